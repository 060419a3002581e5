"""The outlines of discs, coded rings and markers in object space.

Outlines are polygons in the target's plane that move with the target.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.field.testfield import plane_fit, target_normals
from thermocald.photogrammetry.targets import outline, ring_code
from thermocald.photogrammetry.targets.markers import marker_cells, marker_rows

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
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
