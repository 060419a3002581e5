"""Bundle adjustment: datum, normal equations and covariance of photographs and points.

Position and orientation by inner constraints over all targets (the mean standard deviation is
smallest, and no target is privileged): they coincide in the mean with the nominal field if there is
one, else the origin is the centroid and Z the normal of the best plane, towards the cameras. Scale
by measured distances, with their standard deviations, in a rigorous sequential adjustment.

The reduced matrix is inverted in the gauge of its own null space, the targets follow by back
substitution, and an S-transformation brings all of it to the datum in which the mean standard
deviation of the targets is smallest.

Source: Baarda, W. (1973): S-transformations and criterion matrices; Granshaw, S. I. (1980): Bundle
adjustment methods in engineering photogrammetry, Photogrammetric Record 10(56).

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
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Index
    from thermocald.photogrammetry.camera.camera_model import Sensor


@dataclass(frozen=True, slots=True)
class Distance:
    """A measured distance between two targets, mm, with its standard deviation."""

    a: str
    b: str
    length: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class Datum:
    """A bundle in its datum, the targets' covariance (3m, 3m) mm² in it, and how it was brought
    there: `x_new = scale · turn · x + shift`.
    """

    bundle: Bundle
    covariance: Array
    scale: float
    turn: Array
    sd_scale: float
    statement: str


def bring_to_datum(
    bundle: Bundle,
    covariance: Array,
    distances: Sequence[Distance],
    index: dict[str, int],
    nominal: Array | None,
) -> Datum:
    """Scale and place a free network whose covariance (3m, 3m) has inner constraints.

    index: the row of each target by name; nominal (m, 3) mm, NaN where unknown.
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
    return Datum(placed, turned, scale, turn, sd_scale, statement)


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
