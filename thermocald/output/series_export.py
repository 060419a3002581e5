"""What other programs take: a series as a table, and pyorc's camera configuration renewed.

A series is CSV or Parquet with units, times, separators and all thermometers as people want them.
The columns of CONVENTIONS §4 with other units have them in their names (`c_px`, `X0_um`,
`omega_deg`), so that nobody reads one for the other. The temperatures of all thermometers follow.

In pyorc's configuration a warm camera's geometry is for velocities and levels. The camera is that
of the video's temperature, the pose the one that the control points give with it, seen where they
were clicked, or measured in a frame of the video. All else that the configuration holds stays as it
is, but for the control points' image points: pyorc solves for the pose whenever it reads the file,
without weights, and so they are written as the new camera sees them.

Source: pyopenrivercam 0.9, `pyorc.CameraConfig`; OpenCV's pose x_camera = R X + t, in metres.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.series.epochs import csv_text
from thermocald.analysis.thermal.control_points import ControlPoints
from thermocald.errors import DataError, UsageError
from thermocald.files import write_text
from thermocald.photogrammetry.camera.camera_model import EOP, IOP, ExteriorOrientation
from thermocald.photogrammetry.camera.conversions import opencv_terms
from thermocald.photogrammetry.frame.templates import Templates
from thermocald.photogrammetry.targets.image_file import decode_grey
from thermocald.result import jsonable

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from thermocald.analysis.camera.camera import Camera
    from thermocald.analysis.series.epochs import Columns, Epochs
    from thermocald.arrays import Array
    from thermocald.photogrammetry.epoch.adjustment import Adjustment


UNITS = ("px", "um", "deg")
_IN_IMAGE, _ANGLES = ("c", "x0", "y0"), ("omega", "phi", "kappa")
_PLACE = ("X0", "Y0", "Z0")


@dataclass(frozen=True, slots=True)
class ExportStyle:
    """units: of UNITS, others stay mm and rad; time: `seconds` or `iso`; separator and decimal."""

    units: frozenset[str] = frozenset()
    time: str = "seconds"
    separator: str = ","
    decimal: str = "."

    @property
    def is_plain(self) -> bool:
        """Whether it is the form that other programs of ours read."""
        return self == ExportStyle()


def style_of(units: str, time: str, separator: str, decimal: str) -> ExportStyle:
    """The style that options describe; UsageError for what there is not."""
    wanted = [u.strip() for u in units.split(",") if u.strip()]
    for unit in wanted:
        if unit not in UNITS:
            raise UsageError(f"--units {unit}: there are {', '.join(UNITS)}, separated by commas")
    if time not in ("seconds", "iso"):
        raise UsageError(f"--time {time}: must be seconds or iso")
    mark = {"tab": "\t", "\\t": "\t"}.get(separator, separator)
    if mark not in (",", ";", "\t", "|"):
        raise UsageError(f"--separator {separator}: must be one of , ; | tab")
    if decimal not in (".", ","):
        raise UsageError(f"--decimal {decimal}: must be . or ,")
    if decimal == mark:
        raise UsageError("--decimal , needs another --separator, such as ';'")
    return ExportStyle(frozenset(wanted), time, mark, decimal)


def column_parts(
    table: Epochs, style: ExportStyle, pixel_pitch: float, others: Columns | None = None
) -> Iterator[Columns]:
    """Yield the columns of a series in some style, then the others, as they are.

    Some thousand rows at a time: a year has to fit. pixel_pitch: mm.
    """
    done = 0
    for part in table.parts():
        columns: Columns = {}
        for name, values in part.columns().items():
            suffix, factor = _unit(name.removeprefix("sd_"), style, pixel_pitch)
            columns[name + suffix] = values if not suffix else np.asarray(values) * factor
        if style.time == "iso":
            columns["frame_time"] = tuple(map(_iso, part.frame_time.tolist()))
        rows = slice(done, done + len(part.number))
        for name, column in (others or {}).items():
            columns[name if name not in columns else f"extra {name}"] = column[rows]
        yield columns
        done = rows.stop


def _unit(name: str, style: ExportStyle, pixel_pitch: float) -> tuple[str, float]:
    """The ending of a parameter's name, and the factor from mm or rad."""
    if name in _IN_IMAGE and "px" in style.units:
        return "_px", 1.0 / pixel_pitch
    if name in (*_IN_IMAGE, *_PLACE) and "um" in style.units:
        return "_um", 1000.0
    if name in _ANGLES and "deg" in style.units:
        return "_deg", 180.0 / np.pi
    return "", 1.0


def _iso(seconds: float) -> str:
    moment = datetime.fromtimestamp(seconds, UTC)
    return moment.isoformat(timespec="microseconds").replace("+00:00", "Z")


def as_csv(parts: Iterable[Columns], style: ExportStyle) -> Iterator[str]:
    """Yield the columns as text; numbers keep every digit, what is not known stays empty."""
    return csv_text(parts, style.separator, style.decimal)


