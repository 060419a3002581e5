"""Square coded markers: their dictionaries, the order of their corners, and detection in a frame.

Corner 0 of a marker is the top left one of the marker as OpenCV 4 draws it, and the order is
clockwise as seen. OpenCV 4 draws AprilTags turned by 180° against the printed originals, later
versions do not; we keep the order of OpenCV 4: in an upright AprilTag (as its makers and Kalibr
print it) corners 0, 1, 2, 3 are bottom right, bottom left, top left, top right.

Programs number the corners of a marker in different orders. If a test field has another order,
every marker is rotated about its own centre, and a single marker even gives a pose that fits. With
several markers the error is found: their corners and their places disagree about the image's
directions.

A test field names marker corners in its `code` column as `DICT_APRILTAG_36h11:17:0`: dictionary,
marker, corner. Markers are detected by OpenCV, in a reduced image if the frame is large, with a
black border of one cell, or of two as Kalibr prints it; the corners are measured by `corner`.

A marker that is detected twice in an image is dropped, since one of the detections is false or on
another print of the field.
"""

from __future__ import annotations

from collections import defaultdict
from functools import cache
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from thermocald.arrays import eight_bit
from thermocald.errors import TestFieldError
from thermocald.photogrammetry.targets.corner import Corners

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Image
    from thermocald.photogrammetry.field.testfield import TestField


_FEWEST = 3
_NEIGHBOURS = 4
_AGREEMENT = 0.6
_COMPLEX = np.array([1, 1j])


def corners_turned_deg(found: Corners, testfield: TestField) -> int:
    """Return by how many degrees (0, 90, 180, 270) the field's corners are turned to the image's.

    Also returns 0 with fewer than three markers with four corners, since one alone is ambiguous.
    """
    corners: dict[tuple[str, int], list[tuple[int, Array]]] = {}
    for row, at in zip(found.rows.tolist(), found.places, strict=True):
        name, marker, _ = parse_marker(testfield.codes[row])
        corners.setdefault((name, marker), []).append((row, at))
    whole = [pairs for pairs in corners.values() if len(pairs) == 4]
    if len(whole) < _FEWEST:
        return 0
    field = np.array([testfield.points[[row for row, _ in pairs]] for pairs in whole])
    image = np.array([[at for _, at in pairs] for pairs in whole])
    centre, seen = field.mean(axis=1), image.mean(axis=1)
    turns = []
    for k in range(len(whole)):
        # the map of the field's directions into the image by this marker
        linear = np.linalg.lstsq(field[k] - centre[k], image[k] - seen[k], rcond=None)[0]
        near = np.argsort(np.linalg.norm(centre - centre[k], axis=1), kind="stable")
        others = near[1 : _NEIGHBOURS + 1]
        mapped = (centre[others] - centre[k]) @ linear @ _COMPLEX
        turns.append((seen[others] - seen[k]) @ _COMPLEX * mapped.conj())
    turn = np.concatenate(turns)
    turn = turn[turn != 0] / np.abs(turn[turn != 0])
    if not len(turn):
        return 0
    sine = float(np.median(turn.imag))
    if np.median(turn.real) < -_AGREEMENT:
        return 180
    return 0 if abs(sine) <= _AGREEMENT else 90 if sine > 0 else 270


_TAG_0_UPRIGHT = "110101"  # first row of tag 0 of the family 36h11; 1 is white


@cache
def dictionary(name: str) -> Any:
    """Return OpenCV's dictionary of a name; TestFieldError if there is none."""
    number = getattr(cv2.aruco, name, None)
    if not name.startswith("DICT_") or not isinstance(number, int):
        raise TestFieldError(
            f"{name!r} is not a dictionary of OpenCV's, such as DICT_4X4_50, DICT_5X5_1000, or "
            "DICT_APRILTAG_36h11"
        )
    return cv2.aruco.getPredefinedDictionary(number)


def marker_size(name: str, border: int = 1) -> int:
    """Return the number of cells along the side of a marker with a border of `border` cells."""
    return int(dictionary(name).markerSize) + 2 * border


