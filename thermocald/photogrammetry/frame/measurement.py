"""One entry for measuring a frame: everything of a test field that it shows, and what was missed.

    image ─► status ─► markers and ring codes ─► orientation ─► all circles ─► centres, covariances

Coded targets only tell where the camera stands; from there every circle in view has a predicted
outline, coded or plain, and is fitted there. So a code ring in a reflection costs nothing but
itself, and plain circles need no search.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import CameraModel, Sensor
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.photogrammetry.frame.circles import circle_observations, measure_circles
from thermocald.photogrammetry.orientation.identification import Orientation, orient
from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.chessboard import find_chessboards, locate_chess_corners
from thermocald.photogrammetry.targets.circle import fit_circles
from thermocald.photogrammetry.targets.frame_status import OK, FrameStatus, inspect_frame
from thermocald.photogrammetry.targets.markers import (
    MarkerCorners,
    corners_turned_deg,
    is_marker,
    locate_markers,
    measure_corners,
    predicted_markers,
)
from thermocald.photogrammetry.targets.ring_code import find_coded

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray

    from thermocald.arrays import Image
    from thermocald.photogrammetry.camera.camera_model import (
        ExteriorOrientation,
        InteriorOrientation,
    )
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.targets.outline import LocalMap

__all__ = ["Measurement", "Prior", "measure"]

_FEWEST = 4
_TURNED = (
    "the corners of the markers are numbered in another order in the test field: turned by {}°. "
    "Corner 0 is OpenCV's first, in an upright AprilTag the bottom right one, then clockwise; "
    "`thermocald testfield import` writes it so"
)
_WORTH_A_SECOND_LOOK = {
    "not found", "no corner where the marker has one", "the fit does not converge"
}  # fmt: skip
_FEW_CORNERS = 12
_REMEDIES = {
    "saturated": "expose less, paper should be at three quarters of full scale",
    "too little contrast": "more light, or expose longer",
    "too blurred for its size": "focus, then fix the focus",
    "too small": "go nearer, or print larger targets",
}


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known of the camera before a frame is measured; None for what is not.

    With both orientations the targets are looked for where they should be first; where they are
    not, and without, they are found by their codes. principal_distance: mm, from a data sheet.
    """

    sensor: Sensor | None = None
    interior: InteriorOrientation | None = None
    exterior: ExteriorOrientation | None = None
    principal_distance: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """What a frame gave: observations (none where the status is not ok), {row: reason} for targets
    of the field that are in view and not measured, the approximate orientation (None where the
    targets did not carry one), and where the marker corners are.
    """

    observations: Observations
    status: FrameStatus = OK
    missed: dict[int, str] = field(default_factory=dict)
    orientation: Orientation | None = None
    markers: MarkerCorners | None = None


def measure(
    image: NDArray[Any],
    testfield: TestField,
    prior: Prior | None = None,
    eccentricity: bool = True,
) -> Measurement:
    """Measure a test field in a frame (H, W), grey, 8 or 16 bit.

    Never raises for what a camera may deliver: the status says what is wrong with the frame.
    eccentricity: False measures the centres of ellipses instead of the projected target centres.
    Quality per target: `blur` px, `contrast`, `grey` (background), `noise` DN, `saturation` and
    `misfit` (residuals over noise; markers have none: NaN).
    Raises TestFieldError where the field's codes are wrong.
    """
    prior = prior or Prior()
    size = (prior.sensor.width, prior.sensor.height) if prior.sensor is not None else None
    status = inspect_frame(image, size)
    if not status.ok:
        return Measurement(Observations.none(), status)
    sensor = prior.sensor or Sensor(image.shape[1], image.shape[0], 1.0)
    missed: dict[int, str] = {}
    markers = locate_markers(image, testfield, missed)
    if turned := corners_turned_deg(markers, testfield):
        return Measurement(
            Observations.none(), FrameStatus("other_field", _TURNED.format(turned)), missed
        )
    corners = measure_corners(image, markers, missed)
    if "chess_corner" in testfield.kinds:
        plain = find_chessboards(image, testfield, missed)
        corners = corners.joined(plain) if len(plain) else corners
    corners = _by_orientation(image, testfield, prior, sensor, corners, markers, missed)
    found = _measure(image, testfield, prior, sensor, corners, missed, eccentricity)
    return replace(found, markers=markers)


