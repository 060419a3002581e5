"""The outline of a circular target in the image, and the window of pixels around it.

A local map takes the unit disc in the target's plane to pixels. It is a polynomial of second order
about the projected centre, F(q) = c + J q + ½ H[q, q] with q = (s, t). J gives the ellipse. H gives
the eccentricity, by which the centre of the outline differs from the projected centre, from the
perspective and from the variation of the distortion across the target. Terms of third order are
odd: they change the outline symmetrically and do not move the centre.

Only pixels near the outline determine the centre; those near a code ring are excluded. To find
circles without prior knowledge, the frame is thresholded against its local mean, so that uneven
light does no harm. Contours that are ellipses are candidates, which `ring_code` or `orientation`
identify.

Source: the eccentricity as Luhmann, T. (2014): Eccentricity in images of circular and spherical
targets and its impact on spatial intersection, Photogrammetric Record 29(148), 417–433; here it is
not a correction to an ellipse but part of the outline, and thus includes the distortion.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from thermocald.arrays import Array, Image, Single, scratch
from thermocald.photogrammetry.camera.camera_model import Sensor, project
from thermocald.photogrammetry.linalg import inverse_2x2

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray


RING_INNER = 2.0
"""Inner radius of the ring of a coded target, in radii of its disc."""
RING_OUTER = 3.0
"""Outer radius of the ring, in radii of the disc; around it is background."""


@dataclass(frozen=True, slots=True, eq=False)
class LocalMap:
    """n maps of the unit disc.

    centre (n, 2) px; linear (n, 2, 2) px; second (n, 2, 3) px: second derivatives by ss, st, tt.
    """

    centre: Array
    linear: Array
    second: Array

    def __len__(self) -> int:
        return len(self.centre)

    def select(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> LocalMap:
        """Return some of the maps, by mask or rows."""
        return LocalMap(self.centre[keep], self.linear[keep], self.second[keep])

    @classmethod
    def none(cls) -> LocalMap:
        """Return no maps."""
        return cls(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 2, 3)))

    def at(self, centre: Array) -> LocalMap:
        """Return maps of the same shapes about other centres (n, 2) px."""
        return LocalMap(centre, self.linear, self.second)

    @property
    def inverse(self) -> Array:
        """The inverses (n, 2, 2) of the linear parts, 1/px."""
        return inverse_2x2(self.linear)

    @property
    def semi_axes(self) -> Array:
        """The semi-axes (n, 2) of the ellipses, px, the major one first."""
        # in closed form, as `inverse_2x2`
        a, b, c, d = (self.linear[:, i, k] for i in (0, 1) for k in (0, 1))
        mean, difference = np.hypot(a + d, b - c) / 2, np.hypot(a - d, b + c) / 2
        return np.stack([mean + difference, np.abs(mean - difference)], axis=1)

    @property
    def half_extent(self) -> Array:
        """Half the width and height (n, 2) of the ellipses' bounding boxes, px."""
        extent: Array = np.linalg.norm(self.linear, axis=2)
        return extent


def facing(centre: Array, points: Array, normals: Array) -> tuple[Array, Array]:
    """Return normals (n, 3) of targets at points (n, 3), and cosines (n,) to the lines of sight.

    centre (3,): of the camera. An unknown normal (NaN) is replaced by one that faces the camera.
    """
    view = centre - points
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    normals = np.where(np.isfinite(normals), normals, view)
    return normals, np.abs(np.sum(view * normals, axis=1))


def local_maps(
    sensor: Sensor, iop: Array, eop: Array, points: Array, normals: Array, radii: Array
) -> LocalMap:
    """Return the maps of targets at points (n, 3) mm with normals (n, 3) and radii (n,) mm.

    iop (10,), eop (6,). NaN for targets not in front of the camera. Derivatives are differences
    over the target's radius, so that they hold for its outline and not only for its centre.
    """
    # two radii that span each target's plane
    across = np.cross(np.eye(3)[np.argmin(np.abs(normals), axis=1)], normals)
    e1 = across * (radii / np.linalg.norm(across, axis=1))[:, None]
    e2 = np.cross(normals, e1)
    offsets = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)]
    around = np.concatenate([points + s * e1 + t * e2 for s, t in offsets])
    f = project(sensor, iop, eop, around).reshape(len(offsets), -1, 2)
    linear = np.stack([f[1] - f[2], f[3] - f[4]], axis=-1) / 2
    second = np.stack(
        [f[1] + f[2] - 2 * f[0], (f[5] + f[6] - f[7] - f[8]) / 4, f[3] + f[4] - 2 * f[0]], axis=-1
    )
    return LocalMap(f[0], linear, second)


