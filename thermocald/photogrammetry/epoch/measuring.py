"""Measuring with a calibrated camera: its pose, and points on a plane or a line.

The interior orientation is given with its covariance (for example of a thermal model at some
temperature). It is an observation of the resection, so that pose and camera are properly
correlated. A point on a plane or a line follows from the collinearity equations and the plane's;
its covariance includes the image point's, the camera's, the pose's and the plane's.

Sources: Luhmann et al. (2014), sections 4.2.3 (resection) and 4.2.7 (monoplotting).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.arrays import floats
from thermocald.errors import GeometryError, UsageError
from thermocald.numbers import counted
from thermocald.photogrammetry.camera.camera_model import (
    EOP,
    IOP,
    IOP_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
    partials,
    project,
    rays,
    rotation,
)
from thermocald.photogrammetry.epoch.adjustment import (
    Adjustment,
    AdjustmentSettings,
    adjust,
    failed,
)
from thermocald.photogrammetry.orientation import approximate_orientation, possible_poses

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.field.testfield import Observations, TestField

_FEWEST = 4  # control points: three have up to four poses
_THIN = 0.005  # extent across over extent along, up to which points count as one line
_WEAK = 0.04  # sd of a place over the distance to a point, beyond which it is far from linear
_APART = 25.0  # χ² of the difference of two centres from which they are two poses
_FITS = 13.8  # χ² by which a second pose may fit worse
_BESIDE_PX = 5.0  # an image point may be this far beyond a profile's end
_GRAZING = np.sin(np.radians(1.0))  # least angle of a ray to a plane; below, a pixel means metres


def resect(
    sensor: Sensor,
    interior: InteriorOrientation,
    covariance: Array,
    control: TestField,
    observations: Observations,
    start: ExteriorOrientation | None = None,
    snooping_alpha: float = 0.001,
) -> Adjustment:
    """Estimate the pose of a calibrated camera from control points with their sigmas.

    covariance (10, 10) of `interior`; start: an earlier pose, with which three points suffice.
    The result's covariance (16, 16) is that of camera and pose together. Never raises because of
    the data: without a result there are a status and a reason.
    """
    known = tuple(n for n, v in zip(IOP_NAMES, covariance.diagonal(), strict=True) if v > 0)
    s = AdjustmentSettings(free=known, snooping_alpha=snooping_alpha, correlation_bound=None)
    n, fewest = len(observations), _FEWEST - (start is not None)
    if n < fewest:
        return failed(
            "too_few_targets",
            f"{counted(n, 'control point')}; a pose needs at least {fewest}",
            observations,
        )
    points = control.points[observations.targets]
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extent[1] <= _THIN * extent[0]:
        why = "the control points lie on one line, about which the camera can turn: add one beside"
        return failed("no_orientation", why, observations)
    if (np.ptp(observations.points, axis=0) <= observations.sigmas.max()).all():
        why = "the control points are all seen at one place in the image; check x, y (px)"
        return failed("no_orientation", why, observations)
    pose, suspects = start, None
    if pose is None:
        sigmas = control.sigmas[observations.targets]
        pose, suspects = _approximate_pose(sensor, interior, points, observations.points, sigmas)
    if pose is None:
        why = f"no pose fits the {n} control points; check that x, y (px) belong to X, Y, Z"
        return failed("no_orientation", why, observations)
    result = adjust(sensor, control, observations, interior, pose, s, suspects, covariance)
    if len(result.rejected) > s.max_rejected * n or result.status == "too_many_rejected":
        why = (
            "too many control points contradict the others; check that x, y belong to X, Y, Z, and "
            "that the camera is this one, with this lens and image size"
        )
        return failed("too_many_rejected", why, observations)
    if not result.ok:
        return result
    nearest = np.linalg.norm(points - result.values[EOP][3:], axis=1).min()
    # sds that are stated far too large say nothing of the geometry
    true = min(1.0, 5.0 * result.sigma0) if result.redundancy > 4 else 1.0
    if true * (sd := float(result.sd[EOP][3:].max())) > _WEAK * nearest:
        why = (
            f"the control points determine the camera's place to ± {sd:.0f} mm only: add "
            "points beside their line or plane"
        )
        return replace(result, status="weak_geometry", reason=why)
    problem = sensor, control, observations, interior, covariance
    if _has_twin(*problem, result, replace(s, snooping_alpha=0.0), start):
        why = (
            f"a second pose fits the {n} control points nearly as well: add one outside their "
            "line or plane, or give an earlier pose"
        )
        return replace(result, status="ambiguous_pose", reason=why)
    return result


def _approximate_pose(
    sensor: Sensor, interior: InteriorOrientation, points: Array, uv: Array, sigmas: Array
) -> tuple[ExteriorOrientation | None, Mask | None]:
    """Return a pose to start from and a mask (n,) of the points that it does not fit."""
    pose = suspects = None
    with suppress(GeometryError):
        _, pose, fits = approximate_orientation(sensor, points, uv, interior=interior)
        suspects = ~fits
    if suspects is None or suspects.any():
        # the pose of three or four points that it draws may miss the others
        whole = possible_poses(sensor, interior, points, uv, sigmas)
        if whole:
            return whole[0], None
    return pose, suspects


def _has_twin(
    sensor: Sensor,
    control: TestField,
    observations: Observations,
    interior: InteriorOrientation,
    covariance: Array,
    pose: Adjustment,
    settings: AdjustmentSettings,
    earlier: ExteriorOrientation | None,
) -> bool:
    """Return whether a pose apart from the found one fits nearly as well.

    earlier: a pose; then only one that is nearer to it counts, none if the found one is the same.
    """
    here, Q = pose.values[EOP][3:], pose.covariance[EOP, EOP][3:, 3:]

    def is_apart(centre: Array) -> bool:
        apart = centre - here
        return bool(apart @ np.linalg.solve(Q, apart) > _APART)

    if earlier is not None and not is_apart(earlier.centre):
        return False

    def counts(centre: Array) -> bool:
        if not is_apart(centre):
            return False
        if earlier is None:
            return True
        away, kept = (np.linalg.norm(one - earlier.centre) for one in (centre, here))
        return bool(away < kept)

    seen = observations.select(~np.isin(observations.targets, pose.rejected))
    worst = pose.sigma0**2 * pose.redundancy + _FITS * max(pose.sigma0**2, 1.0)
    at, sigmas = control.points[seen.targets], control.sigmas[seen.targets]
    for start in possible_poses(sensor, interior, at, seen.points, sigmas):
        if counts(start.centre):
            other = adjust(sensor, control, seen, interior, start, settings, None, covariance)
            fits = other.ok and other.sigma0**2 * other.redundancy < worst
            if fits and counts(other.values[EOP][3:]):
                return True
    return False


class _Surface:
    """What rays meet: made from any lists of three numbers, a direction of any length."""

    def __post_init__(self) -> None:
        for name, value in vars(self).copy().items():
            words = "0 or above" if name[:2] == "sd" else "three numbers"
            try:
                array = floats(value)
            except (TypeError, ValueError):
                array = np.empty(0)
            if name[:2] == "sd":
                fits = array.ndim == 0 and bool(array >= 0.0)
            else:
                fits = array.shape[-1:] == (3,) and bool(np.isfinite(array).all())
            if name in ("normal", "direction"):
                size = np.linalg.norm(array, axis=-1, keepdims=True)
                fits = fits and bool((size > 0.0).all())
                if fits and (np.abs(size - 1.0) > 1e-12).any():
                    array = array / size
            if not fits:
                raise UsageError(f"{name} is {str(value)[:80]}; it must be {words}")
            object.__setattr__(self, name, array if array.ndim else float(array))


@dataclass(frozen=True, eq=False)
class Plane(_Surface):
    """A plane through `point` (3,) mm with a `normal` (3,); (n, 3): one for each image point.

    sd_mm: sd of its position along the normal; sd_tilt: sd of its tilt about each axis in it, rad.

    >>> water = tc.Plane([0.0, 0.0, 138_270.0], [0, 0, 1], sd_mm=5.0)
    """

    point: Array
    normal: Array
    sd_mm: float = 0.0
    sd_tilt: float = 0.0


@dataclass(frozen=True, eq=False)
class Line(_Surface):
    """A line, such as a staff, through `point` (3,) mm along a `direction` (3,).

    (n, 3): one for each image point.

    sd_mm: sd of its position across its direction.
    """

    point: Array
    direction: Array
    sd_mm: float = 0.0


@dataclass(frozen=True, eq=False)
class Profile(_Surface):
    """A surveyed profile, such as a river bank's: straight lines between `points` (k, 3) mm.

    sd_mm: sd of its position across its direction.
    """

    points: Array
    sd_mm: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.points.ndim != 2 or len(self.points) < 2:
            raise UsageError("a profile needs at least two points (k, 3), in order")


def place_on(
    sensor: Sensor,
    values: Array,
    covariance: Array,
    image_points: ArrayLike,
    sigmas: ArrayLike,
    surface: Plane | Line | Profile,
    own: Array | None = None,
    member: Index | None = None,
) -> tuple[Array, Array]:
    """Intersect image rays with a surface; return points (n, 3) mm and covariance (3n, 3n).

    values (16,) or (n, 16), covariance (16, 16): of camera and pose, the pose the same for all;
    image_points (n, 2), sigmas (n, 2) px; own (g, 10, 10): further covariances of the camera at g
    times; member (n,): time of each point. For a line, rays meet the plane through it that faces
    the camera, and points are projected onto the line: an image point's distance from the line's
    image has no effect, and points have variance along the line, and across it that of the line.
    Raises GeometryError for a point outside the image, and for a ray that does not meet the surface
    in front of the camera.
    """
    uv = np.atleast_2d(np.asarray(image_points, dtype=float))
    if not (inside := sensor.contains(uv, -1.0)).all():
        x, y = uv[np.argmin(inside)]
        raise GeometryError(
            f"image point {x:.0f}, {y:.0f} px is outside the camera's {sensor.width} × "
            f"{sensor.height} px"
        )
    values = np.broadcast_to(values, (len(uv), 16))
    pose = values[0, EOP]
    centre = pose[3:]
    if isinstance(surface, Profile):
        surface = _lines_of(surface, sensor, values, uv)
    plane = surface if isinstance(surface, Plane) else _facing(surface, centre)
    ray = rays(sensor, values[:, IOP], uv[:, None])[:, 0] @ rotation(pose[:3]).T
    normal = np.broadcast_to(plane.normal, ray.shape)
    steep = np.sum(ray * normal, axis=1)
    with np.errstate(divide="ignore"):
        reach = np.sum((plane.point - centre) * normal, axis=1) / steep
    missed = (np.abs(steep) < _GRAZING) | ~(reach > 0)
    if missed.any():
        row = int(np.argmax(missed))
        raise GeometryError(
            f"the ray of image point {uv[row, 0]:.1f}, {uv[row, 1]:.1f} px does not meet the plane "
            "in front of the camera: is it above the horizon, or is the plane the wrong one?"
        )
    X = centre + reach[:, None] * ray
    # [B; n'] dX = [du - A dp; dh]
    _, A, B = (p[:, 0] for p in partials(sensor, values[:, IOP], values[:, EOP], X[:, None]))
    left = np.concatenate([B, normal[:, None]], axis=1)
    inverse = np.linalg.inv(left)
    common = -inverse[:, :, :2] @ A
    moved = inverse[:, :, 2]
    shared = common.reshape(-1, 16)
    total = shared @ covariance @ shared.T
    total += plane.sd_mm**2 * np.outer(moved.ravel(), moved.ravel())
    if plane.sd_tilt:  # a tilt lifts a point in proportion to its distance from the axis
        axes = np.linalg.svd(normal[:1])[2][1:]
        lever = (X - plane.point) @ axes.T
        tilted = (moved[:, :, None] * lever[:, None, :]).reshape(-1, 2)
        total += plane.sd_tilt**2 * tilted @ tilted.T
    noise = np.broadcast_to(np.asarray(sigmas, dtype=float), uv.shape)
    of_noise = inverse[:, :, :2] * noise[:, None, :]
    each = np.einsum("iaib->iab", total.reshape(len(X), 3, len(X), 3))  # a view
    each += of_noise @ np.swapaxes(of_noise, 1, 2)
    if own is not None and member is not None:
        for k, Q in enumerate(own):
            at = np.flatnonzero(np.repeat(member == k, 3))
            lever = shared[at, IOP]
            total[at[:, None], at] += lever @ Q @ lever.T
    if isinstance(surface, Line):
        direction = np.broadcast_to(surface.direction, X.shape)
        point = np.broadcast_to(surface.point, X.shape)
        along = direction[:, :, None] * direction[:, None, :]
        n = len(X)
        blocks = total.reshape(n, 3, n, 3)
        blocks = np.einsum("iab,ibjc,jcd->iajd", along, blocks, along, optimize=True)
        # a line that is elsewhere takes its points with it; the lines of a profile are independent
        taken = np.eye(3) - along + (along @ moved[:, :, None]) * normal[:, None, :]
        same = (point[:, None] == point).all(axis=2) & (direction[:, None] == direction).all(axis=2)
        shared_line = np.einsum("iab,jcb,ij->iajc", taken, taken, same, optimize=True)
        total = (blocks + surface.sd_mm**2 * shared_line).reshape(3 * n, 3 * n)
        X = point + np.einsum("nab,nb->na", along, X - point)
    return X, total


def _facing(line: Line, centre: Array) -> Plane:
    """Return the plane through a line that faces a camera at a projection centre (3,)."""
    normal = np.cross(np.cross(line.direction, centre - line.point), line.direction)
    size = np.linalg.norm(normal, axis=-1, keepdims=True)
    if not (size > 0).all():
        raise GeometryError("the line passes through the camera, so that its image is a point")
    return Plane(line.point, normal / size)


def _lines_of(profile: Profile, sensor: Sensor, values: Array, uv: Array) -> Line:
    """Return the line of a profile for each image point: the one whose image is nearest.

    values (n, 16); uv (n, 2) px. Raises GeometryError for points beyond the profile's ends.
    """
    ends = project(sensor, values[:, IOP], values[0, EOP], profile.points)
    begin, step = ends[:, :-1], np.diff(ends, axis=1)
    size = np.sum(step**2, axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        at = np.sum((uv[:, None] - begin) * step, axis=2) / size
        off = np.linalg.norm(uv[:, None] - begin - np.clip(at, 0, 1)[..., None] * step, axis=2)
    chosen = np.argmin(np.where(np.isfinite(off), off, np.inf), axis=1)
    rows = np.arange(len(uv))
    beside = ~(np.abs(at[rows, chosen] - 0.5) * np.sqrt(size[rows, chosen])
               <= 0.5 * np.sqrt(size[rows, chosen]) + _BESIDE_PX)  # fmt: skip
    if beside.any():
        x, y = uv[np.argmax(beside)]
        raise GeometryError(f"image point {x:.1f}, {y:.1f} px is beyond the profile's ends")
    direction = np.diff(profile.points, axis=0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return Line(profile.points[chosen], direction[chosen], profile.sd_mm)
