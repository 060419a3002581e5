"""Approximate orientation without initial values from the user.

The resection itself is OpenCV's (SQPnP inside RANSAC), which needs a principal distance. The
camera's data sheet gives it, or else a search over fields of view; the candidate with the smallest
truncated residuals is taken.

`orient` and `refine` start from coded targets and predict the image points and outlines of all
others. For this purpose alone they adjust the pose and the interior orientation robustly, with a
weak prior for each parameter. The proper adjustment is `epoch.adjustment`.

Source: Terzakis and Lourakis (2020), SQPnP.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import (
    CameraModel,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
    partials,
    project,
    rays,
)
from thermocald.photogrammetry.field.planes import plane_fit
from thermocald.photogrammetry.linalg import mad_sd, scaled_solve

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from thermocald.arrays import Array, Mask

FLIP = np.diag([1.0, -1.0, -1.0])
"""Our camera axes to OpenCV's, whose camera looks along +Z with y down."""

_FIELDS_OF_VIEW_DEG = (9, 13, 18, 25, 33, 42, 52, 62, 73, 85, 98, 110, 121, 131)
_TOLERANCE = 0.005  # of the image width, as the distortion is still unknown
_MANY = 8  # so many pairs do not fit a pose of three of them by chance
_MINIMUM = 4  # pairs
_CLEAR = 0.5  # share of the pairs that fit


def approximate_orientation(
    sensor: Sensor,
    field_points: ArrayLike,
    image_points: ArrayLike,
    nominal_c: float | None = None,
    interior: InteriorOrientation | None = None,
) -> tuple[InteriorOrientation, ExteriorOrientation, Mask]:
    """Estimate an interior and exterior orientation good enough to start an adjustment.

    field_points (n, 3) mm and image_points (n, 2) px: pairs, gross errors allowed; nominal_c mm:
    from the camera's data sheet; interior: taken unchanged if given.
    Returns the orientations and a mask (n,) of the pairs that fit. Raises GeometryError if there
    are fewer than four pairs, or if no orientation explains them.
    """
    X = np.ascontiguousarray(field_points, dtype=float)
    uv = np.ascontiguousarray(image_points, dtype=float)
    if len(X) < _MINIMUM:
        raise GeometryError(
            f"too few targets for an orientation: {len(X)}, at least {_MINIMUM} are needed"
        )
    if interior is not None:
        candidates = [interior]
    elif nominal_c is not None:
        candidates = [InteriorOrientation(nominal_c * f) for f in (1.0, 0.97, 1.03, 0.93, 1.07)]
    else:  # about the field of view that fits best
        lengths = _distances(sensor, _FIELDS_OF_VIEW_DEG)
        tried = [_robust_resection(sensor, InteriorOrientation(c), X, uv) for c in lengths]
        c = lengths[int(np.argmin([np.inf if t is None else np.median(t[1]) for t in tried]))]
        near = (1.0, 0.96, 1.04, 0.92, 1.08, 0.88, 1.12)
        candidates = [InteriorOrientation(c * f) for f in near]
    best: tuple[float, InteriorOrientation, ExteriorOrientation, Mask] | None = None
    for candidate in candidates:
        found = _robust_resection(sensor, candidate, X, uv)
        if found is None:
            continue
        exterior, residuals = found
        tolerance = _TOLERANCE * sensor.width
        score = float(np.minimum(residuals, tolerance).mean())
        if best is None or score < best[0]:
            best = (score, candidate, exterior, residuals < tolerance)
    if best is None or best[3].sum() < _MINIMUM:
        raise GeometryError(
            f"no orientation explains the {len(X)} targets: check that the test field belongs to "
            "these images, and its units (mm)"
        )
    return best[1:]


def _distances(sensor: Sensor, views_deg: Sequence[float]) -> list[float]:
    """Return the principal distances, mm, of cameras with these fields of view."""
    half_mm = sensor.width * sensor.pixel_pitch / 2
    found: list[float] = (half_mm / np.tan(np.radians(views_deg) / 2)).tolist()
    return found