_REACH_PX = 4.0  # pixels farther from the outline do not depend on the centre
_THIN = 3
_CHUNK_PIXELS = 80_000  # of the windows that are processed together
_CUT_PX = 2.0  # pixels this near to the outline must be in the image
_RING_CLEARANCE = 2.6  # standard deviations of the blur between a used pixel and the code ring


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """The pixels around some targets.

    rows (n,): of the targets; pixel (n, k): index in the flat image; origin (n, 2) px; x, y
    (relative to the origin), grey, weight (n, k), padded with weight 0; begin (n, 10): approximate
    parameters; cut (n,): whether the image's edge cuts the target.
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
        """Return the windows of some of the targets."""
        return Windows(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def thinned(self) -> Windows:
        """Return the windows with every third pixel only."""
        x, y, grey, weight = (
            np.ascontiguousarray(a[:, ::_THIN]) for a in (self.x, self.y, self.grey, self.weight)
        )
        return replace(self, x=x, y=y, grey=grey, weight=weight)


def windows(
    image: Image, maps: LocalMap, coded: NDArray[np.bool_], blur: float = 0.9
) -> Iterator[Windows]:
    """Yield the windows of targets of similar size, with the pixels near each outline.

    coded (n,): targets with a code ring, whose pixels are excluded for a blur of `blur` px.
    """
    height, width = image.shape
    reach_px = max(_REACH_PX, 4.0 * blur)
    levels = _background_and_contrast(image, maps)
    beyond = np.full((len(maps), 2), reach_px)
    clear = (RING_INNER - 1) * maps.semi_axes[coded] - _RING_CLEARANCE * blur
    beyond[coded] = np.clip(clear, 0.0, reach_px)
    outer = _grown_ellipses(maps, beyond)
    inner = _grown_ellipses(maps, np.full_like(beyond, -reach_px))
    near = _grown_ellipses(maps, np.full_like(beyond, _CUT_PX))
    flat = image.ravel()
    for rows, hx, hy in _alike(np.ceil(maps.half_extent + reach_px).astype(int)):
        ox, oy = np.arange(-hx, hx + 1), np.arange(-hy, hy + 1)
        lx, ly = np.tile(ox, len(oy)), np.repeat(oy, len(ox))
        origin = np.rint(maps.centre[rows]).astype(np.int64)
        centre = maps.centre[rows] - origin
        x, y = lx.astype(np.float32), ly.astype(np.float32)
        powers = np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)])
        use = _squared_radius(outer[rows], centre, powers) <= 1.0
        use &= _squared_radius(inner[rows], centre, powers) >= 1.0
        cut, edge = np.zeros(len(rows), dtype=bool), np.array([hx, hy])
        if (origin < edge).any() or (origin + edge >= (width, height)).any():
            ix, iy = lx + origin[:, :1], ly + origin[:, 1:]
            inside = (ix >= 0) & (ix < width) & (iy >= 0) & (iy < height)
            cut = np.any(~inside & (_squared_radius(near[rows], centre, powers) < 1.0), axis=1)
            use &= inside
        count = np.count_nonzero(use, axis=1)
        # the pixels used, moved to the front of each row
        filled = np.arange(max(int(count.max()), 1)) < count[:, None]
        at = np.zeros(filled.shape, dtype=np.int64)
        at[filled] = np.flatnonzero(use) - np.repeat(np.arange(len(rows)) * use.shape[1], count)
        pixel = ((ly * width + lx).take(at) + (origin @ (1, width))[:, None]) * filled
        grey = flat.take(pixel).astype(np.float32)
        begin = np.zeros((len(rows), 10))
        begin[:, :2] = maps.centre[rows]
        begin[:, 5] = blur
        begin[:, 6:8] = levels[rows]
        yield Windows(
            rows, pixel, origin.astype(float), x.take(at), y.take(at), grey,
            filled.astype(np.float32), begin, cut,
        )  # fmt: skip


def _alike(half: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], int, int]]:
    """Yield the rows of targets with windows of similar size, and half its width and height, px.

    half (n, 2) px: half the extent of each target's own window.
    """
    order = np.lexsort((half[:, 0], half.max(axis=1) // 3))
    sizes = half[order].tolist()
    start = 0
    while start < len(order):
        stop, (hx, hy) = start + 1, sizes[start]
        largest = 2.0 * (2 * hx + 1) * (2 * hy + 1)
        while stop < len(order):
            wider, higher = max(hx, sizes[stop][0]), max(hy, sizes[stop][1])
            area = (2 * wider + 1) * (2 * higher + 1)
            if (stop + 1 - start) * area > _CHUNK_PIXELS or area > largest:
                break
            stop, hx, hy = stop + 1, wider, higher
        yield order[start:stop], hx, hy
        start = stop


def _grown_ellipses(maps: LocalMap, beyond: Array) -> Array:
    """Return matrices M (n, 2, 2) of ellipses with semi-axes longer by (n, 2) px.

    eᵀ M e is 1 on the outline; M is zero if an axis vanishes. To choose pixels, the ellipse without
    the eccentricity is good enough.
    """
    squares, axes = np.linalg.eigh(maps.linear @ np.swapaxes(maps.linear, 1, 2))  # minor first
    grown = np.sqrt(np.maximum(squares, 0.0)) + beyond[:, ::-1]
    left = grown[:, :1] > 0
    value = left / np.where(left, grown, 1.0) ** 2
    M: Array = (axes * value[:, None]) @ np.swapaxes(axes, 1, 2)
    return M


def _squared_radius(M: Array, centre: Array, powers: Single) -> Single:
    """Return eᵀ M e (n, k), e relative to the centres (n, 2) px, or 2 if M is zero.

    powers (6, k): xx, xy, yy, x, y, 1 of the pixels.
    """
    shift = (M @ centre[:, :, None])[:, :, 0]
    constant = np.where(M[:, 0, 0] > 0, np.sum(shift * centre, axis=1), 2.0)
    by_power = [M[:, 0, 0], 2 * M[:, 0, 1], M[:, 1, 1], *(-2 * shift.T), constant]
    return np.stack(by_power, axis=1).astype(np.float32) @ powers


def _background_and_contrast(image: Image, maps: LocalMap) -> Array:
    """Return both (n, 2) DN, from the centre and eight points a little outside the outline."""
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


_BLOCK_SHARE = 1 / 40  # of the image's width: the window of the local mean
_SMALLEST_BLOCK = 25
_OFFSET_DN = 6.0
_FEWEST_CONTOUR_POINTS = 8
_LARGEST_SHARE = 0.12  # of the image's width
_COMPACTNESS = 0.5
_AREA_TOLERANCE = 0.12
_RADIUS_TOLERANCE = 0.03
_SMALLEST_AXIS = 1.5
_MOMENTS = ("m00", "m10", "m01", "mu20", "mu11", "mu02")
_LARGEST_AXIS_RATIO = 3.2  # an obliqueness of 60°, and some perspective


def find_circles(image: NDArray[np.uint8], scale: int = 1, polarity: int = -1) -> LocalMap:
    """Find ellipses of one polarity (-1 dark on light, 1 light on dark) in an image (H, W).

    Their centres are good to about 0.1 px. scale: the image is searched at 1/scale of its size;
    ellipses less than about six px across at this size are not found.
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
    # the reduced image covers the original: (x + ½) scales by the true ratio of the sizes
    ratio = np.array([image.shape[1] / small.shape[1], image.shape[0] / small.shape[0]])
    centre = (e[:, :2] + 0.5) * ratio - 0.5
    # a contour goes through pixel centres, half a pixel inside the outline
    (a, b), c, s = scale * (e[:, 2:4].T + 0.5), np.cos(e[:, 4]), np.sin(e[:, 4])
    linear = np.stack([a * c, -b * s, a * s, b * c], axis=1).reshape(-1, 2, 2)
    return LocalMap(centre, linear, np.zeros((len(e), 2, 3)))


