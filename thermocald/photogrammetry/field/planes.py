"""The planes and sheets of a test field, and its exchange with other programs.

A test field's file has no normals. Targets are printed on sheets, so sheets are looked for: of all
planes through a target and two of its neighbours the one that holds most targets nearby is a sheet;
its targets are taken away, and the search goes on. (Majorities among neighbours alone fail in a
corner, where a plane across the edge holds the outermost rows of both sheets.) The normal is that
of the plane through a target's nearest on its own sheet, so that a sheet may be bent a little. A
target on no sheet has no normal: its eccentricity cannot be known, and is left out.

A test field's file does not say what is mounted on what. Planes are looked for that hold most
targets, with the tolerance that their coordinates' errors ask for; what lies in one plane but far
apart is taken for two boards. Boards that touch in one plane count as one.

Source: planes one after the other as Fischler, Bolles (1981), Comm. ACM 24, 381-395 (RANSAC), with
every target as a seed instead of a random one.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField


_NEIGHBOURS = 8
_FLATNESS = 0.03  # of the distance between neighbours
_FEWEST = 6  # targets on a sheet; three always are in a plane, five sometimes by chance
_PLATE = 4  # targets of a small plate, or at the rim of a sheet
_LOOSE = 0.03  # flatness of a target with its nearest where no sheet was found
_COMPACT = 1.6  # how much farther than the nearest the others may be for that
_LOCAL = 8


@lru_cache(maxsize=16)
def field_normals(testfield: TestField) -> Array:
    """`target_normals` of a field's circles, by row; NaN for what is not a circle."""
    circles = testfield.circles
    normals = np.full((len(testfield), 3), np.nan)
    # Marker corners lie on the sheets too and help where circles are few.
    everything = target_normals(testfield.points)
    normals[circles] = everything[circles]
    normals.setflags(write=False)
    return normals


def target_normals(points: Array) -> Array:
    """Unit normals (n, 3), of either sign, of targets at points (n, 3) mm; NaN for no plane."""
    n = len(points)
    normals = np.full((n, 3), np.nan)
    if n < _PLATE:
        return normals
    # axis by axis: three times less memory than all differences at once
    distance = np.sqrt(sum(np.square(np.subtract.outer(x, x)) for x in points.T))
    near = np.argsort(distance, axis=1, kind="stable")[:, 1 : _NEIGHBOURS + 1]
    spacing = float(np.median(np.take_along_axis(distance, near, 1)[:, 0]))
    if spacing == 0:
        return normals
    tolerance = _FLATNESS * spacing
    closeness = np.exp(-((distance / (3 * spacing)) ** 2))
    seeds, planes = _planes_of_neighbours(points, near, spacing)
    if len(seeds) == 0:
        return normals
    offset = np.sum(planes * points[seeds], axis=1)
    holds = np.empty((len(seeds), n), dtype=bool)
    for i in range(0, len(seeds), 4096):
        s = slice(i, i + 4096)
        holds[s] = np.abs(planes[s] @ points.T - offset[s, None]) < tolerance
    left = np.ones(n, dtype=bool)
    while left.sum() >= _FEWEST:
        score = np.concatenate(
            [
                np.einsum("ij,ij->i", closeness[seeds[i : i + 4096]], holds[i : i + 4096] & left)
                for i in range(0, len(seeds), 4096)
            ]
        )
        best = int(np.argmax(score))
        sheet = np.nonzero(holds[best] & left)[0]
        if len(sheet) < _FEWEST:
            break
        for row in sheet.tolist():
            local = sheet[np.argsort(distance[row, sheet], kind="stable")[:_LOCAL]]
            spread = points[local] - points[local].mean(axis=0)
            _, size, axes = np.linalg.svd(spread)
            # A single row of targets does not say how its sheet is turned about it.
            normals[row] = axes[2] if size[1] > 0.1 * size[0] else planes[best]
        left[sheet] = False
    for row in np.nonzero(left)[0].tolist():
        # The rim of a sheet that bends, or a small plate of its own.
        local = np.argsort(distance[row], kind="stable")[:_PLATE]
        spread = points[local] - points[local].mean(axis=0)
        _, size, axes = np.linalg.svd(spread)
        compact = distance[row, local[-1]] < _COMPACT * distance[row, local[1]]
        if (
            compact
            and size[1] > 0.1 * size[0]
            and np.abs(spread @ axes[2]).max() < _LOOSE * spacing
        ):
            normals[row] = axes[2]
    return normals


def _planes_of_neighbours(
    points: Array, near: NDArray[np.int64], spacing: float
) -> tuple[NDArray[np.int64], Array]:
    """Planes through each point and two of its neighbours: the points, and unit normals (m, 3)."""
    pairs = np.array(list(combinations(range(near.shape[1]), 2)), dtype=np.int64).reshape(-1, 2)
    d = points[near] - points[:, None]
    cross = np.cross(d[:, pairs[:, 0]], d[:, pairs[:, 1]])
    size = np.linalg.norm(cross, axis=2)
    length = np.linalg.norm(d, axis=2)
    usable = size > 0.2 * np.maximum(length[:, pairs[:, 0]] * length[:, pairs[:, 1]], spacing**2)
    seeds, which = np.nonzero(usable)
    planes = cross[seeds, which] / size[seeds, which, None]
    # The same plane comes from many pairs; a coarse raster of directions per point is enough.
    sign = np.where(planes @ np.array([1.0, 1e-3, 1e-6]) < 0, -1.0, 1.0)[:, None]
    key = np.column_stack([seeds, np.rint(planes * sign * 200).astype(np.int64)])
    _, first = np.unique(key, axis=0, return_index=True)
    return seeds[first], planes[first]


