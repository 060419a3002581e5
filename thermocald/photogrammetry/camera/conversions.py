"""From our camera model to others' and back: exact where the conventions allow, else the best fit.

A `Family` is somebody else's camera model. Each gives its approximate (often exact) counterpart
of our parameters, and back. Where the counterpart reproduces every pixel it is the answer; where
not, the parameters are fitted over the image area and the result says how well: largest and RMS
residual in px. Covariances follow by the derivative of the same fit.

Directions are (X/Z, Y/Z) in the axes that OpenCV uses: x right, y down, looking along +Z; image
points px with (0, 0) at the centre of the top-left pixel throughout, families convert at their
edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import (
    CameraModel,
    InteriorOrientation,
    Sensor,
    project,
)
from thermocald.photogrammetry.camera.camera_model import rays as camera_rays

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.arrays import Array

__all__ = ["Conversion", "Family", "directions_of", "from_family", "image_grid", "to_family"]

EXACT_PX = 1e-7
_GRID = (41, 31)
_CHECK_GRID = (97, 73)
_NO_POSE = np.zeros(6)


class Family(Protocol):
    """A camera model with parameters in a fixed order."""

    @property
    def name(self) -> str:
        """What it is called in messages."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """The names of its parameters."""

    def project(self, sensor: Sensor, values: Array, directions: Array) -> Array:
        """Directions (n, 2) → image points (n, 2) px."""

    def from_brown(self, model: CameraModel) -> Array:
        """Its parameters for our model, exact or near."""

    def to_brown(self, sensor: Sensor, values: Array) -> InteriorOrientation:
        """Our parameters for its own, exact or near."""


@dataclass(frozen=True, slots=True, eq=False)
class Conversion:
    """What a conversion gave: parameters in the target's order, its residuals over the image, the
    covariance if one was given.
    """

    values: Array
    exact: bool
    largest_px: float
    rms_px: float
    covariance: Array | None

    @property
    def statement(self) -> str:
        """One line for the file."""
        if self.exact:
            return "exact: both models give the same pixels"
        return (
            f"fitted over the image area: largest residual {self.largest_px:.3g} px, "
            f"RMS {self.rms_px:.3g} px"
        )


def image_grid(sensor: Sensor, shape: tuple[int, int] = _GRID) -> Array:
    """Image points (n, 2) px that cover the whole image, its edges included."""
    x = np.linspace(-0.5, sensor.width - 0.5, shape[0])
    y = np.linspace(-0.5, sensor.height - 0.5, shape[1])
    u, v = np.meshgrid(x, y)
    return np.column_stack([u.ravel(), v.ravel()])


def brown_project(sensor: Sensor, iop: Array, directions: Array) -> Array:
    """Our own model as a family's: directions (n, 2) → image points (n, 2) px."""
    points = np.column_stack([directions[:, 0], -directions[:, 1], -np.ones(len(directions))])
    return project(sensor, iop, _NO_POSE, points)


def brown_directions(model: CameraModel, pixels: Array) -> Array:
    """Image points → directions of our own model. GeometryError where its distortion folds back."""
    r = camera_rays(model.sensor, model.interior.as_array(), pixels)
    result: Array = np.column_stack([r[:, 0] / -r[:, 2], r[:, 1] / r[:, 2]])
    return result


def directions_of(
    sensor: Sensor, family: Family, values: Array, pixels: Array, start: Array
) -> Array:
    """Image points → directions of a family, by Newton's method from approximate directions."""
    d = start.copy()
    step = 1e-6
    for _ in range(60):
        r = pixels - family.project(sensor, values, d)
        worst = float(np.max(np.abs(r))) if np.all(np.isfinite(r)) else np.inf
        if worst < 1e-9:
            return d
        J = np.empty((len(d), 2, 2))
        for k in range(2):
            e = np.zeros(2)
            e[k] = step
            J[:, :, k] = (
                family.project(sensor, values, d + e) - family.project(sensor, values, d - e)
            ) / (2 * step)
        try:
            d = d + np.linalg.solve(J, r[..., None])[..., 0]
        except np.linalg.LinAlgError:
            break
    # the differences that the derivative is taken from limit what can be reached
    if worst < EXACT_PX:
        return d
    raise GeometryError(
        f"the {family.name} model has no rays for some of the image: its distortion folds back "
        "inside the picture; it was calibrated over a smaller area, or its parameters are wrong"
    )


def to_family(model: CameraModel, family: Family, covariance: Array | None = None) -> Conversion:
    """Our model in a family's parameters; covariance (10, 10) in the order of `IOP_NAMES`."""
    grid = image_grid(model.sensor)
    directions = brown_directions(model, grid)

    def target(values: Array, d: Array) -> Array:
        return family.project(model.sensor, values, d)

    def source(values: Array, d: Array) -> Array:
        return brown_project(model.sensor, values, d)

    check = image_grid(model.sensor, _CHECK_GRID)
    values, exact, residual = _settle(
        target, family.from_brown(model), grid, directions, check, brown_directions(model, check)
    )
    return _conversion(
        values, exact, residual, source, model.interior.as_array(), target, directions, covariance
    )


