"""Gauss-Markov least squares on the image points of one epoch: iteration, cofactors, tests.

The working half of `adjustment`: arrays only, no judgement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES, partials, project
from thermocald.photogrammetry.parameters import EOP, IOP

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import ArrayLike, NDArray

    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.field.testfield import Observations, TestField

    Array = NDArray[np.float64]
    Mask = NDArray[np.bool_]

__all__ = [
    "TRUSTED_REDUNDANCY",
    "NoConvergenceError",
    "Problem",
    "Rejections",
    "Solution",
    "chi2_2d",
    "cofactor_root",
    "fails_global_test",
    "most_rejected",
    "point_covariances",
    "point_tests",
    "resolve",
    "snoop",
    "solve",
]

_ITERATIONS = 30
_SMALL = 0.3  # standard deviations: a last step that leaves less than 1e-3 px in c, x0, y0
_LINEAR = 10.0  # standard deviations that a solution may move without new partials
TRUSTED_REDUNDANCY = 20
"""From here on the residuals themselves tell the noise."""

_MOST_OF_FEW = 0.15  # one of 7 to 13 targets, two of 14 and more
_GLOBAL_TEST_NORMAL = 3.09  # quantile of the normal distribution: error probability 0.1 %


class NoConvergenceError(Exception):
    """The iteration did not come to an end."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Observations and unknowns of one adjustment.

    points (n, 3) mm; observations in the same order; target_variances (n, 3) mm² or None;
    unknowns (u,): positions in `PARAMETER_NAMES`; prior_weight, prior_value (u,): parameters
    observed beforehand, weight 0 where there is none.
    """

    sensor: Sensor
    points: Array
    observations: Observations
    target_variances: Array | None
    unknowns: NDArray[np.int64]
    prior_weight: Array
    prior_value: Array

    @classmethod
    def build(
        cls,
        sensor: Sensor,
        field: TestField,
        observations: Observations,
        unknowns: NDArray[np.int64],
        priors: Mapping[str, tuple[float, float]],
        target_sigmas: bool,
    ) -> Problem:
        """Collect what the iteration needs."""
        weight, value = np.zeros(len(unknowns)), np.zeros(len(unknowns))
        for row, parameter in enumerate(unknowns) if priors else ():
            if PARAMETER_NAMES[parameter] in priors:
                value[row], sd = priors[PARAMETER_NAMES[parameter]]
                weight[row] = sd**-2
        variances = None
        if target_sigmas and field.sigmas.any():
            variances = field.sigmas[observations.targets] ** 2
        return cls(
            sensor,
            field.points[observations.targets],
            observations,
            variances,
            unknowns,
            weight,
            value,
        )

    def sums(self, whitened: Array, use: Mask, values: Array) -> tuple[Array, Array, float]:
        """Normal matrix (u, u), gradient (u,) and sum of squares of the points that take part.

        whitened (u + 1, 2, n): the partials and the residuals.
        """
        part = whitened if use.all() else whitened[..., use]
        flat = part.reshape(len(part), -1)
        products = flat @ flat.T
        N, gradient = products[:-1, :-1], products[:-1, -1]
        if self.prior_weight.any():
            N.flat[:: len(N) + 1] += self.prior_weight
            gradient += self.prior_weight * (self.prior_value - values[self.unknowns])
        return N, gradient, float(products[-1, -1])

    def cost(self, v: Array, values: Array) -> float:
        """Weighted sum of squared residuals, the priors' included."""
        flat = v.ravel()
        square = float(flat @ flat)
        if self.prior_weight.any():
            square += float(self.prior_weight @ (values[self.unknowns] - self.prior_value) ** 2)
        return square


@dataclass(frozen=True, eq=False)
class Solution:
    """values (16,); whitened (u + 1, 2, n): partials and, last, residuals of all points, those that
    take no part too; covariance (n, 3) px² of the points; root (u, u): cofactors = root · rootᵀ.
    """

    values: Array
    whitened: Array
    covariance: Array
    root: Array

    @property
    def residuals(self) -> Array:
        """Residuals (2, n) px."""
        return _coloured(self.covariance, self.whitened[-1])


