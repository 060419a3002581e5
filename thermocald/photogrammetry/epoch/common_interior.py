"""Several photographs of one camera: one interior orientation, an exterior one per photograph.

A target is where it is in all photographs: its coordinates are unknowns with the test field's
sigmas as prior, eliminated once over all its rays. The weights of the image points do not depend on
the unknowns, so that Gauss-Newton ends at the minimum of the sum of squares. A photograph too poor
to carry an interior orientation of its own takes part all the same.

Source: Luhmann et al. (2014), section 7.3 (test-field calibration); the elimination of points as
Brown, D. C. (1976): The bundle adjustment - progress and prospects.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import (
    EOP_COLUMNS,
    ExteriorOrientation,
    InteriorOrientation,
    free_columns,
    partials,
)
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.photogrammetry.epoch.gauss_markov import point_covariances
from thermocald.photogrammetry.epoch.geometry import image_coverage, obliqueness_deg, uncertain
from thermocald.photogrammetry.epoch.snooping import chi2_2d
from thermocald.photogrammetry.field.planes import plane_fit
from thermocald.photogrammetry.linalg import diagonal_scale, scaled_inverse

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Mask
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.field.testfield import Observations, TestField

_ITERATIONS = 60
_CONVERGED = 1e-3
_ROUNDS = 10
_LEAST_SIGMA_MM = 1e-6  # of a coordinate without sigma alongside others with one


@dataclass(frozen=True, eq=False)
class CommonInterior:
    """One camera from several photographs.

    interior; covariance (16, 16), its EOP block zero; exteriors, exterior_covariances (n, 6, 6);
    sigma0; redundancy; used: masks of the observations per photograph; residuals per photograph
    (n, 2) px; reasons: why the geometry is weak, empty where it is not.
    """

    interior: InteriorOrientation
    covariance: Array
    exteriors: tuple[ExteriorOrientation, ...]
    exterior_covariances: Array
    sigma0: float
    redundancy: int
    used: tuple[Mask, ...]
    residuals: tuple[Array, ...]
    reasons: tuple[str, ...]

    @property
    def sd(self) -> Array:
        """Standard deviations (16,), 0 where held."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, eq=False)
