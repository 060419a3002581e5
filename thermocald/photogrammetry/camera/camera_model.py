"""The camera model of CONVENTIONS §2: Brown's model in photogrammetric notation.

The 16 parameters of an oriented camera, with their names, units and order in a vector; projection,
partials and rays. The distortion is evaluated at the ideal point, so that the image point follows
from the object point in closed form, and the ray from the image point by iteration. All functions
are pure and take arrays. Image points are px with (0, 0) at the centre of the top-left pixel, y
down; object points, projection centre and interior orientation are mm; angles are rad;
`R = Rx(omega) Ry(phi) Rz(kappa)` rotates camera axes to object axes.

Parameter vectors are ordered as `PARAMETER_NAMES`: the ten of the interior orientation, then the
six of the exterior. Leading dimensions of `iop` and `eop` are epochs; points are common to all
epochs or have the same leading dimensions.

Source: Brown, D. C. (1971): Close-range camera calibration; Luhmann, T. et al. (2014):
Close-Range Photogrammetry and 3D Imaging, 2nd ed., sections 2.4 and 3.3; the affinity terms as
El-Hakim (1986).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from thermocald.errors import GeometryError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike

    from thermocald.arrays import Array, Mask
    from thermocald.files import QuantityReader

IOP_NAMES = ("c", "x0", "y0", "A1", "A2", "A3", "B1", "B2", "C1", "C2")
EOP_NAMES = ("omega", "phi", "kappa", "X0", "Y0", "Z0")
PARAMETER_NAMES = IOP_NAMES + EOP_NAMES
DEFAULT_FREE = IOP_NAMES[:8]
"""Interior parameters that are estimated by default; affinity and shear are held."""

IOP = slice(0, 10)
"""Interior orientation."""
EOP = slice(10, 16)
"""Exterior orientation."""
PRINCIPAL = slice(0, 3)
"""c, x0, y0, whose thermal drift is reported."""
PRINCIPAL_POINT = slice(1, 3)
"""x0, y0."""

EOP_COLUMNS = np.arange(EOP.start, EOP.stop)
"""The exterior orientation as an index array."""
EOP_COLUMNS.flags.writeable = False


def free_columns(names: tuple[str, ...]) -> list[int]:
    """Return the positions of the named interior parameters, in the order of `PARAMETER_NAMES`."""
    return [i for i, name in enumerate(IOP_NAMES) if name in names]


_UPWARDS = np.array([1.0, -1.0])  # image coordinates in mm go up, in px down
_TURNS = np.array([-1.0, 1.0, 1.0])
_SLOPE = np.array([2.0, 4.0, 6.0])  # of r², r⁴, r⁶ along r, over r
_BEND = np.array([[6, 0], [0, 2], [0, 2], [2, 0], [2, 0], [0, 6]], dtype=float)
"""Jacobian of the decentring part, xx, xy, yy by x and by y (rows), as factors of B1 and B2."""

_RAY_TOLERANCE_PX = 1e-9
_RAY_ITERATIONS = 50
_MOST_PX = 100_000


@dataclass(frozen=True, slots=True)
class Sensor:
    """Image size in px and pixel pitch in mm."""

    width: int
    height: int
    pixel_pitch: float

    @classmethod
    def read(cls, reader: QuantityReader) -> Self:
        """Read width, height and pixel_pitch from a mapping of a YAML file."""
        pitch = reader.number("pixel_pitch", "mm", above=0.0)
        if not 1e-5 <= pitch <= 0.1:
            raise reader.fail(
                "pixel_pitch", f"is {pitch:g} mm; pixels are a few thousandths of a mm"
            )
        width, height = (reader.whole(side, "px", high=_MOST_PX) for side in ("width", "height"))
        return cls(width, height, pitch)

    def __str__(self) -> str:
        return f"{self.width} × {self.height} px of {self.pixel_pitch * 1000:g} µm"

    @property
    def centre(self) -> Array:
        """The image centre in px, (2,)."""
        return np.array([(self.width - 1) / 2, (self.height - 1) / 2])

    def contains(self, points: ArrayLike, margin: float = 0.0) -> Mask:
        """Return which image points (..., 2) are inside the image by at least `margin` px."""
        p = np.asarray(points, dtype=float)
        high = np.array([self.width, self.height]) - 0.5 - margin
        return np.asarray(((p >= margin - 0.5) & (p <= high)).all(axis=-1))


class _Parameters:
    """Named values that convert to a vector in the order of their fields."""

    __slots__ = ()
    _in_order: ClassVar[Callable[..., tuple[float, ...]]]

    def as_array(self) -> Array:
        """Return the values as a vector, in the order of the fields."""
        return np.array(self._in_order(self), dtype=np.float64)

    @classmethod
    def from_array(cls, values: ArrayLike) -> Self:
        """Build from a vector: the inverse of `as_array`."""
        return cls(*np.asarray(values, dtype=float).tolist())


@dataclass(frozen=True, slots=True)
class InteriorOrientation(_Parameters):
    """IOP: c, x0, y0 mm; A1 mm⁻², A2 mm⁻⁴, A3 mm⁻⁶; B1, B2 mm⁻¹; C1, C2 without unit."""

    _in_order = attrgetter(*IOP_NAMES)

    c: float
    x0: float = 0.0
    y0: float = 0.0
    A1: float = 0.0
    A2: float = 0.0
    A3: float = 0.0
    B1: float = 0.0
    B2: float = 0.0
    C1: float = 0.0
    C2: float = 0.0


@dataclass(frozen=True, slots=True)
class ExteriorOrientation(_Parameters):
    """EOP: omega, phi, kappa rad; X0, Y0, Z0 mm."""

    _in_order = attrgetter(*EOP_NAMES)

    omega: float
    phi: float
    kappa: float
    X0: float
    Y0: float
    Z0: float

    @property
    def rotation(self) -> Array:
        """R (3, 3), camera to object."""
        return rotation(np.array([self.omega, self.phi, self.kappa]))

    @property
    def centre(self) -> Array:
        """The projection centre (3,) mm."""
        return np.array([self.X0, self.Y0, self.Z0])

    @classmethod
    def from_rotation(cls, R: ArrayLike, centre: ArrayLike) -> ExteriorOrientation:
        """Build from R (3, 3), camera to object, and the projection centre (3,) mm."""
        angles = rotation_angles(np.asarray(R, dtype=float))
        return cls.from_array(np.concatenate([angles, np.asarray(centre)]))


@dataclass(frozen=True, slots=True)
class CameraModel:
    """A sensor with its interior orientation."""

    sensor: Sensor
    interior: InteriorOrientation

    def project(self, exterior: ExteriorOrientation, points: ArrayLike) -> Array:
        """Project object points (n, 3) mm to image points (n, 2) px; NaN behind the camera."""
        return project(self.sensor, self.interior.as_array(), exterior.as_array(), points)

    def rays(self, image_points: ArrayLike) -> Array:
        """Return unit directions (n, 3) in the camera frame of image points (n, 2) px."""
        return rays(self.sensor, self.interior.as_array(), image_points)


@dataclass(frozen=True, slots=True)
class CameraSpec:
    """A camera's name, sensor and a-priori interior orientation.

    principal_distance: mm, nominal, or None; interior: initial values, or None.
    """

    name: str
    sensor: Sensor
    principal_distance: float | None = None
    interior: InteriorOrientation | None = None

    @classmethod
    def read(cls, reader: QuantityReader, name: str = "camera") -> Self:
        """Read a camera from a mapping of a YAML file; name: the default if it has none."""
        sensor = Sensor.read(reader)
        distance = None
        if reader.mapping.get("principal_distance") is not None:
            distance = reader.number("principal_distance", "mm", above=0.0, low=1e-3, high=1e5)
        interior = None
        if reader.mapping.get("interior") is not None:
            inner = reader.inner("interior")
            inner.only(IOP_NAMES)
            inner.number("c", "mm", above=0.0, low=1e-3, high=1e5)
            known = {k: inner.finite(k, v) for k, v in inner.mapping.items() if v is not None}
            interior = InteriorOrientation(**known)
        return cls(reader.text("name", name), sensor, distance, interior)


def rotation(angles: ArrayLike) -> Array:
    """Return R (..., 3, 3), camera to object, of the angles omega, phi, kappa (..., 3)."""
    a = np.asarray(angles, dtype=float)
    if a.ndim == 1:  # for one camera plain numbers take a quarter of the time
        omega, phi, kappa = a.tolist()
        so, sp, sk = math.sin(omega), math.sin(phi), math.sin(kappa)
        co, cp, ck = math.cos(omega), math.cos(phi), math.cos(kappa)
    else:
        so, sp, sk = np.moveaxis(np.sin(a), -1, 0)
        co, cp, ck = np.moveaxis(np.cos(a), -1, 0)
    rows = [
        cp * ck, -cp * sk, sp,
        co * sk + so * sp * ck, co * ck - so * sp * sk, -so * cp,
        so * sk - co * sp * ck, so * ck + co * sp * sk, co * cp,
    ]  # fmt: skip
    r = np.array(rows)
    if a.ndim > 1:
        r = np.ascontiguousarray(np.moveaxis(r, 0, -1))
    return r.reshape(*a.shape[:-1], 3, 3)


def rotation_angles(R: Array) -> Array:
    """Return omega, phi, kappa (..., 3) of rotations (..., 3, 3), camera to object."""
    phi = np.arcsin(np.clip(R[..., 0, 2], -1.0, 1.0))
    omega = np.arctan2(-R[..., 1, 2], R[..., 2, 2])
    kappa = np.arctan2(-R[..., 0, 1], R[..., 0, 0])
    return np.stack([omega, phi, kappa], axis=-1)


def _turned(R: Array, eop: Array, points: Array) -> Array:
    """Return camera coordinates (..., 3, n), an order in which later steps write contiguously."""
    return R.swapaxes(-1, -2) @ (points.swapaxes(-1, -2) - eop[..., 3:6, None])


def image_to_mm(sensor: Sensor, image_points: ArrayLike) -> Array:
    """Convert image points from px (y down) to mm (origin at the image centre, y up)."""
    return (np.asarray(image_points, dtype=float) - sensor.centre) * (sensor.pixel_pitch * _UPWARDS)


def image_to_px(sensor: Sensor, points_mm: ArrayLike) -> Array:
    """Convert image points (complex too) from mm to px: the inverse of `image_to_mm`."""
    return np.asarray(points_mm) / (sensor.pixel_pitch * _UPWARDS) + sensor.centre


def distort(iop: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Map ideal points (mm, about the principal point) to measured ones (mm, about the centre).

    iop (..., 10), x, y (..., n), complex if all are. Element by element, so that results are the
    same to the last bit on every machine.
    """
    _, x0, y0, A1, A2, A3, B1, B2, C1, C2 = (iop[..., None, j] for j in range(10))
    # x' = x·h + B1·r² + ..., y' = y·h + B2·r² + ...: h is common to both; computed in place
    r2, other = x * x, y * y
    r2 += other
    h = r2 * A3
    h += A2
    h *= r2
    h += A1
    h *= r2
    h += 1.0
    for factor, part in ((2 * B1, x), (2 * B2, y)):
        h += np.multiply(part, factor, out=other)
    xd = x * h
    xd += np.multiply(r2, B1, out=other)
    if C1.any() or C2.any():
        xd += C1 * x + C2 * y
    xd += x0
    h *= y
    r2 *= B2
    h += r2
    h += y0
    return xd, h