def chi2_2d(alpha: float) -> float:
    """Quantile 1 - alpha of chi-square with two degrees of freedom, which has a closed form."""
    return float(-2.0 * np.log(alpha)) if alpha > 0 else float("inf")


def fails_global_test(unit: ArrayLike, redundancy: ArrayLike) -> NDArray[np.bool_]:
    """Whether residuals are too large for their sigmas, where they are too few to tell the noise.

    unit: variance of unit weight; redundancy: its degrees of freedom. Chi-square at 0.1 %, by
    Wilson and Hilferty's approximation (1931).
    """
    r = np.maximum(np.asarray(redundancy, dtype=float), 1.0)
    ninth = 2.0 / (9.0 * r)
    bound = (1.0 - ninth + _GLOBAL_TEST_NORMAL * np.sqrt(ninth)) ** 3
    return np.asarray((np.asarray(redundancy) < TRUSTED_REDUNDANCY) & (np.asarray(unit) > bound))


def most_rejected(fraction: float, redundancy: int) -> float:
    """Fraction of the targets that may be rejected.

    Where residuals are few a second gross error is hardly told from the good ones that it bends.
    """
    return min(fraction, _MOST_OF_FEW) if redundancy < TRUSTED_REDUNDANCY else fraction


def point_covariances(
    observations: Observations, B: Array | None, target_variances: Array | None
) -> Array:
    """Covariance (n, 3) px² of each image point, xx, yy, xy, its object coordinates' included."""
    out = np.zeros((3, len(observations)))
    np.square(observations.sigmas.T, out=out[:2])
    if observations.covariances is not None:
        out[2] = observations.covariances
    if B is not None and target_variances is not None:
        out[0] += (B[:, 0] ** 2 * target_variances).sum(axis=1)
        out[1] += (B[:, 1] ** 2 * target_variances).sum(axis=1)
        out[2] += (B[:, 0] * B[:, 1] * target_variances).sum(axis=1)
    return out.T


def _whiten(covariance: Array, pairs: Array) -> Array:
    """Multiply pairs (..., 2, n) by the inverse Cholesky factor of each point's covariance."""
    xx, yy, xy = covariance.T
    if not xy.any():
        whitened: Array = pairs * (1.0 / np.sqrt(covariance.T[:2]))
        return whitened
    slope = xy / xx
    out = np.empty_like(pairs)
    np.divide(pairs[..., 0, :], np.sqrt(xx), out=out[..., 0, :])
    np.subtract(pairs[..., 1, :], slope * pairs[..., 0, :], out=out[..., 1, :])
    out[..., 1, :] /= np.sqrt(yy - xy * slope)
    return out


def _coloured(covariance: Array, pair: Array) -> Array:
    """The inverse of `_whiten` for one pair (2, n)."""
    xx, yy, xy = covariance.T
    if not xy.any():
        coloured: Array = pair * np.sqrt(covariance.T[:2])
        return coloured
    slope = xy / xx
    x = pair[0] * np.sqrt(xx)
    return np.stack([x, pair[1] * np.sqrt(yy - xy * slope) + slope * x])


def cofactor_root(N: Array, unknowns: NDArray[np.int64], damping: float = 0.0) -> Array:
    """A root (u, u) of the inverse of a normal matrix: N⁻¹ = root · rootᵀ.

    By Cholesky of N scaled to a unit diagonal, as the parameters differ by ten orders. Raises
    GeometryError naming the parameters that the observations cannot tell apart.
    """
    diagonal = N.diagonal()
    if not (diagonal > 0).all():
        names = [PARAMETER_NAMES[unknowns[i]] for i in np.flatnonzero(~(diagonal > 0))]
        raise GeometryError(f"the observations do not see {', '.join(names)} at all")
    scale = 1.0 / np.sqrt(diagonal)
    scaled = N * scale * scale[:, None]
    if damping:
        scaled.flat[:: len(scale) + 1] += damping
    # NumPy's factorisation, as importing SciPy's would cost the daemon 20 MB.
    try:
        factor = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        factor = None
    if factor is None or factor.diagonal().min() < 1e-8:
        eigenvalues, vectors = np.linalg.eigh(scaled)
        worst = np.argsort(-np.abs(vectors[:, 0]))[:3]
        together = ", ".join(PARAMETER_NAMES[unknowns[i]] for i in worst)
        raise GeometryError(
            f"the normal matrix is singular (smallest eigenvalue {eigenvalues[0]:.1e}): these "
            f"targets cannot tell {together} apart"
        )
    root: Array = scale[:, None] * np.linalg.inv(factor).T
    return root


