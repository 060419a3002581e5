"""The grey values of a blurred disc under a local map, and their derivatives.

A pixel p lies at q in the target's plane (`outline`), at radius ρ = |q|; its distance from the
outline is d = (1 − ρ)/|∇ρ|. The optics blur the step at the outline with a Gaussian, the pixel
integrates over its area (variance 1/12 px²), and the outline's curvature κ moves the blurred edge
inwards by κs²/2, which gives

    I(p) = (b + a Φ(z)) (1 + g·(p − c)),   z = (d − κs²/2)/s,   s² = blur² + 1/12

with background b, contrast a, and the gradient g of the light. All that is left out is symmetrical
about the centre, and moves it not.

Parameters, in this order: x, y (px), m11, m12, m22 (correction of the shape, q := (I + m) q), blur
(px), b, a (DN), gx, gy (1/px).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtr

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.photogrammetry.outline import LocalMap

    Array = NDArray[np.float64]

__all__ = ["PARAMETERS", "blurred_disc", "edge_distance"]

PARAMETERS = ("x", "y", "m11", "m12", "m22", "blur", "background", "contrast", "gx", "gy")
_PIXEL_VARIANCE = 1 / 12
_NORM = 1 / np.sqrt(2 * np.pi)


def edge_distance(maps: LocalMap, ex: Array, ey: Array) -> tuple[Array, Array]:
    """Distance d (n, k) px from the outline, positive inside, and the radius ρ (n, k).

    ex, ey (n, k) px: pixels relative to the maps' centres.
    """
    rho, slope, *_ = _plane(maps.linear, maps.second, np.zeros((len(maps), 3)), ex, ey)
    return (1 - rho) / slope, rho


def _plane(
    linear: Array, second: Array, m: Array, ex: Array, ey: Array
) -> tuple[Array, Array, Array, Array, Array, Array, Array, Array, Array]:
    """ρ, |∇ρ|, unit normal (x, y), κ, the plane coordinates before the shape's correction, and
    the unit radius vector.
    """
    j11, j12, j21, j22 = (linear[:, i, k, None] for i in (0, 1) for k in (0, 1))
    det = j11 * j22 - j12 * j21
    i11, i12, i21, i22 = j22 / det, -j12 / det, -j21 / det, j11 / det
    s = i11 * ex + i12 * ey
    t = i21 * ex + i22 * ey
    curved = bool(np.any(second))
    if curved:
        # ½ J⁻¹ H, so that q = q0 − B[q, q]; one substitution is exact to the second order.
        h = second
        b1 = [0.5 * (i11 * h[:, 0, k, None] + i12 * h[:, 1, k, None]) for k in range(3)]
        b2 = [0.5 * (i21 * h[:, 0, k, None] + i22 * h[:, 1, k, None]) for k in range(3)]
        s0, t0 = s, t
        for _ in range(2):
            ss, st, tt = s * s, 2 * s * t, t * t
            s = s0 - (b1[0] * ss + b1[1] * st + b1[2] * tt)
            t = t0 - (b2[0] * ss + b2[1] * st + b2[2] * tt)
        # ∂q/∂e = (I + 2 B[q, ·])⁻¹ J⁻¹
        a11 = 1 + 2 * (b1[0] * s + b1[1] * t)
        a12 = 2 * (b1[1] * s + b1[2] * t)
        a21 = 2 * (b2[0] * s + b2[1] * t)
        a22 = 1 + 2 * (b2[1] * s + b2[2] * t)
        da = a11 * a22 - a12 * a21
        i11, i12, i21, i22 = (
            (a22 * i11 - a12 * i21) / da,
            (a22 * i12 - a12 * i22) / da,
            (a11 * i21 - a21 * i11) / da,
            (a11 * i22 - a21 * i12) / da,
        )
    m11, m12, m22 = 1 + m[:, 0, None], m[:, 1, None], 1 + m[:, 2, None]
    u, v = m11 * s + m12 * t, m12 * s + m22 * t
    rho = np.maximum(np.sqrt(u * u + v * v), 1e-9)
    u, v = u / rho, v / rho
    # A = (I + m) ∂q/∂e;  ∇ρ = Aᵀ(u, v)
    p11, p12 = m11 * i11 + m12 * i21, m11 * i12 + m12 * i22
    p21, p22 = m12 * i11 + m22 * i21, m12 * i12 + m22 * i22
    gx, gy = p11 * u + p21 * v, p12 * u + p22 * v
    slope2 = gx * gx + gy * gy
    slope = np.sqrt(slope2)
    # Curvature of the outline: tangentᵀ AᵀA tangent/|∇ρ| = (det A)²/|∇ρ|³, the tangent being the
    # image of (−v, u), which A maps to a unit vector times det A/|∇ρ|.
    determinant = p11 * p22 - p12 * p21
    kappa = determinant * determinant / (slope2 * slope)
    return rho, slope, gx / slope, gy / slope, kappa, s, t, u, v


def blurred_disc(
    maps: LocalMap, parameters: Array, x: Array, y: Array, derivatives: bool = True
) -> tuple[Array, Array]:
    """Grey values (n, k) and derivatives (n, 10, k) of n discs at their pixels x, y (n, k) px.

    Only shape and curvature are taken from `maps`; the centres are the parameters (n, 10). The
    derivatives by centre and shape leave out how |∇ρ| and κ change: they vanish on the outline.
    """
    p = parameters
    ex, ey = x - p[:, 0, None], y - p[:, 1, None]
    rho, slope, nx, ny, kappa, s, t, u, v = _plane(maps.linear, maps.second, p[:, 2:5], ex, ey)
    blur = p[:, 5, None]
    width = np.sqrt(blur * blur + _PIXEL_VARIANCE)
    d = (1 - rho) / slope
    z = d / width - 0.5 * kappa * width
    phi = ndtr(z)
    b, a = p[:, 6, None], p[:, 7, None]
    light = 1 + p[:, 8, None] * ex + p[:, 9, None] * ey
    reflect = b + a * phi
    value = reflect * light
    if not derivatives:
        return value, np.empty((len(p), 0, 0))
    j = np.empty((len(p), 10, x.shape[1]))
    edge = (a * _NORM) * np.exp(-0.5 * z * z) * light
    across = edge / width
    j[:, 0] = across * nx
    j[:, 1] = across * ny
    radial = -across / slope
    j[:, 2] = radial * u * s
    j[:, 3] = radial * (u * t + v * s)
    j[:, 4] = radial * v * t
    j[:, 5] = edge * (-d / (width * width) - 0.5 * kappa) * (blur / width)
    j[:, 6] = light
    j[:, 7] = phi * light
    j[:, 8] = reflect * ex
    j[:, 9] = reflect * ey
    return value, j