def project(sensor: Sensor, iop: ArrayLike, eop: ArrayLike, points: ArrayLike) -> Array:
    """Project object points to image points.

    iop (..., 10), eop (..., 6), points (n, 3) or (..., n, 3) mm. Returns (..., n, 2) px, NaN for
    points that are not in front of the camera.
    """
    i = np.asarray(iop, dtype=float)
    e = np.asarray(eop, dtype=float)
    q = _turned(rotation(e[..., :3]), e, np.asarray(points, dtype=float))
    x, y, z = q[..., 0, :], q[..., 1, :], q[..., 2, :]
    if not (z < 0).all():
        z = np.where(z < 0, z, np.nan)
    scale = -i[..., 0, None] / z
    x, y = distort(i, scale * x, scale * y)
    out, px_per_mm = np.empty((2, *x.shape)), 1.0 / sensor.pixel_pitch
    np.multiply(x, px_per_mm, out=out[0])
    np.multiply(y, -px_per_mm, out=out[1])
    out[0] += (sensor.width - 1) / 2
    out[1] += (sensor.height - 1) / 2
    return out.transpose(*range(1, out.ndim), 0)


def distortion_jacobian(iop: Array, x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return the four elements xx, xy, yx, yy of ∂(x', y')/∂(x̄, ȳ); arguments as in `distort`."""
    _, _, _, A1, A2, A3, B1, B2, C1, C2 = (iop[..., None, j] for j in range(10))
    r2 = x * x + y * y
    radial = r2 * (A1 + r2 * (A2 + r2 * A3))
    slope = 2 * (A1 + r2 * (2 * A2 + 3 * r2 * A3))
    jxx = 1 + radial + slope * x * x + 6 * B1 * x + 2 * B2 * y + C1
    jxy = slope * x * y + 2 * B1 * y + 2 * B2 * x + C2
    jyx = slope * x * y + 2 * B2 * x + 2 * B1 * y
    jyy = 1 + radial + slope * y * y + 6 * B2 * y + 2 * B1 * x
    return jxx, jxy, jyx, jyy


def partials(
    sensor: Sensor, iop: ArrayLike, eop: ArrayLike, points: ArrayLike
) -> tuple[Array, Array, Array]:
    """Project object points; return image points and their analytic partial derivatives.

    Arguments as in `project`. Returns image points (..., n, 2) px; the partials with respect to the
    16 parameters, in the order of `PARAMETER_NAMES` (..., n, 2, 16); and those with respect to the
    object point (..., n, 2, 3), px/mm.
    """
    i = np.asarray(iop, dtype=float)
    e = np.asarray(eop, dtype=float)
    R = rotation(e[..., :3])
    # Components come before points, (..., 3, n), so that every line below writes contiguous memory;
    # `_points_first` gives the callers a view (..., n, 2, 16).
    q = _turned(R, e, np.asarray(points, dtype=float))
    depth = -q[..., 2, :]
    if not np.minimum.reduce(depth, axis=None, initial=np.inf) > 0:  # NaN too
        depth = np.where(depth > 0, depth, np.nan)
    inverse_depth = 1.0 / depth
    uv = q[..., :2, :] * inverse_depth[..., None, :]
    out = np.zeros((2, *uv.shape[:-2], 16, uv.shape[-1]))
    measured, by_ideal = _partials_of_distortion(i, i[..., 0, None, None] * uv, out)
    # The third component of `by_ideal` is ∂/∂c.
    scale = (_UPWARDS / sensor.pixel_pitch).reshape(2, *(1,) * (out.ndim - 1))
    measured *= scale[..., 0]
    measured += sensor.centre.reshape(scale[..., 0].shape)
    by_ideal[..., :2, :] *= scale
    by_c = by_ideal[..., 2, :]
    pair = by_ideal[..., :2, :] * uv
    np.add(pair[..., 0, :], pair[..., 1, :], out=by_c)
    out[..., 1:10, :] *= scale
    out[..., 0, :] = by_c

    # With respect to the object point: D = R · (c / depth · by_ideal). A small rotation about the
    # axis w changes q by q × w, and the image point by w · (D × q).
    by_point = R @ (by_ideal * (i[..., 0, None] * inverse_depth)[..., None, :])
    np.negative(by_point, out=out[..., 13:16, :])
    crosswise = uv[..., ::-1, :]
    moment = np.empty(by_ideal.shape)
    np.multiply(by_c[..., None, :], crosswise, out=moment[..., :2, :])
    moment[..., :2, :] += by_ideal[..., 1::-1, :]
    np.multiply(by_ideal[..., :2, :], crosswise, out=pair)
    np.subtract(pair[..., 0, :], pair[..., 1, :], out=moment[..., 2, :])
    np.matmul(turning_axes(e, R) * (i[..., 0, None, None] * _TURNS), moment, out=out[..., 10:13, :])
    image_points = measured.transpose(*range(1, measured.ndim), 0)
    return image_points, _points_first(out), _points_first(by_point)


def _partials_of_distortion(i: Array, ideal: Array, out: Array) -> tuple[Array, Array]:
    """Write the partials of image points with respect to x0 to C2 to `out` (2, ..., 16, n).

    i (..., 10), ideal (..., 2, n) mm. Returns image points (2, ..., n) mm about the image centre,
    and in the first two of three components (2, ..., 3, n) their partials by the ideal points.
    """
    batch, n = ideal.shape[:-2], ideal.shape[-1]
    by_axis = ideal.transpose(len(batch), *range(len(batch)), -1)  # (2, ..., n)
    x, y = by_axis[0], by_axis[1]
    squares = np.empty((*batch, 3, n))  # x², xy, y²
    np.multiply(ideal, x[..., None, :], out=squares[..., :2, :])
    np.multiply(y, y, out=squares[..., 2, :])
    powers = np.empty((*batch, 6, n))  # 1, r², r⁴, r⁶, x, y
    powers[..., 0, :] = 1.0
    powers[..., 4:, :] = ideal
    r2, r4 = powers[..., 1, :], powers[..., 2, :]
    np.add(squares[..., 0, :], squares[..., 2, :], out=r2)
    np.multiply(r2, r2, out=r4)
    np.multiply(r2, r4, out=powers[..., 3, :])

    # The image point is linear in x0 to C2: their partials come first and give the point itself.
    out[0, ..., 1, :] = out[1, ..., 2, :] = 1.0
    twice = 2 * squares
    np.multiply(by_axis[..., None, :], powers[..., 1:4, :], out=out[..., 3:6, :])
    np.add(r2, twice[..., 0, :], out=out[0, ..., 6, :])
    np.add(r2, twice[..., 2, :], out=out[1, ..., 7, :])
    out[0, ..., 7, :] = out[1, ..., 6, :] = twice[..., 1, :]
    out[0, ..., 8:10, :] = ideal
    measured = (i[..., None, 1:] @ out[..., 1:10, :])[..., 0, :]
    measured += by_axis

    # ∂(x', y')/∂(x̄, ȳ) as xx, xy, yy, symmetric but for C1 and C2: slope · (x², xy, y²), and a part
    # linear in the powers, from the radial terms and B1, B2
    linear = np.zeros((*i.shape[:-1], 3, 6))
    linear[..., ::2, 0] = 1.0
    linear[..., ::2, 1:4] = i[..., None, 3:6]
    linear[..., 4:] = (_BEND @ i[..., 6:8, None]).reshape(*i.shape[:-1], 3, 2)
    jacobian = squares
    jacobian *= (i[..., None, 3:6] * _SLOPE) @ powers[..., :3, :]
    jacobian += linear @ powers
    by_ideal = np.empty((2, *batch, 3, n))
    np.add(jacobian[..., :2, :], i[..., 8:10, None], out=by_ideal[0, ..., :2, :])
    by_ideal[1, ..., :2, :] = jacobian[..., 1:, :]
    return measured, by_ideal


def _points_first(array: Array) -> Array:
    """Return a view (..., n, 2, k) of an array (2, ..., k, n)."""
    last = array.ndim - 1
    return array.transpose(*range(1, last - 1), last, 0, last - 1)


def turning_axes(eop: Array, R: Array) -> Array:
    """Return the axes of rotation of omega, phi, kappa as rows (..., 3, 3) in the camera frame."""
    axes = np.zeros(R.shape)
    axes[..., 0, :] = R[..., 0, :]
    if eop.ndim == 1:  # one camera: as in `rotation`
        kappa = float(eop[2])
        axes[1, 0], axes[1, 1] = math.sin(kappa), math.cos(kappa)
    else:
        axes[..., 1, 0], axes[..., 1, 1] = np.sin(eop[..., 2]), np.cos(eop[..., 2])
    axes[..., 2, 2] = 1.0
    return axes


def rays(sensor: Sensor, iop: ArrayLike, image_points: ArrayLike) -> Array:
    """Return unit directions (..., n, 3) in the camera frame of image points (..., n, 2) px.

    The camera looks along -Z. Newton's method on the distortion converges to 1e-9 px. Raises
    GeometryError for points where it does not: beyond the radius at which the distortion
    polynomial folds back.
    """
    i = np.asarray(iop, dtype=float)
    measured = image_to_mm(sensor, image_points)
    xm, ym = measured[..., 0], measured[..., 1]
    x, y = xm - i[..., None, 1], ym - i[..., None, 2]
    tolerance = _RAY_TOLERANCE_PX * sensor.pixel_pitch
    with np.errstate(all="ignore"):  # beyond the fold
        for _ in range(_RAY_ITERATIONS):
            xd, yd = distort(i, x, y)
            jxx, jxy, jyx, jyy = distortion_jacobian(i, x, y)
            determinant = jxx * jyy - jxy * jyx
            rx, ry = xm - xd, ym - yd
            x = x + (jyy * rx - jxy * ry) / determinant
            y = y + (jxx * ry - jyx * rx) / determinant
            size = np.fmax(np.abs(rx), np.abs(ry))
            if bool(np.all(size <= tolerance)):
                break
        jxx, jxy, jyx, jyy = distortion_jacobian(i, x, y)
        # Both eigenvalues may be negative, so that their product is not enough.
        folded = (jxx * jyy - jxy * jyx <= 0) | (jxx + jyy <= 0)
    folded |= ~(size <= tolerance) | ~np.isfinite(x)
    failed = np.isfinite(xm) & np.isfinite(ym) & folded
    if bool(np.any(failed)):
        where = np.argwhere(failed)[0]
        point = np.asarray(image_points, dtype=float)[tuple(where)]
        raise GeometryError(
            f"there is no ray for {int(failed.sum())} of {failed.size} image points: the first is "
            f"({point[0]:.1f}, {point[1]:.1f}) px. The distortion of this camera model folds back "
            "there; use points inside the area in which it was calibrated"
        )
    direction = np.stack([x, y, np.broadcast_to(-i[..., None, 0], x.shape)], axis=-1)
    unit: Array = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    return unit


RASPBERRY_PI_V2 = CameraModel(Sensor(3280, 2464, 0.00112), InteriorOrientation(c=3.04))
"""Nominal values of the Raspberry Pi camera v2.1, the most common one."""
