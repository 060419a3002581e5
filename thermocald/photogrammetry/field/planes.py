"""The planes of a test field: its boards, and its targets' normals.

A test field's file states neither its boards nor its targets' normals. We search for the planes
with the most targets, with a tolerance from the field's spacing and the errors of its coordinates.
Groups far apart in one plane are different boards; boards that touch in one plane count as one. A
target's normal is that of the plane through its nearest neighbours on the same board, so that a
board may be slightly bent. Four targets in a parallelogram are a plate with a normal of its own. A
target on no board and no plate has no normal; its eccentricity cannot be computed and is neglected.

Source: planes are found one after the other as by Fischler, Bolles (1981), Comm. ACM 24, 381-395
(RANSAC), but with targets as seeds instead of random samples.
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


FEWEST_ON_A_SHEET = 6
"""Fewest targets of a board: three are always in a plane, five sometimes by chance."""

_SEED = 12  # nearest targets, for a first plane
_FLATNESS = 0.05  # of the distance between neighbours
_CREASE = 0.01  # of the distance between neighbours; farther out it may be another board's
_ITERATIONS = 20
_EXCHANGES = 5
_SIGMAS = 4.0  # tolerance, in standard deviations of the coordinates
_APART = 2.5  # times the distance between neighbours; farther is another board
_AROUND = 0.5  # share of a target's nearest that are on the same board, at least
_SEEDS = 60
_LOCAL = 8  # nearest targets on a board, for a normal
_PLATE = 4  # targets of a small plate, or at the rim of a board
_SKEW = 0.1  # of the spacing, by which the targets of a plate may miss a parallelogram
_LOOSE = 0.03  # flatness of a target and its nearest, as a share of the spacing, without a board
_COMPACT = 1.6  # for that, the largest ratio of their distances


@lru_cache(maxsize=16)
def field_normals(testfield: TestField) -> Array:
    """Return the `target_normals` (n, 3) of a field's circles; NaN for other targets."""
    circles = testfield.circles
    normals = np.full((len(testfield), 3), np.nan)
    # Marker corners are on the sheets too, and help if circles are few.
    normals[circles] = target_normals(testfield.points)[circles]
    normals.setflags(write=False)
    return normals


def target_normals(points: Array) -> Array:
    """Return unit normals (n, 3), of either sign, of targets at (n, 3) mm; NaN without a plane."""
    if len(points) < _PLATE:
        return np.full((len(points), 3), np.nan)
    near, _ = _neighbours(points)
    reach = np.linalg.norm(points[near[:, :_PLATE]] - points[:, None], axis=2)
    spacing = float(np.median(reach[:, 1]))
    labels = _sheets(points, 0.0)
    normals = sheet_normals(points, labels, _LOCAL)
    # in a corner, a plate and the nearest targets of other ones may pass for a small board
    small = np.isnan(normals[:, 0]) | (np.bincount(labels + 1)[labels + 1] <= 2 * _PLATE)
    for plate in _plates(points, near, small, _SKEW * spacing):
        normals[plate] = plane_fit(points[plate])[1][2]
    for row in np.flatnonzero(np.isnan(normals[:, 0])):
        local = points[near[row, :_PLATE]]
        spread = local - local.mean(axis=0)
        _, size, axes = np.linalg.svd(spread)
        if (
            reach[row, -1] < _COMPACT * reach[row, 1]
            and size[1] > 0.1 * size[0]
            and np.abs(spread @ axes[2]).max() < _LOOSE * spacing
        ):
            normals[row] = axes[2]
    return normals


def _plates(
    points: Array, near: NDArray[np.int64], loose: NDArray[np.bool_], tolerance: float
) -> list[list[int]]:
    """Return the rows of plates: four targets each in a parallelogram, among the loose ones (n,).

    near (n, k): each target and its nearest; tolerance: of the fourth corner, mm. A target's plate
    is the smallest parallelogram at whose corner it is. Where two plates meet at an edge, their
    inner targets may form a smaller one across it, but the outer ones cannot; so the larger of two
    plates with a common target is the true one.
    """
    found: list[tuple[float, int, list[int]]] = []
    for row in np.flatnonzero(loose).tolist():
        around = near[row, 1:][loose[near[row, 1:]]]
        for a, b in combinations(around[:_PLATE].tolist(), 2):
            u, v = points[a] - points[row], points[b] - points[row]
            size = float(u @ u + v @ v)
            off = np.linalg.norm(points[around] - (points[row] + u + v), axis=1)
            in_a_row = np.linalg.norm(np.cross(u, v)) < 0.1 * size
            if off.min() < tolerance and not in_a_row:
                found.append((size, row, [row, a, b, int(around[off.argmin()])]))
    smallest = {row: (size, plate) for size, row, plate in sorted(found, reverse=True)}
    plates: list[list[int]] = []
    for _, plate in sorted(smallest.values(), reverse=True):
        if not any(row in plate for other in plates for row in other):
            plates.append(plate)
    return plates


def sheet_normals(points: Array, labels: NDArray[np.int64], nearest: int) -> Array:
    """Return unit normals (n, 3), of either sign, of targets.

    A normal is that of the plane through the `nearest` targets on the same sheet, the target
    itself included. NaN for targets on no sheet (label -1), or on a sheet that is a single row,
    about which its board could be turned.
    """
    normals = np.full((len(points), 3), np.nan)
    for label in np.unique(labels[labels >= 0]):
        rows = np.flatnonzero(labels == label)
        if len(rows) < _PLATE:
            continue
        centre, (_, across, whole), _ = plane_fit(points[rows])
        width = np.ptp((points[rows] - centre) @ across)
        for row in rows:
            away = np.linalg.norm(points[rows] - points[row], axis=1)
            order = np.argsort(away, kind="stable")[:nearest]
            near = points[rows[order]]
            _, size, axes = np.linalg.svd(near - near.mean(axis=0))
            if size[1] > 0.1 * size[0]:
                normals[row] = axes[2]
            elif width > 0.5 * away[order[1]]:
                normals[row] = whole
    return normals


