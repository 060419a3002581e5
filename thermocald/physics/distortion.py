"""What the distortion does while the principal distance changes.

A lens that moves along its axis keeps its rays' angles: with r = c tan θ the displacement
x̄ A_i r^(2i) is c times a function of the angle only where A_i c^(2i) and B c are constant, so that

    A_i(t) = A_i (c₀ / c(t))^(2i),    B_i(t) = B_i c₀ / c(t),

as OpenCV's k_i and p_i have it; C1 and C2 are such functions already. The other basis keeps A and B
as functions of the image in mm. Linear values are those at c₀: of `angle` they are carried to c.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.arrays import Array

Distortion = Literal["angle", "image"]
BASES: tuple[Distortion, ...] = ("angle", "image")

SURE = 3.0  # standard deviations: an angle that holds is denied in 0.1 % of all series

_POWERS = np.array([0, 0, 0, 2, 4, 6, 1, 1, 0, 0])  # of c, in the order of IOP_NAMES


def follow_angle(linear: Array, c0: float) -> Array:
    """Return interior orientations (…, 10) whose distortion keeps the angles it has at c0 mm."""
    out: Array = linear * (c0 / linear[..., :1]) ** _POWERS
    return out


def angle_derivatives(linear: Array, c0: float, J: Array, by_c0: int | None = None) -> Array:
    """Carry ∂ linear / ∂ unknowns (…, 10, p) to the orientations of `follow_angle`.

    by_c0: the unknown that is c0 itself, if any.
    """
    carried = follow_angle(linear, c0)
    factors = carried * _POWERS
    out: Array = J * ((c0 / linear[..., :1]) ** _POWERS)[..., None]
    out = out - (factors / linear[..., :1])[..., None] * J[..., :1, :]
    if by_c0 is not None:
        out[..., by_c0] += factors / c0
    return out


def distortion_along(iop: Array) -> Array:
    """Return ∂ interior orientation / ∂ linear one (10, 10) at its c₀: c takes A and B along."""
    out = np.eye(10)
    out[:, 0] -= _POWERS * iop / iop[0]
    return out


def choose_basis(left: Mapping[Distortion, float]) -> tuple[Distortion, float]:
    """Return what the distortion follows, of the sums of squares that are left with either, and by
    how many standard deviations the data say so.

    The angle, unless the data deny it by 3 of them: where they cannot tell, the cameras that are
    known keep their angles.
    """
    better = left["image"] - left["angle"]
    sigmas = float(np.sign(better) * np.sqrt(abs(better)))
    return ("image", -sigmas) if sigmas < -SURE else ("angle", sigmas)
