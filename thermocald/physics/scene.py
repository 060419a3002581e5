"""Rendered frames: the grey values of a test field in a camera.

Every target's outline is projected with distortion, filled by its exact area coverage of half
pixels, blurred by a Gaussian, averaged over pixels, darkened towards the corners, given noise, and
rounded to 8 bit. If the blur worked on the pixel grid itself, edges along rows or columns would be
up to 0.02 px off, depending on their place in a pixel, which no lens does.

A frame is the same on every machine, but for single pixels by 1 DN in one of some hundred frames:
positions are rounded, since mathematical libraries differ in their last bits; the noise comes from
PCG64's raw bits through integer tables; the rest is fixed-point with 6 fractional bits, always odd,
so that no value is half-way when rounded.

Source: blur, vignetting and noise as in Luhmann, T. et al. (2014): Close-Range Photogrammetry and
3D Imaging, 2nd ed., chapter 3; vignetting is the first term of the cos⁴ law.

The area coverage is the share of each half pixel, a cell, inside polygons. Every edge is cut at the
cells' borders. A piece inside a cell adds the area to its right to this cell, and its height to all
cells further right, which one running sum along the rows turns into coverage. Nothing is sampled.
Shapes are filled in windows of their own, several small ones at once.

Source: the signed-area accumulation of scan converters, e.g. FreeType's smooth rasteriser.

The outlines of discs, coded rings and markers are polygons in the target's plane that move with the
target.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.field.planes import plane_fit, target_normals
from thermocald.photogrammetry.targets import outline, ring_code
from thermocald.photogrammetry.targets.markers import marker_cells, marker_rows

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.field.testfield import TestField

    Integers = NDArray[np.int64]
    _Polygon = tuple[float, Array, Array]  # sign, weights (k, 4), offset (k, 3)

_CIRCLE_EDGES = 96
_EDGES_PER_MODULE = 3  # as the distortion bends a straight edge


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """The outline of a disc or a marker: polygons in its plane that move with its targets.

    A vertex is weights × points of the targets + offset. targets: four rows of the test field, the
    first of which tells where the shape is; normal (3,): of the plane, towards the viewer; weights
    (v, 4), offset (v, 3) mm; following (v,): the next vertex of the same polygon; sign (v,): +1 for
    ink, -1 for paper in it.
    """

    targets: list[int]
    normal: Array
    weights: Array
    offset: Array
    following: Integers
    sign: Array

    @classmethod
    def of(cls, targets: list[int], normal: Array, polygons: Sequence[_Polygon]) -> Shape:
        """Return the shape of polygons."""
        sign, weights, offset = zip(*polygons, strict=True)
        sizes = np.array([len(w) for w in weights])
        following = np.arange(sizes.sum()) + 1
        following[np.cumsum(sizes) - 1] -= sizes
        return cls(
            targets, normal, np.concatenate(weights), np.concatenate(offset), following,
            np.repeat(np.array(sign), sizes),
        )  # fmt: skip

    def vertices(self, points: Array) -> Array:
        """Return the vertices (v, 3) mm for targets at points (n, 3) mm."""
        return self.offset + self.weights @ points[self.targets]


def surface_normals(field: TestField) -> Array:
    """Return the unit normals (n, 3) of the targets' planes; their sign is arbitrary.

    A target on no board has the normal of the plane through all targets.
    """
    normals = target_normals(field.points)
    if len(field) < 3:
        normals[:] = (0.0, 0.0, 1.0)
    normals[np.isnan(normals[:, 0])] = plane_fit(field.points)[1][2]
    # rounded, as the last bits of the decomposition differ between machines
    return np.round(normals, 9)


def _lay_arc(turns: Array) -> Array:
    angles = 2.0 * np.pi * turns
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _disc_polygons(diameter: float, code: str) -> list[Array]:
    """Return the outlines (k, 2) mm of a plain or ring-coded disc, as (right, down)."""
    angle = 2.0 * np.pi / _CIRCLE_EDGES
    # so that the polygon has the circle's area
    radius = 0.5 * diameter * float(np.round(np.sqrt(angle / np.sin(angle)), 12))
    disc = radius * _lay_arc(np.arange(_CIRCLE_EDGES) / _CIRCLE_EDGES)
    polygons = [disc]
    if ring_code.is_ring(code):
        for begin, end in ring_code.segments(*ring_code.parse(code)):
            turns = np.linspace(begin, end, max(3, round((end - begin) * _CIRCLE_EDGES) + 1))
            arc = _lay_arc(turns)
            polygons.append(
                radius * np.concatenate([outline.RING_OUTER * arc, outline.RING_INNER * arc[::-1]])
            )
    return polygons


@lru_cache(maxsize=1024)
def _marker_polygons(dictionary: str, marker: int) -> tuple[tuple[float, Array], ...]:
    """Return a marker's polygons: sign, outline (k, 2) in sides from corner 0 to 1 and 0 to 3."""
    pattern = ~marker_cells(dictionary, marker)
    modules = len(pattern)
    result = [(1.0, _lay_box(0, 0, modules, modules) / modules)]
    for y, row in enumerate(pattern.astype(int)):
        ends = np.flatnonzero(np.diff(row, prepend=0, append=0)).reshape(-1, 2)
        result += [(-1.0, _lay_box(x0, y, x1, y + 1) / modules) for x0, x1 in ends.tolist()]
    return tuple(result)


