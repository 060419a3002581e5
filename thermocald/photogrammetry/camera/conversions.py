"""Conversion between our camera model and others: exact where the conventions allow, else fitted.

A `Family` is a camera model; ours is `BROWN`. Each converts our parameters to its own and back, at
least approximately and often exactly. Unless the converted parameters reproduce every pixel, they
are fitted over the image area, and the result gives the largest and the RMS residual in px.
Covariances follow from the derivative of the same fit.

Directions are (X/Z, Y/Z) in OpenCV's axes: x right, y down, looking along +Z. Image points are px
with (0, 0) at the centre of the top-left pixel; families with another origin convert internally.

Families:

- `opencv(count)`: the radial and tangential model of OpenCV, ROS, COLMAP, mrcal and Kalibr, with as
  many of k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 as a format has;
- `METASHAPE`: Agisoft's frame camera, affinity and skew applied after the distortion;
- `measured_point(r0)`: our ten terms, the radial ones balanced by r0 mm, evaluated at the measured
  point: `x̄ = x' - x0 - Δx(x' - x0, y' - y0)`;
- `aicon(r0)`: the same at the ideal point, affinity and shear applied after the distortion.

Sources: OpenCV 5 documentation, calib3d; Agisoft Metashape User Manual 2.1, appendix D, "Frame
cameras"; Luhmann, T. et al. (2014): Close-Range Photogrammetry and 3D Imaging, 2nd ed., section
3.3.2 and 3.3.3.4 (modelling at the measured point, balanced radial terms).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, Sensor, distort, image_to_px
from thermocald.photogrammetry.camera.camera_model import rays as camera_rays
from thermocald.result import with_sds

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.arrays import Array

EXACT_PX = 1e-7
_GRID = (41, 31)
_CHECK_GRID = (97, 73)
_ROUNDING = 1e-8  # share of the uncertainty in the image
_STEP = 1e-30j
"""All families are polynomial or rational: a complex step gives a derivative without a difference.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Family:
    """A camera model with parameters in a fixed order.

    name: for messages; project: function of directions (n, 2) that returns image points (n, 2) px;
    from_brown: converts our ten parameters to the family's, exactly or approximately; to_brown:
    converts back.
    """

    name: str
    parameters: tuple[str, ...]
    project: Callable[[Sensor, Array, Array], Array]
    from_brown: Callable[[Sensor, Array], Array]
    to_brown: Callable[[Sensor, Array], Array]


def image_grid(sensor: Sensor, shape: tuple[int, int] = _GRID) -> Array:
    """Return image points (n, 2) px that cover the whole image, its edges included."""
    x = np.linspace(-0.5, sensor.width - 0.5, shape[0])
    y = np.linspace(-0.5, sensor.height - 0.5, shape[1])
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def convert(
    sensor: Sensor, source: Family, values: Array, target: Family, covariance: Array | None = None
) -> tuple[Array, Array | None, bool, float, float]:
    """Convert a camera (values and covariance in the source's order) to another family.

    Returns values and covariance in the target's order, whether they are exact, and the largest and
    RMS residual over the image, px. The covariance is propagated through the least-squares fit of
    the target's parameters to the pixels that the source's move. Raises GeometryError if the
    source's distortion folds back inside the image.
    """
    from scipy.optimize import least_squares  # 20 MB that a live daemon does not need

    if source is target:
        return values, covariance, True, 0.0, 0.0
    own = source.to_brown(sensor, values)
    grid, check = image_grid(sensor), image_grid(sensor, _CHECK_GRID)
    directions, checked = (
        _directions(sensor, source, values, own, pixels) for pixels in (grid, check)
    )

    project_source, project_target = (partial(f.project, sensor) for f in (source, target))
    result = target.from_brown(sensor, own)
    residual = project_target(result, checked) - check
    if not np.abs(residual).max() < EXACT_PX:
        result = least_squares(
            lambda v: (project_target(v, directions) - grid).ravel(), result,
            partial(_derivative, lambda v: project_target(v, directions)),
            x_scale="jac", ftol=1e-15, xtol=1e-15, gtol=None, max_nfev=50,
        ).x  # fmt: skip
        residual = project_target(result, checked) - check
    exact = bool(np.abs(residual).max() < EXACT_PX)
    propagated = None
    if covariance is not None:
        G = _derivative(lambda v: project_target(v, directions), result)
        F = _derivative(lambda v: project_source(v, directions), values)
        scales = np.linalg.norm(G, axis=0)
        scales[scales == 0] = 1.0  # a parameter without effect is 0
        J = np.linalg.lstsq(G / scales, F, rcond=1e-14)[0] / scales[:, None]
        propagated = J @ covariance @ J.T
        # what a fixed parameter keeps is rounding, and may be negative
        moved = scales**2 * np.diag(propagated)
        fixed = moved <= _ROUNDING**2 * moved.max()
        propagated[fixed] = propagated[:, fixed] = 0.0
    size = np.linalg.norm(residual, axis=1)
    return result, propagated, exact, float(size.max()), float(np.sqrt(np.mean(size**2)))