@cache
def detector(name: str, border: int = 1) -> Any:
    """Return OpenCV's detector of a dictionary's markers, which does not refine the corners."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    parameters.minMarkerPerimeterRate = 0.01
    parameters.markerBorderBits = border
    return cv2.aruco.ArucoDetector(dictionary(name), parameters)


@cache
def corner_shift(name: str) -> int:
    """Return by how many places OpenCV's corners precede ours: 2 if it draws AprilTags upright."""
    if not name.startswith("DICT_APRILTAG"):
        return 0
    tags = dictionary("DICT_APRILTAG_36h11")
    drawn = cv2.aruco.generateImageMarker(tags, 0, 8)[1, 1:7] > 127
    return 2 if "".join(str(int(white)) for white in drawn) == _TAG_0_UPRIGHT else 0


@cache
def marker_cells(name: str, number: int, border: int = 1) -> NDArray[np.bool_]:
    """Return a marker's cells with its border, True for black; corner 0 is the upper left one."""
    size = marker_size(name, border)
    image = cv2.aruco.generateImageMarker(dictionary(name), number, size, borderBits=border)
    cells: NDArray[np.bool_] = np.rot90(np.asarray(image) < 128, k=corner_shift(name)).copy()
    cells.setflags(write=False)
    return cells


LARGE_PIXELS = 3_000_000
"""A larger image is searched at half its size first."""
SMALLEST_SIDE_PX = 16.0
"""A marker with a shorter side in the image is not measured."""
SEEN_TWICE = "seen twice"
"""Why a marker was missed that is at two places."""
_LEAST_STEP_DN = 5.0


def is_marker(code: str) -> bool:
    """Return whether a test field's code names a marker or one of its corners."""
    return code.startswith("DICT_")


def parse_marker(code: str) -> tuple[str, int, int | None]:
    """Parse `DICT_5X5_50:17:0` to ("DICT_5X5_50", 17, 0); the corner is None in `DICT_5X5_50:17`.

    TestFieldError if OpenCV has no such dictionary, or the dictionary has no such marker.
    """
    parts = code.split(":")
    numbers = parts[1:]
    if len(parts) not in (2, 3) or not all(n.isascii() and n.isdigit() for n in numbers):
        raise TestFieldError(
            f"{code!r} is not a marker code; write, for example, DICT_APRILTAG_36h11:17:0 for "
            "corner 0 of marker 17"
        )
    count = len(dictionary(parts[0]).bytesList)
    marker = int(numbers[0][:9])
    corner = int(numbers[1][:9]) if len(numbers) == 2 else None
    if marker >= count:
        raise TestFieldError(f"{code!r}: {parts[0]} has markers 0 to {count - 1}")
    if corner is not None and corner > 3:
        raise TestFieldError(f"{code!r}: a marker has corners 0 to 3")
    return parts[0], marker, corner


