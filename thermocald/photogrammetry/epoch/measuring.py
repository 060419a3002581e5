"""Out of pixels into metres with a known camera: its pose, and places on a plane or a line.

The interior orientation is known with its covariance (of a thermal model at a temperature, say) and
takes part as an observation, so that pose and camera come out correlated as they are. A place on a
plane or a line follows from the collinearity equations and that of the plane; its covariance holds
the image point's, the camera's, the pose's and the plane's.

Sources: Luhmann et al. (2014), sections 4.2.3 (resection) and 4.2.7 (monoplotting).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import (
    EOP,
    IOP,
    IOP_NAMES,
    ExteriorOrientation,
    partials,
    rays,
    rotation,
)
from thermocald.photogrammetry.epoch.adjustment import (
    NO_BOUNDS,
    AdjustmentSettings,
    adjust,
    failed,
    mirror_pose,
)
from thermocald.photogrammetry.orientation import approximate_orientation

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import InteriorOrientation, Sensor
    from thermocald.photogrammetry.epoch.adjustment import Adjustment
    from thermocald.photogrammetry.field.testfield import Observations, TestField

_FEWEST = 4  # control points: three have up to four poses
_AMBIGUITY = 2.0  # a second pose must fit this much worse to be excluded
_GRAZING = np.sin(np.radians(1.0))  # between a ray and a plane: beyond it a pixel is metres


def resect(
    sensor: Sensor,
    interior: InteriorOrientation,
    covariance: Array,
    control: TestField,
    observations: Observations,
    start: ExteriorOrientation | None = None,
    snooping_alpha: float = 0.001,
) -> Adjustment:
    """Return the pose of a camera that is known, from control points with their sigmas.

    covariance (10, 10) of `interior`; start: an earlier pose, with which three points suffice.
    The result's covariance (16, 16) joins camera and pose. Never raises for data: without a result
    there are a status and a reason.
    """
    known = tuple(n for n, v in zip(IOP_NAMES, covariance.diagonal(), strict=True) if v > 0)
    s = AdjustmentSettings(free=known, snooping_alpha=snooping_alpha, bounds=NO_BOUNDS)
    n, fewest = len(observations), _FEWEST - (start is not None)
    if n < fewest:
        return failed(
            "too_few_targets", f"{n} control points; a pose needs at least {fewest}", observations
        )
    suspects = None
    if start is None:
        points = control.points[observations.targets]
        try:
            _, start, fits = approximate_orientation(
                sensor, points, observations.points, interior=interior
            )
        except GeometryError as error:
            return failed("no_orientation", str(error), observations)
        suspects = ~fits
    result = adjust(sensor, control, observations, interior, start, s, suspects, covariance)
    if result.ok and suspects is not None:
        second = mirror_pose(sensor, control, observations, interior)
        if second is not None and second < _AMBIGUITY**2:
            why = (
                "the control points lie in one plane, and a second, mirrored pose fits nearly as "
                "well: add one outside of the plane, or state an earlier pose"
            )
            return replace(result, status="ambiguous_pose", reason=why)
    return result


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane through `point` (3,) mm with a unit `normal` (3,).

    sd_mm: of its place along the normal; sd_tilt: rad, of the normal about each axis across it.
    """

    point: Array
    normal: Array
    sd_mm: float = 0.0
    sd_tilt: float = 0.0


@dataclass(frozen=True, eq=False)
class Line:
    """A line through `point` (3,) mm along the unit vector `direction` (3,): a staff, a profile.

    sd_mm: of its place across its direction.
    """

    point: Array
    direction: Array
    sd_mm: float = 0.0


