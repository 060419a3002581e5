"""The boards of a test field: which targets lie in one plane, near each other.

A test field's file does not say what is mounted on what. Planes are looked for that hold most
targets, with the tolerance that their coordinates' errors ask for; what lies in one plane but far
apart is taken for two boards. Boards that touch in one plane count as one.

Source: planes one after the other as Fischler, Bolles (1981), Comm. ACM 24, 381-395 (RANSAC), with
every target as a seed instead of a random one.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.field.planes import plane_fit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField

__all__ = ["FEWEST_ON_A_SHEET", "field_sheets"]

FEWEST_ON_A_SHEET = 6
"""Targets on a board; three always are in a plane, five sometimes by chance."""

_SEED = 12  # nearest targets that give a first plane
_FLATNESS = 0.05  # of the distance between neighbours
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
    tolerance = max(_FLATNESS * spacing, _SIGMAS * float(np.median(testfield.sigmas)))
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
    from scipy.spatial import cKDTree

    k = min(_SEED, len(points) - 1)
    distance, near = cKDTree(points).query(points, k + 1)
    return np.asarray(near, dtype=np.int64), float(np.median(distance[:, min(3, k)]))


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
    from scipy.cluster.hierarchy import fcluster, linkage

    if len(rows) < 2:
        return [rows]
    label = fcluster(linkage(points[rows], "single"), distance, "distance")
    return [rows[label == g] for g in np.unique(label)]
