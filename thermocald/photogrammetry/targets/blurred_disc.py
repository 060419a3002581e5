"""The grey values of a blurred disc under a local map, and their derivatives.

A pixel p lies at q in the target's plane (`outline`), at radius ρ = |q|; its distance from the
outline is d = (1 − ρ)/|∇ρ|. The optics blur the step at the outline with a Gaussian, the pixel
integrates over its area (variance 1/12 px²), and the outline's curvature κ moves the blurred edge
inwards by κs²/2, which gives

    I(p) = (b + a Φ(z)) (1 + g·(p − c)),   z = (d − κs²/2)/s,   s² = blur² + 1/12

with background b, contrast a, and the gradient g of the light. All that is left out is symmetrical
about the centre, and moves it not.

Everything runs in single precision on coordinates relative to a pixel near the target: 1e-5 px, and
half the time.

Parameters, in this order: x, y (px), m11, m12, m22 (correction of the shape, q := (I + m) q), blur
(px), b, a (DN), gx, gy (1/px).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from thermocald.arrays import Array, Single
    from thermocald.photogrammetry.targets.outline import LocalMap

__all__ = ["PARAMETERS", "blurred_disc", "edge_distance", "normal_cdf"]

PARAMETERS = ("x", "y", "m11", "m12", "m22", "blur", "background", "contrast", "gx", "gy")
_PIXEL_VARIANCE = 1 / 12
_NORM = float(1 / np.sqrt(2 * np.pi))
# Φ(z) = (1 + tanh(z·polynomial(z²)))/2 to 2e-5, fitted by minimax on 0 ≤ z ≤ 6.
_CDF = tuple(np.float32(c) for c in (-3.171207e-4, 3.680406e-2, 0.79771415))
_HALF, _ONE = np.float32(0.5), np.float32(1.0)


def normal_cdf(z: Single) -> Single:
    """The standard normal distribution function to 2e-5, ten times faster than exactly."""
    z = np.clip(z, -6, 6)
    square = z * z
    value = square * _CDF[0]
    value += _CDF[1]
    value *= square
    value += _CDF[2]
    value *= z
    np.tanh(value, out=value)
    value += _ONE
    value *= _HALF
    return value


def edge_distance(linear: Array, ex: Single, ey: Single) -> tuple[Single, Single]:
    """Distance d (n, k) px from ellipses' outlines, positive inside, and the radius ρ (n, k).

    linear (n, 2, 2): as of `LocalMap`; ex, ey (n, k) px: pixels relative to the centres.
    """
    inverse = np.linalg.inv(linear)
    M = (np.swapaxes(inverse, 1, 2) @ inverse).astype(np.float32)
    # ρ² = eᵀ M e, so that ∇ρ = M e/ρ
    gx = M[:, 0, 0, None] * ex + M[:, 0, 1, None] * ey
    gy = M[:, 1, 0, None] * ex + M[:, 1, 1, None] * ey
    rho = gx * ex
    rho += gy * ey
    np.sqrt(np.maximum(rho, np.float32(1e-12), out=rho), out=rho)
    gx *= gx
    gy *= gy
    gx += gy
    slope = np.sqrt(np.maximum(gx, np.float32(1e-18), out=gx), out=gx)
    distance = _ONE - rho
    distance *= rho
    distance /= slope
    return distance, rho


def _plane(maps: LocalMap, m: Array, ex: Single, ey: Single) -> tuple[Single, ...]:
    """ρ, |∇ρ|, unit normal (x, y), det ∂q/∂p, the plane coordinates before the shape's
    correction (s, t), and the unit radius vector (u, v).
    """
    inverse = np.linalg.inv(maps.linear)
    shape = np.eye(2) + m[:, [[0, 1], [1, 2]]]
    L = shape @ inverse
    # q = (I + m)(J⁻¹e − ½ J⁻¹ H[J⁻¹e, J⁻¹e]) = L e − P[e, e]; what is left out is of third order,
    # and moves no centre. A = ∂q/∂e = L − 2 P[e, ·], and q = ½ (L + A) e.
    l11, l12, l21, l22 = (L[:, i, k, None].astype(np.float32) for i in (0, 1) for k in (0, 1))
    a11, a12, a21, a22 = l11, l12, l21, l22
    u, v = l11 * ex + l12 * ey, l21 * ex + l22 * ey
    if np.any(maps.second):
        bend = (L @ maps.second)[:, :, [[0, 1], [1, 2]]]
        twice = (  # 2 P
            np.swapaxes(inverse, 1, 2)[:, None] @ bend @ inverse[:, None]
        ).astype(np.float32)[..., None]
        (x1, y1), (x2, y2) = (
            (twice[:, i, 0, 0] * ex + twice[:, i, 0, 1] * ey,
             twice[:, i, 1, 0] * ex + twice[:, i, 1, 1] * ey) for i in (0, 1)
        )  # fmt: skip
        u -= _HALF * (x1 * ex + y1 * ey)
        v -= _HALF * (x2 * ex + y2 * ey)
        a11, a12, a21, a22 = l11 - x1, l12 - y1, l21 - x2, l22 - y2
    back = np.linalg.inv(shape).astype(np.float32)[..., None]
    s, t = back[:, 0, 0] * u + back[:, 0, 1] * v, back[:, 1, 0] * u + back[:, 1, 1] * v
    rho = np.sqrt(u * u + v * v)
    np.maximum(rho, np.float32(1e-6), out=rho)
    u /= rho
    v /= rho
    gx, gy = a11 * u + a21 * v, a12 * u + a22 * v  # ∇ρ = Aᵀ(u, v)
    slope = np.sqrt(gx * gx + gy * gy)
    np.maximum(slope, np.float32(1e-9), out=slope)
    gx /= slope
    gy /= slope
    return rho, slope, gx, gy, a11 * a22 - a12 * a21, s, t, u, v


def blurred_disc(
    maps: LocalMap, parameters: Array, x: Single, y: Single, out: Single | None = None
) -> tuple[Single, Single]:
    """Grey values (n, k) and derivatives (n, 10, k) of n discs at their pixels x, y (n, k) px.

    Only shape and curvature are taken from `maps`; the centres are the parameters (n, 10), in the
    coordinates of x and y, which should be small. The derivatives by centre and shape leave out
    how |∇ρ| and κ change: they vanish on the outline. out: where to put the derivatives.
    """
    p = parameters.astype(np.float32)
    ex, ey = x - p[:, 0, None], y - p[:, 1, None]
    rho, slope, nx, ny, determinant, s, t, u, v = _plane(maps, parameters[:, 2:5], ex, ey)
    blur = p[:, 5, None]
    width = np.sqrt(blur * blur + np.float32(_PIXEL_VARIANCE))
    # Curvature of the outline: tangentᵀ AᵀA tangent/|∇ρ| = (det A)²/|∇ρ|³, the tangent being what
    # A maps to a vector of length det A/|∇ρ| across the radius.
    kappa = determinant * determinant / (slope * slope * slope)
    d = (_ONE - rho) / slope
    kappa *= _HALF
    z = d / width - kappa * width
    phi = normal_cdf(z)
    b, a = p[:, 6, None], p[:, 7, None]
    light = _ONE + p[:, 8, None] * ex + p[:, 9, None] * ey
    reflect = b + a * phi
    value = reflect * light
    j = np.empty((len(p), 10, x.shape[1]), dtype=np.float32) if out is None else out
    z *= z
    z *= -_HALF
    edge = np.exp(z, out=z)
    edge *= np.float32(_NORM) * a
    edge *= light
    across = edge / width
    np.multiply(across, nx, out=j[:, 0])
    np.multiply(across, ny, out=j[:, 1])
    radial = across / -slope
    u *= radial
    v *= radial
    np.multiply(u, s, out=j[:, 2])
    j[:, 3] = u * t + v * s
    np.multiply(v, t, out=j[:, 4])
    j[:, 5] = edge * (d / (width * width) + kappa) * (-blur / width)
    j[:, 6] = light
    np.multiply(phi, light, out=j[:, 7])
    np.multiply(reflect, ex, out=j[:, 8])
    np.multiply(reflect, ey, out=j[:, 9])
    return value, j
