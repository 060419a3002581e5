"""Files for other programs: a series as a table, and an updated camera configuration of pyorc.

A series is written as CSV or Parquet with a choice of units, times, separators and thermometers.
Columns of CONVENTIONS §4 with another unit have it in their names (`c_px`, `X0_um`, `omega_deg`),
so that units are not confused. The temperatures of all thermometers follow.

The configuration of pyorc gets the geometry of the warm camera, for velocities and water levels:
the camera at the temperature of the video, and the pose that it gives with the control points, as
they were clicked or as measured in a frame of the video. Everything else stays unchanged, except
for the image points of the control points: pyorc solves for the pose whenever it reads the file,
without weights, and therefore they are written as the new camera projects them.

Source: pyopenrivercam 0.9, `pyorc.CameraConfig`; OpenCV's pose x_camera = R X + t, in metres.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.thermal.control_points import ControlPoints, read_document
from thermocald.errors import DataError, UsageError
from thermocald.files import write_text
from thermocald.photogrammetry.camera.camera_model import EOP, IOP
from thermocald.photogrammetry.frame.templates import Templates
from thermocald.photogrammetry.targets.image_file import decode_grey
from thermocald.result import in_parts, jsonable
from thermocald.store.logger.clock import iso

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from thermocald.analysis.camera.camera import Camera
    from thermocald.analysis.series.epochs import Epochs
    from thermocald.photogrammetry.epoch.adjustment import Adjustment
    from thermocald.result import Columns


UNITS = ("px", "um", "deg")
_IN_IMAGE, _ANGLES = ("c", "x0", "y0"), ("omega", "phi", "kappa")
_PLACE = ("X0", "Y0", "Z0")


def check_style(units: str, time: str, separator: str, decimal: str) -> tuple[list[str], str]:
    """Return the units and the separator that options give; UsageError for unknown values."""
    wanted = [u.strip() for u in units.split(",") if u.strip()]
    for unit in wanted:
        if unit not in UNITS:
            raise UsageError(
                f"--units {unit}: must be one of {', '.join(UNITS)}; separate several by commas"
            )
    if time not in ("seconds", "iso"):
        raise UsageError(f"--time {time}: must be seconds or iso")
    mark = {"tab": "\t", "\\t": "\t"}.get(separator, separator)
    if mark not in (",", ";", "\t", "|"):
        raise UsageError(f"--separator {separator}: must be one of , ; | tab")
    if decimal not in (".", ","):
        raise UsageError(f"--decimal {decimal}: must be . or ,")
    if decimal == mark:
        raise UsageError("--decimal , needs another --separator, such as ';'")
    return wanted, mark


def column_parts(
    table: Epochs, units: Sequence[str], iso_times: bool, pixel_pitch: float, others: Columns | None
) -> Iterator[Columns]:
    """Yield the columns of a series, then the other columns unchanged.

    They come some thousand rows at a time, because of the memory for a year. units: a choice of
    UNITS, otherwise mm and rad; iso_times: times as text, otherwise s; pixel_pitch: mm.
    """
    done = 0
    for part in in_parts(table.columns()):
        columns: Columns = {}
        for name, values in part.items():
            suffix, factor = _unit(name.removeprefix("sd_"), units, pixel_pitch)
            columns[name + suffix] = values if not suffix else np.asarray(values) * factor
        if iso_times:
            columns["frame_time"] = tuple(iso(float(t), "microseconds") for t in part["frame_time"])
        rows = slice(done, done + len(part["epoch"]))
        for name, column in (others or {}).items():
            columns[name if name not in columns else f"extra {name}"] = column[rows]
        yield columns
        done = rows.stop


def _unit(name: str, units: Sequence[str], pixel_pitch: float) -> tuple[str, float]:
    """Return the suffix of a parameter's column, and the factor from mm or rad to its unit."""
    if name in _IN_IMAGE and "px" in units:
        return "_px", 1.0 / pixel_pitch
    if name in (*_IN_IMAGE, *_PLACE) and "um" in units:
        return "_um", 1000.0
    if name in _ANGLES and "deg" in units:
        return "_deg", 180.0 / np.pi
    return "", 1.0


