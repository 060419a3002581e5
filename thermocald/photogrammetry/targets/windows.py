"""The pixels about the outlines of circular targets, in arrays of many targets at once.

Only pixels near the outline say where the centre is; those near a code ring are kept out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.targets.blurred_disc import edge_distance
from thermocald.photogrammetry.targets.ring_code import RING_INNER

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Image, Single
    from thermocald.photogrammetry.targets.outline import LocalMap

__all__ = ["Windows", "window_reach", "windows"]

REACH_PX = 4.0
"""Pixels farther from the outline carry nothing about the centre."""
_THIN = 3
_RING_CLEARANCE = 2.6  # standard deviations of the blur between a used pixel and the code ring


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """The pixels about some targets.

    rows (n,) of the targets; pixel (n, k): place in the flat image; origin (n, 2) px; x, y relative
    to it, grey, weight (n, k); k is padded, the padding has weight 0. begin (n, 10): parameters to
    begin with; cut (n,): whether the image's edge cuts the target.
    """

    rows: NDArray[np.int64]
    pixel: NDArray[np.int64]
    origin: Array
    x: Single
    y: Single
    grey: Single
    weight: Single
    begin: Array
    cut: NDArray[np.bool_]

    def thinned(self) -> Windows:
        """The same with every third pixel."""
        x, y, grey, weight = (
            np.ascontiguousarray(a[:, ::_THIN]) for a in (self.x, self.y, self.grey, self.weight)
        )
        return replace(self, x=x, y=y, grey=grey, weight=weight)


def window_reach(blur: float, reach: float = REACH_PX) -> float:
    """How far from the outline pixels are used, px, at a blur of so many px."""
    return max(reach, 4.0 * blur)


def windows(
    image: Image,
    maps: LocalMap,
    coded: NDArray[np.bool_],
    blur: float = 0.9,
    reach: float = REACH_PX,
    chunk_pixels: int = 60_000,
) -> Iterator[Windows]:
    """The pixels near each outline, targets of like size together.

    coded (n,): targets with a code ring, which is kept out at `blur` px.
    """
    height, width = image.shape
    reach_px = window_reach(blur, reach)
    half = np.ceil(maps.half_extent + reach_px).astype(int)
    # Targets of like size and like shape share a window.
    order = np.lexsort((half[:, 0], half.max(axis=1) // 3))
    levels = _background_and_contrast(image, maps)
    sizes = half[order].tolist()
    flat = image.ravel()
    start = 0
    while start < len(order):
        stop, (hx, hy) = start + 1, sizes[start]
        largest = 1.5 * (2 * hx + 1) * (2 * hy + 1)
        while stop < len(order):
            wider, higher = max(hx, sizes[stop][0]), max(hy, sizes[stop][1])
            area = (2 * wider + 1) * (2 * higher + 1)
            if (stop + 1 - start) * area > chunk_pixels or area > largest:
                break
            stop, hx, hy = stop + 1, wider, higher
        rows = order[start:stop]
        start = stop
        part = maps.select(rows)
        ox, oy = np.arange(-hx, hx + 1), np.arange(-hy, hy + 1)
        lx, ly = np.tile(ox, len(oy)), np.repeat(oy, len(ox))
        origin = np.rint(part.centre).astype(np.int64)
        x, y = lx.astype(np.float32), ly.astype(np.float32)
        centre = (part.centre - origin).astype(np.float32)
        d, rho = edge_distance(part.linear, x - centre[:, :1], y - centre[:, 1:])
        use = np.abs(d) <= reach_px  # the ellipse alone is good enough to choose pixels by
        ringed = np.flatnonzero(coded[rows])
        if len(ringed):
            # d = (1 − ρ)/|∇ρ|, so the ring's inner edge is (2 − ρ)/|∇ρ| = d (2 − ρ)/(1 − ρ) away
            rho = rho[ringed]
            with np.errstate(divide="ignore", invalid="ignore"):
                ring = d[ringed] * (RING_INNER - rho) / (1 - rho)
            use[ringed] &= (rho <= 1) | (ring >= _RING_CLEARANCE * blur)
        cut = np.zeros(len(rows), dtype=bool)
        reach_xy = np.array([hx, hy])
        if np.any(origin < reach_xy) or np.any(origin + reach_xy >= (width, height)):
            ix, iy = lx + origin[:, :1], ly + origin[:, 1:]
            inside = (ix >= 0) & (ix < width) & (iy >= 0) & (iy < height)
            cut = np.any(~inside & (d > -2.0), axis=1)
            use &= inside
        count = np.count_nonzero(use, axis=1)
        # The pixels used, moved to the front of each row.
        filled = np.arange(max(int(count.max()), 1)) < count[:, None]
        at = np.zeros(filled.shape, dtype=np.int64)
        at[filled] = np.flatnonzero(use) - np.repeat(np.arange(len(rows)) * use.shape[1], count)
        pixel = (ly * width + lx).take(at)
        pixel += origin[:, 1:] * width + origin[:, :1]
        pixel *= filled
        weight = filled.astype(np.float32)
        grey = flat.take(pixel).astype(np.float32)
        begin = np.zeros((len(rows), 10))
        begin[:, :2] = part.centre
        begin[:, 5] = blur
        begin[:, 6:8] = levels[rows]
        yield Windows(
            rows, pixel, origin.astype(float), x.take(at),
            y.take(at), grey, weight, begin, cut,
        )  # fmt: skip


def _background_and_contrast(image: Image, maps: LocalMap) -> Array:
    """Both (n, 2) DN, from the centre and from eight points a little outside of the outline."""
    turn = np.arange(8) * (np.pi / 4)
    out = 1 + np.minimum(2.5 / maps.semi_axes[:, 1], 0.5)
    around = (maps.linear @ np.stack([np.cos(turn), np.sin(turn)])) * out[:, None, None]
    at = np.concatenate([np.zeros((len(maps), 2, 1)), around], axis=2) + maps.centre[:, :, None]
    high = np.array([image.shape[1] - 1, image.shape[0] - 1])[:, None]
    x, y = np.moveaxis(np.clip(np.rint(at), 0, high).astype(np.int64), 1, 0)
    grey = image[y, x].astype(float)
    background = np.median(grey[:, 1:], axis=1)
    contrast = grey[:, 0] - background
    contrast += np.abs(contrast) < 1
    return np.stack([background, contrast], axis=1)
