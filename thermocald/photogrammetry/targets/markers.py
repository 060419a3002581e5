"""Square coded markers: dictionaries, the order of their corners, and where they are in a frame.

Programs number the corners of one marker in different orders (`dictionary`). A field with another
order gives every marker a turn of its own, and a single one even a pose that fits. Among several
markers the turn shows: what their corners say of the image's directions is not what their places
say.

Corner 0 of a marker is the top left one of the marker as OpenCV 4 draws it, and the order runs
clockwise as seen. OpenCV 4 draws AprilTags turned by 180° against the printed originals, later
versions do not; here the order of OpenCV 4 stays: in an AprilTag that stands upright (as its makers
and Kalibr print it) corners 0, 1, 2, 3 are bottom right, bottom left, top left, top right.

A test field names marker corners in its `code` column as `DICT_APRILTAG_36h11:17:0`: dictionary,
marker, corner in the order that `dictionary` defines (clockwise as seen; in an upright AprilTag
from its bottom right). Detection is OpenCV's, in a reduced image where the frame is large, with a
black border of one cell, or of two as Kalibr prints it; the corners are our own fit (`corner`).

A marker that is seen twice in an image is dropped: one of the two is not what it says.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from thermocald.errors import TestFieldError
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.targets.corner import fit_corners

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array, Image


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


_LARGE_PIXELS = 3_000_000
_SMALLEST_SIDE_PX = 16.0
_LEAST_STEP_DN = 5.0


def is_marker(code: str) -> bool:
    """Whether a test field's code names a marker or one of its corners."""
    return code.startswith("DICT_")


def parse_marker(code: str) -> tuple[str, int, int | None]:
    """`DICT_5X5_50:17:0` → ("DICT_5X5_50", 17, 0); the corner is None for `DICT_5X5_50:17`.

    TestFieldError where OpenCV has no such dictionary, or the dictionary no such marker.
    """
    parts = code.split(":")
    numbers = parts[1:]
    if len(parts) not in (2, 3) or not all(n.isascii() and n.isdigit() for n in numbers):
        raise TestFieldError(
            f"{code!r} is not a marker code: write, for example, DICT_APRILTAG_36h11:17:0 for "
            "corner 0 of marker 17"
        )
    known = len(dictionary(parts[0]).bytesList)
    marker = int(numbers[0][:9])
    corner = int(numbers[1]) if len(numbers) == 2 else None
    if marker >= known:
        raise TestFieldError(f"{code!r}: {parts[0]} has markers 0 to {known - 1}")
    if corner is not None and corner > 3:
        raise TestFieldError(f"{code!r}: a marker has corners 0 to 3")
    return parts[0], marker, corner


@dataclass(frozen=True, slots=True, eq=False)
class DetectedMarkers:
    """Markers of one dictionary: numbers (m,), corners (m, 4, 2) px, good to about a pixel; border:
    cells of their black border.
    """

    dictionary: str
    numbers: NDArray[np.int64]
    corners: Array
    border: int = 1


def to_8_bit(image: Image) -> NDArray[np.uint8]:
    """The image itself, or a 16-bit one scaled so that its brightest value is 255."""
    if image.dtype == np.uint8:
        return image  # type: ignore[return-value]
    return cv2.convertScaleAbs(image, alpha=255.0 / max(int(image.max()), 1))  # type: ignore[return-value]


