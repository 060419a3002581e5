"""Bundle adjustment of photographs and points: normal equations, iteration and covariance.

The targets are eliminated block by block (Schur complement). A free network has a datum defect of
seven (position, orientation, scale): its null space is added to the reduced matrix, which becomes
regular without a constraint on anything that the photographs determine. The targets follow by back
substitution, and an S-transformation gives the datum in which the targets' mean standard deviation
is smallest. Coordinates of known targets are observations with their standard deviations; then
there is no datum defect.

Rotations are updated in object space (`R ← exp([w]×) R`), so that there is no gimbal lock.

Source: Baarda, W. (1973): S-transformations and criterion matrices; Granshaw, S. I. (1980): Bundle
adjustment methods in engineering photogrammetry, Photogrammetric Record 10(56); Triggs, B. et al.
(2000): Bundle adjustment — a modern synthesis, sections 6 and 9; Armijo, L. (1966): Minimization
of functions having Lipschitz continuous first partial derivatives, Pacific Journal of Mathematics
16.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import prod
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    Sensor,
    partials,
    project,
    rotation_angles,
)
from thermocald.photogrammetry.linalg import (
    median_variance,
    rigid_motion,
    scaled_inverse,
    unit_diagonal,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.field.testfield import Observations

    _Normals = tuple[Array, Array, Array, Array, Array]


_N_IOP = len(IOP_NAMES)
# Smaller eigenvalues of the scaled matrix are rounding errors of its elements.
_SINGULAR = 1e-13
_SEPARATE_NOTHING = (
    "the normal matrix is singular: these photographs do not separate the parameters; take some "
    "from other directions or hold parameters fixed"
)
BEHIND = 1e6
"""The whitened residual of a target behind its camera."""
_LEAST_DECREASE = 0.5  # of what the step predicts
_DAMPING = 1e-6  # of the unit diagonal, so that a weak free network does not run away
_AS_STATED = 2.0  # residuals in their sigmas: larger ones have another cause than weak geometry
_CONTROLLED = 1e-3  # cofactor of a residual below which no other observation controls it


class KnownTargets(NamedTuple):
    """A-priori coordinates of the targets: places (m, 3) mm, weights (m, 3) mm⁻², and a mask (m,)
    of the uncertain ones, the others being held.
    """

    places: Array
    weights: Array
    uncertain: Mask


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
        """Collect the image points of photographs in their order; targets keep their rows."""
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

    def select(self, keep: Mask) -> ImageRays:
        """Return the rays of a mask."""
        return ImageRays(
            self.photo[keep], self.target[keep], self.points[keep], self.whitening[keep]
        )

    def in_pixels(self) -> ImageRays:
        """Return the rays without sigmas, so that residuals are in px."""
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
        """Return the exterior orientations (k, 6) in the order of `EOP_NAMES`."""
        return np.concatenate([rotation_angles(self.rotations), self.centres], axis=1)

    def apply(self, cameras: Array, targets: Array, free: Index) -> Bundle:
        """Return the bundle after a step of cameras (u,) and targets (m, 3)."""
        interior, pose = self.interior.copy(), cameras[len(free) :].reshape(-1, 6)
        interior[free] += cameras[: len(free)]
        return Bundle(
            interior,
            np.array([cv2.Rodrigues(w)[0] for w in pose[:, :3]]) @ self.rotations,
            self.centres + pose[:, 3:],
            self.points + targets,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Cofactors:
    """Cofactors (sigma0 = 1) of a bundle; of a free one in an arbitrary datum.

    cameras (u, u): interior first; mixed (u, 3m): between cameras and targets; follow (u, 3m):
    derivatives of the targets by the cameras; own (m, 3, 3): of the targets with cameras held;
    weakest: the parameters that a free network determines worst.
    """

    cameras: Array
    mixed: Array
    follow: Array
    own: Array
    weakest: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class BundleAdjustment:
    """The adjustment of one camera's image points with interior orientation, poses and targets.

    free: indices of the unknown ones of `IOP_NAMES`; known: None for a free network, whose
    position, orientation and scale are undefined.
    """

    sensor: Sensor
    rays: ImageRays
    free: Index
    known: KnownTargets | None = None

    def residuals(self, bundle: Bundle) -> Array:
        """Return whitened residuals (n, 2), measured minus computed; `BEHIND` for a target behind
        its camera.
        """
        eop = bundle.exteriors()[self.rays.photo]
        points = bundle.points[self.rays.target][:, None, :]
        computed = project(self.sensor, bundle.interior, eop, points)[:, 0]
        v = np.einsum("nij,nj->ni", self.rays.whitening, self.rays.points - computed)
        return np.where(np.isfinite(v), v, BEHIND)

    def solve(self, bundle: Bundle, *, robust: bool = False, iterations: int = 30) -> Bundle:
        """Adjust a bundle to the image points.

        Steps are whole or shorter ones (Gauss-Newton, hardly damped in a free network), which
        follow the narrow valley of a weak geometry. robust: renew weights in each iteration
        (Cauchy, scaled by the median residual); then, as in a free network, the last iteration is
        good enough. Raises GeometryError if it does not converge.
        """
        w = np.ones(len(self.rays))
        v = self.residuals(bundle)
        for _ in range(iterations):
            if robust:  # weights fall from 1 with the square of the residual
                size2 = np.sum(v * v, axis=1)
                w = 1.0 / (1.0 + size2 / (9.0 * median_variance(size2)))
            cost = self.cost(bundle, v, w)
            normals = self._normal_equations(bundle, w)
            cameras, targets, size = self._step(bundle, normals)
            for fraction in 0.5 ** np.arange(12):
                trial = bundle.apply(fraction * cameras, fraction * targets, self.free)
                if trial.interior[0] > 0:
                    v_new = self.residuals(trial)
                    new = self.cost(trial, v_new, w)
                    # a whole step overshoots where residuals are large
                    if new + _LEAST_DECREASE * fraction * size <= cost * (1 + 1e-12):
                        break
            else:
                # no step lowers the sum: a minimum to within rounding, or no convergence
                if size < 1e-4:
                    return bundle
                raise GeometryError(
                    "the bundle adjustment does not converge: take more photographs, from more "
                    "sides, or give approximate camera data"
                )
            bundle, v = trial, v_new
            if size < 1e-8 or (robust and cost - new < 1e-6 * cost):
                break
        else:
            if self.known is not None and not robust:
                size = np.sqrt(np.mean(v * v))
                why = "is it one camera with one focus, and a field that does not bend? If so, "
                if size < _AS_STATED:
                    why = "the photographs hardly determine the camera; "
                raise GeometryError(
                    f"the adjustment did not converge in {iterations} iterations; residuals are "
                    f"{size:.1f} times their sigmas: {why}take more photographs, some of them "
                    "oblique"
                )
        # orthonormal to the last bit
        U, _, Vt = np.linalg.svd(bundle.rotations)
        return replace(bundle, rotations=U @ Vt)

    def approach(self, bundle: Bundle, iterations: int) -> Bundle:
        """Adjust a bundle robustly: with c, x0, y0 and A1 first, then with all that is free."""
        for last in (4, _N_IOP):
            stage = replace(self, free=self.free[self.free < last])
            bundle = stage.solve(bundle, robust=True, iterations=iterations)
        return bundle

    def with_held_targets(self, bundle: Bundle) -> BundleAdjustment:
        """Return the adjustment that holds known targets and adds their covariance to the rays'."""
        assert self.known is not None
        by_target = self.linearised(bundle, np.ones(len(self.rays)))[2]
        J = by_target / np.sqrt(self.known.weights)[self.rays.target, None]
        root = np.linalg.cholesky(np.eye(2) + J @ np.swapaxes(J, 1, 2))
        rays = replace(self.rays, whitening=np.linalg.solve(root, self.rays.whitening))
        held = self.known._replace(uncertain=np.zeros_like(self.known.uncertain))
        return replace(self, rays=rays, known=held)

    def cofactors(self, bundle: Bundle) -> Cofactors:
        """Return the cofactors at the solution. Raises GeometryError if it is undetermined."""
        normals = self._normal_equations(bundle, np.ones(len(self.rays)))
        S, _, inverses = _reduce(normals)
        weakest: tuple[str, ...] = ()
        if self.known is None:
            null, _ = null_space(bundle.centres, bundle.points, len(self.free))
            scaled, scales, projector = _regularise(S, null)
            values, vectors = np.linalg.eigh(scaled)
            labels = [IOP_NAMES[i] for i in self.free] + ["a camera's pose"] * len(S)
            strongest = np.argsort(-(vectors[:, 0] ** 2))[:3]
            weakest = tuple(dict.fromkeys(labels[i] for i in strongest))
            if values[0] < _SINGULAR:
                raise GeometryError(
                    f"the photographs do not determine {', '.join(weakest)}: take them from more "
                    "directions, turn the camera by 90° for some, and bring depth into the field"
                )
            Q = ((vectors / values) @ vectors.T - projector) * scales[:, None] * scales
        else:
            try:
                np.linalg.cholesky(unit_diagonal(S)[0])
                Q = scaled_inverse(S)
            except np.linalg.LinAlgError:
                raise GeometryError(_SEPARATE_NOTHING) from None
        B3 = normals[1].reshape(len(Q), -1, 3)
        follow = -np.einsum("mij,umj->umi", inverses, B3).reshape(len(Q), -1)
        return Cofactors(Q, Q @ follow, follow, inverses, weakest)

    def explained(self, bundle: Bundle, found: Cofactors) -> Array:
        """Return the cofactors (n, 2, 2) of the adjusted, whitened image points, which do not
        depend on the datum. The rays may be others than those of the adjustment.
        """
        _, J, by_target = self.linearised(bundle, np.ones(len(self.rays)))
        columns = self.columns[:, :, None]
        rows = 3 * self.rays.target[:, None] + np.arange(3)
        half = J @ found.mixed[columns, rows[:, None, :]] @ np.swapaxes(by_target, 1, 2)
        follow, mixed = (a.reshape(len(a), -1, 3) for a in (found.follow, found.mixed))
        of_targets = found.own + np.einsum("umi,umj->mij", follow, mixed)
        total: Array = (
            J @ found.cameras[columns, np.swapaxes(columns, 1, 2)] @ np.swapaxes(J, 1, 2)
            + half
            + np.swapaxes(half, 1, 2)
            + by_target @ of_targets[self.rays.target] @ np.swapaxes(by_target, 1, 2)
        )
        return total

    @property
    def columns(self) -> Index:
        """Columns (n, f + 6) of each ray's camera and pose in the normal equations."""
        pose = len(self.free) + 6 * self.rays.photo[:, None] + np.arange(6)
        interior = np.broadcast_to(np.arange(len(self.free)), (len(pose), len(self.free)))
        return np.concatenate([interior, pose], axis=1)

    def cost(self, bundle: Bundle, v: Array, weights: Array) -> float:
        """Return the weighted sum of squares of residuals (n, 2) and targets' corrections."""
        total = float(weights @ np.sum(v * v, axis=1))
        if self.known is not None:
            total += float(np.sum(self.known.weights * (bundle.points - self.known.places) ** 2))
        return total

    def linearised(self, bundle: Bundle, weights: Array) -> tuple[Array, Array, Array]:
        """Return whitened residuals (n, 2), and the partials with respect to camera and pose
        (n, 2, f + 6) and to the target (n, 2, 3), 0 if that is held.
        """
        rays = self.rays
        eop = bundle.exteriors()[rays.photo]
        points = bundle.points[rays.target]
        computed, by_parameter, by_point = partials(
            self.sensor, bundle.interior, eop, points[:, None, :]
        )
        in_front = np.isfinite(computed[:, 0, 0])
        root = np.sqrt(np.where(in_front, weights, 0.0))[:, None, None] * rays.whitening
        by_point = np.nan_to_num(by_point[:, 0])
        # q = Rᵀ d: a rotation about an object axis e acts as a movement of the point by d × e
        cross = -rigid_motion(points - bundle.centres[rays.photo])[:, :, 3:]
        by_interior = np.nan_to_num(by_parameter[:, 0, :, :_N_IOP])[:, :, self.free]
        by_camera = np.concatenate([by_interior, by_point @ cross, -by_point], axis=2)
        v = (root @ np.nan_to_num(rays.points - computed[:, 0])[..., None])[..., 0]
        if self.known is not None:
            by_point = by_point * self.known.uncertain[rays.target, None, None]
        return v, root @ by_camera, root @ by_point

    def _normal_equations(self, bundle: Bundle, weights: Array) -> _Normals:
        """Return normal blocks of the cameras (u, u), interior first, then six per photograph; of
        cameras by targets (u, 3m); of targets (m, 3, 3); and right-hand sides (u,), (m, 3).
        """
        v, by_camera, by_point = self.linearised(bundle, weights)
        columns, target, m = self.columns, self.rays.target, len(bundle.points)
        u = len(self.free) + 6 * len(bundle.centres)
        C, P = np.swapaxes(by_camera, 1, 2), np.swapaxes(by_point, 1, 2)
        A = np.zeros((u, u))
        for photo in np.unique(self.rays.photo):  # in a third of the time of all rays at once
            mine = self.rays.photo == photo
            rows, J = columns[mine][0], by_camera[mine].reshape(-1, columns.shape[1])
            A[rows[:, None], rows] += J.T @ J
        B = sum_at((u, m, 3), (columns, target[:, None]), C @ by_point)
        D = sum_at((m, 3, 3), (target,), P @ by_point)
        a = sum_at((u,), (columns,), C @ v[..., None])
        d = sum_at((m, 3), (target,), P @ v[..., None])
        if self.known is not None:
            D += self.known.weights[:, :, None] * np.eye(3)
            d += self.known.weights * (self.known.places - bundle.points)
        return A, B.reshape(u, -1), D, a, d

    def _step(self, bundle: Bundle, normals: _Normals) -> tuple[Array, Array, float]:
        """Return the step of cameras (u,) and targets (m, 3), and its size stepᵀ N step.

        Raises GeometryError if the matrix is not positive definite.
        """
        S, s, inverses = _reduce(normals, _DAMPING if self.known is None else 0.0)
        if self.known is None:
            null, _ = null_space(bundle.centres, bundle.points, len(self.free))
            scaled, scales, _ = _regularise(S, null)
            scaled += _DAMPING * np.eye(len(scaled))
        else:
            scaled, scales = unit_diagonal(S)
        try:
            np.linalg.cholesky(scaled)
        except np.linalg.LinAlgError:
            raise GeometryError(_SEPARATE_NOTHING) from None
        dc = scales * np.linalg.solve(scaled, scales * s)
        _, B, _, a, d = normals
        dp = np.einsum("mij,mj->mi", inverses, d - (dc @ B).reshape(-1, 3))
        # the predicted decrease of the sum of squares
        return dc, dp, float(dc @ a + dp.ravel() @ d.ravel())