def _ellipses(contours: Sequence[Any], longest: float) -> Array:
    """Return ellipses x, y, a, b, angle (n, 5) of the contours that are ellipses.

    An ellipse has the contour's moments; it must fit to the raster of pixels and 3 %. longest:
    most pixels of a contour.
    """
    used = [
        c
        for c in contours
        if _FEWEST_CONTOUR_POINTS <= len(c) <= longest
        # compact; the area is positive for outlines, negative for holes
        and -4 * np.pi * cv2.contourArea(c, oriented=True)
        >= _COMPACTNESS * cv2.arcLength(c, closed=True) ** 2
    ]
    if not used:
        return np.zeros((0, 5))
    count = np.array([len(c) for c in used])
    which = np.repeat(np.arange(len(used)), count)
    points = np.concatenate(used)[:, 0].T.astype(float)
    area, *moments = np.array([itemgetter(*_MOMENTS)(cv2.moments(c)) for c in used]).T
    *centre, xx, xy, yy = moments / area
    mean, difference = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    # the semi-axes of an ellipse are twice the roots of its principal moments
    a, b = (2 * np.sqrt(np.maximum(mean + sign * difference, 1e-6)) for sign in (1, -1))
    angle = np.arctan2(2 * xy, xx - yy) / 2
    ellipse = np.pi * a * b
    keep = (
        (np.abs(area - ellipse) < _AREA_TOLERANCE * ellipse + 3.0)
        & (2 * b >= _SMALLEST_AXIS)
        & (2 * a + 1 <= _LARGEST_AXIS_RATIO * (2 * b + 1))
    )
    # distance of the contour from the ellipse, in the plane where that is the unit circle
    c, s = np.cos(angle), np.sin(angle)
    axes = np.stack([c / a, s / a, -s / b, c / b])[:, which]
    dx, dy = points - np.stack(centre)[:, which]
    u, v = axes[0] * dx + axes[1] * dy, axes[2] * dx + axes[3] * dy
    off = np.bincount(which, np.abs(np.sqrt(u * u + v * v) - 1)) / count
    keep &= off < _RADIUS_TOLERANCE + 0.35 / b
    ellipses: Array = np.stack([*centre, a, b, angle], axis=1)[keep]
    return ellipses
