"""A frame's number as 32 black and white bars in its top rows, least significant bit first."""

from __future__ import annotations

import numpy as np

BAR_ROWS = 16


def stamp(image: np.ndarray, number: int) -> np.ndarray:
    """Return a copy with the number's bars."""
    marked = image.copy()
    bar = image.shape[1] // 32
    bits = np.array([(number >> k) & 1 for k in range(32)], np.uint8) * 235 + 10
    marked[:BAR_ROWS, : 32 * bar] = np.repeat(bits, bar)
    return marked


def number_of(image: np.ndarray) -> int:
    """Return the number in the bars."""
    bar = image.shape[1] // 32
    middle = image[4:12, : 32 * bar].reshape(8, 32, bar)[:, :, bar // 4 : bar - bar // 4]
    return sum(int(level > 127) << k for k, level in enumerate(middle.mean(axis=(0, 2))))