def sum_at(shape: tuple[int, ...], index: tuple[Index, ...], values: Array) -> Array:
    """Sum values at indices of the leading axes of an array of this shape; the latter broadcast."""
    at = np.ravel_multi_index(np.broadcast_arrays(*index), shape[: len(index)])
    inner = prod(shape[len(index) :])
    rows = at.reshape(-1, 1) * inner + np.arange(inner)
    sums = np.bincount(rows.ravel(), weights=values.ravel(), minlength=prod(shape))
    return np.asarray(sums.reshape(shape), dtype=np.float64)


def _reduce(normals: _Normals, damping: float = 0.0) -> tuple[Array, Array, Array]:
    """Return the matrix and right-hand side with targets eliminated, and the inverse blocks.

    damping: share of its weight that holds a target, which in a bad start one ray alone may show.
    """
    A, B, D, a, d = normals
    trace = np.trace(D, axis1=1, axis2=2)
    # a target without any weight is held
    weight = np.where(trace == 0, 1.0, damping * trace)[:, None, None]
    inverses = np.asarray(np.linalg.inv(D + weight * np.eye(3)), dtype=np.float64)
    B3 = B.reshape(len(B), len(inverses), 3)
    BD = np.einsum("umi,mij->umj", B3, inverses).reshape(B.shape)
    return A - BD @ B.T, a - BD @ d.ravel(), inverses


