"""Bundle adjustment of photographs and points: normal equations, iteration and covariance.

The targets are eliminated block by block (Schur complement). In a free network the gauge of seven
(position, orientation, scale) is left free and its null space added to the reduced matrix, which
makes it regular without constraining anything that the photographs determine; the targets follow by
back substitution, and an S-transformation brings all of it to the datum in which the mean standard
deviation of the targets is smallest. Where the targets are known their places and standard
deviations are observations, and nothing is free.

Rotations are updated in object space (`R ← exp([w]×) R`), so no camera can look into a gimbal lock.

Source: Baarda, W. (1973): S-transformations and criterion matrices; Granshaw, S. I. (1980): Bundle
adjustment methods in engineering photogrammetry, Photogrammetric Record 10(56); Triggs, B. et al.
(2000): Bundle adjustment — a modern synthesis, sections 6 and 9.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    ExteriorOrientation,
    Sensor,
    partials,
    project,
)
from thermocald.photogrammetry.linalg import unit_diagonal

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Index
    from thermocald.photogrammetry.field.testfield import Observations


_N_IOP = len(IOP_NAMES)
# Eigenvalues of the scaled matrix below this are rounding errors of its elements.
_SINGULAR = 1e-13
SINGULAR = (
    "the normal matrix is singular: these photographs do not separate the parameters; take some "
    "from other directions or hold parameters fixed"
)
_LEAST_SIGMA_MM = 1e-6  # of a coordinate without sigma alongside others with one


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
    blocks = np.einsum("mimj->mij", Qp.reshape(m, 3, m, 3))  # a view
    blocks += inverses
    cofactors = np.eye(2) - adjusted_cofactors(linearised, rays, free, Qc, Qcp, blocks)

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


def adjusted_cofactors(
    linearised: tuple[Array, Array, Array, Array],
    rays: ImageRays,
    free: Index,
    Qc: Array,
    Qcp: Array,
    targets: Array,
) -> Array:
    """The cofactors (n, 2, 2) of the adjusted, whitened image points; independent of the gauge.

    Qc (u, u), Qcp (u, 3m), targets (m, 3, 3): cofactors of cameras, between both, of each target.
    """
    _, by_interior, by_pose, by_point = linearised
    J = np.concatenate([by_interior[:, :, free], by_pose], axis=2)
    f = len(free)
    pose = f + 6 * rays.photo[:, None] + np.arange(6)
    columns = np.concatenate([np.broadcast_to(np.arange(f), (len(rays), f)), pose], axis=1)
    rows = 3 * rays.target[:, None] + np.arange(3)
    cameras = Qc[columns[:, :, None], columns[:, None, :]]
    mixed = Qcp[columns[:, :, None], rows[:, None, :]]
    points = targets[rays.target]
    half = J @ mixed @ np.swapaxes(by_point, 1, 2)
    total: Array = (
        J @ cameras @ np.swapaxes(J, 1, 2)
        + half
        + np.swapaxes(half, 1, 2)
        + by_point @ points @ np.swapaxes(by_point, 1, 2)
    )
    return total


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

    @classmethod
    def collect(cls, photographs: Sequence[Observations]) -> ImageRays:
        """The image points of photographs, one after the other; targets keep their rows."""
        points = np.concatenate([o.points for o in photographs]).astype(float)
        C = np.zeros((len(points), 2, 2))
        sigmas = np.concatenate([o.sigmas for o in photographs])
        C[:, 0, 0], C[:, 1, 1] = sigmas[:, 0] ** 2, sigmas[:, 1] ** 2
        xy = [np.zeros(len(o)) if o.covariances is None else o.covariances for o in photographs]
        C[:, 0, 1] = C[:, 1, 0] = np.concatenate(xy)
        return cls(
            np.repeat(np.arange(len(photographs)), [len(o) for o in photographs]),
            np.concatenate([o.targets for o in photographs]).astype(np.int64),
            points,
            np.linalg.inv(np.linalg.cholesky(C)),
        )

    def select(self, keep: NDArray[np.bool_]) -> ImageRays:
        """The rays of a mask."""
        return ImageRays(
            self.photo[keep], self.target[keep], self.points[keep], self.whitening[keep]
        )

    def in_pixels(self) -> ImageRays:
        """The same rays with residuals in px, whatever their sigmas."""
        return replace(self, whitening=np.broadcast_to(np.eye(2), self.whitening.shape))


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
class KnownTargets:
    """What is known of the targets beforehand: places (m, 3) mm with weights (m, 3) mm⁻², and which
    of them (m,) are uncertain; the others are held.
    """

    points: Array
    weights: Array
    uncertain: NDArray[np.bool_]

    @classmethod
    def build(cls, points: Array, sigmas: Array) -> KnownTargets:
        """From places and standard deviations (m, 3) mm, 0 for what is exact."""
        uncertain = np.asarray((sigmas > 0).any(axis=1))
        weights = np.where(uncertain[:, None], np.maximum(sigmas, _LEAST_SIGMA_MM) ** -2, 1.0)
        return cls(points, weights, uncertain)

    def cost(self, bundle: Bundle) -> float:
        """The weighted sum of squares of the targets' corrections."""
        return float(np.sum(self.weights * (bundle.points - self.points) ** 2))


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
    sensor: Sensor,
    bundle: Bundle,
    rays: ImageRays,
    weights: Array,
    known: KnownTargets | None = None,
) -> tuple[Array, Array, Array, Array]:
    """Whitened residuals (n, 2), partials by interior (n, 2, 10), pose (…, 6), target (…, 3).

    The partials by a target that is held are 0.
    """
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
    if known is not None:
        by_point = by_point * known.uncertain[rays.target, None, None]
    return v, root @ by_interior, root @ by_pose, root @ by_point


