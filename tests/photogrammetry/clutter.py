"""Frames full of things that are not coded targets, though some look nearly like them."""

from __future__ import annotations

import cv2
import numpy as np

WIDTH, HEIGHT = 640, 480
FINER = 2


def clutter(seed: int) -> np.ndarray:
    """Draw a frame of ellipses, discs with closed rings, flowers, bars, chessboards, letters."""
    rng = np.random.default_rng(seed)
    image = np.full((HEIGHT * FINER, WIDTH * FINER), int(rng.integers(60, 220)), dtype=np.uint8)
    for _ in range(rng.integers(20, 90)):
        _THINGS[rng.integers(len(_THINGS))](image, rng)
    small = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(small, (0, 0), rng.uniform(0.4, 1.5)).astype(float)
    blurred *= np.linspace(1 - rng.uniform(0, 0.4), 1, WIDTH)
    noise = rng.normal(0, rng.uniform(1, 5), blurred.shape)
    return np.clip(blurred + noise, 0, 255).astype(np.uint8)


def _place(rng) -> tuple[int, int]:
    return int(rng.integers(0, WIDTH * FINER)), int(rng.integers(0, HEIGHT * FINER))


def _grey(rng) -> int:
    return int(rng.integers(0, 256))


def _ellipses(*radii: int):
    """Return a function that draws concentric ellipses in turn in one grey and its negative."""

    def draw(image, rng) -> None:
        at, angle, grey, a = _place(rng), rng.uniform(0, 180), _grey(rng), int(rng.integers(6, 70))
        b = max(3, int(a * rng.uniform(0.4, 1)))
        for i, k in enumerate(radii):
            shade = 255 - grey if i % 2 else grey
            cv2.ellipse(image, at, (k * a, k * b), angle, 0, 360, shade, -1)

    return draw


def _flower(image, rng) -> None:
    (x, y), grey = _place(rng), _grey(rng)
    r, petals = int(rng.integers(6, 70)), int(rng.integers(4, 15))
    cv2.circle(image, (x, y), r, grey, -1)
    for turn in 2 * np.pi * np.arange(petals) / petals:
        at = (int(x + 2.5 * r * np.cos(turn)), int(y + 2.5 * r * np.sin(turn)))
        cv2.circle(image, at, int(r * rng.uniform(0.3, 0.8)), grey, -1)


def _bar(image, rng) -> None:
    cv2.line(image, _place(rng), _place(rng), _grey(rng), int(rng.integers(1, 12)))


def _letters(image, rng) -> None:
    text = "".join(chr(rng.integers(48, 123)) for _ in range(8))
    font, size = int(rng.integers(0, 8)), rng.uniform(0.5, 3)
    cv2.putText(image, text, _place(rng), font, size, _grey(rng), int(rng.integers(1, 8)))


def _chessboard(image, rng) -> None:
    (x, y), grey, size = _place(rng), _grey(rng), int(rng.integers(6, 24))
    for i, j in np.ndindex(6, 6):
        corner = (x + i * size, y + j * size)
        shade = grey if (i + j) % 2 else 255 - grey
        cv2.rectangle(image, corner, (corner[0] + size - 1, corner[1] + size - 1), shade, -1)


_THINGS = (_ellipses(1), _ellipses(3, 2, 1), _flower, _bar, _letters, _chessboard)