def _by_orientation(
    image: Image,
    testfield: TestField,
    prior: Prior,
    sensor: Sensor,
    corners: Observations,
    markers: MarkerCorners,
    missed: dict[int, str],
) -> Observations:
    """Corners that detection does not give, where the orientation from the others has them: those
    of markers and chessboards that it placed wrongly, and of the squares of ChArUco boards.
    """
    again = [row for row, why in missed.items() if why in _WORTH_A_SECOND_LOOK]
    again = again if len(corners) >= max(_FEW_CORNERS, len(again)) else []
    squares = [
        row
        for row, (kind, code) in enumerate(zip(testfield.kinds, testfield.codes, strict=True))
        if kind == "chess_corner" and (not code or row in again)
    ]
    again = [row for row in again if is_marker(testfield.codes[row])]
    if len(corners) < _FEWEST or not (again or squares):
        return corners
    try:
        known = orient(
            sensor, testfield.points[corners.targets], corners.points, prior.principal_distance,
            prior.interior,
        )  # fmt: skip
    except GeometryError:
        return corners
    places = [locate_chess_corners(testfield, squares, known)] if squares else []
    if again:
        points = known.camera.project(known.exterior, testfield.points)
        inside = sensor.contains(np.nan_to_num(points, nan=-1e9), 3.0)
        rows = [row for row in again if inside[row]]
        places.append(predicted_markers(testfield, rows, points, markers))
    for place in places:
        if len(place):
            found = measure_corners(image, place, missed)
            for row in found.targets.tolist():
                missed.pop(row, None)
            corners = corners.joined(found) if len(found) else corners
    return corners


def _measure(
    image: Image,
    testfield: TestField,
    prior: Prior,
    sensor: Sensor,
    corners: Observations,
    missed: dict[int, str],
    eccentricity: bool,
) -> Measurement:
    """The circles, once the marker corners are known."""
    circles = np.array([kind == "circle" for kind in testfield.kinds], dtype=bool)
    if not circles.any():
        return _finish(testfield, corners, missed, None, foreign=False)

    if prior.interior is not None and prior.exterior is not None:
        known = Orientation(CameraModel(sensor, prior.interior), prior.exterior, np.zeros((0, 2)))
        found = measure_circles(image, testfield, known, corners, None, eccentricity)
        if len(found[0]) >= max(_FEWEST, 0.5 * (len(found[0]) + len(found[1]))):
            missed.update(found[1])
            return _finish(testfield, corners.joined(found[0]), missed, found[2], False)

    rows, points, maps, foreign = find_coded(
        image, testfield, _FEWEST, needed=len(corners) < _FEWEST
    )
    pair_rows = np.concatenate([corners.targets, rows])
    pair_points = np.concatenate([corners.points, points])
    if len(pair_rows) < _FEWEST:
        return _few(image, testfield, corners, rows, maps, missed, foreign)
    try:
        orientation = orient(
            sensor, testfield.points[pair_rows], pair_points, prior.principal_distance,
            prior.interior,
        )  # fmt: skip
    except GeometryError as error:
        return Measurement(
            Observations.none(),
            FrameStatus(
                "other_field",
                f"{len(pair_rows)} codes of the test field are seen, but not where it has them "
                f"({error})",
            ),
            missed,
        )
    measured, lost, orientation = measure_circles(
        image, testfield, orientation, corners, prior.interior, eccentricity
    )
    missed.update(lost)
    return _finish(testfield, corners.joined(measured), missed, orientation, foreign)


def _few(
    image: Image,
    testfield: TestField,
    corners: Observations,
    rows: NDArray[np.int64],
    maps: LocalMap,
    missed: dict[int, str],
    foreign: bool,
) -> Measurement:
    """Too few codes for an orientation: those that there are, as ellipses."""
    coded = np.array([ring_code.is_ring(testfield.codes[r]) for r in rows], dtype=bool)
    fit = fit_circles(image, maps, coded)
    good = fit.good
    missed.update({int(r): why for r, why in zip(rows, fit.reasons, strict=True) if why})
    circles = circle_observations(rows, fit, good)
    return _finish(testfield, corners.joined(circles), missed, None, foreign)


def _finish(
    testfield: TestField,
    observations: Observations,
    missed: dict[int, str],
    orientation: Orientation | None,
    foreign: bool,
) -> Measurement:
    n = len(observations)
    status = OK
    coded = any(testfield.codes)
    if n < _FEWEST and foreign:
        status = FrameStatus(
            "other_field", "the ring codes in the frame are not those of this test field"
        )
    elif n == 0 and not coded:
        status = FrameStatus(
            "nothing_found",
            "the test field has no coded target and the camera's orientation is not known: plain "
            "circles alone cannot be separated",
        )
    elif n == 0:
        status = FrameStatus("nothing_found", _why_nothing(missed))
    elif n < _FEWEST:
        status = FrameStatus("too_few", f"only {n} targets are found in the frame")
    return Measurement(observations, status, missed, orientation)


def _why_nothing(missed: dict[int, str]) -> str:
    """What keeps the targets that are seen from being measured, by the most frequent reason."""
    reasons = [why for why in missed.values() if why != "not found"]
    if not reasons:
        return "no target of the test field is found in the frame"
    word, count = Counter(reasons).most_common(1)[0]
    remedy = _REMEDIES.get(word)
    return f"{len(reasons)} targets are seen and none can be measured; {count} are {word}" + (
        f": {remedy}" if remedy else ""
    )
