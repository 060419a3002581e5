"""Arithmetic whose last bit is the same on every machine.

Libraries of mathematical functions, fused multiply-add and vectorised sums differ in their last
bits between machines, and a pixel value on the verge of rounding would flip. IEEE 754 fixes
addition, multiplication, division and square root alone; NumPy's element-wise operations on arrays
round each of them separately. What a rendered frame depends on is made of these.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor

__all__ = ["gaussian_kernel", "project", "rotation", "sin_cos"]

# π/2 in two parts: multiples of the first are exact for the angles that occur
_HALF_PI_HIGH = 1.5707963267341256
_HALF_PI_LOW = 6.077100506506192e-11


def sin_cos(angles: ArrayLike) -> tuple[Array, Array]:
    """Sine and cosine (...,) of angles in rad, to 1e-15, by their series on ±π/4."""
    a = np.asarray(angles, dtype=float)
    quarter = np.rint(a / 1.5707963267948966)
    x = (a - quarter * _HALF_PI_HIGH) - quarter * _HALF_PI_LOW
    x2 = x * x
    s, c = np.zeros_like(x), np.zeros_like(x)
    for n in range(9, 0, -1):
        s = (1.0 + s) * (x2 / (-(2.0 * n) * (2.0 * n + 1.0)))
        c = (1.0 + c) * (x2 / (-(2.0 * n) * (2.0 * n - 1.0)))
    s, c = x * (1.0 + s), 1.0 + c
    turn = quarter.astype(np.int64) % 4
    swapped = turn % 2 == 1
    sine, cosine = np.where(swapped, c, s), np.where(swapped, s, c)
    return np.where(turn >= 2, -sine, sine), np.where((turn == 1) | (turn == 2), -cosine, cosine)


def rotation(angles: ArrayLike) -> Array:
    """R (3, 3) of omega, phi, kappa (CONVENTIONS §1), camera to object."""
    sine, cosine = sin_cos(angles)
    so, sp, sk = (float(v) for v in sine)
    co, cp, ck = (float(v) for v in cosine)
    return np.array(
        [
            [cp * ck, -cp * sk, sp],
            [co * sk + so * sp * ck, co * ck - so * sp * sk, -so * cp],
            [so * sk - co * sp * ck, so * ck + co * sp * sk, co * cp],
        ]
    )


def project(sensor: Sensor, iop: Array, eop: Array, points: Array) -> Array:
    """Object points (n, 3) mm → image points (n, 2) px as `camera_model.project` has it.

    The same formulas, without matrix products. NaN for points not in front of the camera.
    """
    r = rotation(eop[:3])
    dx, dy, dz = (points[:, k] - eop[3 + k] for k in range(3))
    xc, yc, zc = (dx * r[0, k] + dy * r[1, k] + dz * r[2, k] for k in range(3))
    c, x0, y0, A1, A2, A3, B1, B2, C1, C2 = (float(v) for v in iop)
    scale = c / np.where(zc < 0, -zc, np.nan)
    x, y = scale * xc, scale * yc
    r2 = x * x + y * y
    radial = r2 * (A1 + r2 * (A2 + r2 * A3))
    xy = x * y
    xm = x0 + x * (1 + radial) + B1 * (r2 + 2 * x * x) + 2 * B2 * xy + C1 * x + C2 * y
    ym = y0 + y * (1 + radial) + B2 * (r2 + 2 * y * y) + 2 * B1 * xy
    u = xm / sensor.pixel_pitch + (sensor.width - 1) / 2
    v = -ym / sensor.pixel_pitch + (sensor.height - 1) / 2
    return np.stack([u, v], axis=1)


def gaussian_kernel(sigma: float) -> Array:
    """A normalised Gaussian (2n+1,) on the pixel grid, n = ⌈4 σ⌉; just [1] where σ is 0."""
    if sigma <= 0:
        return np.ones(1)
    n = int(np.ceil(4.0 * sigma))
    # exp(-k²/2σ²) from the one number exp(-1/2σ²), itself from its series after halving 10 times
    x = -0.5 / (sigma * sigma) / 1024.0
    e = 1.0
    for k in range(14, 0, -1):
        e = 1.0 + e * x / k
    for _ in range(10):
        e = e * e
    half = [1.0]
    power, odd = 1.0, e
    for _ in range(n):
        power = power * odd
        odd = odd * e * e
        half.append(power)
    total = half[0]
    for value in half[1:]:
        total = total + 2.0 * value
    return np.array([*half[:0:-1], *half]) / total
