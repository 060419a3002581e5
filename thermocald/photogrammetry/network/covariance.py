"""The covariance of a free network, with inner constraints over its targets.

The reduced matrix is inverted in the gauge of its own null space, the targets follow by back
substitution, and an S-transformation brings all of it to the datum in which the mean standard
deviation of the targets is smallest.

Source: Baarda, W. (1973): S-transformations and criterion matrices; Granshaw, S. I. (1980): Bundle
adjustment methods in engineering photogrammetry, Photogrammetric Record 10(56).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.photogrammetry.network.bundle import (
    linearise,
    normal_equations,
    null_space,
    reduce_targets,
    regularise,
)

if TYPE_CHECKING:
    from thermocald.arrays import Array, Index
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.network.bundle import Bundle, ImageRays

__all__ = ["Covariance", "covariance"]

_N_IOP = len(IOP_NAMES)
# Eigenvalues of the scaled matrix below this are rounding errors of its elements.
_SINGULAR = 1e-13


@dataclass(frozen=True, slots=True, eq=False)
class Covariance:
    """Cofactors (sigma0 = 1) of a bundle with inner constraints over the targets.

    interior (10, 10), zero for what is held; centres (k, 3, 3) mm²; points (3m, 3m) mm²;
    residual_cofactors (n, 2, 2): those of the whitened residuals, the identity less the adjusted
    points' share; weakest: the smallest eigenvalue of the scaled reduced matrix and the parameters
    that it belongs to.
    """

    interior: Array
    centres: Array
    points: Array
    residual_cofactors: Array
    weakest: tuple[float, tuple[str, ...]]


def covariance(
    sensor: Sensor, bundle: Bundle, rays: ImageRays, free: Index, weights: Array
) -> Covariance:
    """The cofactors at the solution; `weights` 0 or 1. GeometryError if it is undetermined."""
    linearised = linearise(sensor, bundle, rays, weights)
    normals = normal_equations(bundle, rays, free, linearised)
    S, _, inverses = reduce_targets(normals, 0.0)
    f, k, m = len(free), len(bundle.centres), len(bundle.points)
    null_c, null_p = null_space(bundle.centres, bundle.points, f)
    scaled, scales, projector = regularise(S, null_c)
    values, vectors = np.linalg.eigh(scaled)
    labels = [IOP_NAMES[i] for i in free] + ["a camera's pose"] * (6 * k)
    share = vectors[:, 0] ** 2
    strongest = np.argsort(-share)[:3]
    weakest = (float(values[0]), tuple(dict.fromkeys(labels[i] for i in strongest)))
    if values[0] < _SINGULAR:
        raise GeometryError(
            f"the photographs do not determine {', '.join(weakest[1])}: take them from more "
            "directions, turn the camera by 90° for some, and bring depth into the field"
        )
    Qc = (vectors / values) @ vectors.T - projector
    Qc = Qc * scales[:, None] * scales
    W = -np.einsum("mij,umj->umi", inverses, normals.B.reshape(-1, m, 3)).reshape(-1, 3 * m)
    Qcp = Qc @ W
    Qp = W.T @ Qcp
    for t in range(m):
        Qp[3 * t : 3 * t + 3, 3 * t : 3 * t + 3] += inverses[t]
    cofactors = np.eye(2) - _adjusted_cofactors(linearised, rays, free, Qc, Qcp, Qp)

    K = np.linalg.solve(null_p.T @ null_p, null_p.T)
    KQ = K @ Qp
    inner = Qp - null_p @ KQ - KQ.T @ null_p.T + null_p @ (KQ @ K.T) @ null_p.T
    KQc = K @ Qcp.T
    cameras = Qc - null_c @ KQc - KQc.T @ null_c.T + null_c @ (KQ @ K.T) @ null_c.T
    interior = np.zeros((_N_IOP, _N_IOP))
    interior[np.ix_(free, free)] = cameras[:f, :f]
    poses = cameras[f:, f:].reshape(k, 6, k, 6)
    centres = np.array([poses[i, 3:, i, 3:] for i in range(k)])
    return Covariance(interior, centres, inner, cofactors, weakest)


def _adjusted_cofactors(
    linearised: tuple[Array, Array, Array, Array],
    rays: ImageRays,
    free: Index,
    Qc: Array,
    Qcp: Array,
    Qp: Array,
) -> Array:
    """The cofactors (n, 2, 2) of the adjusted, whitened image points; independent of the gauge."""
    _, by_interior, by_pose, by_point = linearised
    J = np.concatenate([by_interior[:, :, free], by_pose], axis=2)
    f = len(free)
    pose = f + 6 * rays.photo[:, None] + np.arange(6)
    columns = np.concatenate([np.broadcast_to(np.arange(f), (len(rays), f)), pose], axis=1)
    rows = 3 * rays.target[:, None] + np.arange(3)
    cameras = Qc[columns[:, :, None], columns[:, None, :]]
    mixed = Qcp[columns[:, :, None], rows[:, None, :]]
    points = Qp[rows[:, :, None], rows[:, None, :]]
    half = J @ mixed @ np.swapaxes(by_point, 1, 2)
    total: Array = (
        J @ cameras @ np.swapaxes(J, 1, 2)
        + half
        + np.swapaxes(half, 1, 2)
        + by_point @ points @ np.swapaxes(by_point, 1, 2)
    )
    return total