def _lay_box(x0: int, y0: int, x1: int, y1: int) -> Array:
    sides = []
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        steps = (abs(bx - ax) + abs(by - ay)) * _EDGES_PER_MODULE
        t = np.arange(steps) / steps
        sides.append(np.stack([ax + (bx - ax) * t, ay + (by - ay) * t], axis=1))
    return np.concatenate(sides)


def outlines(field: TestField, normals: Array) -> Iterator[Shape]:
    """Yield the outline of each disc, and then of each marker; normals (n, 3) point at the viewer.

    Circles without a diameter and markers without all four corners are left out.
    """
    for i, (kind, code) in enumerate(zip(field.kinds, field.codes, strict=True)):
        if kind == "circle" and field.diameters[i] > 0:
            # right and down in the plane, for a viewer at whom the normal points
            up = normals[i]
            helper = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.7 else np.array([0.0, 1.0, 0.0])
            right = np.cross(helper, up)
            right = right / np.sqrt(right[0] * right[0] + right[1] * right[1] + right[2] * right[2])
            down = -np.cross(up, right)
            polygons = [
                (1.0, np.eye(4)[[0] * len(p)], p[:, :1] * right + p[:, 1:] * down)
                for p in _disc_polygons(float(field.diameters[i]), code)
            ]
            yield Shape.of([i] * 4, up, polygons)
    for dictionary, rows in marker_rows(field).items():
        for marker in dict.fromkeys(number for number, _ in rows):
            order = [rows[marker, k] for k in range(4) if (marker, k) in rows]
            if len(order) < 4:
                continue
            polygons = []
            for sign, polygon in _marker_polygons(dictionary, marker):
                u, v = polygon.T
                weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=1)
                polygons.append((sign, weights, np.zeros((len(u), 3))))
            a, b, _, d = field.points[order]
            # corners run clockwise for the viewer, so that right × down points away from the viewer
            yield Shape.of(order, -np.cross(b - a, d - a), polygons)


_FINER = 2  # cells in a pixel, along both axes
_AT_ONCE = 20_000  # px of the windows that are filled at once