def _robust_resection(
    sensor: Sensor, interior: InteriorOrientation, X: Array, uv: Array
) -> tuple[ExteriorOrientation, Array] | None:
    """Resect by RANSAC; return the exterior orientation and residuals (n,) px, None on failure."""
    try:
        ideal = _ideal(sensor, interior, uv)
    except GeometryError:
        return None
    tolerance = _TOLERANCE * sensor.width
    found = majority_pose(X, ideal, tolerance * sensor.pixel_pitch / interior.c)
    pose, fit, residuals = None, int(_CLEAR * len(X)), np.empty(0)
    if found is not None:
        pose = _exterior(*found[:2])
        residuals = np.linalg.norm(image_residuals(sensor, interior, pose, X, uv), axis=1)
        if len(found[2]) > _CLEAR * len(X):
            return pose, residuals
        fit = int((residuals < tolerance).sum())
    # For a board seen obliquely SQPnP of few pairs may fail; the resection of a plane does not.
    for _, whole in resection(sensor, interior, X, uv)[:1]:
        other = np.linalg.norm(image_residuals(sensor, interior, whole, X, uv), axis=1)
        if (other < tolerance).sum() > fit:
            return whole, other
    return None if pose is None else (pose, residuals)


def majority_pose(
    X: Array, ideal: Array, threshold: float, fewest: int = _MINIMUM, seed: int = 0
) -> tuple[Array, Array, NDArray[Any]] | None:
    """Estimate OpenCV's R (3, 3) and t (3,), object to camera, and the rows that fit, or None.

    X (n, 3) mm; ideal (n, 2): image points at the distance 1, y down; threshold: largest residual
    of a pair that fits; fewest: number of pairs that must fit. RANSAC with SQPnP, refined on the
    pairs that fit. If it finds no pose, as for points exactly in a plane, three points at a time
    are tried.
    """
    by_three = max(fewest, _MANY, int(_CLEAR * len(X)) + 1)
    for solver, least in ((cv2.SOLVEPNP_SQPNP, fewest), (cv2.SOLVEPNP_AP3P, by_three)):
        cv2.setRNGSeed(seed)
        try:
            ok, rvec, tvec, inliers = cv2.solvePnPRansac(
                X, ideal, np.eye(3), None, iterationsCount=300, reprojectionError=threshold,
                confidence=0.9999, flags=solver,
            )  # fmt: skip
        except cv2.error:  # degenerate points fail an assertion of OpenCV's
            continue
        if ok and inliers is not None and len(inliers) >= least:
            rows = inliers.ravel()
            centre, axes, flat = plane_fit(X[rows])
            if flat and solver == cv2.SOLVEPNP_AP3P:  # the pose may be the mirrored one
                poses = _plane_poses(X[rows], ideal[rows], centre, axes)
                return (*poses[0], rows) if poses else None
            rvec, tvec = cv2.solvePnPRefineLM(X[rows], ideal[rows], np.eye(3), None, rvec, tvec)
            return np.asarray(cv2.Rodrigues(rvec)[0], float), np.asarray(tvec, float).ravel(), rows
    return None


def _plane_poses(X: Array, ideal: Array, centre: Array, axes: Array) -> list[tuple[Array, Array]]:
    """Return both poses R (3, 3), t (3,) of points in a plane, the better one first.

    centre, axes: of the plane, from `plane_fit`.
    """
    local = np.ascontiguousarray((X - centre) @ axes.T)
    local[:, 2] = 0.0
    _, rvecs, tvecs, _ = cv2.solvePnPGeneric(
        local, ideal, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )  # fmt: skip
    poses = []
    for rvec, tvec in zip(rvecs, tvecs, strict=True):
        R = np.asarray(cv2.Rodrigues(rvec)[0] @ axes, float)
        poses.append((R, np.asarray(tvec, float).ravel() - R @ centre))
    return poses


def _ideal(sensor: Sensor, interior: InteriorOrientation, uv: Array) -> Array:
    """Return undistorted image points (n, 2) at the distance 1, y down as in OpenCV."""
    direction = rays(sensor, interior.as_array(), uv)
    return np.ascontiguousarray(direction[:, :2] / -direction[:, 2:] * [1.0, -1.0])


def image_residuals(
    sensor: Sensor, interior: InteriorOrientation, pose: ExteriorOrientation, X: Array, uv: Array
) -> Array:
    """Return measured minus predicted image points (n, 2) px; 1e6 for points behind the camera."""
    predicted = project(sensor, interior.as_array(), pose.as_array(), X)
    return np.nan_to_num(uv - predicted, nan=1e6)