def _directions(sensor: Sensor, family: Family, values: Array, own: Array, pixels: Array) -> Array:
    """Return a family's directions of image points, by Newton's method from a pinhole camera.

    own (10,): the nearby parameters of our model.
    """
    if family is BROWN:
        r = camera_rays(sensor, values, pixels)
        return np.column_stack([r[:, 0] / -r[:, 2], r[:, 1] / r[:, 2]])
    c, x0, y0, C1 = own[[0, 1, 2, 8]]
    from_point = (pixels - sensor.centre) * sensor.pixel_pitch - np.array([x0, -y0])
    d: Array = from_point / np.array([c * (1 + C1), c])
    with np.errstate(all="ignore"):  # a distortion that folds back may run away
        for _ in range(60):
            r = pixels - family.project(sensor, values, d)
            worst = float(np.max(np.abs(r)))
            if worst < 1e-9:
                return d
            J = [np.imag(family.project(sensor, values, d + by)) for by in _STEP * np.eye(2)]
            try:
                d = d + np.linalg.solve(np.stack(J, axis=-1) / abs(_STEP), r[..., None])[..., 0]
            except np.linalg.LinAlgError:
                break
    raise GeometryError(
        f"the {family.name} has no rays for some of the image: its distortion folds back "
        "inside the picture; it was calibrated over a smaller area, or its parameters are wrong"
    )


def _derivative(function: Callable[[Array], Array], values: Array) -> Array:
    """Return ∂function/∂values, the function's values in a column, exact to the last digits."""
    columns = [np.imag(function(values + by)).ravel() for by in _STEP * np.eye(len(values))]
    return np.stack(columns, axis=1) / abs(_STEP)


def opencv_terms(sensor: Sensor, values: Array, covariance: Array) -> dict[str, float]:
    """Return OpenCV's parameters with sds, and the image size, quickly by the closed form.

    values (10,), covariance (10, 10). `exact` is 1 without affinity and shear, else 0.
    """
    family = opencv(5)
    terms = family.from_brown(sensor, values)
    J = _derivative(partial(family.from_brown, sensor), values)
    with np.errstate(invalid="ignore"):  # in a weak epoch rounding may make a variance negative
        sds = np.sqrt(np.diag(J @ covariance @ J.T))
    size = {"width": sensor.width, "height": sensor.height}
    exact = float(values[8] == 0 and values[9] == 0)
    return {**size, **with_sds(family.parameters, terms, sds), "exact": exact}


def _project_brown(sensor: Sensor, iop: Array, directions: Array) -> Array:
    x, y = distort(iop, iop[0] * directions[:, 0], -iop[0] * directions[:, 1])
    return image_to_px(sensor, np.column_stack([x, y]))


def _same(_: Sensor, values: Array) -> Array:
    """Return the parameters, which are near enough for a fit to begin with."""
    return values


BROWN = Family("Brown model", IOP_NAMES, _project_brown, _same, _same)
"""Our own model."""


_OPENCV = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6",
           "s1", "s2", "s3", "s4")  # fmt: skip


def opencv(count: int) -> Family:
    """Return OpenCV's model with the first `count` distortion coefficients: 0, 4, 5, 8, or 12."""
    return Family(
        f"OpenCV model with {count} coefficients",
        _OPENCV[: 4 + count],
        _project_opencv,
        lambda sensor, iop: _opencv_of_brown(sensor, iop)[: 4 + count],
        _brown_of_opencv,
    )


def _sixteen(values: Array) -> Array:
    """Return all of OpenCV's parameters, 0 for those that a model does not have."""
    return np.pad(values, (0, len(_OPENCV) - len(values)))


def _project_opencv(_: Sensor, values: Array, directions: Array) -> Array:
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = _sixteen(values)
    x, y = directions[:, 0], directions[:, 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    radial = radial / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4)
    return np.column_stack([fx * xd + cx, fy * yd + cy])


def _opencv_of_brown(sensor: Sensor, iop: Array) -> Array:
    """Convert our parameters to OpenCV's (CONVENTIONS §2), exactly but for C2."""
    c, x0, y0, A1, A2, A3, B1, B2, C1, _ = iop
    p, (cx, cy), none = sensor.pixel_pitch, sensor.centre, [0 * c] * 7
    return np.array(
        [
            (1 + C1) * c / p, c / p, cx + x0 / p, cy - y0 / p,
            A1 * c**2, A2 * c**4, -B2 * c, B1 * c, A3 * c**6, *none,
        ]
    )  # fmt: skip