def from_family(
    sensor: Sensor, family: Family, values: Array, covariance: Array | None = None
) -> Conversion:
    """A family's parameters as our ten, in the order of `IOP_NAMES`."""
    start = family.to_brown(sensor, values)
    begin = CameraModel(sensor, start)
    directions, checks = (
        directions_of(sensor, family, values, pixels, _pinhole(begin, pixels))
        for pixels in (image_grid(sensor), image_grid(sensor, _CHECK_GRID))
    )

    def target(iop: Array, d: Array) -> Array:
        return brown_project(sensor, iop, d)

    def source(v: Array, d: Array) -> Array:
        return family.project(sensor, v, d)

    result, exact, residual = _settle(
        target, start.as_array(), image_grid(sensor), directions,
        image_grid(sensor, _CHECK_GRID), checks,
    )  # fmt: skip
    return _conversion(result, exact, residual, source, values, target, directions, covariance)


def _pinhole(model: CameraModel, pixels: Array) -> Array:
    """Directions without distortion, to begin with."""
    i, p = model.interior, model.sensor.pixel_pitch
    d = (pixels - model.sensor.centre) * p - np.array([i.x0, -i.y0])
    directions: Array = d / np.array([i.c * (1 + i.C1), i.c])
    return directions


def _settle(
    target: Callable[[Array, Array], Array],
    start: Array,
    pixels: Array,
    directions: Array,
    check_pixels: Array,
    check_directions: Array,
) -> tuple[Array, bool, Array]:
    """The counterpart if it is exact, else the fit; and the residuals (n, 2) px."""
    residual = target(start, check_directions) - check_pixels
    if np.all(np.isfinite(residual)) and np.abs(residual).max() < EXACT_PX:
        return start, True, residual
    values = _fit(target, start, pixels, directions)
    return values, False, target(values, check_directions) - check_pixels


def _fit(
    target: Callable[[Array, Array], Array], start: Array, pixels: Array, directions: Array
) -> Array:
    """Least squares over the image area, Gauss-Newton with step halving."""
    values = start.astype(float)
    cost = _cost(target, values, pixels, directions)
    for _ in range(50):
        G = _derivative(target, values, directions)
        r = (pixels - target(values, directions)).ravel()
        scales = np.linalg.norm(G, axis=0)
        used = scales > 0
        step = np.zeros(len(values))
        step[used] = np.linalg.lstsq(G[:, used] / scales[used], r, rcond=1e-14)[0] / scales[used]
        for _halving in range(20):
            new = _cost(target, values + step, pixels, directions)
            if new < cost:
                break
            step /= 2
        else:
            return values
        values = values + step
        if cost - new < 1e-12 * cost:
            return values
        cost = new
    return values


def _cost(
    target: Callable[[Array, Array], Array], values: Array, pixels: Array, directions: Array
) -> float:
    r = pixels - target(values, directions)
    return float(np.sum(r * r)) if np.all(np.isfinite(r)) else np.inf


def _derivative(
    function: Callable[[Array, Array], Array], values: Array, directions: Array
) -> Array:
    """∂(image points)/∂(parameters), (2n, u), central differences.

    All families are polynomial or rational in their parameters; the step is one that moves the
    image by about a hundredth of a pixel.
    """
    G = np.zeros((2 * len(directions), len(values)))
    base = function(values, directions)
    for k in range(len(values)):
        h = 1e-6 * max(abs(values[k]), 1e-3)
        for _ in range(30):
            moved = values.copy()
            moved[k] += h
            shift = float(np.nanmax(np.abs(function(moved, directions) - base)))
            if shift == 0:
                h *= 1e3
            elif 1e-4 < shift < 1e-1:
                break
            else:
                h *= 1e-2 / shift
        plus, minus = values.copy(), values.copy()
        plus[k] += h
        minus[k] -= h
        G[:, k] = (
            (function(plus, directions) - function(minus, directions)) / (plus[k] - minus[k])
        ).ravel()
    return G


def _conversion(
    values: Array,
    exact: bool,
    residual: Array,
    source: Callable[[Array, Array], Array],
    source_values: Array,
    target: Callable[[Array, Array], Array],
    directions: Array,
    covariance: Array | None,
) -> Conversion:
    """The result, with the covariance carried over: small changes of the source's parameters move
    pixels, and the target's parameters follow by least squares.
    """
    carried = None
    if covariance is not None:
        G = _derivative(target, values, directions)
        F = _derivative(source, source_values, directions)
        scales = np.linalg.norm(G, axis=0)
        used = scales > 0
        J = np.zeros((len(values), len(source_values)))
        J[used] = np.linalg.lstsq(G[:, used] / scales[used], F, rcond=1e-14)[0] / scales[used, None]
        carried = J @ covariance @ J.T
    size = np.linalg.norm(residual, axis=1)
    return Conversion(values, exact, float(size.max()), float(np.sqrt(np.mean(size**2))), carried)
