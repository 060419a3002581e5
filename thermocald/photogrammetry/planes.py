"""The plane that each target of a field lies in, from its neighbours.

A test field's file has no normals. Targets are printed on sheets, so a target's plane is the one
through it that holds most of its nearest neighbours, the flattest where two hold as many; in a
corner a target near an edge has neighbours on two sheets, and the majority decides. A target whose
neighbours agree on no plane has none: its eccentricity cannot be known, and is left out.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.photogrammetry.testfield import TestField

    Array = NDArray[np.float64]

__all__ = ["field_normals", "target_normals"]

_NEIGHBOURS = 10
_FLATNESS = 0.03  # of the distance between neighbours: 2° of a plane's tilt
_FEWEST = 3  # neighbours in the plane; two always are


@lru_cache(maxsize=16)
def field_normals(testfield: TestField) -> Array:
    """`target_normals` of a field's circles, by row; NaN for what is no circle."""
    circles = np.array([kind == "circle" for kind in testfield.kinds], dtype=bool)
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
    if n < _FEWEST + 1:
        return normals
    count = min(_NEIGHBOURS, n - 1)
    pairs = np.array(list(combinations(range(count), 2)))
    for i in range(n):
        offset = points - points[i]
        distance = np.linalg.norm(offset, axis=1)
        near = np.argsort(distance, kind="stable")[1 : count + 1]
        d, length = offset[near], distance[near]
        if length[0] == 0:
            continue
        cross = np.cross(d[pairs[:, 0]], d[pairs[:, 1]])
        size = np.linalg.norm(cross, axis=1)
        usable = size > 0.2 * length[pairs[:, 0]] * length[pairs[:, 1]]
        if not usable.any():
            continue
        candidates = cross[usable] / size[usable, None]
        height = np.abs(candidates @ d.T) / length
        flat = height < _FLATNESS
        held = flat.sum(axis=1)
        # Near neighbours count a little more: among planes that hold as many, theirs wins.
        score = held + 0.5 * (flat / (1 + np.arange(count))).sum(axis=1) - height.mean(axis=1)
        best = int(np.argmax(score))
        if held[best] < _FEWEST:
            continue
        plane = np.vstack([np.zeros(3), d[flat[best]]])
        normals[i] = np.linalg.svd(plane - plane.mean(axis=0))[2][2]
    return normals
