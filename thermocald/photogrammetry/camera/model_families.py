"""Camera models of other programs, as `conversions.Family`.

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
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor

if TYPE_CHECKING:
    from thermocald.arrays import Array

__all__ = ["BrownOpenCV", "MeasuredPoint", "Metashape"]

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
