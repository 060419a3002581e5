"""From our camera model to others' and back: exact where the conventions allow, else the best fit.

A `Family` is somebody else's camera model. Each gives its approximate (often exact) counterpart
of our parameters, and back. Where the counterpart reproduces every pixel it is the answer; where
not, the parameters are fitted over the image area and the result says how well: largest and RMS
residual in px. Covariances follow by the derivative of the same fit.

Directions are (X/Z, Y/Z) in the axes that OpenCV uses: x right, y down, looking along +Z; image
points px with (0, 0) at the centre of the top-left pixel throughout, families convert at their
edge.

Families:

- `BrownOpenCV`: the radial and tangential model of OpenCV, ROS, COLMAP, mrcal, Kalibr, with as many
  of k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 as a format has;
- `Metashape`: Agisoft's frame camera, affinity and skew applied after the distortion;
- `MeasuredPoint`: photogrammetric terms evaluated at the measured image point, radial terms
  balanced by r0 (AICON and others); with `at_ideal_point` the same terms at the ideal point.

Sources: OpenCV 5 documentation, calib3d; Agisoft Metashape User Manual 2.1, appendix D, "Frame
cameras"; Luhmann, T. et al. (2014): Close-Range Photogrammetry and 3D Imaging, 2nd ed., section
3.3.2 and 3.3.3.4 (modelling at the measured point, balanced radial terms).
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


def opencv_terms(sensor: Sensor, values: Array, covariance: Array) -> dict[str, float]:
    """Return OpenCV's terms with sds, and the size of the image, by the closed form; quickly.

    values (10,), covariance (10, 10). Exact without an affinity and a shear, as `exact` says.
    """
    c, x0, y0, A1, A2, A3, B1, B2, C1, C2 = values.tolist()
    f = 1.0 / sensor.pixel_pitch
    centre = sensor.centre
    terms: dict[str, tuple[float, dict[int, float]]] = {
        "fx": ((1 + C1) * c * f, {0: (1 + C1) * f, 8: c * f}),
        "fy": (c * f, {0: f}),
        "cx": (float(centre[0]) + x0 * f, {1: f}),
        "cy": (float(centre[1]) - y0 * f, {2: -f}),
        "k1": (A1 * c**2, {0: 2 * A1 * c, 3: c**2}),
        "k2": (A2 * c**4, {0: 4 * A2 * c**3, 4: c**4}),
        "p1": (-B2 * c, {0: -B2, 7: -c}),
        "p2": (B1 * c, {0: B1, 6: c}),
        "k3": (A3 * c**6, {0: 6 * A3 * c**5, 5: c**6}),
    }
    found: dict[str, float] = {"width": sensor.width, "height": sensor.height}
    for name, (value, partial) in terms.items():
        j = np.zeros(10)
        j[list(partial)] = list(partial.values())
        found |= {name: value, f"sd_{name}": float(j @ covariance @ j) ** 0.5}
    return {**found, "exact": float(C1 == 0 and C2 == 0)}


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


_OPENCV = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6",
           "s1", "s2", "s3", "s4")  # fmt: skip


@dataclass(frozen=True, slots=True)
class BrownOpenCV:
    """OpenCV's model with the first `count` distortion coefficients: 0, 4, 5, 8, or 12."""

    count: int = 5

    @property
    def name(self) -> str:
        """For messages."""
        return f"OpenCV model with {self.count} coefficients"

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names in OpenCV's order."""
        return _OPENCV[: 4 + self.count]

    def project(self, sensor: Sensor, values: Array, directions: Array) -> Array:  # noqa: ARG002
        """Directions → image points; the formula of cv2.projectPoints."""
        v = np.zeros(16)
        v[: len(values)] = values
        fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = v
        x, y = directions[:, 0], directions[:, 1]
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        prism_x, prism_y = r2 * (s1 + r2 * s2), r2 * (s3 + r2 * s4)
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + prism_x
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + prism_y
        return np.column_stack([fx * xd + cx, fy * yd + cy])

    def from_brown(self, model: CameraModel) -> Array:
        """CONVENTIONS §2."""
        i, p = model.interior, model.sensor.pixel_pitch
        cx, cy = model.sensor.centre
        c = i.c
        full = [
            (1 + i.C1) * c / p, c / p, cx + i.x0 / p, cy - i.y0 / p,
            i.A1 * c**2, i.A2 * c**4, -i.B2 * c, i.B1 * c, i.A3 * c**6,
        ]  # fmt: skip
        return np.array((full + [0.0] * 7)[: 4 + self.count])

    def to_brown(self, sensor: Sensor, values: Array) -> InteriorOrientation:
        """The inverse; a rational denominator enters to first order, thin prisms not at all."""
        v = np.zeros(16)
        v[: len(values)] = values
        p, c = sensor.pixel_pitch, v[1] * sensor.pixel_pitch
        centre = sensor.centre
        return InteriorOrientation(
            c=c, x0=(v[2] - centre[0]) * p, y0=-(v[3] - centre[1]) * p,
            A1=(v[4] - v[9]) / c**2, A2=(v[5] - v[10] - v[9] * (v[4] - v[9])) / c**4,
            A3=v[8] / c**6 if not v[9:12].any() else 0.0,
            B1=v[7] / c, B2=-v[6] / c, C1=v[0] / v[1] - 1,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Metashape:
    """Agisoft's frame camera."""

    name: str = "Metashape frame model"
    parameters: tuple[str, ...] = (
        "f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2",
    )  # fmt: skip

    def project(self, sensor: Sensor, values: Array, directions: Array) -> Array:
        """Directions → image points; u = w/2 + cx + x'f + x'b1 + y'b2 with pixel centres at 0.5."""
        f, cx, cy, b1, b2, k1, k2, k3, k4, p1, p2 = values
        x, y = directions[:, 0], directions[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        xd = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
        yd = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
        centre = sensor.centre
        return np.column_stack([centre[0] + cx + xd * (f + b1) + yd * b2, centre[1] + cy + yd * f])

    def from_brown(self, model: CameraModel) -> Array:
        """Exact without affinity and shear, or without distortion."""
        i, p = model.interior, model.sensor.pixel_pitch
        c = i.c
        return np.array(
            [
                c / p, i.x0 / p, -i.y0 / p, i.C1 * c / p, -i.C2 * c / p,
                i.A1 * c**2, i.A2 * c**4, i.A3 * c**6, 0.0, i.B1 * c, -i.B2 * c,
            ]
        )  # fmt: skip

    def to_brown(self, sensor: Sensor, values: Array) -> InteriorOrientation:
        """The inverse; k4 has no counterpart."""
        f, cx, cy, b1, b2, k1, k2, k3, _, p1, p2 = values
        p, c = sensor.pixel_pitch, f * sensor.pixel_pitch
        return InteriorOrientation(
            c=c, x0=cx * p, y0=-cy * p, A1=k1 / c**2, A2=k2 / c**4, A3=k3 / c**6,
            B1=p1 / c, B2=-p2 / c, C1=b1 / f, C2=-b2 / f,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class MeasuredPoint:
    """Our ten terms, the radial ones balanced by r0 mm, evaluated at the measured point:
    `x̄ = x' - x0 - Δx(x' - x0, y' - y0)`; or at the ideal point as ours are.
    """

    r0: float = 0.0
    at_ideal_point: bool = False

    @property
    def name(self) -> str:
        """For messages."""
        where = "ideal" if self.at_ideal_point else "measured"
        return f"photogrammetric model at the {where} point, r0 {self.r0:g} mm"

    @property
    def parameters(self) -> tuple[str, ...]:
        """As ours."""
        return ("c", "x0", "y0", "A1", "A2", "A3", "B1", "B2", "C1", "C2")

    def correction(self, values: Array, x: Array, y: Array) -> tuple[Array, Array]:
        """Δx, Δy mm at points (mm, about the principal point)."""
        _, _, _, A1, A2, A3, B1, B2, C1, C2 = values
        r2, q = x * x + y * y, self.r0**2
        radial = A1 * (r2 - q) + A2 * (r2**2 - q**2) + A3 * (r2**3 - q**3)
        return (
            x * radial + B1 * (r2 + 2 * x * x) + 2 * B2 * x * y + C1 * x + C2 * y,
            y * radial + B2 * (r2 + 2 * y * y) + 2 * B1 * x * y,
        )

    def project(self, sensor: Sensor, values: Array, directions: Array) -> Array:
        """Directions → image points; at the measured point by a fixed-point iteration."""
        c, x0, y0 = values[:3]
        ideal_x, ideal_y = c * directions[:, 0], -c * directions[:, 1]
        x, y = ideal_x, ideal_y
        for _ in range(1 if self.at_ideal_point else 200):
            with np.errstate(over="ignore", invalid="ignore"):  # looked at below
                dx, dy = self.correction(values, x, y)
                new_x, new_y = ideal_x + dx, ideal_y + dy
                change = float(np.max(np.hypot(new_x - x, new_y - y)))
            x, y = new_x, new_y
            if change < 1e-12 * sensor.pixel_pitch:
                break
            if not np.isfinite(change):
                raise GeometryError(f"the {self.name} does not converge over the image")
        return np.column_stack([x0 + x, -(y0 + y)]) / sensor.pixel_pitch + sensor.centre

    def from_brown(self, model: CameraModel) -> Array:
        """Radial and decentering terms as they are, r0's part taken up by c; affinity exact."""
        values = _rebalanced(model.interior.as_array(), 0.0, self.r0)
        if not self.at_ideal_point:
            values[8:] /= 1 + values[8]  # x̄ = (x' - x0 - C2 ȳ) / (1 + C1)
        return values

    def to_brown(self, sensor: Sensor, values: Array) -> InteriorOrientation:  # noqa: ARG002
        """The inverse."""
        at_ideal = values.copy()
        if not self.at_ideal_point:
            at_ideal[8:] /= 1 - values[8]
        return InteriorOrientation.from_array(_rebalanced(at_ideal, self.r0, 0.0))


def _rebalanced(values: Array, r_from: float, r_to: float) -> Array:
    """The terms with another r0 that give the same image at the ideal point, exactly.

    With s = A1 r0² + A2 r0⁴ + A3 r0⁶ the balanced model is the unbalanced one of a camera of
    principal distance (1-s)c: x̄ becomes (1-s)x̄, and each term is rescaled for it.
    """
    out = values.copy()
    if r_from:
        _, _, _, A1, A2, A3 = values[:6]
        out = _stretched(values, 1 - (A1 * r_from**2 + A2 * r_from**4 + A3 * r_from**6))
    if r_to:
        # the stretch depends on the rescaled terms: solve for it (one real number near 1)
        t = 1.0
        for _ in range(100):
            A1, A2, A3 = _stretched(out, t)[3:6]
            # unbalancing stretches by 1 - s, so balancing does by its inverse
            new = 1 / (1 - (A1 * r_to**2 + A2 * r_to**4 + A3 * r_to**6))
            if abs(new - t) < 1e-16:
                break
            t = new
        out = _stretched(out, t)
    return out


def _stretched(values: Array, t: float) -> Array:
    """Terms of the camera whose ideal points are `t` times as far out and whose image is the same
    but for the constant radial part t - 1.
    """
    c, x0, y0, A1, A2, A3, B1, B2, C1, C2 = values
    return np.array(
        [c * t, x0, y0, A1 / t**3, A2 / t**5, A3 / t**7, B1 / t**2, B2 / t**2, C1 / t, C2 / t]
    )