class _State:
    """Parameters iop (10,), eops (n, 6), and corrections (T, 3) mm of the targets."""

    iop: Array
    eops: Array
    shifts: Array


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations N (u, u), b (u,) of interior (q) and exteriors (6 each) with the targets
    eliminated; what gives the targets' own step: Q (T, 3, 3), C (u, T, 3), d (T, 3); the weighted
    sum of squares; residuals px of each photograph; its rays: partials (n, 2, q + 6) by the
    camera, (n, 2, 3) by the targets, and weights (n, 2, 2).
    """

    N: Array
    b: Array
    Q: Array
    C: Array
    d: Array
    cost: float
    residuals: tuple[Array, ...]
    rays: tuple[tuple[Array, Array, Array], ...]


def adjust_common_interior(
    sensor: Sensor,
    testfield: TestField,
    photographs: Sequence[Observations],
    interior: InteriorOrientation,
    exteriors: Sequence[ExteriorOrientation],
    settings: AdjustmentSettings | None = None,
    fitting: Sequence[Mask] | None = None,
) -> CommonInterior:
    """Adjust photographs that share an interior orientation, from start values.

    fitting: masks of the observations that take part at first, per photograph; what fits the result
    comes back. Raises GeometryError where the adjustment does not converge or is singular.
    """
    s = settings or AdjustmentSettings()
    problem = _Problem(
        sensor, testfield, tuple(photographs), np.array(free_columns(s.free), dtype=np.int64)
    )
    eops = np.array([e.as_array() for e in exteriors])
    state = _State(interior.as_array(), eops, np.zeros((len(testfield), 3)))
    everything = [np.ones(len(o), dtype=bool) for o in photographs]
    used = everything if fitting is None or s.snooping_alpha <= 0 else list(fitting)
    for _ in range(_ROUNDS):
        state, system = problem.solve(state, used)
        tests = problem.tests(system, used)
        kept = snoop_rays(tests, photographs, used, s.snooping_alpha)
        if all(np.array_equal(a, b) for a, b in zip(kept, used, strict=True)):
            break
        used = kept
    free, values, eops = problem.free, state.iop, state.eops
    n = sum(int(m.sum()) for m in used)
    redundancy = 2 * n - len(free) - 6 * len(photographs)
    if redundancy < s.bounds.minimum_redundancy:
        raise GeometryError(
            f"{n} image points in {len(photographs)} photographs leave a redundancy of "
            f"{redundancy}; at least {s.bounds.minimum_redundancy} is needed"
        )
    variance = system.cost / redundancy
    Q = _inverse(system.N) * (variance if s.scale == "posterior" else 1.0)
    q = len(free)
    covariance = np.zeros((16, 16))
    covariance[np.ix_(free, free)] = Q[:q, :q]
    exterior_covariances = np.array([Q[k : k + 6, k : k + 6] for k in range(q, len(Q), 6)]).reshape(
        -1, 6, 6
    )
    result_eops = tuple(ExteriorOrientation.from_array(e) for e in eops)
    reasons = weaknesses_together(sensor, testfield, photographs, used, values, eops, covariance, s)
    return CommonInterior(
        InteriorOrientation.from_array(values),
        covariance,
        result_eops,
        exterior_covariances,
        float(np.sqrt(variance)),
        redundancy,
        tuple(used),
        system.residuals,
        tuple(reasons),
    )


@dataclass(frozen=True, eq=False)
class _Problem:
    """What does not change in the adjustment; free: positions of the free interior parameters."""

    sensor: Sensor
    testfield: TestField
    photographs: tuple[Observations, ...]
    free: NDArray[np.int64]

    def system(self, state: _State, used: Sequence[Mask]) -> _System:
        """The normal equations at a state; raises GeometryError for targets behind the camera."""
        q, T = len(self.free), len(self.testfield)
        u = q + 6 * len(self.photographs)
        N, b, C = np.zeros((u, u)), np.zeros(u), np.zeros((u, T, 3))
        M, d, uncertain, cost = self._priors(state)
        residuals, rays = [], []
        for k, (obs, mask) in enumerate(zip(self.photographs, used, strict=True)):
            points = self.testfield.points[obs.targets] + state.shifts[obs.targets]
            predicted, A, B = partials(self.sensor, state.iop, state.eops[k], points)
            if not np.isfinite(predicted[mask]).all():
                raise GeometryError("targets came to lie behind the camera during the iteration")
            P, r = _inverse_covariances(obs), obs.points - predicted
            residuals.append(r)
            columns = np.concatenate([self.free, EOP_COLUMNS])
            rays.append((A[..., columns], B, P))
            cost += float(np.einsum("ni,nij,nj->", r[mask], P[mask], r[mask]))
            rows = np.concatenate([np.arange(q), q + 6 * k + np.arange(6)])
            Au, Bu, Pu, ru = A[mask][..., columns], B[mask], P[mask], r[mask]
            PA = Pu @ Au
            N[np.ix_(rows, rows)] += np.einsum("nik,nil->kl", Au, PA)
            b[rows] += np.einsum("nik,ni->k", PA, ru)
            seen = obs.targets[mask]
            C[rows[:, None], seen] += np.einsum("nik,nij->knj", PA, Bu)
            M[seen] += np.einsum("nik,nij,njl->nkl", Bu, Pu, Bu)
            d[seen] += np.einsum("nik,nij,nj->nk", Bu, Pu, ru)
        C[:, ~uncertain] = 0.0
        d[~uncertain] = 0.0
        Q: Array = np.linalg.inv(M).astype(np.float64, copy=False)
        Q[~uncertain] = 0.0
        CQ = np.einsum("utk,tkl->utl", C, Q).reshape(u, -1)
        N -= CQ @ C.reshape(u, -1).T
        b -= CQ @ d.ravel()
        return _System(N, b, Q, C, d, cost, tuple(residuals), tuple(rays))

    def tests(self, system: _System, used: Sequence[Mask]) -> list[Array]:
        """Chi-square (2) of every image point of each photograph against all the others."""
        q, Qx = len(self.free), _inverse(system.N)
        tests = []
        for k, (obs, mask) in enumerate(zip(self.photographs, used, strict=True)):
            A, B, P = system.rays[k]
            Q = system.Q[obs.targets]
            # by the camera, its target following: A − B Q Cᵀ
            D = -np.einsum("nij,njk,unk->niu", B, Q, system.C[:, obs.targets])
            D[..., np.concatenate([np.arange(q), q + 6 * k + np.arange(6)])] += A
            share = (D @ Qx) @ np.swapaxes(D, 1, 2) + B @ Q @ np.swapaxes(B, 1, 2)
            tests.append(ray_tests(system.residuals[k], share, P, mask))
        return tests

    def _priors(self, state: _State) -> tuple[Array, Array, Mask, float]:
        """Normal equations (T, 3, 3), (T, 3) of the targets' sigmas, which targets are uncertain,
        and what their corrections cost.
        """
        sigmas = self.testfield.sigmas
        uncertain: Mask = np.asarray((sigmas > 0).any(axis=1))
        weight = np.where(uncertain[:, None], 1.0 / np.maximum(sigmas, _LEAST_SIGMA_MM) ** 2, 1.0)
        M = weight[:, :, None] * np.eye(3)
        d = -weight * state.shifts
        return M, d, uncertain, float((weight * state.shifts**2).sum())

    def moved(self, state: _State, system: _System, step: Array, fraction: float) -> _State:
        """The state after a fraction of a step (u,)."""
        q = len(self.free)
        iop = state.iop.copy()
        iop[self.free] += fraction * step[:q]
        right = system.d - np.einsum("utk,u->tk", system.C, step)
        shifts = np.einsum("tkl,tl->tk", system.Q, right)
        return _State(
            iop,
            state.eops + fraction * step[q:].reshape(-1, 6),
            state.shifts + fraction * shifts,
        )

    def solve(self, state: _State, used: Sequence[Mask]) -> tuple[_State, _System]:
        """Gauss-Newton with shorter steps where a whole one does not improve."""
        system = self.system(state, used)
        for _ in range(_ITERATIONS):
            step = _inverse(system.N) @ system.b
            gain = float(system.b @ step) + float(
                np.einsum("tk,tkl,tl->", system.d, system.Q, system.d)
            )
            for fraction in (1.0, 0.5, 0.25, 0.1, 0.03, 0.01):
                trial = self.moved(state, system, step, fraction)
                try:
                    new = self.system(trial, used)
                except GeometryError:
                    continue
                if new.cost <= system.cost * (1 + 1e-9):
                    break
            else:
                if gain < _CONVERGED * max(system.cost, 1.0):
                    return state, system
                raise GeometryError("the adjustment does not converge from its start values")
            saved = system.cost - new.cost
            state, system = trial, new
            if fraction == 1.0 and (gain < _CONVERGED**2 or saved < 1e-8 * system.cost):
                return state, system
        raise GeometryError(f"the adjustment did not converge in {_ITERATIONS} iterations")


def _inverse_covariances(obs: Observations) -> Array:
    """Inverse covariance (n, 2, 2) px⁻² of the image points."""
    cov = point_covariances(obs, None, None)
    det = cov[:, 0] * cov[:, 1] - cov[:, 2] ** 2
    P = np.empty((len(obs), 2, 2))
    P[:, 0, 0], P[:, 1, 1] = cov[:, 1] / det, cov[:, 0] / det
    P[:, 0, 1] = P[:, 1, 0] = -cov[:, 2] / det
    return P


def _inverse(N: Array) -> Array:
    """Inverse of the normal matrix; raises GeometryError where the photographs do not carry it."""
    scale = diagonal_scale(N)
    try:
        np.linalg.cholesky(N * np.outer(scale, scale))
        return scaled_inverse(N)
    except np.linalg.LinAlgError:
        raise GeometryError(
            "the normal matrix is singular: these photographs do not separate the parameters; "
            "take some from other directions or hold parameters fixed"
        ) from None


_UNTESTABLE = 1e-6  # of its variance: a ray whose residual the unknowns take up
_LARGEST_OBLIQUENESS_NEEDED_DEG = 20.0


def ray_tests(r: Array, share: Array, P: Array, mask: Mask) -> Array:
    """Chi-square (2) of residuals (n, 2) of weights P (n, 2, 2), of which the unknowns explain a
    covariance `share` (n, 2, 2).
    """
    V = np.linalg.inv(P) + np.where(mask, -1.0, 1.0)[:, None, None] * share
    determinant = np.linalg.det(V) * np.linalg.det(P)
    testable = determinant > _UNTESTABLE
    V[~testable] = np.eye(2)
    test = np.einsum("ni,nij,nj->n", r, np.linalg.inv(V), r)
    return np.where(testable, test, 0.0)


def snoop_rays(
    tests: Sequence[Array], photographs: Sequence[Observations], used: Sequence[Mask], alpha: float
) -> list[Mask]:
    """Which image points stay; of the rays of one target only the worst goes at a time."""
    if alpha <= 0:
        return list(used)
    offered = np.concatenate([test[m] for test, m in zip(tests, used, strict=True)])
    limit = chi2_2d(alpha) * max(float(np.median(offered)) / (2 * np.log(2)), 1e-12)
    size = 1 + max(int(o.targets.max(initial=0)) for o in photographs)
    worst = np.zeros(size)
    for test, o, m in zip(tests, photographs, used, strict=True):
        np.maximum.at(worst, o.targets[m], test[m])
    return [
        (test <= limit) | (m & (test < worst[o.targets]))
        for test, o, m in zip(tests, photographs, used, strict=True)
    ]


def weaknesses_together(
    sensor: Sensor,
    testfield: TestField,
    photographs: Sequence[Observations],
    used: Sequence[Mask],
    values: Array,
    eops: Array,
    covariance: Array,
    s: AdjustmentSettings,
) -> list[str]:
    """Why the photographs do not carry the free parameters."""
    reasons: list[str] = []
    if not s.free:
        return reasons
    seen = np.unique(np.concatenate([o.targets[m] for o, m in zip(photographs, used, strict=True)]))
    _, axes, flat = plane_fit(testfield.points[seen])
    if flat and "c" in s.free:
        angles = [obliqueness_deg(eop, axes[2]) for eop in eops]
        if max(angles) < _LARGEST_OBLIQUENESS_NEEDED_DEG:
            reasons.append(
                f"one plane, in all {len(eops)} photographs within {max(angles):.0f}° of frontal "
                f"(some at {_LARGEST_OBLIQUENESS_NEEDED_DEG:.0f}° and more are needed): principal "
                "distance and distance to the field cannot be separated, however small the "
                "residuals are"
            )
    points = np.concatenate([o.points[m] for o, m in zip(photographs, used, strict=True)])
    coverage = image_coverage(sensor, points)
    if coverage < s.bounds.coverage:
        reasons.append(
            f"the targets cover {coverage:.1%} of the image in all photographs together (at least "
            f"{s.bounds.coverage:.0%} are needed)"
        )
    return reasons + uncertain(sensor, values, np.sqrt(np.diag(covariance)), s.free, s.bounds)
