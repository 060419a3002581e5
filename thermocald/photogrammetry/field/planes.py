"""The planes of a test field: the boards that its targets are on, and the targets' normals.

A test field's file says neither. Planes are looked for that hold most targets, with the tolerance
that the field's spacing and its coordinates' errors ask for; what lies in one plane but far apart
is taken for two boards. Boards that touch in one plane count as one. The normal of a target is that
of the plane through its nearest on its own board, so that a board may be bent a little. A target on
no board and no small plate has no normal: its eccentricity cannot be known, and is left out.

Source: planes one after the other as Fischler, Bolles (1981), Comm. ACM 24, 381-395 (RANSAC), with
targets as seeds instead of random ones.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField


FEWEST_ON_A_SHEET = 6
"""Targets on a board; three always are in a plane, five sometimes by chance."""

_SEED = 12  # nearest targets that give a first plane
_FLATNESS = 0.05  # of the distance between neighbours
_SIGMAS = 4.0  # of the coordinates
_APART = 2.5  # times the distance between neighbours: another board
_SEEDS = 60
_LOCAL = 8  # nearest targets on a board that give a normal
_PLATE = 4  # targets of a small plate, or at the rim of a board
_LOOSE = 0.03  # flatness of a target with its nearest where no board was found
_COMPACT = 1.6  # how much farther than the nearest the others may be for that


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
    """Return unit normals (n, 3), of either sign, of targets at (n, 3) mm; NaN for no plane."""
    if len(points) < _PLATE:
        return np.full((len(points), 3), np.nan)
    near, _ = _neighbours(points)
    reach = np.linalg.norm(points[near[:, :_PLATE]] - points[:, None], axis=2)
    spacing = float(np.median(reach[:, 1]))
    normals = sheet_normals(points, _sheets(points, 0.0), _LOCAL)
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


def sheet_normals(points: Array, labels: NDArray[np.int64], nearest: int) -> Array:
    """Return unit normals (n, 3), of either sign, of targets by the nearest on the same sheet, so
    many with the target itself; NaN for those on none (label -1), or on one that is a single row:
    it does not say how its board is turned about it.
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


@lru_cache(maxsize=16)
def field_sheets(testfield: TestField) -> NDArray[np.int64]:
    """Label (n,) of the board of each target, -1 where it is on none."""
    labels = _sheets(testfield.points, _SIGMAS * float(np.median(testfield.sigmas)))
    labels.setflags(write=False)
    return labels


def _sheets(points: Array, least: float) -> NDArray[np.int64]:
    """Label (n,) of the board of each point, -1 where it is on none; least: tolerance, mm."""
    labels = np.full(len(points), -1, dtype=np.int64)
    if len(points) < FEWEST_ON_A_SHEET:
        return labels
    near, spacing = _neighbours(points)
    tolerance = max(_FLATNESS * spacing, least)
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