def _brown_of_opencv(sensor: Sensor, values: Array) -> Array:
    """Convert OpenCV's parameters to ours: a rational denominator to first order, no thin prism."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, *_ = _sixteen(values)
    p, c, centre = sensor.pixel_pitch, fy * sensor.pixel_pitch, sensor.centre
    A3 = 0.0 if k4 or k5 or k6 else k3 / c**6
    return np.array(
        [
            c, (cx - centre[0]) * p, -(cy - centre[1]) * p,
            (k1 - k4) / c**2, (k2 - k5 - k4 * (k1 - k4)) / c**4, A3,
            p2 / c, -p1 / c, fx / fy - 1, 0.0,
        ]
    )  # fmt: skip


def _project_metashape(sensor: Sensor, values: Array, directions: Array) -> Array:
    """Project as in its manual: u = w/2 + cx + x'f + x'b1 + y'b2, with pixel centres at 0.5."""
    f, cx, cy, b1, b2, k1, k2, k3, k4, p1, p2 = values
    x, y = directions[:, 0], directions[:, 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    xd = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    yd = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    centre = sensor.centre
    return np.column_stack([centre[0] + cx + xd * (f + b1) + yd * b2, centre[1] + cy + yd * f])


def _metashape_of_brown(sensor: Sensor, iop: Array) -> Array:
    """Convert our parameters to Metashape's; exact without affinity and shear, or distortion."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, *_ = _opencv_of_brown(sensor, iop)
    x, y = np.array([cx, cy]) - sensor.centre
    return np.array([fy, x, y, fx - fy, -iop[9] * fy, k1, k2, k3, k4, p2, p1])


def _brown_of_metashape(sensor: Sensor, values: Array) -> Array:
    """Convert Metashape's parameters to ours; k4 has no counterpart."""
    f, cx, cy, b1, b2, k1, k2, k3, _, p1, p2 = values
    x, y = np.array([cx, cy]) + sensor.centre
    brown = _brown_of_opencv(sensor, np.array([f + b1, f, x, y, k1, k2, p2, p1, k3]))
    brown[9] = -b2 / f
    return brown


METASHAPE = Family(
    "Metashape frame model", ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2"),
    _project_metashape, _metashape_of_brown, _brown_of_metashape,
)  # fmt: skip
"""Agisoft's frame camera."""


def measured_point(r0: float) -> Family:
    """Return our ten terms evaluated at the measured point, the radial ones balanced by r0 mm."""
    name = f"photogrammetric model at the measured point, r0 {r0:g} mm"

    def project_them(sensor: Sensor, values: Array, directions: Array) -> Array:
        c, x0, y0, *_, C1, C2 = values
        ideal_x, ideal_y = c * directions[:, 0], -c * directions[:, 1]
        x, y = ideal_x, ideal_y
        for _ in range(200):
            with np.errstate(over="ignore", invalid="ignore"):  # tested below
                dx, dy = _balanced_correction(values, r0, x, y)
                new_x, new_y = ideal_x + (dx + C1 * x + C2 * y), ideal_y + dy
                change = float(np.max(np.abs(new_x - x) + np.abs(new_y - y)))
            x, y = new_x, new_y
            if change < 1e-12 * sensor.pixel_pitch:
                break
            if not np.isfinite(change):
                raise GeometryError(f"the {name} does not converge over the image")
        return image_to_px(sensor, np.column_stack([x0 + x, y0 + y]))

    return Family(name, IOP_NAMES, project_them, _same, _same)


def aicon(r0: float) -> Family:
    """Return our terms at the ideal point, the radial ones balanced by r0 mm, with affinity and
    shear applied after the distortion: exact without affinity and shear.
    """

    def project_them(sensor: Sensor, values: Array, directions: Array) -> Array:
        c, x0, y0, *_, C1, C2 = values
        x, y = c * directions[:, 0], -c * directions[:, 1]
        dx, dy = _balanced_correction(values, r0, x, y)
        x, y = x + dx, y + dy
        return image_to_px(sensor, np.column_stack([x0 + (1 + C1) * x + C2 * y, y0 + y]))

    return Family(f"AICON model, R0 {r0:g} mm", IOP_NAMES, project_them, _same, _same)


def _balanced_correction(values: Array, r0: float, x: Array, y: Array) -> tuple[Array, Array]:
    """Return radial and decentring Δx, Δy mm at points (mm, about the principal point)."""
    A1, A2, A3, B1, B2 = values[3:8]
    r2, q = x * x + y * y, r0**2
    radial = A1 * (r2 - q) + A2 * (r2**2 - q**2) + A3 * (r2**3 - q**3)
    return (
        x * radial + B1 * (r2 + 2 * x * x) + 2 * B2 * x * y,
        y * radial + B2 * (r2 + 2 * y * y) + 2 * B1 * x * y,
    )
