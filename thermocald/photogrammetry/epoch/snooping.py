"""Data snooping of one epoch: tests of the image points, and which of them are rejected.

Baarda's tests on the two coordinates of a point together, with noise estimated from the residuals.
"""

from __future__ import annotations

from math import log
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import MEDIAN_CHI2

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from thermocald.arrays import Array, Mask
    from thermocald.photogrammetry.epoch.gauss_markov import Solution


TRUSTED_REDUNDANCY = 20
"""Redundancy from which the noise is estimated from the residuals."""

_MOST_OF_FEW = 0.15  # one of 7 to 13 targets, two of 14 or more
_GLOBAL_TEST_NORMAL = 3.09  # quantile of the normal distribution: error probability 0.1 %
_AFTER_REJECTION_NORMAL = 1.28  # 10 %


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

    unit: variance of unit weight; redundancy: its degrees of freedom. χ² at 0.1 %, by Wilson and
    Hilferty's approximation (1931). After a rejection, which relies on the stated noise alone, at
    10 %: noise three times as large would look the same, and lose its worst target too.
    """
    quantile = _AFTER_REJECTION_NORMAL if after_rejection else _GLOBAL_TEST_NORMAL
    r = np.maximum(np.asarray(redundancy, dtype=float), 1.0)
    ninth = 2.0 / (9.0 * r)
    bound = (1.0 - ninth + quantile * np.sqrt(ninth)) ** 3
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