def inner_constraints(
    bundle: Bundle, found: Cofactors, free: Index, noise: float, more_c: Array, more_p: Array
) -> tuple[Array, Array, Array]:
    """Return the covariances of a free network with inner constraints over the targets: of the
    interior orientation (10, 10), zero if held, the centres (k, 3, 3) mm² and the targets (3m, 3m)
    mm².

    noise: variance of unit weight; more_c (e, u), more_p (e, 3m): roots of what is added to the
    covariances of cameras and targets.
    """
    f, k, m = len(free), len(bundle.centres), len(bundle.points)
    Qp = noise * found.follow.T @ found.mixed + more_p.T @ more_p
    blocks = np.einsum("mimj->mij", Qp.reshape(m, 3, m, 3))  # a view
    blocks += noise * found.own
    null_c, null_p = null_space(bundle.centres, bundle.points, f)
    K = np.linalg.solve(null_p.T @ null_p, null_p.T)
    KQ = K @ Qp
    inner = Qp - null_p @ KQ - KQ.T @ null_p.T + null_p @ (KQ @ K.T) @ null_p.T
    KQc = K @ (noise * found.mixed.T + more_p.T @ more_c)
    cameras = noise * found.cameras + more_c.T @ more_c
    cameras = cameras - null_c @ KQc - KQc.T @ null_c.T + null_c @ (KQ @ K.T) @ null_c.T
    interior = np.zeros((_N_IOP, _N_IOP))
    interior[np.ix_(free, free)] = cameras[:f, :f]
    poses = cameras[f:, f:].reshape(k, 6, k, 6)
    return interior, np.einsum("kikj->kij", poses[:, 3:, :, 3:]), inner


