"""The free-network bundle adjustment: photographs of one camera, targets, reduced normal equations.

The targets are eliminated block by block (Schur complement), the gauge of seven (position,
orientation, scale) is left free and its null space added to the reduced matrix, which makes it
regular without constraining anything that the photographs determine.

Rotations are updated in object space (`R ← exp([w]×) R`), so no camera can look into a gimbal lock.

Source: Granshaw, S. I. (1980): Bundle adjustment methods in engineering photogrammetry,
Photogrammetric Record 10(56); Triggs, B. et al. (2000): Bundle adjustment — a modern synthesis,
sections 6 and 9.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    ExteriorOrientation,
    partials,
    project,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array, Index
    from thermocald.photogrammetry.camera.camera_model import Sensor

__all__ = [
    "Bundle",
    "ImageRays",
    "NormalEquations",
    "linearise",
    "normal_equations",
    "null_space",
    "reduce_targets",
    "regularise",
    "residuals",
    "solve",
]

_N_IOP = len(IOP_NAMES)


@dataclass(frozen=True, slots=True, eq=False)
class ImageRays:
    """All image points of a network, one row each.

    photo, target: (n,) row numbers; points (n, 2) px; whitening (n, 2, 2), 1/px: the inverse square
    root of each point's covariance.
    """

    photo: Index
    target: Index
    points: Array
    whitening: Array

    def __len__(self) -> int:
        return len(self.photo)

    def select(self, keep: NDArray[np.bool_]) -> ImageRays:
        """The rays of a mask."""
        return ImageRays(
            self.photo[keep], self.target[keep], self.points[keep], self.whitening[keep]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """The unknowns: interior orientation (10,), rotations (k, 3, 3) camera to object,
    projection centres (k, 3) mm, targets (m, 3) mm.
    """

    interior: Array
    rotations: Array
    centres: Array
    points: Array

    def exteriors(self) -> Array:
        """The exterior orientations (k, 6) in the order of `EOP_NAMES`."""
        rows = [
            ExteriorOrientation.from_rotation(R, X).as_array()
            for R, X in zip(self.rotations, self.centres, strict=True)
        ]
        return np.array(rows)


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """Normal equations: cameras (interior first, then six per photo) and targets."""

    A: Array  # (u, u)
    B: Array  # (u, 3m)
    D: Array  # (m, 3, 3)
    a: Array  # (u,)
    d: Array  # (m, 3)


def residuals(sensor: Sensor, bundle: Bundle, rays: ImageRays) -> Array:
    """Whitened residuals (n, 2), measured minus computed; huge for a target behind its camera."""
    eop = bundle.exteriors()[rays.photo]
    computed = project(sensor, bundle.interior, eop, bundle.points[rays.target][:, None, :])[:, 0]
    v = np.einsum("nij,nj->ni", rays.whitening, rays.points - computed)
    result: Array = np.where(np.isfinite(v), v, 1e6)
    return result


def linearise(
    sensor: Sensor, bundle: Bundle, rays: ImageRays, weights: Array
) -> tuple[Array, Array, Array, Array]:
    """Whitened residuals (n, 2), partials by interior (n, 2, 10), pose (…, 6), target (…, 3)."""
    eop = bundle.exteriors()[rays.photo]
    points = bundle.points[rays.target]
    computed, by_parameter, by_point = partials(sensor, bundle.interior, eop, points[:, None, :])
    in_front = np.isfinite(computed[:, 0, 0])
    root = np.sqrt(np.where(in_front, weights, 0.0))[:, None, None] * rays.whitening
    by_point = np.nan_to_num(by_point[:, 0])
    # q = Rᵀ d, turned about the object's axes: the derivative by w is that by the point times d × e
    d = points - bundle.centres[rays.photo]
    cross = np.zeros((len(rays), 3, 3))
    cross[:, 1, 0], cross[:, 2, 0] = d[:, 2], -d[:, 1]
    cross[:, 0, 1], cross[:, 2, 1] = -d[:, 2], d[:, 0]
    cross[:, 0, 2], cross[:, 1, 2] = d[:, 1], -d[:, 0]
    by_pose = np.concatenate([by_point @ cross, -by_point], axis=2)
    v = (root @ np.nan_to_num(rays.points - computed[:, 0])[..., None])[..., 0]
    by_interior = np.nan_to_num(by_parameter[:, 0, :, :_N_IOP])
    return v, root @ by_interior, root @ by_pose, root @ by_point


def normal_equations(
    bundle: Bundle, rays: ImageRays, free: Index, linearised: tuple[Array, Array, Array, Array]
) -> NormalEquations:
    """The normal equations of a bundle in blocks: camera and poses, targets, and between them.

    free: columns of the interior orientation that are estimated; linearised: of `linearise`.
    """
    v, by_interior, by_pose, by_point = linearised
    by_interior = by_interior[:, :, free]
    k, m, f = len(bundle.centres), len(bundle.points), len(free)
    u = f + 6 * k
    A, a = np.zeros((u, u)), np.zeros(u)
    flat = by_interior.reshape(2 * len(rays), f)
    A[:f, :f] = flat.T @ flat
    a[:f] = flat.T @ v.ravel()
    pose = np.zeros((k, 6, 6))
    np.add.at(pose, rays.photo, np.swapaxes(by_pose, 1, 2) @ by_pose)
    mixed = np.zeros((k, f, 6))
    np.add.at(mixed, rays.photo, np.swapaxes(by_interior, 1, 2) @ by_pose)
    right = np.zeros((k, 6))
    np.add.at(right, rays.photo, np.einsum("nai,na->ni", by_pose, v))
    for i in range(k):
        rows = slice(f + 6 * i, f + 6 * i + 6)
        A[rows, rows], A[:f, rows], A[rows, :f], a[rows] = pose[i], mixed[i], mixed[i].T, right[i]

    B_interior = np.zeros((m, f, 3))
    np.add.at(B_interior, rays.target, np.swapaxes(by_interior, 1, 2) @ by_point)
    B_pose = np.zeros((k, m, 6, 3))
    np.add.at(B_pose, (rays.photo, rays.target), np.swapaxes(by_pose, 1, 2) @ by_point)
    B = np.concatenate(
        [
            B_interior.transpose(1, 0, 2).reshape(f, 3 * m),
            B_pose.transpose(0, 2, 1, 3).reshape(6 * k, 3 * m),
        ]
    )
    D, d = np.zeros((m, 3, 3)), np.zeros((m, 3))
    np.add.at(D, rays.target, np.swapaxes(by_point, 1, 2) @ by_point)
    np.add.at(d, rays.target, np.einsum("nai,na->ni", by_point, v))
    return NormalEquations(A, B, D, a, d)


def null_space(centres: Array, points: Array, n_interior: int) -> tuple[Array, Array]:
    """What the photographs cannot tell: 3 shifts, 3 turns, 1 scale.

    Returns its part over the cameras (n_interior + 6k, 7) and over the targets (3m, 7), in the
    order of the unknowns.
    """

    def motion(x: Array) -> Array:
        g = np.zeros((len(x), 3, 7))
        g[:, :, :3] = np.eye(3)
        for axis in range(3):
            g[:, :, 3 + axis] = np.cross(np.eye(3)[axis], x)
        g[:, :, 6] = x
        return g

    cameras = np.zeros((len(centres), 6, 7))
    cameras[:, :3, 3:6] = np.eye(3)
    cameras[:, 3:] = motion(centres)
    padded = np.concatenate([np.zeros((n_interior, 7)), cameras.reshape(-1, 7)])
    return padded, motion(points).reshape(-1, 7)


def reduce_targets(normals: NormalEquations, damping: float) -> tuple[Array, Array, Array]:
    """The reduced matrix and right-hand side, and the inverses of the targets' blocks."""
    eye = np.eye(3)
    trace = np.trace(normals.D, axis1=1, axis2=2)[:, None, None]
    # a target without any weight left stays where it is
    regular = normals.D + (damping * trace + np.where(trace == 0, 1.0, 0.0)) * eye
    inverses = np.linalg.inv(regular)
    m = len(inverses)
    B3 = normals.B.reshape(len(normals.B), m, 3)
    BD = np.einsum("umi,mij->umj", B3, inverses).reshape(normals.B.shape)
    return normals.A - BD @ normals.B.T, normals.a - BD @ normals.d.ravel(), inverses