def normal_equations(
    bundle: Bundle,
    rays: ImageRays,
    free: Index,
    linearised: tuple[Array, Array, Array, Array],
    known: KnownTargets | None = None,
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
    if known is not None:
        D += known.weights[:, :, None] * np.eye(3)
        d += known.weights * (known.points - bundle.points)
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


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """A step of cameras (u,) and targets (m, 3), and its size: stepᵀ N step."""

    cameras: Array
    targets: Array
    size: float

    def taken(self, bundle: Bundle, free: Index, fraction: float) -> Bundle:
        """The bundle after a fraction of the step."""
        dc, f = fraction * self.cameras, len(free)
        interior, pose = bundle.interior.copy(), dc[f:].reshape(-1, 6)
        interior[free] += dc[:f]
        return Bundle(
            interior,
            _turn(pose[:, :3]) @ bundle.rotations,
            bundle.centres + pose[:, 3:],
            bundle.points + fraction * self.targets,
        )


def _step(
    bundle: Bundle, normals: NormalEquations, free: Index, damping: float, gauge: bool
) -> _Step | None:
    """The damped step; None if the matrix is not positive definite.

    gauge: whether position, orientation and scale are free.
    """
    S, s, inverses = reduce_targets(normals, damping)
    if gauge:
        null, _ = null_space(bundle.centres, bundle.points, len(free))
        scaled, scales, _ = regularise(S, null)
    else:
        scaled, scales = unit_diagonal(S)
    scaled = scaled + damping * np.eye(len(scaled))
    try:
        np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return None
    dc = scales * np.linalg.solve(scaled, scales * s)
    dp = np.einsum("mij,mj->mi", inverses, normals.d - (dc @ normals.B).reshape(-1, 3))
    # the predicted decrease of the sum of squares, in its own unit
    return _Step(dc, dp, float(dc @ normals.a + dp.ravel() @ normals.d.ravel()))


def solve(
    sensor: Sensor,
    bundle: Bundle,
    rays: ImageRays,
    free: Index,
    *,
    weights: Array | None = None,
    robust: bool = False,
    iterations: int = 30,
    known: KnownTargets | None = None,
) -> tuple[Bundle, Array]:
    """Adjust the bundle to the rays.

    A free network by damped steps (Levenberg-Marquardt); with known targets by whole or shorter
    ones (Gauss-Newton), which follow the narrow valley of a weak geometry to its end.
    free: which of `IOP_NAMES` are unknown (indices); weights (n,) factors of the rays' weights, 0
    leaves one out; `robust` renews them in each iteration (Cauchy, scaled by the median residual);
    known: what is known of the targets, None for a free network.
    Returns the bundle and the final weights. Raises GeometryError where it cannot converge.
    """

    def cost_of(bundle: Bundle, v: Array) -> float:
        prior = 0.0 if known is None else known.cost(bundle)
        return float(w @ np.sum(v * v, axis=1)) + prior

    gauge = known is None
    w = np.ones(len(rays)) if weights is None else weights
    damping = 1e-6 if gauge else 0.0
    v = residuals(sensor, bundle, rays)
    for _ in range(iterations):
        if robust:
            w = _cauchy(v) * (1.0 if weights is None else weights > 0)
        cost = cost_of(bundle, v)
        linearised = linearise(sensor, bundle, rays, w, known)
        normals = normal_equations(bundle, rays, free, linearised, known)
        fraction = 1.0
        for _attempt in range(12):
            step = _step(bundle, normals, free, damping, gauge)
            if step is not None:
                trial = step.taken(bundle, free, fraction)
                if trial.interior[0] > 0:
                    v_new = residuals(sensor, trial, rays)
                    new = cost_of(trial, v_new)
                    if new <= cost * (1 + 1e-12):
                        break
            elif not gauge:
                raise GeometryError(SINGULAR)
            if gauge:
                damping = max(damping * 10, 1e-9)
            else:
                fraction /= 2
        else:
            # no step lowers the sum: it is the minimum to within rounding, or hopeless
            if step is not None and step.size < 1e-4:
                return bundle, w
            raise GeometryError(
                "the bundle adjustment does not converge: take more photographs, from more sides, "
                "or give approximate camera data"
            )
        bundle, v = trial, v_new
        if gauge:
            damping = max(damping / 10, 1e-12)
        if step.size < 1e-8 or (robust and cost - new < 1e-6 * cost):
            break
    else:
        if not gauge:
            raise GeometryError(f"the adjustment did not converge in {iterations} iterations")
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
