"""Measure a frame: everything of a test field that it shows, what was missed, focus and light.

    image ─► status ─► markers and ring codes ─► orientation ─► all circles ─► centres, covariances

Coded targets only tell where the camera stands; from there every circle in view has a predicted
outline, coded or plain, and is fitted there. So a code ring in a reflection costs nothing but
itself, and plain circles need no search. The fits improve the orientation; where that changes the
outlines, they are fitted once more. The edge width of each target is known; its trend over the
image tells a tilted or shifting lens from plain defocus, and heat does both.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import (
    CameraModel,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
)
from thermocald.photogrammetry.field.planes import field_normals
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.linalg import MAD_TO_SD
from thermocald.photogrammetry.orientation import Orientation, orient, refine
from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.boards import find_chessboards, locate_chess_corners
from thermocald.photogrammetry.targets.circle import CircleFit, fit_circles
from thermocald.photogrammetry.targets.frame_status import OK, FrameStatus, inspect_frame
from thermocald.photogrammetry.targets.markers import (
    MarkerCorners,
    corners_turned_deg,
    is_marker,
    locate_markers,
    measure_corners,
    predicted_markers,
)
from thermocald.photogrammetry.targets.outline import LocalMap, local_maps
from thermocald.photogrammetry.targets.ring_code import find_coded

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array, Image

_LARGEST_TILT_COSINE = 0.2  # 78°: beyond, a sheet is seen edge-on
_GROSS_SD = 8.0
_GROSS_PX = 3.0
_USUAL_BLUR_PX = 0.9
_WIDE_BLUR_PX = 1.1
_SETTLED_PX = 0.002


def predicted_maps(
    testfield: TestField, orientation: Orientation, eccentricity: bool = True
) -> tuple[NDArray[np.int64], LocalMap]:
    """Rows and outlines of the field's circles that face the camera and lie in the image.

    A circle whose plane is not known is taken as facing the camera, and has no eccentricity.
    """
    rows = np.nonzero(testfield.circles & np.isfinite(testfield.diameters))[0]
    X = testfield.points[rows]
    normals = field_normals(testfield)[rows]
    view = orientation.exterior.centre - X
    view = view / np.linalg.norm(view, axis=1, keepdims=True)
    unknown = ~np.isfinite(normals[:, 0])
    normals = np.where(unknown[:, None], view, normals)
    cosine = np.abs(np.sum(view * normals, axis=1))
    maps = local_maps(
        orientation.camera.sensor, orientation.camera.interior.as_array(),
        orientation.exterior.as_array(), X, normals, testfield.diameters[rows] / 2,
    )  # fmt: skip
    visible = (
        np.isfinite(maps.second).all(axis=(1, 2))
        & np.isfinite(maps.linear).all(axis=(1, 2))
        & orientation.camera.sensor.contains(np.nan_to_num(maps.centre, nan=-1e9))
        & (cosine > _LARGEST_TILT_COSINE)
    )
    maps = maps if eccentricity else maps.without_eccentricity()
    return rows[visible], maps.select(visible)


def measure_circles(
    image: Image,
    testfield: TestField,
    orientation: Orientation,
    corners: Observations,
    interior: InteriorOrientation | None,
    eccentricity: bool,
) -> tuple[Observations, dict[int, str], Orientation]:
    """Fit every circle in view, improve the orientation with them, and fit once more if needed.

    corners: what was measured before; interior: the camera's, where it is known. Returns the
    observations, {row: reason} for circles that were not measured, and the orientation.
    """
    rows, maps = predicted_maps(testfield, orientation, eccentricity)
    coded = ring_code.have_rings(testfield, rows)
    fit = fit_circles(image, maps, coded, _USUAL_BLUR_PX)
    blur = float(np.median(fit.parameters[:, 5])) if len(rows) else _USUAL_BLUR_PX
    if blur > _WIDE_BLUR_PX:
        # The windows were too narrow for this frame.
        fit = fit_circles(image, maps, coded, blur)
    good = fit.good
    if good.sum() + len(corners) < _FEWEST:
        return Observations.none(), dict(zip(rows.tolist(), fit.reasons, strict=True)), orientation
    pairs = np.concatenate([corners.targets, rows[good]])
    better = refine(
        orientation.camera.sensor, orientation.camera.interior, orientation.exterior,
        testfield.points[pairs], np.concatenate([corners.points, fit.points[good]]),
        known=interior is not None,
    )  # fmt: skip
    new_rows, new_maps = predicted_maps(testfield, better, eccentricity)
    same = len(new_rows) == len(rows) and bool(np.all(new_rows == rows))
    # The outlines' asymmetry decides about the centres, the rest is estimated anyway.
    settled = (
        same
        and bool(good.all())
        and float(np.abs(new_maps.second - maps.second).max(initial=0.0)) < _SETTLED_PX
    )
    if not settled:
        start = None
        if same:
            new_maps = new_maps.at(np.where(good[:, None], fit.points, new_maps.centre))
            start = fit.parameters if good.all() else None
        rows, maps = new_rows, new_maps
        coded = ring_code.have_rings(testfield, rows)
        fit = fit_circles(image, maps, coded, blur, None, start)
    return (*_observations(rows, fit, testfield, better), better)


def _observations(
    rows: NDArray[np.int64], fit: CircleFit, testfield: TestField, orientation: Orientation
) -> tuple[Observations, dict[int, str]]:
    """The good fits; a circle far from where its target must be is another circle."""
    reasons = list(fit.reasons)
    predicted = orientation.camera.project(orientation.exterior, testfield.points[rows])
    off = np.abs(fit.points - predicted).max(axis=1, initial=0.0)
    limit = max(_GROSS_PX, _GROSS_SD * min(orientation.scatter, 1.0))
    for i in np.nonzero(off > limit)[0]:
        reasons[i] = reasons[i] or "not where the target must be"
    good = np.array([not reason for reason in reasons], dtype=bool)
    observations = circle_observations(rows, fit, good)
    return observations, {int(r): why for r, why in zip(rows, reasons, strict=True) if why}


def circle_observations(
    rows: NDArray[np.int64], fit: CircleFit, good: NDArray[np.bool_]
) -> Observations:
    """Some of the fits (mask) as observations of the test field's rows (n,)."""
    c, p = fit.covariances[good], fit.parameters[good]
    return Observations(
        rows[good].astype(np.int64),
        p[:, :2],
        np.sqrt(np.stack([c[:, 0, 0], c[:, 1, 1]], axis=-1)),
        c[:, 0, 1],
        {
            "blur": p[:, 5],
            "contrast": p[:, 7],
            "grey": p[:, 6],
            "noise": np.sqrt(fit.noise.variance(p[:, 6])).astype(float),
            "saturation": fit.saturation[good],
            "misfit": fit.misfit[good],
        },
    )


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
    if not testfield.circles.any():
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
    coded = ring_code.have_rings(testfield, rows)
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