def as_json(parts: Iterable[Columns]) -> Iterator[str]:
    """Yield the columns as one JSON list with a row per epoch; unknown values are null."""
    start = "[\n"
    encode = json.JSONEncoder(separators=(",\n  ", ": ")).encode  # `indent` takes twice as long
    for columns in parts:
        lists = [jsonable(column) for column in columns.values()]
        for row in zip(*lists, strict=True):
            text = encode(dict(zip(columns, row, strict=True)))
            yield f"{start} {{\n  {text[1:-1]}\n }}"
            start = ",\n"
    yield "\n]\n" if start != "[\n" else "[]\n"


_AXES = np.diag([1.0, -1.0, -1.0])  # from our camera frame: y up, looking along −Z


@dataclass(frozen=True, eq=False)
class RenewedConfiguration:
    """An updated configuration of pyorc: document, camera, control points, and estimated pose."""

    document: dict[str, Any]
    camera: Camera
    control: ControlPoints
    pose: Adjustment

    def write(self, path: Path) -> str:
        """Write the document, and return the precision of the pose in words."""
        write_text(path, json.dumps(self.document, indent=4) + "\n")
        sd = self.pose.sd[EOP]
        rejected = ", ".join(self.control.field.names[row] for row in self.pose.rejected)
        return (
            f"pose from {self.pose.n_observations} control points, sigma0 {self.pose.sigma0:.2f}, "
            f"± {np.degrees(np.linalg.norm(sd[:3])):.4f}°, ± {np.linalg.norm(sd[3:]):.0f} mm"
            + (f"; left out: {rejected}" if rejected else "")
            + "".join(f"; doubtful: {d}" for d in self.control.find_doubts(self.camera, self.pose))
        )


def image_size(path: Path) -> tuple[int, int]:
    """Return the width and height, px, of a configuration's images."""
    document = _document(path)
    try:
        return int(document["width"]), int(document["height"])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: has no width and height: {error}") from error


def renew_configuration(
    path: Path, camera: Camera, reference: Path | None = None, frame: Path | None = None
) -> RenewedConfiguration:
    """Update a configuration of pyorc with a camera and the pose that its control points give.

    reference: the frame in which the points were clicked; frame: a frame of the video in which to
    measure them. Raises DataError if they give no pose.
    """
    import cv2

    document = _document(path)
    control = ControlPoints.read(path, "m")
    if (frame is None) != (reference is None):
        raise UsageError("give both --reference (clicked) and --frame (to measure in), or neither")
    if reference is not None and frame is not None:
        templates = Templates.read(reference, control.field, control.seen)
        found = templates.measure(decode_grey(frame))
        if not found.status.ok:
            raise DataError(f"{frame}: {found.status.reason}")
        control = replace(control, seen=found.observations)
    # no snooping with assumed standard deviations: sigma0 then shows how good they are
    try:
        pose = control.pose(camera, 0.0 if control.assumed else 0.001)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
    assert pose.exterior is not None
    # pose and camera are correlated: write the camera that was estimated together with the pose
    now = replace(camera, values=pose.values[IOP], covariance=pose.covariance[IOP, IOP])
    K, distortion = now.opencv()
    # pyorc solves for the pose again when it reads the file: with the points as this camera
    # projects them it obtains this pose
    six = pose.exterior.as_array()
    R, centre = _AXES @ pose.exterior.rotation.T, (control.origin + six[3:]) / 1000.0
    document["gcps"]["src"] = now.project(control.field.points, six).tolist()
    document |= {
        "camera_matrix": K.tolist(),
        "dist_coeffs": [[k] for k in distortion.tolist()],
        "rvec": cv2.Rodrigues(R)[0].ravel().tolist(),
        "tvec": (-R @ centre).tolist(),
        "lens_position": centre.tolist(),
    }
    return RenewedConfiguration(document, now, control, pose)


def _document(path: Path) -> dict[str, Any]:
    document = read_document(path)
    if not isinstance(document.get("gcps"), dict):
        raise DataError(f"{path}: is not a camera configuration of pyorc; it has no gcps")
    return document
