"""Dictionaries of square markers: OpenCV's, with one order of corners whatever OpenCV's version.

Corner 0 of a marker is the top left one of the marker as OpenCV 4 draws it, and the order runs
clockwise as seen. OpenCV 4 draws AprilTags turned by 180° against the printed originals, later
versions do not; here the order of OpenCV 4 stays: in an AprilTag that stands upright (as its makers
and Kalibr print it) corners 0, 1, 2, 3 are bottom right, bottom left, top left, top right.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from thermocald.errors import TestFieldError

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["corner_shift", "detector", "dictionary", "marker_cells", "marker_size"]

_TAG_0_UPRIGHT = "110101"  # the first row of tag 0 of the family 36h11, 1 is white


@cache
def dictionary(name: str) -> Any:
    """OpenCV's dictionary of a name; TestFieldError where it has none."""
    number = getattr(cv2.aruco, name, None)
    if not name.startswith("DICT_") or not isinstance(number, int):
        raise TestFieldError(
            f"{name!r} is not a dictionary of OpenCV's; DICT_4X4_50, DICT_5X5_1000, or "
            "DICT_APRILTAG_36h11 are"
        )
    return cv2.aruco.getPredefinedDictionary(number)


def marker_size(name: str, border: int = 1) -> int:
    """Cells along the side of a marker with a black border of so many cells."""
    return int(dictionary(name).markerSize) + 2 * border


@cache
def detector(name: str, border: int = 1) -> Any:
    """OpenCV's detector of a dictionary's markers; corners are measured by our own fit later."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    parameters.minMarkerPerimeterRate = 0.01
    parameters.markerBorderBits = border
    # A bit is read from a third of its cell: the default of eight px a cell gives blur a chance.
    return cv2.aruco.ArucoDetector(dictionary(name), parameters)


@cache
def corner_shift(name: str) -> int:
    """By how many places OpenCV's order of corners precedes ours: 2 where it turns AprilTags."""
    if not name.startswith("DICT_APRILTAG"):
        return 0
    tags = dictionary("DICT_APRILTAG_36h11")
    drawn = cv2.aruco.generateImageMarker(tags, 0, 8)[1, 1:7] > 127
    return 2 if "".join(str(int(white)) for white in drawn) == _TAG_0_UPRIGHT else 0


@cache
def marker_cells(name: str, number: int, border: int = 1) -> NDArray[np.bool_]:
    """The cells of a marker, its border included, True where black; corner 0 is the upper left."""
    size = marker_size(name, border)
    image = cv2.aruco.generateImageMarker(dictionary(name), number, size, borderBits=border)
    cells: NDArray[np.bool_] = np.rot90(np.asarray(image) < 128, k=corner_shift(name)).copy()
    cells.setflags(write=False)
    return cells
