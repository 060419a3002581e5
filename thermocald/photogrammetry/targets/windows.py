"""The pixels about the outlines of circular targets, in arrays of many targets at once.

Only pixels near the outline say where the centre is; those near a code ring are kept out.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

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
_CUT_PX = 2.0  # pixels so near to the outline have to be in the image
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

    def select(self, keep: NDArray[np.int64]) -> Windows:
        """Some of the targets."""
        return Windows(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})

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
    chunk_pixels: int = 120_000,
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
    beyond = np.full((len(maps), 2), reach_px)
    clear = (RING_INNER - 1) * maps.semi_axes[coded] - _RING_CLEARANCE * blur
    beyond[coded] = np.clip(clear, 0.0, reach_px)
    outer, inner = _ellipses(maps, beyond), _ellipses(maps, np.full_like(beyond, -reach_px))
    sizes = half[order].tolist()
    flat = image.ravel()
    start = 0
    while start < len(order):
        stop, (hx, hy) = start + 1, sizes[start]
        largest = 2.0 * (2 * hx + 1) * (2 * hy + 1)
        while stop < len(order):
            wider, higher = max(hx, sizes[stop][0]), max(hy, sizes[stop][1])
            area = (2 * wider + 1) * (2 * higher + 1)
            if (stop + 1 - start) * area > chunk_pixels or area > largest:
                break
            stop, hx, hy = stop + 1, wider, higher
        rows = order[start:stop]
        start = stop
        ox, oy = np.arange(-hx, hx + 1), np.arange(-hy, hy + 1)
        lx, ly = np.tile(ox, len(oy)), np.repeat(oy, len(ox))
        origin = np.rint(maps.centre[rows]).astype(np.int64)
        centre = maps.centre[rows] - origin
        x, y = lx.astype(np.float32), ly.astype(np.float32)
        powers = np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)])
        use = _squared_radius(outer[rows], centre, powers) <= 1.0
        use &= _squared_radius(inner[rows], centre, powers) >= 1.0
        cut = np.zeros(len(rows), dtype=bool)
        reach_xy = np.array([hx, hy])
        if np.any(origin < reach_xy) or np.any(origin + reach_xy >= (width, height)):
            ix, iy = lx + origin[:, :1], ly + origin[:, 1:]
            inside = (ix >= 0) & (ix < width) & (iy >= 0) & (iy < height)
            near = _ellipses(maps.select(rows), np.full((len(rows), 2), _CUT_PX))
            cut = np.any(~inside & (_squared_radius(near, centre, powers) < 1.0), axis=1)
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
        begin[:, :2] = maps.centre[rows]
        begin[:, 5] = blur
        begin[:, 6:8] = levels[rows]
        yield Windows(
            rows, pixel, origin.astype(float), x.take(at),
            y.take(at), grey, weight, begin, cut,
        )  # fmt: skip


def _ellipses(maps: LocalMap, beyond: Array) -> Array:
    """Matrices (n, 2, 2) of ellipses with semi-axes longer by (n, 2) px: eᵀ M e = 1 on the outline,
    zero where nothing is left. The ellipse alone is good enough to choose pixels by.
    """
    axes = maps.semi_axes
    grown = axes + beyond
    left = grown[:, 1] > 0
    value = left[:, None] / np.where(left[:, None], grown, 1.0) ** 2
    # M has the axes of J Jᵀ, so that it is a combination of it and of the identity.
    square = axes * axes
    spread = square[:, 0] - square[:, 1]
    circle = spread < 1e-6 * square[:, 0]
    slope = np.where(circle, 0.0, (value[:, 0] - value[:, 1]) / np.where(circle, 1.0, spread))
    M: Array = slope[:, None, None] * (maps.linear @ np.swapaxes(maps.linear, 1, 2))
    M[:, [0, 1], [0, 1]] += (value[:, 0] - slope * square[:, 0])[:, None]
    return M


def _squared_radius(M: Array, centre: Array, powers: Single) -> Single:
    """eᵀ M e (n, k) at pixels with powers xx, xy, yy, x, y, 1 (6, k), 2 everywhere where M is zero.

    centre (n, 2) px: what e is relative to.
    """
    shift = (M @ centre[:, :, None])[:, :, 0]
    constant = np.where(M[:, 0, 0] > 0, np.sum(shift * centre, axis=1), 2.0)
    by_power = [
        M[:, 0, 0],
        2 * M[:, 0, 1],
        M[:, 1, 1],
        -2 * shift[:, 0],
        -2 * shift[:, 1],
        constant,
    ]
    found: Single = np.stack(by_power, axis=1).astype(np.float32) @ powers
    return found


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