def as_json(parts: Iterable[Columns]) -> Iterator[str]:
    """Yield the columns as one JSON list with a row per epoch; what is not known is null."""
    start = "[\n"
    for columns in parts:
        lists = [c.tolist() if isinstance(c, np.ndarray) else c for c in columns.values()]
        for row in zip(*lists, strict=True):
            said = json.dumps(jsonable(dict(zip(columns, row, strict=True))), indent=1)
            yield start + " " + said.replace("\n", "\n ")
            start = ",\n"
    yield "\n]\n" if start != "[\n" else "[]\n"


_AXES = np.diag([1.0, -1.0, -1.0])  # ours: y up, looking along -Z


@dataclass(frozen=True, eq=False)
class RenewedConfiguration:
    """pyorc's document, and its camera: as known beforehand, and as the control points have it."""

    document: dict[str, Any]
    camera: Camera
    control: ControlPoints
    pose: Adjustment

    def write(self, path: Path) -> str:
        """Write the document; returns in words what the pose is worth."""
        write_text(path, json.dumps(self.document, indent=4) + "\n")
        sd = self.pose.sd[EOP]
        rejected = ", ".join(self.control.field.names[row] for row in self.pose.rejected)
        return (
            f"pose from {self.pose.n_observations} control points, sigma0 {self.pose.sigma0:.2f}, "
            f"± {np.degrees(np.linalg.norm(sd[:3])):.4f}°, ± {np.linalg.norm(sd[3:]):.0f} mm"
            + (f"; left out: {rejected}" if rejected else "")
        )


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height px of a configuration's images."""
    document = _document(path)
    try:
        return int(document["width"]), int(document["height"])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: holds no width and height: {error}") from error


def renew_configuration(
    path: Path, camera: Camera, reference: Path | None = None, frame: Path | None = None
) -> RenewedConfiguration:
    """Renew pyorc's configuration with a camera and the pose that its control points give.

    reference: the frame that was clicked in; frame: one of the video, in which the points are
    measured. Raises DataError where they give no pose.
    """
    document = _document(path)
    control = ControlPoints.read(path, "m")
    if (frame is None) != (reference is None):
        raise UsageError("--reference (clicked) and --frame (measured) go together")
    if reference is not None and frame is not None:
        templates = Templates.read(reference, control.field, control.seen)
        found = templates.measure(decode_grey(frame))
        if not found.status.ok:
            raise DataError(f"{frame}: {found.status.reason}")
        control = replace(control, seen=found.observations)
    # sigmas that nobody stated cannot tell a gross error; sigma0 then says what they are worth
    try:
        pose = control.pose(camera, 0.0 if control.assumed else 0.001)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
    assert pose.exterior is not None
    # pose and camera are correlated: the pose goes with the camera that it was estimated with
    now = replace(camera, values=pose.values[IOP], covariance=pose.covariance[IOP, IOP])
    K, distortion = _opencv(now)
    rvec, tvec = opencv_pose(pose.exterior, control.origin)
    # pyorc solves for the pose again when it reads the file: from where this camera sees the points
    # it finds this pose
    six = pose.exterior.as_array()
    document["gcps"]["src"] = now.project(control.field.points, six).tolist()
    document |= {
        "camera_matrix": K.tolist(),
        "dist_coeffs": [[k] for k in distortion.tolist()],
        "rvec": rvec.tolist(),
        "tvec": tvec.tolist(),
        "lens_position": ((control.origin + six[3:]) / 1000.0).tolist(),
    }
    return RenewedConfiguration(document, now, control, pose)


def _opencv(camera: Camera) -> tuple[Array, Array]:
    """OpenCV's matrix and distortion; in closed form where that is exact, also where a distortion
    of few terms folds back in the corners of the image.
    """
    terms = opencv_terms(camera.sensor, camera.values, camera.covariance)
    if not terms["exact"]:
        return camera.opencv()
    K = np.array(
        [[terms["fx"], 0.0, terms["cx"]], [0.0, terms["fy"], terms["cy"]], [0.0, 0.0, 1.0]]
    )
    return K, np.array([terms[name] for name in ("k1", "k2", "p1", "p2", "k3")])


def opencv_pose(pose: ExteriorOrientation, origin: Array) -> tuple[Array, Array]:
    """Return OpenCV's rotation vector and translation (m) for coordinates that count from zero."""
    import cv2

    R = _AXES @ pose.rotation.T
    centre = (np.asarray(pose.as_array()[3:]) + origin) / 1000.0
    rvec, _ = cv2.Rodrigues(R)
    return np.asarray(rvec, dtype=float).ravel(), -R @ centre


def _document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as JSON: {error}") from error
    if not isinstance(document, dict) or not isinstance(document.get("gcps"), dict):
        raise DataError(f"{path}: is not a camera configuration of pyorc: it has no gcps")
    return document
