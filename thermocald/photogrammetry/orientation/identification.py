"""From coded targets to all targets: an orientation good enough to say where the others are.

The orientation is a small robust adjustment of the pose and as much of the interior orientation as
the targets carry, each parameter held by a weak prior; its only use is to predict image points and
outlines. The observations are adjusted properly elsewhere (`adjustment`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import (
    CameraModel,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
    partials,
)
from thermocald.photogrammetry.orientation.approximate import approximate_orientation, resection

if TYPE_CHECKING:
    from thermocald.arrays import Array

__all__ = ["Orientation", "orient", "refine"]

_FIELDS_OF_VIEW_DEG = (60.0, 40.0, 80.0, 25.0)
_GOOD_START = 0.02  # of the image's width: the RMS of a resection without distortion
_ITERATIONS = 12
_LEAST_SD_PX = 0.05
_CUT = 5.0
_KNOWN_BETTER = 20.0  # times, than a data sheet knows


@dataclass(frozen=True, slots=True, eq=False)
class Orientation:
    """A camera and its pose, with the residuals (n, 2) px of the pairs it was made from."""

    camera: CameraModel
    exterior: ExteriorOrientation
    residuals: Array

    @property
    def scatter(self) -> float:
        """Robust standard deviation of the residuals in px."""
        if len(self.residuals) == 0:
            return np.inf
        return 1.4826 * float(np.median(np.abs(self.residuals)))


def orient(
    sensor: Sensor,
    points: Array,
    image_points: Array,
    nominal_c: float | None = None,
    interior: InteriorOrientation | None = None,
) -> Orientation:
    """Orientation from pairs of object points (n, 3) mm and image points (n, 2) px.

    Codes are hardly ever misread, so a plain resection is tried first; where it does not fit, the
    robust and slower `approximate_orientation` decides, and its GeometryError is passed on.
    """
    start = None
    if len(points) >= 6:
        start = _quick_start(sensor, points, image_points, nominal_c, interior)
    if start is not None:
        found = refine(sensor, *start, points, image_points, known=interior is not None)
        if found.scatter < 1.5 and np.mean(np.abs(found.residuals).max(axis=1) < 8.0) > 0.8:
            return found
    i, e, inliers = approximate_orientation(sensor, points, image_points, nominal_c, interior)
    part = refine(sensor, i, e, points[inliers], image_points[inliers], interior is not None)
    uv, _, _ = partials(sensor, part.camera.interior.as_array(), part.exterior.as_array(), points)
    return Orientation(part.camera, part.exterior, np.nan_to_num(image_points - uv, nan=1e6))


def _quick_start(
    sensor: Sensor,
    X: Array,
    uv: Array,
    nominal_c: float | None,
    interior: InteriorOrientation | None,
) -> tuple[InteriorOrientation, ExteriorOrientation] | None:
    width = sensor.width * sensor.pixel_pitch
    if interior is not None:
        candidates = [interior]
    elif nominal_c is not None:
        candidates = [InteriorOrientation(nominal_c)]
    else:
        views = np.radians(_FIELDS_OF_VIEW_DEG)
        candidates = [InteriorOrientation(float(width / 2 / np.tan(v / 2))) for v in views]
    best = None
    for candidate in candidates:
        try:
            solutions = resection(sensor, candidate, X, uv)
        except (GeometryError, cv2.error):
            continue
        for rms, pose in solutions[:1]:
            if best is None or rms < best[0]:
                best = (rms, candidate, pose)
        if best is not None and best[0] < _GOOD_START * sensor.width:
            break
    return None if best is None else best[1:]


def refine(
    sensor: Sensor,
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    points: Array,
    image_points: Array,
    known: bool = False,
) -> Orientation:
    """Adjust pose and c, x0, y0, A1, A2, B1, B2 with priors, robustly.

    known: the interior orientation is an earlier calibration; a camera drifts from it by some per
    mille, so it is held loosely all the same.
    """
    size = sensor.width * sensor.pixel_pitch
    n = len(points)
    # What a camera's parameters may be off from nominal, as sd; A1 r² of 5 % at the image's edge.
    radius2 = (size / 2) ** 2
    prior_sd = np.array(
        [0.3 * interior.c, 0.02 * size, 0.02 * size, 0.05 / radius2, 0.05 / radius2**2,
         0.002 / size, 0.002 / size]
    )  # fmt: skip
    free = [0, 1, 2, 3, 4, 6, 7, *range(10, 16)]
    prior = np.zeros(len(free))
    prior[:7] = (_KNOWN_BETTER if known else 1.0) ** 2 / prior_sd**2
    nominal = np.concatenate([interior.as_array(), exterior.as_array()])
    p = nominal.copy()
    weight = np.ones(n)
    scale, last = 1.0, np.inf
    damping = 1e-6
    uv, A, _ = partials(sensor, p[:10], p[10:], points)
    for _ in range(_ITERATIONS):
        r = np.nan_to_num(image_points - uv, nan=1e3)
        distance = np.abs(r).max(axis=1)
        scale = max(1.4826 * float(np.median(np.abs(r))), _LEAST_SD_PX)
        weight = np.minimum(1.0, _CUT * scale / np.maximum(distance, 1e-9)) / scale**2
        weight[distance > 12 * scale] *= 1e-3
        design = np.nan_to_num(A[:, :, free]).reshape(-1, len(free))
        weighted = design * np.repeat(weight, 2)[:, None]
        N = design.T @ weighted + np.diag(prior)
        b = weighted.T @ r.ravel() - prior * (p - nominal)[free]
        d = np.sqrt(np.maximum(np.diag(N), 1e-30))
        step = np.linalg.solve(N / np.outer(d, d) + damping * np.eye(len(free)), b / d) / d
        p[free] += step
        if p[0] <= 0 or not np.isfinite(p).all():
            p = nominal.copy()
            uv, A, _ = partials(sensor, p[:10], p[10:], points)
            break
        uv, A, _ = partials(sensor, p[:10], p[10:], points)
        # A standard deviation from the end is near enough for a prediction.
        if abs(last - scale) < 0.1 * scale and float(np.abs(step * d).max()) < 1.0:
            break
        last = scale
    return Orientation(
        CameraModel(sensor, InteriorOrientation.from_array(p[:10])),
        ExteriorOrientation.from_array(p[10:]),
        np.nan_to_num(image_points - uv, nan=1e6),
    )