def on_plane(
    sensor: Sensor,
    values: Array,
    covariance: Array,
    image_points: ArrayLike,
    sigmas: ArrayLike,
    plane: Plane,
    own: Array | None = None,
) -> tuple[Array, Array]:
    """Return where image points lie on a plane: (n, 3) mm, and their joint covariance (3n, 3n).

    values (16,) or (n, 16), covariance (16, 16): camera and pose, the pose of all is the same;
    image_points (n, 2), sigmas (n, 2) px; own (n, 10, 10): what each point's camera has besides.
    Raises GeometryError for a point whose ray does not meet the plane before the camera.
    """
    uv = np.atleast_2d(np.asarray(image_points, dtype=float))
    values = np.broadcast_to(values, (len(uv), 16))
    pose = values[0, EOP]
    ray = rays(sensor, values[:, IOP], uv[:, None])[:, 0] @ rotation(pose[:3]).T
    centre = pose[3:]
    steep = ray @ plane.normal
    with np.errstate(divide="ignore"):
        reach = ((plane.point - centre) @ plane.normal) / steep
    missed = (np.abs(steep) < _GRAZING) | ~(reach > 0)
    if missed.any():
        row = int(np.argmax(missed))
        raise GeometryError(
            f"the ray of image point {uv[row, 0]:.1f}, {uv[row, 1]:.1f} px does not meet the plane "
            "before the camera: is it above the horizon, or is the plane the wrong one?"
        )
    X = centre + reach[:, None] * ray
    # [B; n'] dX = [du - A dp; dh]
    _, A, B = (p[:, 0] for p in partials(sensor, values[:, IOP], values[:, EOP], X[:, None]))
    left = np.concatenate([B, np.broadcast_to(plane.normal, (len(X), 1, 3))], axis=1)
    inverse = np.linalg.inv(left)
    common = -inverse[:, :, :2] @ A
    moved = inverse[:, :, 2]
    across = _across(plane.normal)
    lever = (X - plane.point) @ across.T  # a tilt lifts a place by its distance from the axis
    shared = common.reshape(-1, 16)
    tilted = (moved[:, :, None] * lever[:, None, :]).reshape(-1, 2)
    total = shared @ covariance @ shared.T
    total += plane.sd_mm**2 * np.outer(moved.ravel(), moved.ravel())
    total += plane.sd_tilt**2 * tilted @ tilted.T
    noise = np.broadcast_to(np.asarray(sigmas, dtype=float), uv.shape)
    for i, block in enumerate(inverse[:, :, :2] * noise[:, None, :]):
        rows = slice(3 * i, 3 * i + 3)
        total[rows, rows] += block @ block.T
        if own is not None:
            total[rows, rows] += common[i][:, IOP] @ own[i] @ common[i][:, IOP].T
    return X, total


def on_line(
    sensor: Sensor,
    values: Array,
    covariance: Array,
    image_points: ArrayLike,
    sigmas: ArrayLike,
    line: Line,
    own: Array | None = None,
) -> tuple[Array, Array]:
    """Return where image points lie on a line: (n, 3) mm, and their joint covariance (3n, 3n).

    As `on_plane`, in the plane through the line that faces the camera; what an image point is off
    the line's image is left over, and not in the result. A place has a direction of no variance.
    """
    centre = np.atleast_2d(values)[0, EOP][3:]
    aside = np.cross(line.direction, centre - line.point)
    normal = np.cross(aside, line.direction)
    size = np.linalg.norm(normal)
    if not size > 0:
        raise GeometryError("the line passes through the camera: it is seen as a point")
    plane = Plane(line.point, normal / size, line.sd_mm)
    X, covariance_of_X = on_plane(sensor, values, covariance, image_points, sigmas, plane, own)
    along = np.outer(line.direction, line.direction)
    block = np.kron(np.eye(len(X)), along)
    return line.point + (X - line.point) @ along, block @ covariance_of_X @ block


def place_on(
    sensor: Sensor,
    values: Array,
    covariance: Array,
    image_points: ArrayLike,
    sigmas: ArrayLike,
    surface: Plane | Line,
    own: Array | None = None,
) -> tuple[Array, Array]:
    """Return what `on_plane` or `on_line` does, whichever the surface is."""
    if isinstance(surface, Line):
        return on_line(sensor, values, covariance, image_points, sigmas, surface, own)
    return on_plane(sensor, values, covariance, image_points, sigmas, surface, own)


def _across(normal: Array) -> Array:
    """Two unit vectors (2, 3) across a normal."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])
