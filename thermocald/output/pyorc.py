"""pyorc's camera configuration, renewed: a warm camera's geometry for velocities and levels.

The camera is that of the video's temperature, the pose the one that the control points give with
it, seen where they were clicked, or measured in a frame of the video. All else that the
configuration holds stays as it is, but for the control points' image points: pyorc solves for the
pose whenever it reads the file, without weights, and so they are written as the new camera sees
them.

Source: pyopenrivercam 0.9, `pyorc.CameraConfig`; OpenCV's pose x_camera = R X + t, in metres.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.thermal.control_points import ControlPoints
from thermocald.errors import DataError, UsageError
from thermocald.files import write_text
from thermocald.photogrammetry.camera.camera_model import EOP, IOP, ExteriorOrientation
from thermocald.photogrammetry.camera.conversions import opencv_terms
from thermocald.photogrammetry.frame.templates import Templates
from thermocald.photogrammetry.targets.image_file import decode_grey

if TYPE_CHECKING:
    from pathlib import Path

    from thermocald.analysis.camera.camera import Camera
    from thermocald.arrays import Array
    from thermocald.photogrammetry.epoch.adjustment import Adjustment

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