def point_tests(v: Array, cofactors: Array) -> Array:
    """Return vᵀ Qvv⁻¹ v (n,) of whitened residuals (n, 2) with cofactors (n, 2, 2): χ² with two
    degrees of freedom, without directions that no other observation controls.
    """
    values, vectors = np.linalg.eigh(cofactors)
    along = np.einsum("nji,nj->ni", vectors, v)
    controlled = values > _CONTROLLED
    shares = np.where(controlled, along**2 / np.where(controlled, values, 1), 0)
    tests: Array = np.sum(shares, axis=1)
    return tests


def null_space(centres: Array, points: Array, n_interior: int) -> tuple[Array, Array]:
    """Return the null space of a free network: 3 shifts, 3 rotations, 1 scale.

    Its parts for the cameras (n_interior + 6k, 7) and the targets (3m, 7), in the order of the
    unknowns.
    """

    def motion(x: Array) -> Array:
        return np.concatenate([rigid_motion(x), x[:, :, None]], axis=2)

    cameras = np.zeros((len(centres), 6, 7))
    cameras[:, :3, 3:6] = np.eye(3)
    cameras[:, 3:] = motion(centres)
    padded = np.concatenate([np.zeros((n_interior, 7)), cameras.reshape(-1, 7)])
    return padded, motion(points).reshape(-1, 7)


def _regularise(S: Array, null: Array) -> tuple[Array, Array, Array]:
    """Scale S to a unit diagonal and add the projector on its null space; return all three."""
    scaled, scales = unit_diagonal(S)
    basis, _ = np.linalg.qr(null / scales[:, None])
    projector = basis @ basis.T
    return scaled + projector, scales, projector