def solve(problem: Problem, start: Array, use: Mask) -> Solution:
    """Gauss-Newton, with shorter or damped steps only where a whole one does not improve.

    start (16,); use (n,) the observations that take part. A warm epoch needs two sets of partials:
    its last step, by fresh ones, is too small to be looked at. Raises NoConvergenceError,
    GeometryError.
    """
    u, sensor = problem.unknowns, problem.sensor
    values, last = start, float("inf")
    observed = problem.observations.points.T
    pairs = np.empty((len(u) + 1, *observed.shape))  # the partials and the residuals, px
    for _ in range(_ITERATIONS):
        predicted, A, B = partials(sensor, values[IOP], values[EOP], problem.points)
        covariance = point_covariances(problem.observations, B, problem.target_variances)
        pairs[:-1] = A.transpose(2, 1, 0)[u]
        np.subtract(observed, predicted.T, out=pairs[-1])
        whitened = _whiten(covariance, pairs)
        N, gradient, squares = problem.sums(whitened, use, values)
        if not np.isfinite(squares):
            raise NoConvergenceError("targets came to lie behind the camera during the iteration")
        whole, size = _whole_step(N, gradient, u)
        if size < _SMALL:
            solution = Solution(values, whitened, covariance, cofactor_root(N, u))
            return _moved(solution, u, whole)
        near, last = size < _LINEAR and size < 0.5 * last, size
        if near:
            values = values.copy()
            values[u] += whole
            continue
        cost = problem.cost(whitened[-1][:, use], values)
        for step in _trial_steps(N, u, gradient):
            trial = values.copy()
            trial[u] += step
            residuals = observed - project(sensor, trial[IOP], trial[EOP], problem.points).T
            new = problem.cost(_whiten(covariance, residuals)[:, use], trial)
            if np.isfinite(new) and new <= cost * (1 + 1e-9) + 1e-12:
                break
        else:
            raise NoConvergenceError("the adjustment does not converge from its start values")
        values = trial
    raise NoConvergenceError(f"the adjustment did not converge in {_ITERATIONS} iterations")


def _whole_step(N: Array, gradient: Array, u: NDArray[np.int64]) -> tuple[Array, float]:
    """The step (u,) of a normal matrix, and its size in standard deviations.

    Without the inverse, which only the last iteration needs. Raises GeometryError.
    """
    diagonal = N.diagonal()
    if (diagonal > 0).all():
        scale = 1.0 / np.sqrt(diagonal)
        try:
            step = scale * np.linalg.solve(N * scale * scale[:, None], scale * gradient)
        except np.linalg.LinAlgError:
            step = np.full(len(u), np.nan)
        square = float(gradient @ step)
        if 0.0 <= square < _LINEAR**2:
            return step, square**0.5
    root = cofactor_root(N, u)
    half = root.T @ gradient
    return root @ half, float(np.sqrt(half @ half))


def _trial_steps(N: Array, u: NDArray[np.int64], gradient: Array) -> Iterator[Array]:
    """Steps to try in turn.

    First along its direction, which follows the narrow valleys of correlated parameters, then
    damped (Levenberg-Marquardt).
    """
    root = cofactor_root(N, u)
    whole = root @ (root.T @ gradient)
    yield whole
    for shortened in (0.5, 0.25, 0.1, 0.03):
        yield shortened * whole
    for damping in (1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e4, 1e6):
        damped = cofactor_root(N, u, damping)
        yield damped @ (damped.T @ gradient)


