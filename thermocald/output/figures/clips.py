"""Image clips around one target in the first and the last frame: the eye sees what has moved."""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import ImageError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["clip_png", "cut_clip", "data_uri"]

_LONGEST_SIDE_PX = 480


def cut_clip(path: Path, centre: tuple[float, float], size: int) -> NDArray[np.uint8]:
    """A square of `size` px about `centre` (px), grey; black beyond the image's edge.

    Raises ImageError for what is not an image.
    """
    import cv2

    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror}") from None
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    if image is None:
        raise ImageError(f"{path}: is not an image")
    left, top = (round(v - (size - 1) / 2) for v in centre)
    clip = np.zeros((size, size), dtype=np.uint8)
    height, width = image.shape
    x0, x1 = max(left, 0), min(left + size, width)
    y0, y1 = max(top, 0), min(top + size, height)
    if x0 < x1 and y0 < y1:
        clip[y0 - top : y1 - top, x0 - left : x1 - left] = image[y0:y1, x0:x1]
    return clip


def clip_png(clip: NDArray[np.uint8]) -> bytes:
    """A clip as PNG, enlarged by whole pixels, which stay visible, with a cross at its centre."""
    import cv2

    factor = max(1, _LONGEST_SIDE_PX // len(clip))
    large = cv2.cvtColor(np.kron(clip, np.ones((factor, factor), np.uint8)), cv2.COLOR_GRAY2BGR)
    middle = len(large) // 2
    cv2.line(large, (middle, 0), (middle, len(large)), (0, 94, 213), 1)
    cv2.line(large, (0, middle), (len(large), middle), (0, 94, 213), 1)
    done, png = cv2.imencode(".png", large)
    if not done:
        raise ImageError("an image clip could not be written as PNG")
    return bytes(png.tobytes())


def data_uri(png: bytes) -> str:
    """PNG bytes as the src of an <img>."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")