def regularise(S: Array, null: Array) -> tuple[Array, Array, Array]:
    """S scaled to a unit diagonal plus the projector on its null space; scales; projector."""
    scales = 1.0 / np.sqrt(np.maximum(np.diag(S), 1e-300))
    basis, _ = np.linalg.qr(null / scales[:, None])
    projector = basis @ basis.T
    scaled: Array = S * scales[:, None] * scales + projector
    return scaled, scales, projector


def _turn(w: Array) -> Array:
    """Rotation vectors (k, 3) → rotation matrices (k, 3, 3)."""
    angle = np.linalg.norm(w, axis=1)[:, None, None]
    K = np.zeros((len(w), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -w[:, 2], w[:, 1], -w[:, 0]
    K -= np.swapaxes(K, 1, 2)
    small = angle < 1e-9
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 1.0, np.sin(safe) / safe)
    second = np.where(small, 0.5, (1 - np.cos(safe)) / safe**2)
    turned: Array = np.eye(3) + first * K + second * (K @ K)
    return turned


def _step(
    bundle: Bundle, normals: NormalEquations, free: Index, damping: float
) -> tuple[Bundle, float] | None:
    """The bundle after one damped step, and the step's size in standard deviations; None if the
    matrix is not positive definite.
    """
    S, s, inverses = reduce_targets(normals, damping)
    null, _ = null_space(bundle.centres, bundle.points, len(free))
    scaled, scales, _ = regularise(S, null)
    scaled = scaled + damping * np.eye(len(scaled))
    try:
        np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return None
    dc = scales * np.linalg.solve(scaled, scales * s)
    dp = np.einsum("mij,mj->mi", inverses, normals.d - (dc @ normals.B).reshape(-1, 3))
    interior = bundle.interior.copy()
    interior[free] += dc[: len(free)]
    pose = dc[len(free) :].reshape(-1, 6)
    moved = Bundle(
        interior, _turn(pose[:, :3]) @ bundle.rotations, bundle.centres + pose[:, 3:],
        bundle.points + dp,
    )  # fmt: skip
    # half of stepᵀ N step: the predicted decrease of the sum of squares, in its own unit
    size = float(dc @ normals.a + dp.ravel() @ normals.d.ravel())
    return moved, size


def solve(
    sensor: Sensor,
    bundle: Bundle,
    rays: ImageRays,
    free: Index,
    *,
    weights: Array | None = None,
    robust: bool = False,
    iterations: int = 30,
) -> tuple[Bundle, Array]:
    """Adjust the bundle to the rays (Levenberg-Marquardt).

    free: which of `IOP_NAMES` are unknown (indices); weights (n,) factors of the rays' weights, 0
    leaves one out; `robust` renews them in each iteration (Cauchy, scaled by the median residual).
    Returns the bundle and the final weights. Raises GeometryError where it cannot converge.
    """
    w = np.ones(len(rays)) if weights is None else weights
    damping = 1e-6
    v = residuals(sensor, bundle, rays)
    for _ in range(iterations):
        if robust:
            w = _cauchy(v) * (1.0 if weights is None else weights > 0)
        cost = float(w @ np.sum(v * v, axis=1))
        normals = normal_equations(bundle, rays, free, linearise(sensor, bundle, rays, w))
        for _attempt in range(12):
            step = _step(bundle, normals, free, damping)
            if step is not None and step[0].interior[0] > 0:
                v_new = residuals(sensor, step[0], rays)
                new = float(w @ np.sum(v_new * v_new, axis=1))
                if new <= cost * (1 + 1e-12):
                    break
            damping = max(damping * 10, 1e-9)
        else:
            # no step lowers the sum: it is the minimum to within rounding, or hopeless
            if step is not None and step[1] < 1e-4:
                return bundle, w
            raise GeometryError(
                "the bundle adjustment does not converge: take more photographs, from more sides, "
                "or give approximate camera data"
            )
        bundle, v = step[0], v_new
        damping = max(damping / 10, 1e-12)
        if step[1] < 1e-8 or (robust and cost - new < 1e-6 * cost):
            break
    return _normalised(bundle), w


def _cauchy(v: Array) -> Array:
    """Weights (n,) from whitened residuals (n, 2): 1 for the good, falling with the square."""
    size2 = np.sum(v * v, axis=1)
    scale2 = max(float(np.median(size2)) / 1.386, 1e-12)  # the median of chi² with 2 degrees
    weights: Array = 1.0 / (1.0 + size2 / (9.0 * scale2))
    return weights


def _normalised(bundle: Bundle) -> Bundle:
    """With rotations that are orthonormal to the last bit."""
    U, _, Vt = np.linalg.svd(bundle.rotations)
    return replace(bundle, rotations=U @ Vt)