def detect_markers(
    image: Image, name: str, expected: frozenset[int] | None = None
) -> DetectedMarkers:
    """Find the markers of one dictionary in an image; `expected` numbers, others are ignored.

    A number that is found twice is dropped. A large image is searched at half its size first, and
    at full size where that found less than half of what is expected; then with the wide border of
    Kalibr's AprilGrids, where there may be some.
    """
    grey = to_8_bit(image)
    large = grey.size > _LARGE_PIXELS
    searches = [(scale, 1) for scale in ((2, 1) if large else (1,))]
    if name.startswith("DICT_APRILTAG"):
        searches += [(scale, 2) for scale, _ in searches]
    best: dict[int, Array] = {}
    best_border = 1
    for scale, border in searches:
        small = cv2.resize(grey, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)
        found, numbers, _ = detector(name, border).detectMarkers(small if scale > 1 else grey)
        seen: defaultdict[int, list[Array]] = defaultdict(list)
        if numbers is not None:
            for number, corners in zip(numbers.ravel().tolist(), found, strict=True):
                if expected is None or number in expected:
                    # cv2.resize maps pixel centres as x = scale·x' + (scale − 1)/2.
                    at = scale * corners.reshape(4, 2).astype(float) + (scale - 1) / 2
                    if _outlined(grey, at):
                        seen[number].append(np.roll(at, corner_shift(name), axis=0))
        single = {number: at[0] for number, at in seen.items() if _one_place(at)}
        if len(single) > len(best):
            best, best_border = single, border
        if len(best) > 0.5 * (len(expected) if expected is not None else 0) and best:
            break
    numbers = np.array(sorted(best), dtype=np.int64)
    corners = np.array([best[n] for n in numbers.tolist()]).reshape(-1, 4, 2)
    return DetectedMarkers(name, numbers, corners, best_border)


def _outlined(grey: NDArray[np.uint8], quad: Array) -> bool:
    """Whether the image gets lighter across the sides of a marker: OpenCV takes a tag with a border
    of two cells for one with a border of one, a cell too small.
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


def _one_place(found: list[Array]) -> bool:
    """Whether all finds of one number are the same find (OpenCV may report inner and outer)."""
    first = found[0]
    size = np.linalg.norm(first[0] - first[2])
    return all(bool(np.linalg.norm(f.mean(0) - first.mean(0)) < 0.1 * size) for f in found[1:])


def marker_rows(testfield: TestField) -> dict[str, dict[tuple[int, int], int]]:
    """{dictionary: {(marker, corner): row of the test field}}."""
    rows: dict[str, dict[tuple[int, int], int]] = {}
    for row, code in enumerate(testfield.codes):
        if is_marker(code):
            dictionary, marker, corner = parse_marker(code)
            if corner is None:
                continue
            corners = rows.setdefault(dictionary, {})
            if (marker, corner) in corners:
                raise TestFieldError(
                    f"code {code!r} is duplicated in the test field, at targets "
                    f"{testfield.names[corners[marker, corner]]!r} and {testfield.names[row]!r}"
                )
            corners[marker, corner] = row
    return rows


@dataclass(frozen=True, slots=True, eq=False)
class MarkerCorners:
    """Marker corners as found: rows (n,) of the test field, corners (n, 2) px and their neighbours
    along the outline, before and after (n, 2) px; cell (n,) px, width of the marker's border.
    """

    rows: NDArray[np.int64]
    corners: Array
    before: Array
    after: Array
    cell: Array

    def __len__(self) -> int:
        return len(self.rows)

    def moved(self, found: Observations) -> MarkerCorners:
        """With corners and neighbours moved by what `found` says of these corners."""
        at = {int(row): i for i, row in enumerate(found.targets)}
        shift = np.array(
            [
                found.points[at[row]] - corner if row in at else (np.nan, np.nan)
                for row, corner in zip(self.rows.tolist(), self.corners, strict=True)
            ]
        ).reshape(-1, 2)
        if np.isfinite(shift).any():
            shift = np.where(np.isfinite(shift), shift, np.nanmedian(shift, axis=0))
        else:
            shift = np.zeros_like(shift)
        return MarkerCorners(
            self.rows, self.corners + shift, self.before + shift, self.after + shift, self.cell
        )


def locate_markers(
    image: Image, testfield: TestField, missed: dict[int, str] | None = None
) -> MarkerCorners:
    """Find a test field's markers; `missed` receives {row: reason} for corners not found."""
    missed = {} if missed is None else missed
    rows: list[int] = []
    corners, before, after, cell = [], [], [], []
    for name, known in marker_rows(testfield).items():
        expected = frozenset(marker for marker, _ in known)
        found = detect_markers(image, name, expected)
        cells = marker_size(name, found.border)
        for number, quad in zip(found.numbers.tolist(), found.corners, strict=True):
            side = np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).min()
            for k in range(4):
                row = known.get((number, k))
                if row is not None and side >= _SMALLEST_SIDE_PX:
                    rows.append(row)
                    corners.append(quad[k])
                    before.append(quad[k - 1])
                    after.append(quad[(k + 1) % 4])
                    cell.append(found.border * side / cells)
                elif row is not None:
                    missed[row] = "too small"
        missing = expected.difference(found.numbers.tolist())
        missed.update({r: "not found" for (m, _), r in known.items() if m in missing})
    return MarkerCorners(
        np.array(rows, dtype=np.int64), _xy(corners), _xy(before), _xy(after),
        np.array(cell, dtype=float),
    )  # fmt: skip