_FEWEST_BLURS = 6
_BLUR_CUT = 3.5
_BLUR_ROUNDS = 3


def frame_figures(observations: Observations, sensor: Sensor) -> dict[str, float]:
    """Figures of one frame for the store.

    `blur_px` (in the middle of the image), `blur_trend_x`, `blur_trend_y` (px from the left to the
    right edge, from top to bottom), `blur_curvature` (px from the middle to the corners), each with
    `sd_…`; medians over the targets of `contrast` (DN, negative for dark targets), `grey` (DN of
    the background), `noise` (DN), `saturation` (share of pixels). What cannot be told is absent.
    """
    figures: dict[str, float] = {}
    for name in ("contrast", "grey", "noise", "saturation"):
        values = observations.quality.get(name)
        if values is not None and np.isfinite(values).any():
            figures[name] = float(np.nanmedian(values))
    blur = observations.quality.get("blur")
    if blur is not None and np.isfinite(blur).sum() >= _FEWEST_BLURS:
        values, sd = blur_trend(observations.points, blur, sensor)
        for name, value, s in zip(
            ("blur_px", "blur_trend_x", "blur_trend_y", "blur_curvature"), values, sd, strict=True
        ):
            figures[name], figures[f"sd_{name}"] = float(value), float(s)
    elif blur is not None and np.isfinite(blur).any():
        figures["blur_px"] = float(np.nanmedian(blur))
    return figures


def blur_trend(points: Array, blur: Array, sensor: Sensor) -> tuple[Array, Array]:
    """Blur as b + tx·x + ty·y + k·r² of points (n, 2) px: (b, tx, ty, k) and their sd (4,), px.

    x and y run from -½ to ½ over the image, r from 0 in its middle to 1 in its corners. Robust: a
    target that is disturbed does not count. The terms that the targets' spread does not carry get
    large standard deviations.
    """
    x, y = ((points - sensor.centre) / (sensor.width, sensor.height)).T
    design = np.column_stack([np.ones(len(x)), x, y, 2 * (x * x + y * y)])
    good = np.isfinite(blur)
    solution, variance = np.zeros(4), 0.0
    for _ in range(_BLUR_ROUNDS):
        A, b = design[good], blur[good]
        solution = np.linalg.lstsq(A, b, rcond=None)[0]
        residual = blur - design @ solution
        sd = MAD_TO_SD * float(np.median(np.abs(residual[good])))
        variance = float(np.sum(residual[good] ** 2)) / max(int(good.sum()) - 4, 1)
        good = np.isfinite(blur) & (np.abs(residual) <= _BLUR_CUT * max(sd, 1e-6))
    normal = design[good].T @ design[good]
    inverse = np.linalg.pinv(normal + 1e-9 * np.eye(4))
    return solution, np.sqrt(np.maximum(np.diag(inverse) * variance, 0.0))
