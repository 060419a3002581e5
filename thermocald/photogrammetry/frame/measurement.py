"""Measure a test field in a frame: its targets, the missed ones, focus and light.

    image ─► status ─► markers and ring codes ─► orientation ─► all circles ─► centres, covariances

Coded targets only give the orientation. It predicts the outline of every circle in view, coded or
plain, which is fitted there. So a wrong code, as in a reflection, affects no other target, and
plain circles need no search. The fits improve the orientation; if this changes the outlines, they
are fitted once more. The blur of each target is estimated. Its trend over the image distinguishes a
tilted or shifted lens from defocus; heat causes both.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import GeometryError
from thermocald.numbers import counted
from thermocald.photogrammetry.camera.camera_model import (
    CameraModel,
    CameraSpec,
    ExteriorOrientation,
    Sensor,
)
from thermocald.photogrammetry.field.planes import field_normals
from thermocald.photogrammetry.field.testfield import FAR_ELSEWHERE, Observations, TestField
from thermocald.photogrammetry.linalg import inverse_2x2, mad_sd
from thermocald.photogrammetry.orientation import Orientation, orient, refine
from thermocald.photogrammetry.targets.boards import locate_chessboards, predict_corners
from thermocald.photogrammetry.targets.circle import fit_circles
from thermocald.photogrammetry.targets.corner import Corners, measure_corners
from thermocald.photogrammetry.targets.frame_status import OK, FrameStatus, inspect_frame
from thermocald.photogrammetry.targets.markers import (
    SEEN_TWICE,
    corners_turned_deg,
    is_marker,
    locate_markers,
)
from thermocald.photogrammetry.targets.outline import LocalMap, facing, local_maps
from thermocald.photogrammetry.targets.ring_code import find_coded, have_rings, is_ring

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Image

_LARGEST_TILT_COSINE = 0.2  # 78°; beyond, a sheet is nearly edge-on
_GROSS_SD = 8.0
_GROSS_PX = 3.0
_USUAL_BLUR_PX = 0.9
_WIDE_BLUR_PX = 1.1
_SETTLED_PX = 0.002


def predict_circles(
    testfield: TestField,
    camera: CameraModel,
    exterior: ExteriorOrientation,
    normals: Array | None = None,
) -> tuple[NDArray[np.int64], LocalMap]:
    """Predict the outlines of the field's circles that face the camera and lie in the image.

    normals (n, 3): of the targets, by default from the planes of the field. A circle without a
    normal is assumed to face the camera (`add_unknown_tilts`). Returns rows and maps.
    """
    rows = np.nonzero(testfield.circles & np.isfinite(testfield.diameters))[0]
    points = testfield.points[rows]
    normals = field_normals(testfield) if normals is None else normals
    normals, cosine = facing(exterior.centre, points, normals[rows])
    maps = local_maps(
        camera.sensor, camera.interior.as_array(), exterior.as_array(), points, normals,
        testfield.diameters[rows] / 2,
    )  # fmt: skip
    visible = (
        np.isfinite(maps.second).all(axis=(1, 2))
        & np.isfinite(maps.linear).all(axis=(1, 2))
        & camera.sensor.contains(np.nan_to_num(maps.centre, nan=-1e9))
        & (cosine > _LARGEST_TILT_COSINE)
    )
    return rows[visible], maps.select(visible)


def add_unknown_tilts(
    covariances: Array, testfield: TestField, camera: CameraModel, rows: NDArray[np.int64],
    maps: LocalMap, parameters: Array,
) -> None:  # fmt: skip
    """Add to covariances (n, 2, 2) px² of rows (n,) of a field what unknown normals cause.

    A circle without a normal was taken to face the camera. The axes a, b of its ellipse give its
    tilt, not the sense, so that the centre is off by the eccentricity b √(a² − b²)/c along the
    minor axis, one way or the other. parameters (n, 10): fitted with the maps.
    """
    loose = np.isnan(field_normals(testfield)[rows, 0])
    shapes = parameters[loose][:, [[2, 3], [3, 4]]] + np.eye(2)
    # a fit that failed may have no ellipse
    linear = np.nan_to_num(maps.linear[loose] @ inverse_2x2(shapes), posinf=0.0, neginf=0.0)
    squares, axes = np.linalg.eigh(linear @ np.swapaxes(linear, 1, 2))
    minor, major = np.maximum(squares.T, 0.0) * (camera.sensor.pixel_pitch / camera.interior.c)
    off = np.sqrt(minor * (major - minor))[:, None] * axes[:, :, 0]
    covariances[loose] += off[:, :, None] * off[:, None]


_FEWEST = 4
_TURNED = (
    "the test field numbers the corners of the markers in another order: turned by {}°. Corner 0 "
    "is OpenCV's first, in an upright AprilTag the bottom right one, and the others follow "
    "clockwise; `thermocald testfield import` writes this order"
)
_MIRRORED = (
    "the frame is mirrored: the test field is found in its mirror image only. Switch mirroring off "
    "in the camera, or photograph the field without a mirror"
)
_ELSEWHERE = "not where the target must be"
_WORTH_A_SECOND_LOOK = {
    "not found", SEEN_TWICE, _ELSEWHERE, "no corner where the marker has one",
    "the fit does not converge",
}  # fmt: skip
_FEW_CORNERS = 12
_REMEDIES = {
    "saturated": "expose less, so that paper is at three quarters of full scale",
    "too little contrast": "use more light, or expose longer",
    "too blurred for its size": "focus, then fix the focus",
    "too small": "go nearer, or print larger targets",
    SEEN_TWICE: "show one print of the test field only",
}


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """The measurement of a frame.

    observations: none if the status is not ok; missed: {row: reason} for targets of the field that
    are in view and not measured; orientation: approximate, None if the targets do not determine
    it; corners: where corners of markers and squares are, measured or not; searched: why a tracker
    searched the whole frame, empty if it measured in windows only.
    """

    observations: Observations
    status: FrameStatus = OK
    missed: dict[int, str] = field(default_factory=dict)
    orientation: Orientation | None = None
    corners: Corners = field(default_factory=Corners.none)
    searched: str = ""


def measure(
    image: NDArray[Any], testfield: TestField, camera: CameraSpec | None = None
) -> Measurement:
    """Measure a test field in a frame (H, W), grey, 8 or 16 bit.

    camera: what is known of it beforehand. The targets are found by their codes. The qualities of
    a target are `blur` px, `contrast`, `grey` (background), `noise` DN, `saturation` and `misfit`
    (residual sd over noise; NaN for markers). Never raises for a bad frame, whose status is the
    reason; TestFieldError if the field's codes are wrong.
    """
    size = None if camera is None else (camera.sensor.width, camera.sensor.height)
    status = inspect_frame(image, size)
    if not status.ok:
        return Measurement(Observations.none(), status)
    height, width = image.shape
    camera = camera or CameraSpec("", Sensor(width, height, 1.0))
    found = _Frame(image, testfield, camera).measure()
    # in a mirror, a chessboard and plain circles look the same
    if found.status.word in ("nothing_found", "other_field") and any(
        is_marker(code) or is_ring(code) for code in testfield.codes
    ):
        mirrored = np.ascontiguousarray(image[:, ::-1])
        if _Frame(mirrored, testfield, camera).measure().status.ok:
            return replace(found, status=FrameStatus(found.status.word, _MIRRORED))
    return found


def worth_a_second_look(testfield: TestField, missed: Mapping[int, str]) -> list[int]:
    """Return the rows of corners to be measured at predicted places: some of those missed, for
    their reason, and the corners of a ChArUco board's squares.
    """
    again = {row for row, why in missed.items() if why in _WORTH_A_SECOND_LOOK}
    appearances = enumerate(zip(testfield.kinds, testfield.codes, strict=True))
    return sorted(again.union(row for row, how in appearances if how == ("chess_corner", "")))


class _Frame:
    """A frame while it is measured; a second look may remove targets from `missed`."""

    def __init__(self, image: Image, testfield: TestField, camera: CameraSpec) -> None:
        self._image, self._field, self._camera = image, testfield, camera
        self._missed: dict[int, str] = {}
        self._markers = self._places = locate_markers(image, testfield, self._missed)

    def measure(self) -> Measurement:
        """Measure markers and squares, orient the frame with them and the codes, then circles."""
        if turned := corners_turned_deg(self._markers, self._field):
            return self._other_field(_TURNED.format(turned))
        if "chess_corner" in self._field.kinds:
            boards = locate_chessboards(self._image, self._field, self._missed)
            self._places = self._markers.joined(boards)
        corners = measure_corners(self._image, self._places, self._missed)
        if SEEN_TWICE in self._missed.values():
            corners = self._of_one_print(corners)
        corners = corners.joined(self._second_look(corners))
        if not self._field.circles.any():
            return self._finish(corners)
        rows, maps, foreign = find_coded(
            self._image, self._field, _FEWEST, needed=len(corners) < _FEWEST
        )
        pairs = np.concatenate([corners.targets, rows])
        if len(pairs) < _FEWEST:  # too few for an orientation; the circles found, as ellipses
            fit = fit_circles(self._image, maps, have_rings(self._field, rows))
            self._missed.update(fit.missed(rows))
            circles = fit.observations(rows, fit.good)
            return self._finish(corners.joined(circles), foreign=foreign)
        try:
            orientation = self._orient(pairs, np.concatenate([corners.points, maps.centre]))
        except GeometryError as error:
            return self._other_field(
                f"{len(pairs)} codes of the test field are seen, but not where it has them: {error}"
            )
        measured, missed, orientation = self._fit_circles(orientation, corners)
        self._missed.update(missed)
        return self._finish(corners.joined(measured), orientation, foreign)

    def _of_one_print(self, corners: Observations) -> Observations:
        """Return the corners that fit together; the others are on another print of the field."""
        try:
            orientation = self._orient(corners.targets, corners.points)
        except GeometryError:
            return corners
        c_px = orientation.camera.interior.c / orientation.camera.sensor.pixel_pitch
        off = np.hypot(*orientation.residuals.T) > FAR_ELSEWHERE * c_px
        self._missed.update(dict.fromkeys(corners.targets[off].tolist(), _ELSEWHERE))
        here = ~np.isin(self._places.rows, corners.targets[off])
        self._places = self._places.select(here)
        return corners.select(~off)

    def _second_look(self, corners: Observations) -> Observations:
        """Measure further corners at the places predicted by the orientation from the others.

        These are corners of markers and chessboards that were not detected or badly placed, and
        the corners of squares of ChArUco boards.
        """
        rows = worth_a_second_look(
            self._field, self._missed if len(corners) >= _FEW_CORNERS else {}
        )
        if len(corners) < _FEWEST or not rows:
            return Observations.none()
        try:
            orientation = self._orient(corners.targets, corners.points)
        except GeometryError:
            return Observations.none()
        places = predict_corners(self._field, rows, orientation, self._markers)
        self._places = self._places.joined(places)
        found = measure_corners(self._image, places, self._missed)
        for row in found.targets.tolist():
            self._missed.pop(row, None)
        return found

    def _orient(self, rows: NDArray[np.int64], points: Array) -> Orientation:
        camera = self._camera
        return orient(
            camera.sensor, self._field.points[rows], points, camera.principal_distance,
            camera.interior,
        )  # fmt: skip

    def _fit_circles(
        self, orientation: Orientation, corners: Observations
    ) -> tuple[Observations, dict[int, str], Orientation]:
        """Fit every circle in view, improve the orientation with them, and fit once more if needed.

        corners: already measured. Returns the observations, {row: reason} for circles that were
        not measured, and the orientation.
        """
        image, field = self._image, self._field
        rows, maps = predict_circles(field, orientation.camera, orientation.exterior)
        coded = have_rings(field, rows)
        fit = fit_circles(image, maps, coded, _USUAL_BLUR_PX)
        blur = float(np.median(fit.parameters[:, 5])) if len(rows) else _USUAL_BLUR_PX
        if blur > _WIDE_BLUR_PX:
            # the windows were too narrow for this blur
            fit = fit_circles(image, maps, coded, blur)
        good = fit.good
        if good.sum() + len(corners) < _FEWEST:
            return fit.observations(rows, good), fit.missed(rows), orientation
        pairs = np.concatenate([corners.targets, rows[good]])
        better = refine(
            self._camera.sensor, orientation.camera.interior, orientation.exterior,
            field.points[pairs], np.concatenate([corners.points, fit.points[good]]),
            known=self._camera.interior is not None,
        )  # fmt: skip
        new_rows, new_maps = predict_circles(field, better.camera, better.exterior)
        same = np.array_equal(new_rows, rows)
        # the second derivatives shift the centres; the rest of the outline is estimated anyway
        settled = (
            same
            and good.all()
            and np.abs(new_maps.second - maps.second).max(initial=0.0) < _SETTLED_PX
        )
        if not settled:
            start = fit.parameters if same and good.all() else None
            if same:
                new_maps = new_maps.at(np.where(good[:, None], fit.points, new_maps.centre))
            rows, maps = new_rows, new_maps
            fit = fit_circles(image, maps, have_rings(field, rows), blur, None, start)
        # a circle far from the predicted place is not the target
        predicted = better.camera.project(better.exterior, field.points[rows])
        off = np.abs(fit.points - predicted).max(axis=1, initial=0.0)
        limit = max(_GROSS_PX, _GROSS_SD * min(better.scatter, 1.0))
        fit.reasons[fit.good & (off > limit)] = _ELSEWHERE
        add_unknown_tilts(fit.covariances, field, better.camera, rows, maps, fit.parameters)
        return fit.observations(rows, fit.good), fit.missed(rows), better

    def _finish(
        self,
        observations: Observations,
        orientation: Orientation | None = None,
        foreign: bool = False,
    ) -> Measurement:
        """Return the measurement with its status; foreign: codes of another field were seen."""
        status, n = OK, len(observations)
        if n < _FEWEST and foreign:
            why = "the ring codes in the frame are not those of this test field"
            status = FrameStatus("other_field", why)
        elif n < _FEWEST:
            status = FrameStatus("too_few" if n else "nothing_found", self._why_few(n))
        return Measurement(observations, status, self._missed, orientation, self._places)

    def _why_few(self, measured: int) -> str:
        """Return why only some targets, or none, can be measured, by the most frequent reason."""
        if not any(self._field.codes):
            return (
                "the test field has no coded target and the camera's orientation is unknown: "
                "plain circles alone cannot be identified"
            )
        reasons = [why for why in self._missed.values() if why != "not found"]
        if not reasons and measured:
            return f"the frame shows only {counted(measured, 'target')} of the test field"
        if not reasons:
            whole = any(code.startswith("CHESS") for code in self._field.codes)
            remedy = "; a chessboard must be whole in the frame, with its margin" if whole else ""
            return f"no target of the test field is found in the frame{remedy}"
        word, count = Counter(reasons).most_common(1)[0]
        remedy = f"; {_REMEDIES[word]}" if word in _REMEDIES else ""
        seen = counted(measured + len(reasons), "target")
        return f"of {seen} seen, {measured or 'none'} can be measured: {word} ({count}){remedy}"

    def _other_field(self, why: str) -> Measurement:
        status = FrameStatus("other_field", why)
        return Measurement(Observations.none(), status, self._missed, None, self._places)


REPEATED = "shows the view of {}, with the same errors: a copy in another encoding? Counts once"
_SAME_SHARE = 0.9
_SAME_ERRORS = 0.5  # of the differences that independent errors would have


def find_repeated(observations: Observations, earlier: Mapping[str, Observations]) -> str | None:
    """Return the name of earlier observations of the same view with the same errors, or None.

    So is a photograph in another encoding: it would count twice.
    """
    for name, other in earlier.items():
        both, i, j = np.intersect1d(observations.targets, other.targets, return_indices=True)
        if len(both) >= max(_SAME_SHARE * max(len(observations), len(other)), _FEWEST):
            sigmas = np.hypot(observations.sigmas[i], other.sigmas[j])
            z = (observations.points[i] - other.points[j]) / sigmas
            if np.mean(z**2) < _SAME_ERRORS**2:
                return name
    return None


_FEWEST_BLURS = 6
_BLUR_CUT = 3.5
_BLUR_ROUNDS = 3


def frame_figures(observations: Observations, sensor: Sensor) -> dict[str, float]:
    """Return the figures of a frame for the store.

    `blur_px` (in the middle of the image), `blur_trend_x`, `blur_trend_y` (px from the left to the
    right edge, from top to bottom), `blur_curvature` (px from the middle to the corners), each with
    `sd_…`; medians over the targets of `contrast` (DN, negative for dark targets), `grey` (DN of
    the background), `noise` (DN), `saturation` (share of pixels). A figure that cannot be estimated
    is absent; a trend that the distribution of the targets does not determine has a large sd.
    """
    figures: dict[str, float] = {}
    for name in ("contrast", "grey", "noise", "saturation", "blur"):
        values = observations.quality.get(name)
        if values is not None and np.isfinite(values).any():
            figures["blur_px" if name == "blur" else name] = float(np.nanmedian(values))
    blur = observations.quality.get("blur")
    if blur is None or np.isfinite(blur).sum() < _FEWEST_BLURS:
        return figures
    # the blur is fitted by b + tx·x + ty·y + k·r², robustly against disturbed targets; x and y are
    # -½ to ½ over the image, r is 0 in its middle and 1 in its corners
    x, y = ((observations.points - sensor.centre) / (sensor.width, sensor.height)).T
    design = np.column_stack([np.ones(len(x)), x, y, 2 * (x * x + y * y)])
    good = np.isfinite(blur)
    solution, variance = np.zeros(4), 0.0
    for _ in range(_BLUR_ROUNDS):
        A, b = design[good], blur[good]
        solution = np.linalg.lstsq(A, b, rcond=None)[0]
        residual = blur - design @ solution
        sd = float(mad_sd(residual[good]))
        variance = float(np.sum(residual[good] ** 2)) / max(int(good.sum()) - 4, 1)
        good = np.isfinite(blur) & (np.abs(residual) <= _BLUR_CUT * max(sd, 1e-6))
    normal = design[good].T @ design[good]
    inverse = np.linalg.pinv(normal + 1e-9 * np.eye(4))
    sds = np.sqrt(np.maximum(np.diag(inverse) * variance, 0.0))
    for i, name in enumerate(("blur_px", "blur_trend_x", "blur_trend_y", "blur_curvature")):
        figures[name], figures[f"sd_{name}"] = float(solution[i]), float(sds[i])
    return figures