def _cut_edges(a: Array, b: Array, axis: int) -> tuple[Array, Array, Integers, Integers]:
    """Cut edges a → b (n, 2) at integers of an axis; return each piece's a, b, cell and edge."""
    fa = np.floor(a[:, axis]).astype(np.int64)
    fb = np.floor(b[:, axis]).astype(np.int64)
    pieces = np.abs(fb - fa) + 1
    edge = np.repeat(np.arange(len(a)), pieces)
    j = np.arange(len(edge)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    rising = (fb >= fa)[edge]
    cell = np.where(rising, fa[edge] + j, fa[edge] - j)
    begin, along = a[edge], (b - a)[edge]
    length = np.where(along[:, axis] != 0.0, along[:, axis], 1.0)
    # where the edge enters and leaves the cell, as shares of its length
    enters = (np.where(rising, cell, cell + 1) - begin[:, axis]) / length
    leaves = (np.where(rising, cell + 1, cell) - begin[:, axis]) / length
    first, last = np.where(j > 0, enters, 0.0), np.where(j < pieces[edge] - 1, leaves, 1.0)
    return begin + first[:, None] * along, begin + last[:, None] * along, cell, edge


def average(cells: NDArray[np.float32], kernel: Array, axis: int) -> NDArray[np.float32]:
    """Average cells along one axis to half as many pixels, with a symmetric kernel of even length.

    The margins must hold zeros.
    """
    n, k = len(kernel) // 2, kernel.astype(np.float32)
    moved = np.moveaxis(cells, axis, 0)
    half = moved[0::2], moved[1::2]
    out = half[0] + half[1]
    out *= k[n]
    part = np.empty_like(out)
    for d in range(1, n):
        # pixel r: cells 2r - d and 2r + 1 + d
        reach, odd = (d + 1) // 2, d % 2
        end = len(out) - reach
        inner = part[reach:end]
        np.add(half[odd][: end - reach], half[1 - odd][2 * reach :], out=inner)
        inner *= k[n + d]
        out[reach:end] += inner
    return np.moveaxis(out, 0, axis)


def cover(
    shapes: Sequence[Shape], vertices: Sequence[Array], kernel: Array, width: int, height: int
) -> NDArray[np.float32]:
    """Return the blurred coverage (k, height, width) by shapes, each in its own window.

    vertices: of each shape (v, 2) px from its window's corner, running clockwise in the image (y
    down) where ink is added; kernel: of `average`.
    """
    a = np.concatenate(vertices)
    b = np.concatenate([v[s.following] for s, v in zip(shapes, vertices, strict=True)])
    a1, b1, cy, edge1 = _cut_edges(_FINER * a, _FINER * b, 1)
    a2, b2, cx, edge2 = _cut_edges(a1, b1, 0)
    edge, own = edge1[edge2], np.repeat(np.arange(len(shapes)), list(map(len, vertices)))
    dy = (b2[:, 1] - a2[:, 1]) * np.concatenate([s.sign for s in shapes])[edge]
    right = 0.5 * (a2[:, 0] + b2[:, 0]) - cx
    rows, columns = _FINER * height, _FINER * width
    size = len(shapes) * rows * columns
    # the row is that of the first cut: rounding in the second one cannot change it
    cell = (own[edge] * rows + cy[edge2]) * columns + cx
    # the signed coverage of the cell to the left minus that of each cell
    steps = np.bincount(cell, dy * (1.0 - right), size)
    steps += np.bincount(cell + 1, dy * right, size + 1)[:-1]
    cells = average(steps.reshape(-1, rows, columns).astype(np.float32), kernel, 1)
    # each row sums to 0: a running sum over all rows is a running sum over each
    inked = -np.cumsum(cells.reshape(len(shapes), -1), axis=1, dtype=np.float64)
    return average(inked.reshape(cells.shape).astype(np.float32), kernel, 2)


_FRACTION = 64  # fixed-point steps per DN


@dataclass(frozen=True, slots=True)
class Look:
    """The look of frames: grey values and optics.

    Paper and ink DN, blur (Gaussian sigma) px, noise sigma DN; vignetting: share of light lost at
    the image corners.
    """

    paper_dn: float = 200.0
    ink_dn: float = 30.0
    blur_px: float = 0.8
    noise_dn: float = 2.0
    vignetting: float = 0.15


@lru_cache(maxsize=2)
def _compute_gain(sensor: Sensor, vignetting: float) -> NDArray[np.float32]:
    """Return the transmitted share of light (H, W), 1 - v (r / r_corner)²."""
    cx, cy = (sensor.width - 1) / 2, (sensor.height - 1) / 2
    x2 = (np.arange(sensor.width) - cx) ** 2
    y2 = (np.arange(sensor.height) - cy) ** 2
    share = vignetting / (cx * cx + cy * cy)
    return (1.0 - share * (y2[:, None] + x2[None, :])).astype(np.float32)


@lru_cache(maxsize=2)
def _draw_paper(sensor: Sensor, paper_dn: float, vignetting: float) -> NDArray[np.int16]:
    """Return the empty scene in fixed point, even numbers."""
    half = np.float32(paper_dn * _FRACTION / 2)
    fixed: NDArray[np.int16] = np.rint(_compute_gain(sensor, vignetting) * half).astype(np.int16)
    return fixed + fixed


@lru_cache(maxsize=8)
def _make_noise_tables(sigma_dn: float) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Make two tables (256,); their sum for two random bytes is normal with this sigma, and odd."""
    from scipy.special import ndtri

    quantiles = ndtri((np.arange(256) + 0.5) / 256)
    quantiles *= sigma_dn * _FRACTION / np.sqrt(2.0) / float(np.std(quantiles))
    even = 2 * np.rint(quantiles / 2).astype(np.int16)
    # symmetric about 0 in steps of 2: half a step above, half below
    odd = 2 * np.floor(quantiles / 2).astype(np.int16) + 1
    return even, odd


class Scene:
    """A test field to be rendered; stores what does not change between frames."""

    def __init__(self, sensor: Sensor, field: TestField, look: Look | None = None) -> None:
        self.sensor = sensor
        self.field = field
        self.look = look or Look()
        self._normals = surface_normals(field)
        self._facing: NDArray[np.bool_] | None = None
        self._outlines: list[Shape] = []

    def _shapes(self, centre: Array) -> list[Shape]:
        """Return the outlines seen from a point (3,) mm; its side sets the sense of ring codes."""
        facing = np.sum(self._normals * (centre - self.field.points), axis=1) > 0
        if self._facing is None or not np.array_equal(facing, self._facing):
            self._facing = facing
            normals = np.where(facing[:, None], self._normals, -self._normals)
            self._outlines = list(outlines(self.field, normals))
        return self._outlines

    def render(
        self,
        iop: Array,
        eop: Array,
        points: Array | None = None,
        seed: int | Sequence[int] = 0,
        blur_factor: float = 1.0,
    ) -> NDArray[np.uint8]:
        """Render a frame (H, W), 8 bit.

        iop (10,), eop (6,); points (n, 3) mm: of the targets (default: the field's); seed: of the
        noise; blur_factor: factor on the look's blur.
        """
        # rounded (by less than 1e-5 px), as arguments may differ in their last bits by machine
        iop, eop = np.round(iop, 10), np.concatenate([np.round(eop[:3], 10), np.round(eop[3:], 6)])
        where = self.field.points if points is None else np.round(points, 6)
        look = self.look
        canvas = _draw_paper(self.sensor, look.paper_dn, look.vignetting).copy()
        self._draw(canvas, iop, eop, where, blur_factor)
        if look.noise_dn > 0:
            even, odd = _make_noise_tables(look.noise_dn)
            size = canvas.size
            raw = np.random.PCG64(seed).random_raw(-(-2 * size // 8)).astype("<u8", copy=False)
            random_bytes = raw.view(np.uint8)[: 2 * size].reshape(2, *canvas.shape)
            first, second = cv2.LUT(random_bytes[0], even), cv2.LUT(random_bytes[1], odd)
            cv2.add(first, second, dst=first)
        else:
            first = np.ones_like(canvas)
        noisy = cv2.addWeighted(canvas, 1 / _FRACTION, first, 1 / _FRACTION, 0, dtype=cv2.CV_8U)
        return np.asarray(noisy, dtype=np.uint8)

    def _draw(
        self, canvas: NDArray[np.int16], iop: Array, eop: Array, points: Array, blur_factor: float
    ) -> None:
        shapes = self._shapes(eop[3:6])
        if not shapes:
            return
        placed = [shape.vertices(points) for shape in shapes]
        projected = np.round(project(self.sensor, iop, eop, np.concatenate(placed)), 9)
        begins = np.cumsum([0, *map(len, placed[:-1])])
        images = np.split(projected, begins[1:])
        low, high = (f.reduceat(projected, begins) for f in (np.minimum, np.maximum))
        zero, edge = np.zeros(1), np.array([self.sensor.width, self.sensor.height])
        sigma = _FINER * self.look.blur_px * blur_factor  # cells of a Gaussian's ± 4 sigma
        x = np.arange(-np.ceil(4.0 * sigma), np.ceil(4.0 * sigma) + 1.0)
        kernel: Array = np.exp(-0.5 * (x / max(sigma, 1e-9)) ** 2)
        kernel /= kernel.sum()
        kernel = (np.concatenate([kernel, zero]) + np.concatenate([zero, kernel])) / _FINER
        margin = len(kernel) // (2 * _FINER) + 1
        depth = np.float32((self.look.paper_dn - self.look.ink_dn) * _FRACTION / 2)
        gain = _compute_gain(self.sensor, self.look.vignetting)
        towards = eop[3:6] - points[[shape.targets[0] for shape in shapes]]
        seen = np.sum(towards * [shape.normal for shape in shapes], axis=1) > 0
        # a shape larger than the image, behind or beside the camera, would need a huge window
        seen &= np.all((high > -0.5) & (low < edge - 0.5) & (high - low < edge), axis=1)
        corners = np.floor(low[seen] + 0.5).astype(np.int64) - margin
        sizes = np.floor(high[seen] + 0.5).astype(np.int64) + margin + 2 - corners
        number, area = np.flatnonzero(seen), sizes.prod(axis=1)
        order = np.argsort(area)
        while len(order):  # the largest first, with others of about its size
            count = max(1, _AT_ONCE // int(area[order[-1]]))
            some, order = order[-count:], order[:-count]
            # a pixel is [i, i+1) after the shift by half a pixel
            vertices = [images[number[k]] - (corners[k] - 0.5) for k in some]
            own = [shapes[k] for k in number[some]]
            covered = cover(own, vertices, kernel, *sizes[some].max(axis=0).tolist())
            for corner, size, inked in zip(corners[some], sizes[some], covered, strict=True):
                (left, top), (x0, y0) = corner.tolist(), np.maximum(corner, 0).tolist()
                x1, y1 = np.minimum(corner + size, edge).tolist()
                ink = inked[y0 - top : y1 - top, x0 - left : x1 - left]
                taken = np.rint(ink * gain[y0:y1, x0:x1] * depth).astype(np.int16)
                canvas[y0:y1, x0:x1] -= taken + taken