def predicted_markers(
    testfield: TestField, rows: list[int], image_points: Array, found: MarkerCorners
) -> MarkerCorners:
    """Marker corners (rows of the field) where an orientation has them.

    image_points (N, 2) px of the whole field; found: those that were detected, for the width of the
    border. Corners of which a neighbour is not in the field are left out.
    """
    side = np.linalg.norm(found.before - found.corners, axis=1)
    share = float(np.median(found.cell / np.maximum(side, 1e-9))) if len(found) else 0.1
    row_of = {(n, *key): row for n, m in marker_rows(testfield).items() for key, row in m.items()}
    places, corners, before, after, cell = [], [], [], [], []
    for row in rows:
        name, marker, k = parse_marker(testfield.codes[row])
        ends = [row_of.get((name, marker, ((k or 0) + step) % 4)) for step in (-1, 1)]
        if ends[0] is None or ends[1] is None:
            continue
        at, first, second = (image_points[r] for r in (row, ends[0], ends[1]))
        size = min(float(np.linalg.norm(first - at)), float(np.linalg.norm(second - at)))
        if size >= _SMALLEST_SIDE_PX:
            places.append(row)
            corners.append(at)
            before.append(first)
            after.append(second)
            cell.append(share * size)
    return MarkerCorners(
        np.array(places, dtype=np.int64), _xy(corners), _xy(before), _xy(after),
        np.array(cell, dtype=float),
    )  # fmt: skip


def measure_corners(
    image: Image, found: MarkerCorners, missed: dict[int, str] | None = None
) -> Observations:
    """Measure marker corners where they were found; `missed` receives reasons for the others."""
    missed = {} if missed is None else missed
    fit = fit_corners(image, found.corners, found.before, found.after, found.cell)
    rows = found.rows.tolist()
    missed.update({row: why for row, why in zip(rows, fit.reasons, strict=True) if why})
    order = sorted((row, i) for i, row in enumerate(rows) if not fit.reasons[i])
    keep = np.array([i for _, i in order], dtype=np.int64)
    return Observations(
        np.array([row for row, _ in order], dtype=np.int64),
        fit.points[keep],
        np.sqrt(np.stack([fit.covariances[keep, 0, 0], fit.covariances[keep, 1, 1]], axis=-1)),
        fit.covariances[keep, 0, 1],
        {
            "blur": fit.blur[keep],
            "contrast": fit.contrast[keep],
            "grey": fit.background[keep],
            "noise": fit.residual_sd[keep],
            "saturation": fit.saturation[keep],
        },
    )


def measure_markers(
    image: Image, testfield: TestField, missed: dict[int, str] | None = None
) -> Observations:
    """Measure the marker corners of a test field in an image (H, W), grey, 8 or 16 bit.

    Returns the corners found, with standard deviation and covariance of each, and as quality
    `blur` px, `contrast`, `grey` (background), `noise` DN, `saturation` (share of pixels).
    `missed` receives {row: reason} for corners of markers that were found but not measured, and
    for those not found at all.
    """
    return measure_corners(image, locate_markers(image, testfield, missed), missed)


def _xy(points: list[Array]) -> Array:
    return np.array(points, dtype=float).reshape(-1, 2)
