"""Circles found in a frame without prior knowledge.

A frame is thresholded against its local mean, so that uneven light does no harm; contours that are
ellipses are candidates. What they are is for others to say (`ring_code`, `orientation`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from thermocald.arrays import scratch
from thermocald.photogrammetry.targets.outline import LocalMap, from_ellipses

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array


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
    e = _ellipses(contours, 4 * _LARGEST_SHARE * small.shape[1])
    # The reduced image covers the whole one: (x + ½) grows with the true ratio of the sizes.
    ratio = np.array([image.shape[1] / small.shape[1], image.shape[0] / small.shape[0]])
    centre = (e[:, :2] + 0.5) * ratio - 0.5
    # A contour runs through pixel centres, half a pixel inside of the outline.
    return Candidates(
        from_ellipses(centre, scale * (e[:, 2:4] + 0.5), e[:, 4]),
        np.full(len(e), polarity, dtype=np.int64),
    )


def _ellipses(contours: Sequence[Any], longest: float) -> Array:
    """Ellipses x, y, a, b, angle (n, 5) of those contours that are ellipses, to a pixel's raster
    and 3 %: with the contour's own moments. longest: most pixels of a contour.
    """
    used = [c for c in contours if _FEWEST_CONTOUR_POINTS <= len(c) <= longest]
    if not used:
        return np.zeros((0, 5))
    count = np.array([len(c) for c in used])
    first = np.cumsum(count) - count
    which = np.repeat(np.arange(len(used)), count)
    points = np.concatenate(used)[:, 0].T.astype(float)
    begin = points[:, first]
    points -= begin[:, which]
    area, length, centre, (xx, xy, yy) = _moments(points, first, count)
    mean, difference = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    # The semi-axes of an ellipse are twice the roots of its principal moments.
    a, b = (2 * np.sqrt(np.maximum(mean + sign * difference, 1e-6)) for sign in (1, -1))
    angle = np.arctan2(2 * xy, xx - yy) / 2
    ellipse = np.pi * a * b
    keep = (
        (area * 4 * np.pi >= _COMPACTNESS * length**2)
        & (np.abs(area - ellipse) < _AREA_TOLERANCE * ellipse + 3.0)
        & (2 * b >= _SMALLEST_AXIS)
        & (2 * a + 1 <= _LARGEST_AXIS_RATIO * (2 * b + 1))
    )
    # How far the contour is from the ellipse, in the plane where that is the unit circle
    c, s = np.cos(angle), np.sin(angle)
    axes = np.stack([c / a, s / a, -s / b, c / b])[:, which]
    dx, dy = points - centre[:, which]
    u, v = axes[0] * dx + axes[1] * dy, axes[2] * dx + axes[3] * dy
    off = np.bincount(which, np.abs(np.sqrt(u * u + v * v) - 1)) / count
    keep &= off < _RADIUS_TOLERANCE + 0.35 / b
    found: Array = np.stack([*(centre + begin), a, b, angle], axis=1)[keep]
    return found


def _moments(
    points: Array, first: NDArray[np.int64], count: NDArray[np.int64]
) -> tuple[Array, Array, Array, tuple[Array, Array, Array]]:
    """Of n polygons: area (positive for outlines, negative for holes), length, centre (2, n), and
    second moments xx, xy, yy about it, each divided by the area (Green's theorem).

    points (2, k): one polygon after the other, from `first` on, `count` of each.
    """
    after = np.arange(1, points.shape[1] + 1)
    after[first + count - 1] = first
    (x, y), (x1, y1) = points, points[:, after]
    cross = x1 * y - x * y1

    def integral(values: Array) -> Array:
        total: Array = np.add.reduceat(values, first)
        return total

    area = integral(cross) / 2
    length = integral(np.hypot(x1 - x, y1 - y))
    per_area = 1 / np.where(area == 0, 1.0, area)
    cx, cy = (integral((p + p1) * cross) / 6 * per_area for p, p1 in ((x, x1), (y, y1)))
    xx, yy = (integral((p * (p + p1) + p1 * p1) * cross) / 12 for p, p1 in ((x, x1), (y, y1)))
    xy = integral((2 * (x * y + x1 * y1) + x * y1 + x1 * y) * cross) / 24
    about = (xx * per_area - cx * cx, xy * per_area - cx * cy, yy * per_area - cy * cy)
    return area, length, np.stack([cx, cy]), about