def _exterior(R: NDArray[Any], t: NDArray[Any]) -> ExteriorOrientation:
    return ExteriorOrientation.from_rotation(R.T @ FLIP, -R.T @ t)


def resection(
    sensor: Sensor, interior: InteriorOrientation, field_points: ArrayLike, image_points: ArrayLike
) -> list[tuple[float, ExteriorOrientation]]:
    """Return the possible exterior orientations, best first, each after its RMS residual in px.

    Points in one plane have two: if the second fits as well as the first, the pose is ambiguous.
    Other points have one, or none if they contradict each other or are all at one place. Source:
    Collins and Bartoli (2014), IPPE.
    """
    X = np.ascontiguousarray(field_points, dtype=float)
    uv = np.asarray(image_points, dtype=float)
    ideal = _ideal(sensor, interior, uv)
    centre, axes, flat = plane_fit(X)
    try:
        if flat:
            poses = [_exterior(R, t) for R, t in _plane_poses(X, ideal, centre, axes)]
        else:
            found, rvec, tvec = cv2.solvePnP(X, ideal, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
            if not found:
                return []
            rvec, tvec = cv2.solvePnPRefineLM(X, ideal, np.eye(3), None, rvec, tvec)
            poses = [_exterior(cv2.Rodrigues(rvec)[0], tvec.ravel())]
    except cv2.error:  # degenerate points fail an assertion of OpenCV's
        return []
    rms = [float(np.sqrt(np.mean(image_residuals(sensor, interior, p, X, uv) ** 2))) for p in poses]
    return sorted(zip(rms, poses, strict=True), key=lambda s: s[0])


_SPREAD = 6  # points whose triples are tried
_START = 0.005  # of the image's width: largest RMS residual of a pose of all points
_START_SDS = 3.0  # the same, in standard deviations of a poor survey


def possible_poses(
    sensor: Sensor,
    interior: InteriorOrientation,
    field_points: ArrayLike,
    image_points: ArrayLike,
    sigmas: Array,
) -> list[ExteriorOrientation]:
    """Return poses that fit all points, the best first; several of them may be nearly the same.

    sigmas (n, 3) mm: of the points. The poses are those of `resection`, and up to four of any three
    of six points that are far apart in the image. Source: Ke and Roumeliotis (2017), AP3P.
    """
    X, uv = np.asarray(field_points, dtype=float), np.asarray(image_points, dtype=float)
    try:
        ideal = _ideal(sensor, interior, uv)
    except GeometryError:  # an image point is where the distortion folds back
        return []
    found = resection(sensor, interior, X, uv)
    chosen = [int(np.argmax(np.linalg.norm(uv - uv.mean(axis=0), axis=1)))]
    while len(chosen) < min(_SPREAD, len(X)):
        away = np.linalg.norm(uv[:, None] - uv[chosen], axis=2).min(axis=1)
        away[chosen] = -1.0
        chosen.append(int(np.argmax(away)))
    for three in map(list, combinations(chosen, 3)):
        _, *poses = cv2.solveP3P(X[three], ideal[three], np.eye(3), None, cv2.SOLVEPNP_AP3P)
        for turn, shift in zip(*poses, strict=True):
            pose = _exterior(cv2.Rodrigues(turn)[0], shift.ravel())
            off = image_residuals(sensor, interior, pose, X, uv)
            found.append((float(np.sqrt(np.mean(off**2))), pose))

    def allowed(pose: ExteriorOrientation) -> float:
        angles = sigmas / np.linalg.norm(X - pose.centre, axis=1)[:, None]
        surveyed = interior.c / sensor.pixel_pitch * float(np.sqrt(np.mean(angles**2)))
        return max(_START * sensor.width, _START_SDS * surveyed)

    found.sort(key=lambda f: f[0])
    return [pose for rms, pose in found if rms <= allowed(pose)]


_QUICK_VIEWS_DEG = (60.0, 40.0, 80.0, 25.0)
_GOOD_START = 0.02  # of the image's width: the RMS of a resection without distortion
_ITERATIONS = 12
_LEAST_SD_PX = 0.05
_CUT = 5.0  # times the scatter, beyond which weights fall
_KNOWN_BETTER = 20.0  # ratio of the priors' sds without and with an earlier calibration


@dataclass(frozen=True, slots=True, eq=False)
class Orientation:
    """A camera and its pose, with the residuals (n, 2) px of the pairs that gave them."""

    camera: CameraModel
    exterior: ExteriorOrientation
    residuals: Array

    @property
    def scatter(self) -> float:
        """Robust standard deviation of the residuals in px."""
        return float(mad_sd(self.residuals))


def orient(
    sensor: Sensor,
    points: Array,
    image_points: Array,
    nominal_c: float | None = None,
    interior: InteriorOrientation | None = None,
) -> Orientation:
    """Estimate an orientation from pairs of object points (n, 3) mm and image points (n, 2) px.

    Codes are hardly ever misread, so a plain resection is tried first. If it does not fit, the
    robust and slower `approximate_orientation` follows. Raises its GeometryError.
    """
    lengths = _distances(sensor, _QUICK_VIEWS_DEG) if nominal_c is None else [nominal_c]
    candidates = [InteriorOrientation(c) for c in lengths] if interior is None else [interior]
    best = None
    for candidate in candidates if len(points) >= 6 else ():
        with suppress(GeometryError, IndexError):
            rms, pose = resection(sensor, candidate, points, image_points)[0]
            if best is None or rms < best[0]:
                best = (rms, candidate, pose)
            if best[0] < _GOOD_START * sensor.width:
                break
    if best is not None:
        found = refine(sensor, *best[1:], points, image_points, known=interior is not None)
        if found.scatter < 1.5 and np.mean(np.abs(found.residuals).max(axis=1) < 8.0) > 0.8:
            return found
    i, e, inliers = approximate_orientation(sensor, points, image_points, nominal_c, interior)
    part = refine(sensor, i, e, points[inliers], image_points[inliers], interior is not None)
    residuals = image_residuals(sensor, part.camera.interior, part.exterior, points, image_points)
    return Orientation(part.camera, part.exterior, residuals)


def refine(
    sensor: Sensor,
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    points: Array,
    image_points: Array,
    known: bool = False,
) -> Orientation:
    """Adjust the pose and c, x0, y0, A1, A2, B1, B2 robustly, with priors.

    known: whether the interior orientation is an earlier calibration. It is held loosely even so,
    as a camera drifts by a few per mille.
    """
    size = sensor.width * sensor.pixel_pitch
    # How far a camera's parameters may be from nominal, as sds; A1 r² is 5 % at the image's edge.
    radius2 = (size / 2) ** 2
    prior_sd = np.array(
        [0.3 * interior.c, 0.02 * size, 0.02 * size, 0.05 / radius2, 0.05 / radius2**2,
         0.002 / size, 0.002 / size]
    )  # fmt: skip
    free = [0, 1, 2, 3, 4, 6, 7, *range(10, 16)]
    prior = np.zeros(len(free))
    prior[:7] = (_KNOWN_BETTER if known else 1.0) ** 2 / prior_sd**2
    nominal = np.concatenate([interior.as_array(), exterior.as_array()])
    p, last = nominal.copy(), np.inf
    for _ in range(_ITERATIONS):
        uv, A, _ = partials(sensor, p[:10], p[10:], points)
        r = np.nan_to_num(image_points - uv, nan=1e3)
        distance = np.abs(r).max(axis=1)
        scale = max(float(mad_sd(r)), _LEAST_SD_PX)
        weight = np.minimum(1.0, _CUT * scale / np.maximum(distance, 1e-9)) / scale**2
        weight[distance > 12 * scale] *= 1e-3
        design = np.nan_to_num(A[:, :, free]).reshape(-1, len(free))
        weighted = design * np.repeat(weight, 2)[:, None]
        N = design.T @ weighted + np.diag(prior)
        b = weighted.T @ r.ravel() - prior * (p - nominal)[free]
        step = scaled_solve(N, b, ridge=1e-6)
        p[free] += step
        if p[0] <= 0 or not np.isfinite(p).all():
            p = nominal.copy()
            break
        # Within one standard deviation of the solution is close enough for a prediction.
        in_sds = np.abs(step) * np.sqrt(np.diag(N))
        if abs(last - scale) < 0.1 * scale and in_sds.max() < 1.0:
            break
        last = scale
    i, e = InteriorOrientation.from_array(p[:10]), ExteriorOrientation.from_array(p[10:])
    residuals = image_residuals(sensor, i, e, points, image_points)
    return Orientation(CameraModel(sensor, i), e, residuals)