def resolve(problem: Problem, solution: Solution, use: Mask) -> Solution:
    """The solution with other observations: by the same partials where it hardly moves."""
    N, gradient, _ = problem.sums(solution.whitened, use, solution.values)
    root = cofactor_root(N, problem.unknowns)
    half = root.T @ gradient
    if float(half @ half) > _LINEAR**2:
        return solve(problem, solution.values, use)
    return _moved(replace(solution, root=root), problem.unknowns, root @ half)


def _moved(s: Solution, unknowns: NDArray[np.int64], step: Array) -> Solution:
    """A solution after a small step, its residuals by the partials."""
    values, whitened = s.values.copy(), s.whitened.copy()
    values[unknowns] += step
    whitened[-1] -= (step @ s.whitened[:-1].reshape(len(step), -1)).reshape(whitened[-1].shape)
    return Solution(values, whitened, s.covariance, s.root)


def point_tests(solution: Solution, use: Mask) -> tuple[Array, Array]:
    """Chi-square with 2 degrees of freedom per point (n,), and redundancy numbers (n, 2).

    A point that takes part has the residual covariance I - h'h, one that does not I + h'h.
    """
    u, n = len(solution.root), len(use)
    h = solution.root.T @ solution.whitened[:-1].reshape(u, -1)
    claimed = np.einsum("uk,uk->k", h, h).reshape(2, n)
    sign = np.where(use, -1.0, 1.0)
    qxx, qyy = 1 + sign * claimed
    qxy = sign * np.einsum("un,un->n", h[:, :n], h[:, n:])
    vx, vy = solution.whitened[-1]
    determinant = qxx * qyy - qxy**2
    # A point that alone carries a parameter has no residual: it cannot be tested.
    determinant[determinant <= 1e-9] = np.inf
    test = (qyy * vx**2 - 2 * qxy * vx * vy + qxx * vy**2) / determinant
    return test, np.maximum(1 - claimed.T, 0.0)


class Rejections:
    """What data snooping has done so far: a point rejected for the second time stays out.

    A borderline point would otherwise come and go for ever.
    """

    def __init__(self, used: Mask) -> None:
        self._back = np.zeros(used.shape, dtype=bool)
        self._barred = np.zeros(used.shape, dtype=bool)

    def settle(self, use: Mask, keep: Mask, part: slice | NDArray[np.int64] = slice(None)) -> Mask:
        """Which of those that a round would keep do stay, `use` itself where nothing changes.

        part: the rows that the round looked at.
        """
        if keep is use or np.array_equal(keep, use):
            return use
        keep = keep & ~self._barred[part]
        self._barred[part] |= self._back[part] & use & ~keep
        self._back[part] |= keep & ~use
        return use if np.array_equal(keep, use) else keep


def snoop(test: Array, use: Mask, unknowns: int, alpha: float) -> Mask:
    """Which observations stay: the worst are rejected, those that fit again come back.

    test (n,) of `point_tests`; alpha: error probability of one test.
    """
    if alpha <= 0:
        return use
    n = int(use.sum())
    used = test if n == len(use) else test[use]
    # Median of chi-square(2) is 2 ln 2: a scale that the gross errors do not reach.
    variance = float(np.partition(used, n // 2)[n // 2]) / (2 * np.log(2))
    few = 2 * n - unknowns < TRUSTED_REDUNDANCY
    if few:
        variance = 1.0  # one gross error reaches every residual: the stated sigmas are the scale
    limit = chi2_2d(alpha) * max(variance, 1e-12)
    fits = test <= limit
    if np.array_equal(fits, use):
        return use
    keep: Mask = use | fits
    suspicious = use & ~fits
    if suspicious.any():
        # One gross error lifts its neighbours: only those near the worst go at once.
        near = 1.0 if few else 0.5
        keep[suspicious & (test >= near * used.max())] = False
    return keep
