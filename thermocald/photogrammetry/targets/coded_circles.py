"""Circles that are recognised by themselves: by ring codes, or by a marker next to them.

Searched from the likely to the rare: dark on light in a reduced image first, light on dark at full
size last, until enough are found for an orientation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.detection import Candidates, find_circles
from thermocald.photogrammetry.targets.markers import (
    detect_markers,
    is_marker,
    parse_marker,
    to_8_bit,
)
from thermocald.photogrammetry.targets.outline import LocalMap
from thermocald.photogrammetry.targets.ring_reading import read_codes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array, Image
    from thermocald.photogrammetry.field.testfield import TestField

__all__ = ["find_coded"]

_SEARCHES = ((2, -1), (2, 1), (1, -1), (1, 1))  # scale, polarity
_ENOUGH_CODES = 0.5
_LARGE_WIDTH = 1200
_MARKER_NEIGHBOURHOOD = 2.0  # sides of the marker that names a circle


def find_coded(
    image: Image, testfield: TestField, fewest: int, needed: bool
) -> tuple[NDArray[np.int64], Array, LocalMap, bool]:
    """Rows, centres (n, 2), and maps of ring-coded and marker-named circles; whether codes were
    seen that are not of this field. fewest: targets that carry an orientation; needed: search on
    until enough are found.
    """
    row_of: dict[tuple[int, int], int] = {}
    named: dict[str, dict[int, int]] = {}
    for row, code in enumerate(testfield.codes):
        if testfield.kinds[row] != "circle" or not code:
            continue
        if ring_code.is_ring(code):
            row_of[ring_code.parse(code)] = row
        elif is_marker(code):
            dictionary, marker, corner = parse_marker(code)
            if corner is None:
                named.setdefault(dictionary, {})[marker] = row
    if not row_of and not named:
        return _nothing()
    grey = to_8_bit(image)
    best: tuple[NDArray[np.int64], Array, LocalMap] | None = None
    foreign = False
    enough = max(fewest + 2, _ENOUGH_CODES * (len(row_of) + sum(map(len, named.values()))))
    searches = _SEARCHES if image.shape[1] > _LARGE_WIDTH else _SEARCHES[2:]
    for scale, polarity in searches:
        candidates = find_circles(grey, scale, polarity)
        codes = read_codes(grey, candidates, wanted=(row_of, enough))
        keys = list(zip(codes.bits.tolist(), codes.numbers.tolist(), strict=True))
        ours = [i for i, key in enumerate(keys) if key in row_of]
        foreign = foreign or len(ours) < len(keys)
        rows = [row_of[keys[i]] for i in ours]
        which = [int(codes.rows[i]) for i in ours]
        for row, place in _circles_by_marker(grey, candidates, named):
            if place not in which:
                rows.append(row)
                which.append(place)
        if best is None or len(rows) > len(best[0]):
            maps = candidates.maps.select(np.array(which, dtype=np.int64))
            best = np.array(rows, dtype=np.int64), maps.centre, maps
        if len(best[0]) >= enough or (not needed and len(best[0]) >= fewest):
            break
    if best is None:
        return _nothing()
    return (*best, foreign)


def _nothing() -> tuple[NDArray[np.int64], Array, LocalMap, bool]:
    none = LocalMap(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 2, 3)))
    return np.zeros(0, dtype=np.int64), np.zeros((0, 2)), none, False


def _circles_by_marker(
    grey: NDArray[np.uint8], candidates: Candidates, named: dict[str, dict[int, int]]
) -> list[tuple[int, int]]:
    """(row, candidate) of circles that a marker names: the one circle nearest to its centre."""
    pairs: list[tuple[int, int]] = []
    for dictionary, row_of in named.items():
        found = detect_markers(grey, dictionary, frozenset(row_of))
        for number, quad in zip(found.numbers.tolist(), found.corners, strict=True):
            side = np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).mean()
            distance = np.linalg.norm(candidates.maps.centre - quad.mean(axis=0), axis=1)
            outside = np.array(
                [cv2.pointPolygonTest(quad.astype(np.float32), tuple(c), True) < 0
                 for c in candidates.maps.centre], dtype=bool,
            )  # fmt: skip
            near = np.nonzero(outside & (distance < _MARKER_NEIGHBOURHOOD * side))[0]
            if len(near):
                pairs.append((row_of[number], int(near[np.argmin(distance[near])])))
    return pairs