def plane_fit(points: ArrayLike, tolerance: float = 0.002) -> tuple[Array, Array, bool]:
    """Centre (3,), axes (3, 3; rows, right-handed, the last the normal), and whether it is flat.

    Flat: the RMS distance from the plane is below `tolerance` of the RMS extent in it.
    """
    X = np.asarray(points, dtype=float)
    centre = X.mean(axis=0)
    reduced = X - centre
    s2, vectors = np.linalg.eigh(reduced.T @ reduced)
    axes = vectors.T[::-1].copy()
    (a, b, c), (d, e, f) = axes[0], axes[1]
    axes[2] = (b * f - c * e, c * d - a * f, a * e - b * d)  # right-handed
    return centre, axes, bool(s2[0] <= tolerance**2 * max(s2[2], 1e-300))


FEWEST_ON_A_SHEET = 6
"""Targets on a board; three always are in a plane, five sometimes by chance."""

_SEED = 12  # nearest targets that give a first plane
_SHEET_FLATNESS = 0.05  # of the distance between neighbours
_SIGMAS = 4.0  # of the coordinates
_APART = 2.5  # times the distance between neighbours: another board
_SEEDS = 60


@lru_cache(maxsize=16)
def field_sheets(testfield: TestField) -> NDArray[np.int64]:
    """Label (n,) of the board of each target, -1 where it is on none."""
    points = testfield.points
    labels = np.full(len(points), -1, dtype=np.int64)
    if len(points) < FEWEST_ON_A_SHEET:
        return labels
    near, spacing = _neighbours(points)
    tolerance = max(_SHEET_FLATNESS * spacing, _SIGMAS * float(np.median(testfield.sigmas)))
    left = np.ones(len(points), dtype=bool)
    count = 0
    while left.sum() >= FEWEST_ON_A_SHEET:
        rest = np.flatnonzero(left)
        seeds = rest[:: max(len(rest) // _SEEDS, 1)]
        planes = [_plane(points, near[s], left, tolerance) for s in seeds]
        best = max(planes, key=len, default=np.zeros(0, dtype=np.int64))
        if len(best) < FEWEST_ON_A_SHEET:
            break
        left[best] = False
        for board in _apart(points, best, _APART * spacing):
            if len(board) >= FEWEST_ON_A_SHEET:
                labels[board] = count
                count += 1
    labels.setflags(write=False)
    return labels


def _neighbours(points: Array) -> tuple[NDArray[np.int64], float]:
    """The nearest targets of each, and the usual distance of the third: of the next marker."""
    # not SciPy's tree, whose import costs the daemon 25 MB
    k = min(_SEED, len(points) - 1)
    near = np.empty((len(points), k + 1), dtype=np.int64)
    third = np.empty(len(points))
    for row, point in enumerate(points):
        distance = np.linalg.norm(points - point, axis=1)
        near[row] = np.argsort(distance, kind="stable")[: k + 1]
        third[row] = distance[near[row, min(3, k)]]
    return near, float(np.median(third))


def _plane(
    points: Array, near: NDArray[np.int64], left: NDArray[np.bool_], tolerance: float
) -> NDArray[np.int64]:
    """The remaining targets in the plane of a target and some of its neighbours."""
    inside = near[left[near]]
    found = np.zeros(0, dtype=np.int64)
    # of growing neighbourhoods the largest that is flat: at an edge two boards meet
    for size in (4, 6, _SEED + 1):
        some = inside[:size]
        if len(some) < 4:
            break
        centre, axes, _ = plane_fit(points[some])
        if np.abs((points[some] - centre) @ axes[2]).max() > tolerance:
            break
        found = some
    if not len(found):
        return found
    for _ in range(3):
        centre, axes, _ = plane_fit(points[found])
        off = np.abs((points - centre) @ axes[2])
        found = np.flatnonzero(left & (off <= tolerance))
        if len(found) < 3:
            return np.zeros(0, dtype=np.int64)
    return found


def _apart(points: Array, rows: NDArray[np.int64], distance: float) -> list[NDArray[np.int64]]:
    """Targets of one plane that hang together by steps up to a distance."""
    left, groups = np.ones(len(rows), dtype=bool), []
    while left.any():
        group, ends = np.zeros(len(rows), dtype=bool), [int(np.argmax(left))]
        group[ends] = True
        while ends:
            steps = np.linalg.norm(points[rows] - points[rows[ends.pop()]], axis=1)
            reached = np.flatnonzero((steps <= distance) & ~group)
            group[reached] = True
            ends += reached.tolist()
        groups.append(rows[group])
        left &= ~group
    return groups
