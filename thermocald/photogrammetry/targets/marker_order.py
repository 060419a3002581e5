"""Whether the corners of a field's markers are numbered as they are seen.

Programs number the corners of one marker in different orders (`dictionary`). A field with another
order gives every marker a turn of its own, and a single one even a pose that fits. Among several
markers the turn shows: what their corners say of the image's directions is not what their places
say.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.targets.markers import parse_marker

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.targets.markers import MarkerCorners

__all__ = ["corners_turned_deg"]

_FEWEST = 3
_NEIGHBOURS = 4
_AGREEMENT = 0.6


def corners_turned_deg(found: MarkerCorners, testfield: TestField) -> int:
    """By how many degrees (0, 90, 180, 270) the field's corners are turned against the image's.

    0 too where fewer than three markers with four corners each are seen: one alone cannot tell.
    """
    corners: dict[tuple[str, int], list[tuple[int, Array]]] = {}
    for row, at in zip(found.rows.tolist(), found.corners, strict=True):
        name, marker, _ = parse_marker(testfield.codes[row])
        corners.setdefault((name, marker), []).append((row, at))
    whole = [pairs for pairs in corners.values() if len(pairs) == 4]
    if len(whole) < _FEWEST:
        return 0
    field = np.array([testfield.points[[row for row, _ in pairs]] for pairs in whole])
    image = np.array([[at for _, at in pairs] for pairs in whole])
    centre, seen = field.mean(axis=1), image.mean(axis=1)
    cosines, sines = [], []
    for k in range(len(whole)):
        # the marker's own map of the field's directions into the image
        linear = np.linalg.lstsq(field[k] - centre[k], image[k] - seen[k], rcond=None)[0]
        near = np.argsort(np.linalg.norm(centre - centre[k], axis=1), kind="stable")
        for other in near[1 : _NEIGHBOURS + 1].tolist():
            told, true = (centre[other] - centre[k]) @ linear, seen[other] - seen[k]
            size = float(np.linalg.norm(told) * np.linalg.norm(true))
            if size > 0:
                cosines.append(float(told @ true) / size)
                sines.append(float(told[0] * true[1] - told[1] * true[0]) / size)
    cosine, sine = float(np.median(cosines)), float(np.median(sines))
    if cosine < -_AGREEMENT:
        return 180
    if abs(sine) > _AGREEMENT:
        return 90 if sine > 0 else 270
    return 0
