"""Circles found in a frame without prior knowledge.

A frame is thresholded against its local mean, so that uneven light does no harm; contours that are
ellipses are candidates. What they are is for others to say (`ring_reading`, `identification`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from thermocald.photogrammetry.targets.outline import LocalMap, from_ellipses
from thermocald.photogrammetry.targets.scratch import scratch

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array

__all__ = ["Candidates", "find_circles"]

_BLOCK_SHARE = 1 / 40  # of the image's width: the neighbourhood of the local mean, full size
_SMALLEST_BLOCK = 25
_OFFSET_DN = 6.0
_FEWEST_CONTOUR_POINTS = 8
_LARGEST_SHARE = 0.12  # of the image's width
_COMPACTNESS = 0.5
_AREA_TOLERANCE = 0.12
_RADIUS_TOLERANCE = 0.03
_SMALLEST_AXIS = 1.5
_LARGEST_AXIS_RATIO = 3.2  # 60° obliqueness and then some perspective


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """n ellipses: maps (centre to some 0.1 px), and polarity (n,): -1 dark on light, 1 reverse."""

    maps: LocalMap
    polarity: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.polarity)


def find_circles(image: NDArray[np.uint8], scale: int = 1, polarity: int = -1) -> Candidates:
    """Ellipses of one kind (dark on light -1, light on dark 1) in an image (H, W).

    scale: the image is searched at 1/scale of its size; ellipses with less than some six px across
    there are not found.
    """
    small = image
    if scale > 1:
        size = (image.shape[1] // scale, image.shape[0] // scale)
        small = scratch("small", size[::-1], np.uint8)
        cv2.resize(image, size, dst=small, interpolation=cv2.INTER_AREA)
    block = max(int(image.shape[1] * _BLOCK_SHARE / scale), _SMALLEST_BLOCK) | 1
    mask = scratch("mask", small.shape, np.uint8)
    cv2.blur(small, (block, block), dst=mask, borderType=cv2.BORDER_REPLICATE)
    first, second = (mask, small) if polarity < 0 else (small, mask)
    cv2.subtract(first, second, dst=mask)
    cv2.threshold(mask, _OFFSET_DN, 255, cv2.THRESH_BINARY, dst=mask)
    contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    longest = 4 * _LARGEST_SHARE * small.shape[1]
    found, outlines = [], []
    for contour in contours:
        if not _FEWEST_CONTOUR_POINTS <= len(contour) <= longest:
            continue
        # Outlines have a negative, holes a positive oriented area.
        area = -cv2.contourArea(contour, oriented=True)
        if area * 4 * np.pi < _COMPACTNESS * cv2.arcLength(contour, True) ** 2:
            continue
        (x, y), (width, height), angle = cv2.fitEllipseDirect(contour)
        ellipse = np.pi / 4 * width * height
        if (
            abs(area - ellipse) < _AREA_TOLERANCE * ellipse + 3.0
            and min(width, height) >= _SMALLEST_AXIS
            and max(width, height) + 1 <= _LARGEST_AXIS_RATIO * (min(width, height) + 1)
        ):
            found.append((x, y, width / 2, height / 2, np.radians(angle)))
            outlines.append(contour)
    e = np.array(found, dtype=float).reshape(-1, 5)
    e = e[_are_ellipses(outlines, e)]
    # The reduced image covers the whole one: (x + ½) grows with the true ratio of the sizes.
    ratio = np.array([image.shape[1] / small.shape[1], image.shape[0] / small.shape[0]])
    centre = (e[:, :2] + 0.5) * ratio - 0.5
    # A contour runs through pixel centres, half a pixel inside of the outline.
    return Candidates(
        from_ellipses(centre, scale * (e[:, 2:4] + 0.5), e[:, 4]),
        np.full(len(e), polarity, dtype=np.int64),
    )


def _are_ellipses(contours: list[Any], e: Array) -> NDArray[np.bool_]:
    """Which contours keep to their ellipses (x, y, a, b, angle), to a pixel's raster and 3 %."""
    if not contours:
        return np.zeros(0, dtype=bool)
    count = np.array([len(c) for c in contours])
    which = np.repeat(np.arange(len(contours)), count)
    a, b, angle = e[:, 2:].T
    c, s = np.cos(angle), np.sin(angle)
    # to the plane of the unit circle, by what is the same for all points of a contour
    axes = np.stack([c / a, s / a, -s / b, c / b], axis=1).astype(np.float32)[which].T
    points = np.concatenate(contours)[:, 0] - e[:, :2].astype(np.float32)[which]
    dx, dy = points.astype(np.float32).T
    u, v = axes[0] * dx + axes[1] * dy, axes[2] * dx + axes[3] * dy
    off = np.bincount(which, np.abs(np.sqrt(u * u + v * v) - 1)) / count
    keeps: NDArray[np.bool_] = off < _RADIUS_TOLERANCE + 0.35 / np.minimum(a, b)
    return keeps
