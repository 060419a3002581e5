"""Gauss-Markov least squares on the image points of one epoch: iteration, cofactors, snooping.

The numerical half of `adjustment`, on arrays. Adding the object coordinates' covariance to the
image point's eliminates these coordinates; multiplication by the inverse Cholesky factors then
gives all observations unit weight. An epoch has so few points that calls cost more than arithmetic:
constants are computed once, and in place where that is safe.

Data snooping is Baarda's test on the two coordinates of a point together, with noise estimated from
the residuals.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, log, sqrt
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import (
    EOP,
    IOP,
    PARAMETER_NAMES,
    Sensor,
    partials,
    project,
)
from thermocald.photogrammetry.linalg import MEDIAN_CHI2, chi2_quantile

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import ArrayLike, NDArray

    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.field.testfield import Observations, TestField


def point_covariances(
    observations: Observations, B: Array | None, target_variances: Array | None
) -> Array:
    """Return each image point's covariance (n, 3) px²: xx, yy, xy, with its object coordinates'.

    B (n, 2, 3) px/mm: partials with respect to the object point; target_variances (n, 3) mm².
    """
    out = np.zeros((3, len(observations)))
    np.square(observations.sigmas.T, out=out[:2])
    if observations.covariances is not None:
        out[2] = observations.covariances
    if B is not None and target_variances is not None:
        out[0] += (B[:, 0] ** 2 * target_variances).sum(axis=1)
        out[1] += (B[:, 1] ** 2 * target_variances).sum(axis=1)
        out[2] += (B[:, 0] * B[:, 1] * target_variances).sum(axis=1)
    return out.T


@dataclass(frozen=True, eq=False)
class Whitening:
    """Multiplication by the inverse Cholesky factors of the points' covariances.

    factor (2, n) px⁻¹: one over the diagonal of the Cholesky factors; slope (n,): regression of y
    on x, None if x and y are uncorrelated in all points.
    """

    factor: Array
    slope: Array | None

    @classmethod
    def build(cls, covariance: Array) -> Whitening:
        """Build the whitening of points with covariances (n, 3) px²: xx, yy, xy."""
        xy = covariance[:, 2]
        variances, slope = covariance.T[:2], None
        if xy.any():
            slope = xy / covariance[:, 0]
            variances = variances.copy()
            variances[1] -= slope * xy
        return cls(1.0 / np.sqrt(variances), slope)

    def whiten(self, pairs: Array) -> Array:
        """Whiten x and y (..., 2, n) in place."""
        if self.slope is not None:
            pairs[..., 1, :] -= self.slope * pairs[..., 0, :]
        pairs *= self.factor
        return pairs


_ITERATIONS = 30
_SMALL = 0.3  # standard deviations; after a last step below it, c, x0, y0 are good to 1e-3 px
_LINEAR = 10.0  # standard deviations that a solution may move without new partials
_SINGULAR = 1e-8  # of a correlation matrix's eigenvalues


class NoConvergenceError(Exception):
    """The iteration did not converge."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Observations and unknowns of one adjustment.

    points (n, 3) mm; observations in the same order; target_variances (n, 3) mm² or None;
    unknowns (u,): positions in `PARAMETER_NAMES`; prior_weight (u, u), prior_value (u,): parameters
    observed beforehand, with weight 0 for the others; no weight if none was.
    """

    sensor: Sensor
    points: Array
    observations: Observations
    target_variances: Array | None
    unknowns: Index
    prior_weight: Array
    prior_value: Array

    @classmethod
    def build(
        cls,
        sensor: Sensor,
        field: TestField,
        observations: Observations,
        unknowns: Index,
        values: Array,
        covariance: Array,
    ) -> Problem:
        """Collect the inputs of the iteration.

        values (16,), covariance (16, 16): of parameters observed beforehand, 0 for the others.
        """
        weight, variances = np.empty(0), covariance.diagonal()[unknowns]
        some = np.flatnonzero(variances > 0)
        if len(some):
            weight = np.zeros((len(unknowns),) * 2)
            # a combination with almost no variance gets an sd of 1e-4 of its parameters' sds
            scale, among = np.sqrt(variances[some]), unknowns[some]
            scaled = covariance[np.ix_(among, among)] / np.outer(scale, scale)
            share, vectors = np.linalg.eigh(scaled)
            rows = (vectors / np.sqrt(np.maximum(share, _SINGULAR))) / scale[:, None]
            weight[np.ix_(some, some)] = rows @ rows.T
        targets = observations.targets
        of_targets = field.shape_sigmas[targets] ** 2 if field.sigmas.any() else None
        places, value = field.points[targets], values[unknowns]
        return cls(sensor, places, observations, of_targets, unknowns, weight, value)

    def sums(self, whitened: Array, use: Mask, values: Array) -> tuple[Array, Array, float]:
        """Return the normal matrix (u, u), gradient (u,) and sum of squares of the points in use.

        whitened (u + 1, 2, n): partials and, last, residuals.
        """
        part = whitened if np.count_nonzero(use) == len(use) else whitened.compress(use, axis=-1)
        flat = part.reshape(len(part), -1)
        residuals = flat[-1]
        # flat @ flat.T would be NumPy's symmetric product, three times as slow at this size.
        products = flat[:-1] @ flat.T
        N, gradient = products[:, :-1], products[:, -1]
        if len(self.prior_weight):
            N += self.prior_weight
            gradient += self.prior_weight @ (self.prior_value - values[self.unknowns])
        return N, gradient, float(residuals @ residuals)

    def cost(self, v: Array, values: Array) -> float:
        """Return the weighted sum of squared residuals, the priors' included.

        v: whitened residuals of the points in use; values (16,).
        """
        flat = v.ravel()
        if not len(self.prior_weight):
            return float(flat @ flat)
        difference = values[self.unknowns] - self.prior_value
        return float(flat @ flat + difference @ self.prior_weight @ difference)


@dataclass(frozen=True, eq=False)
class Solution:
    """A solution of a `Problem`.

    values (16,); whitened (u + 1, 2, n): partials and, last, residuals of all points, also of
    those not in use; root (u, u): cofactors = root · rootᵀ.
    """

    values: Array
    whitened: Array
    whitening: Whitening
    root: Array

    @property
    def residuals(self) -> Array:
        """Residuals (2, n) px."""
        coloured: Array = self.whitened[-1] / self.whitening.factor
        if self.whitening.slope is not None:
            coloured[1] += self.whitening.slope * coloured[0]
        return coloured


def cofactor_root(N: Array, unknowns: Index, damping: float = 0.0) -> Array:
    """Return a root (u, u) of the inverse of a normal matrix: N⁻¹ = root · rootᵀ.

    N is scaled to a unit diagonal before its Cholesky factorisation, as the parameters differ by
    ten orders of magnitude. damping: added to the unit diagonal. Raises GeometryError naming the
    parameters that the observations cannot separate.
    """
    diagonal = N.diagonal()
    if not np.minimum.reduce(diagonal, initial=np.inf) > 0:
        names = [PARAMETER_NAMES[unknowns[i]] for i in np.flatnonzero(~(diagonal > 0))]
        raise GeometryError(f"the observations do not depend on {', '.join(names)} at all")
    scale = 1.0 / np.sqrt(diagonal)
    scaled = N * scale * scale[:, None]
    if damping:
        scaled.flat[:: len(scale) + 1] += damping
    # NumPy's factorisation, as importing SciPy would cost the daemon 20 MB.
    try:
        factor = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        factor = None
    if factor is None or np.minimum.reduce(factor.diagonal()) < 1e-8:
        eigenvalues, vectors = np.linalg.eigh(scaled)
        worst = np.argsort(-np.abs(vectors[:, 0]))[:3]
        together = ", ".join(PARAMETER_NAMES[unknowns[i]] for i in worst)
        raise GeometryError(
            f"the normal matrix is singular (smallest eigenvalue {eigenvalues[0]:.1e}): these "
            f"targets cannot separate {together}"
        )
    return scale[:, None] * np.linalg.inv(factor).T


def solve(problem: Problem, start: Array, use: Mask) -> Solution:
    """Solve by Gauss-Newton, with shorter or damped steps only where a whole one fails.

    start (16,); use (n,): mask of the observations in use. From good start values two sets of
    partials suffice: the last step, by fresh ones, is too small for a test. Raises
    NoConvergenceError, GeometryError.
    """
    u, sensor = problem.unknowns, problem.sensor
    observed = problem.observations.points.T
    whitened = np.empty((len(u) + 1, *observed.shape))
    values, last = start, float("inf")
    whitening: Whitening | None = None
    for _ in range(_ITERATIONS):
        predicted, A, B = partials(sensor, values[IOP], values[EOP], problem.points)
        if whitening is None or problem.target_variances is not None:
            whitening = Whitening.build(
                point_covariances(problem.observations, B, problem.target_variances)
            )
        whitened[:-1] = A.transpose(2, 1, 0)[u]
        np.subtract(observed, predicted.T, out=whitened[-1])
        whitening.whiten(whitened)
        N, gradient, squares = problem.sums(whitened, use, values)
        if not isfinite(squares):
            raise NoConvergenceError("targets came to lie behind the camera during the iteration")
        root = cofactor_root(N, u)
        whole, size = _whole_step(gradient, root)
        if size < _SMALL:
            return _apply_step(Solution(values, whitened, whitening, root), u, whole)
        near, last = size < _LINEAR and size < 0.5 * last, size
        if near:
            values = values.copy()
            values[u] += whole
            continue
        cost = problem.cost(whitened[-1][:, use], values)
        for step in _trial_steps(N, u, gradient, whole):
            trial = values.copy()
            trial[u] += step
            residuals = observed - project(sensor, trial[IOP], trial[EOP], problem.points).T
            new = problem.cost(whitening.whiten(residuals)[:, use], trial)
            if np.isfinite(new) and new <= cost * (1 + 1e-9) + 1e-12:
                break
        else:
            raise NoConvergenceError("the adjustment does not converge from its start values")
        values = trial
    raise NoConvergenceError(f"the adjustment did not converge in {_ITERATIONS} iterations")


def _whole_step(gradient: Array, root: Array) -> tuple[Array, float]:
    """Return the Gauss-Newton step (u,) and its size in standard deviations."""
    half = gradient @ root
    return root @ half, sqrt(half @ half)


def _trial_steps(N: Array, u: Index, gradient: Array, whole: Array) -> Iterator[Array]:
    """Yield steps to try in turn.

    First shortened Gauss-Newton steps, which follow the narrow valleys of correlated parameters,
    then damped ones (Levenberg-Marquardt).
    """
    for shortened in (1.0, 0.5, 0.25, 0.1, 0.03):
        yield shortened * whole
    for damping in (1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e4, 1e6):
        yield _whole_step(gradient, cofactor_root(N, u, damping))[0]


def resolve(problem: Problem, solution: Solution, use: Mask) -> Solution:
    """Solve with other observations in use, by the same partials if the solution hardly moves."""
    N, gradient, _ = problem.sums(solution.whitened, use, solution.values)
    root = cofactor_root(N, problem.unknowns)
    step, size = _whole_step(gradient, root)
    if size > _LINEAR:
        return solve(problem, solution.values, use)
    renewed = Solution(solution.values, solution.whitened.copy(), solution.whitening, root)
    return _apply_step(renewed, problem.unknowns, step)


def _apply_step(s: Solution, unknowns: Index, step: Array) -> Solution:
    """Apply a small step to a solution; its residuals are changed in place, by the partials."""
    values = s.values.copy()
    values[unknowns] += step
    residuals = s.whitened[-1]
    residuals -= (step @ s.whitened[:-1].reshape(len(step), -1)).reshape(residuals.shape)
    return Solution(values, s.whitened, s.whitening, s.root)


TRUSTED_REDUNDANCY = 20
"""Redundancy from which the noise is estimated from the residuals."""

_MOST_OF_FEW = 0.15  # one of 7 to 13 targets, two of 14 or more
_GLOBAL_TEST = 0.999  # probability of passing
_AFTER_REJECTION = 0.9


def limit_2d(alpha: float, uncertainty: Array) -> Array:
    """Return the limit of a point's test at error probability alpha, for an estimated noise.

    uncertainty: one over the degrees of freedom of the noise, 0 for a given one; the median of n
    points' tests has about n. The limit is the quantile of 2 F(2, m), which has a closed form.
    """
    if alpha <= 0:
        return np.full(np.shape(uncertainty), np.inf)
    known = np.maximum(uncertainty, 1e-9)
    return np.asarray(np.expm1(-2.0 * known * log(alpha)) / known)


def fails_global_test(
    unit: ArrayLike, redundancy: ArrayLike, after_rejection: bool = False
) -> Mask:
    """Return whether residuals, too few to estimate the noise, are too large for their sigmas.

    unit: variance of unit weight; redundancy: its degrees of freedom. χ² at 0.1 %. After a
    rejection, which relies on the stated noise alone, at 10 %: noise three times as large would
    look the same, and lose its worst target too.
    """
    r = np.maximum(np.asarray(redundancy, dtype=float), 1.0)
    bound = chi2_quantile(_AFTER_REJECTION if after_rejection else _GLOBAL_TEST, r) / r
    return np.asarray((np.asarray(redundancy) < TRUSTED_REDUNDANCY) & (np.asarray(unit) > bound))


def most_rejected(fraction: float, redundancy: int) -> float:
    """Return the fraction of the targets that may be rejected.

    With few residuals a second gross error can hardly be separated from good points it distorts.
    """
    return min(fraction, _MOST_OF_FEW) if redundancy < TRUSTED_REDUNDANCY else fraction


def point_tests(solution: Solution, use: Mask) -> Array:
    """Return each point's test (n,): χ² with 2 degrees of freedom.

    The residual covariance of a point in use is I - h'h, that of any other I + h'h.
    """
    u, n = len(solution.root), len(use)
    h = solution.root.T @ solution.whitened[:-1].reshape(u, -1)
    claimed = np.add.reduce(h * h).reshape(2, n)
    q, qxy = 1 - claimed, np.add.reduce(h[:, :n] * h[:, n:])
    if np.count_nonzero(use) == n:
        np.negative(qxy, out=qxy)
    else:
        sign = np.where(use, -1.0, 1.0)
        q = 1 + sign * claimed
        qxy *= sign
    v = solution.whitened[-1]
    determinant = q[0] * q[1]
    determinant -= qxy * qxy
    # A point that alone determines a parameter has no residual: it cannot be tested.
    determinant[determinant <= 1e-9] = np.inf
    squares = v * v
    squares *= q[::-1]
    qxy *= v[0]
    qxy *= v[1]
    test: Array = squares[0] + squares[1]
    test -= qxy
    test -= qxy
    test /= determinant
    return test


def settle(history: NDArray[np.int8], use: Mask, keep: Mask) -> Mask:
    """Return the mask of a round's points to use; `use` itself if nothing changes.

    history: 0 at first, 1 once a point was taken back, 2 once it was rejected again: then it stays
    out, as a borderline point would otherwise alternate for ever. Changed in place.
    """
    if keep is use or not np.count_nonzero(keep != use):
        return use
    keep = keep & (history < 2)
    history[(history == 1) & use & ~keep] = 2
    history[keep & ~use] = 1
    return keep if np.count_nonzero(keep != use) else use


def snoop(test: Array, use: Mask, unknowns: int, alpha: float) -> Mask:
    """Return the mask of observations to keep: the worst are rejected, those that fit taken back.

    test (n,): of `point_tests`; alpha: error probability of one test. `series.system` has the
    same rule for many epochs; its arrays would cost a single epoch ten times as much.
    """
    if alpha <= 0:
        return use
    n = int(np.count_nonzero(use))
    used = test if n == len(use) else test[use]
    # The median is a scale that gross errors do not affect.
    ordered = used.copy()
    ordered.partition(n // 2)
    variance = float(ordered[n // 2]) / MEDIAN_CHI2
    few = 2 * n - unknowns < TRUSTED_REDUNDANCY
    if few:
        variance = 1.0  # one gross error affects all residuals: the stated sigmas are the scale
    limit = float(limit_2d(alpha, np.asarray(0.0 if few else 1.0 / n))) * max(variance, 1e-12)
    fits = test <= limit
    if not np.count_nonzero(fits != use):
        return use
    keep: Mask = use | fits
    suspicious = use & ~fits
    if suspicious.any():
        # One gross error increases its neighbours' residuals: reject only those near the worst.
        near = 1.0 if few else 0.5
        keep[suspicious & (test >= near * used.max())] = False
    return keep