def plane_fit(points: ArrayLike, tolerance: float = 0.002) -> tuple[Array, Array, bool]:
    """Fit a plane to points (n, 3); return its centre (3,), axes (3, 3), and whether it is flat.

    The axes are right-handed rows, the last of them the normal. Flat: the RMS distance from the
    plane is below `tolerance` times the RMS extent in it.
    """
    X = np.asarray(points, dtype=float)
    centre = X.mean(axis=0)
    reduced = X - centre
    s2, vectors = np.linalg.eigh(reduced.T @ reduced)
    axes = vectors.T[::-1].copy()
    (a, b, c), (d, e, f) = axes[0], axes[1]
    axes[2] = (b * f - c * e, c * d - a * f, a * e - b * d)  # right-handed
    return centre, axes, bool(s2[0] <= tolerance**2 * max(s2[2], 1e-300))


@lru_cache(maxsize=16)
def field_sheets(testfield: TestField) -> NDArray[np.int64]:
    """Return the label (n,) of each target's board, -1 for targets on none."""
    labels = _sheets(testfield.points, _SIGMAS * float(np.median(testfield.sigmas)))
    labels.setflags(write=False)
    return labels


def _sheets(points: Array, least: float) -> NDArray[np.int64]:
    """Return the label (n,) of each point's board, -1 for none; least: smallest tolerance, mm."""
    labels = np.full(len(points), -1, dtype=np.int64)
    if len(points) < FEWEST_ON_A_SHEET:
        return labels
    near, spacing = _neighbours(points)
    tolerance = max(_FLATNESS * spacing, least)
    left = np.ones(len(points), dtype=bool)
    count = 0
    while left.sum() >= _PLATE:
        rest = np.flatnonzero(left)
        seeds = rest[:: max(len(rest) // _SEEDS, 1)]
        planes = [_plane(points, near[s], left, tolerance) for s in seeds]
        best = max(planes, key=len, default=np.zeros(0, dtype=np.int64))
        if len(best) < _PLATE:
            break
        left[best] = False
        for board in _apart(points, best, _APART * spacing):
            if len(board) >= _PLATE:
                labels[board] = count
                count += 1
    taken = labels.copy()
    _exchange(points, labels, _APART * spacing, max(_CREASE * spacing, least))
    for back in (taken, np.full_like(labels, -1)):
        size = np.bincount(labels + 1)
        around = np.mean(labels[near[:, 1 : _PLATE + 1]] == labels[:, None], axis=1)
        # targets that are in a plane by chance have others nearer
        chance = np.bincount(labels + 1, around) < _AROUND * size
        none = (chance | (size < FEWEST_ON_A_SHEET))[labels + 1]
        labels[none] = back[none]
    compact = np.unique(labels, return_inverse=True)[1]
    return compact - int(labels.min() < 0)


def _neighbours(points: Array) -> tuple[NDArray[np.int64], float]:
    """Return the rows (n, k + 1) of each target and its nearest, and the spacing of targets, mm.

    The spacing is the median distance to the third nearest, which for corners of markers is on the
    next marker.
    """
    # not SciPy's tree, whose import takes 25 MB of the daemon's memory
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
    """Return the remaining targets in the plane of `near`: a target and some of its neighbours."""
    inside = near[left[near]]
    found = np.zeros(0, dtype=np.int64)
    # the largest neighbourhood that is flat, since two boards may meet at an edge
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


def _exchange(points: Array, labels: NDArray[np.int64], reach: float, least: float) -> None:
    """Give a board's targets farther than `least` mm from its plane to one whose plane is nearer.

    So a board that was found first gives back the rows of others that begin near an edge of it. The
    nearer plane must be twice as near, and a target of its board within `reach` mm. The planes are
    those of least absolute distances; labels (n,) are changed in place.
    """
    rows = np.flatnonzero(labels >= 0)
    for _ in range(_EXCHANGES if len(rows) else 0):
        off = np.full((labels.max() + 1, len(rows)), np.inf)
        for label in np.unique(labels[rows]):
            mine = points[labels == label]
            weight = np.ones((len(mine), 1))
            for _ in range(_ITERATIONS):
                centre = (weight * mine).sum(axis=0) / weight.sum()
                root = np.sqrt(weight) * (mine - centre)
                normal = np.linalg.svd(root, full_matrices=False)[2][2]
                weight = 1.0 / np.maximum(np.abs((mine - centre) @ normal), 0.1 * least)[:, None]
            off[label] = np.abs((points[rows] - centre) @ normal)
        best, own = off.argmin(axis=0), off[labels[rows], np.arange(len(rows))]
        before = labels.copy()
        for k in np.flatnonzero((own > least) & (off.min(axis=0) < 0.5 * own)):
            others = points[before == best[k]]
            if np.linalg.norm(others - points[rows[k]], axis=1).min() <= reach:
                labels[rows[k]] = best[k]
        if np.array_equal(labels, before):
            break


def _apart(points: Array, rows: NDArray[np.int64], distance: float) -> list[NDArray[np.int64]]:
    """Return the groups of targets in a plane that are connected by steps of at most `distance`."""
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
