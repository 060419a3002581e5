"""The datum of a free network: where it lies, how it is turned, and its scale.

Position and orientation by inner constraints over all targets (the mean standard deviation is
smallest, and no target is privileged): they coincide in the mean with the nominal field if there is
one, else the origin is the centroid and Z the normal of the best plane, towards the cameras. Scale
by measured distances, with their standard deviations, in a rigorous sequential adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.network.bundle import Bundle

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array


@dataclass(frozen=True, slots=True)
class Distance:
    """A measured distance between two targets, mm, with its standard deviation."""

    a: str
    b: str
    length: float
    sigma: float


def bring_to_datum(
    bundle: Bundle,
    covariance: Array,
    distances: Sequence[Distance],
    index: dict[str, int],
    nominal: Array | None,
) -> tuple[Bundle, Array, Array, float, str]:
    """Scale and place a free network whose covariance (3m, 3m) has inner constraints.

    index: the row of each target by name; nominal (m, 3) mm, NaN where unknown. Returns the bundle
    in its datum, the targets' covariance in it, scale times rotation (3, 3) into it, the scale's
    relative standard deviation, and the datum in words.
    """
    scaled, Q, scale, sd_scale = _scaled(bundle.points, covariance, distances, index)
    turn, shift, where = _placement(scaled, scale * bundle.centres, nominal, distances[0], index)
    m = len(scaled)
    points = scaled @ turn.T + shift
    blocks = Q.reshape(m, 3, m, 3)
    turned = np.einsum("ab,mbnc,dc->mand", turn, blocks, turn, optimize=True).reshape(3 * m, 3 * m)
    placed = Bundle(
        bundle.interior,
        turn @ bundle.rotations,
        scale * bundle.centres @ turn.T + shift,
        points,
    )
    by = ", ".join(f"{d.a}–{d.b} = {d.length:g} ± {d.sigma:g} mm" for d in distances)
    statement = f"inner constraints over {m} targets, {where}; scale by {by}"
    return placed, turned, scale * turn, sd_scale, statement


def _scaled(
    points: Array, Q: Array, distances: Sequence[Distance], index: dict[str, int]
) -> tuple[Array, Array, float, float]:
    """Points and covariance with the scale that the distances give; the scale and its relative sd.

    The estimate is linear in the network's points and the measured distances: ln L = ln l + lambda
    with the network's own covariance; one distance fixes the scale, further ones also correct the
    shape, each to its weight.
    """
    n, m3 = len(distances), points.size
    H, r, noise = np.zeros((n, m3)), np.zeros(n), np.zeros(n)
    for i, d in enumerate(distances):
        missing = [name for name in (d.a, d.b) if name not in index]
        if missing:
            raise GeometryError(
                f"the distance {d.a}–{d.b} cannot give the scale: target {' and '.join(missing)} "
                "was not determined; at least three photographs must show both of its ends"
            )
        a, b = index[d.a], index[d.b]
        e = points[b] - points[a]
        length = float(np.linalg.norm(e))
        H[i, 3 * b : 3 * b + 3], H[i, 3 * a : 3 * a + 3] = e / length**2, -e / length**2
        r[i], noise[i] = np.log(d.length / length), (d.sigma / d.length) ** 2
    # distances without a standard deviation must not make V singular
    V = H @ Q @ H.T + np.diag(np.maximum(noise, 1e-18))
    P = np.linalg.inv(V)
    ones = np.ones(n)
    weight = float(ones @ P @ ones)
    a_row = ones @ P / weight
    lam = float(a_row @ r)
    M = P - np.outer(P @ ones, a_row)
    centred = (points - points.mean(axis=0)).ravel()
    gain = Q @ H.T @ M
    shape = points + (gain @ r).reshape(-1, 3)
    scale = float(np.exp(lam))
    F = gain + np.outer(centred, a_row)
    T = np.eye(m3) - F @ H
    Qs = scale**2 * (T @ Q @ T.T + (F * noise) @ F.T)
    return scale * shape, Qs, scale, float(np.sqrt(1.0 / weight))


def _placement(
    points: Array,
    centres: Array,
    nominal: Array | None,
    first: Distance,
    index: dict[str, int],
) -> tuple[Array, Array, str]:
    """The turn (3, 3) and shift (3,) into the datum, and what it is in words."""
    if nominal is not None:
        known = np.isfinite(nominal).all(axis=1)
        if known.sum() >= 3:
            turn, shift = _rigid(points[known], nominal[known])
            return turn, shift, f"in the mean on the nominal coordinates of {known.sum()} targets"
    centroid = points.mean(axis=0)
    _, _, Vt = np.linalg.svd(points - centroid)
    z = Vt[2] * (1.0 if (centres.mean(axis=0) - centroid) @ Vt[2] > 0 else -1.0)
    along = points[index[first.b]] - points[index[first.a]]
    along = along - (along @ z) * z
    # a distance along the normal gives no direction: the field's longest side does
    if np.linalg.norm(along) < 1e-3 * np.linalg.norm(np.ptp(points, axis=0)):
        along = Vt[0]
    x = along / np.linalg.norm(along)
    turn = np.array([x, np.cross(z, x), z])
    where = f"origin at their centroid, Z normal to their plane, X along {first.a}–{first.b}"
    return turn, -turn @ centroid, where


def _rigid(points: Array, onto: Array) -> tuple[Array, Array]:
    """The rotation and shift of least squares (Arun et al. 1987), no reflection."""
    p, q = points.mean(axis=0), onto.mean(axis=0)
    U, _, Vt = np.linalg.svd((points - p).T @ (onto - q))
    turn = Vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))]) @ U.T
    return turn, q - turn @ p