def halved(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the image at half its size: x in it is 2·x + ½ in the original."""
    return cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)  # type: ignore[return-value]


def _searches(
    grey: NDArray[np.uint8], wide_too: bool
) -> Iterator[tuple[int, int, NDArray[np.uint8]]]:
    """Yield border, scale and image of the searches for markers; wide_too: with wide borders."""
    views = [(2, halved(grey)), (1, grey)] if grey.size > LARGE_PIXELS else [(1, grey)]
    for border in (1, 2) if wide_too else (1,):
        yield from ((border, scale, view) for scale, view in views)
    if wide_too:  # noise and a JPEG's blocks leave only inner outlines of wide borders
        yield 2, 1, np.asarray(cv2.GaussianBlur(grey, (0, 0), 2.0), dtype=np.uint8)


def detect_markers(
    image: Image, name: str, expected: frozenset[int]
) -> tuple[dict[int, Array], int, set[int]]:
    """Detect the markers of one dictionary with `expected` numbers in an image.

    Returns the corners (4, 2) px by number, good to about a pixel, the width of the black border in
    cells, and the numbers that were found twice and dropped. A large image is searched at half its
    size first, at full size if half of the markers or fewer were found, and then, for AprilTags,
    with the wide border of Kalibr's AprilGrids, in the end smoothed.
    """
    grey = eight_bit(image)
    best: dict[int, Array] = {}
    best_border, twice = 1, set[int]()
    for border, scale, searched in _searches(grey, name.startswith("DICT_APRILTAG")):
        found, numbers, _ = detector(name, border).detectMarkers(searched)
        seen: defaultdict[int, list[Array]] = defaultdict(list)
        if numbers is not None:
            for number, corners in zip(numbers.ravel().tolist(), found, strict=True):
                if number in expected:
                    at = scale * corners.reshape(4, 2).astype(float) + (scale - 1) / 2
                    if _is_outline(grey, at):
                        seen[number].append(np.roll(at, corner_shift(name), axis=0))
        single = {}
        for number, quads in sorted(seen.items()):
            off = np.linalg.norm(np.mean(quads, axis=1) - quads[0].mean(axis=0), axis=1)
            # OpenCV may detect the inner and the outer outline of one marker
            if off.max() < 0.1 * np.linalg.norm(quads[0][0] - quads[0][2]):
                single[number] = quads[0]
        twice |= seen.keys() - single.keys()
        if len(single) > len(best):
            best, best_border = single, border
        if len(best) > 0.5 * len(expected):
            break
    return best, best_border, twice - best.keys()


def _is_outline(grey: NDArray[np.uint8], quad: Array) -> bool:
    """Return whether the image gets lighter outwards across the sides of a marker.

    OpenCV may take a tag with a border of two cells for one with a border of one, a cell too small.
    """
    following = np.roll(quad, -1, axis=0)
    middle = quad.mean(axis=0)
    along = np.array([0.3, 0.5, 0.7])[:, None, None]
    places = quad + along * (following - quad)
    outwards = places - middle
    distance = np.linalg.norm(outwards, axis=-1)[..., None]
    step = outwards * np.maximum(0.06, 2.0 / np.maximum(distance, 1e-9))
    high = np.array(grey.shape[::-1]) - 1

    def at(where: Array) -> Array:
        x, y = np.moveaxis(np.clip(np.rint(where), 0, high).astype(np.int64), -1, 0)
        return np.asarray(grey[y, x], dtype=float)

    return bool(np.median(at(places + step) - at(places - step)) > _LEAST_STEP_DN)


def marker_rows(testfield: TestField) -> dict[str, dict[tuple[int, int], int]]:
    """Return {dictionary: {(marker, corner): row of the test field}}."""
    rows: dict[str, dict[tuple[int, int], int]] = {}
    for row, code in enumerate(testfield.codes):
        dictionary, marker, corner = parse_marker(code) if is_marker(code) else ("", 0, None)
        if corner is not None:
            rows.setdefault(dictionary, {})[marker, corner] = row
    return rows


def locate_markers(image: Image, testfield: TestField, missed: dict[int, str]) -> Corners:
    """Detect a test field's markers; `missed` receives {row: reason} for corners not found."""
    found: list[tuple[int, float, Array]] = []  # row, border, corner with its neighbours
    for name, known in marker_rows(testfield).items():
        expected = frozenset(marker for marker, _ in known)
        quads, border, twice = detect_markers(image, name, expected)
        cells = marker_size(name, border)
        for number, quad in quads.items():
            side = np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).min()
            for k in range(4):
                row = known.get((number, k))
                if row is not None and side >= SMALLEST_SIDE_PX:
                    found.append((row, border * side / cells, quad[[k, k - 1, (k + 1) % 4]]))
                elif row is not None:
                    missed[row] = "too small"
        for (number, _), row in known.items():
            if number not in quads:
                missed[row] = SEEN_TWICE if number in twice else "not found"
    rows = np.array([row for row, _, _ in found], dtype=np.int64)
    borders = np.array([border for _, border, _ in found])
    places, before, after = (
        np.array([three for *_, three in found]).reshape(-1, 3, 2).swapaxes(0, 1)
    )
    return Corners(rows, places, before, after, borders)
