"""Data snooping of one epoch: what each image point contradicts, and which of them stay.

Baarda's tests on the two coordinates of a point together, with the noise that the residuals show.
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
"""From here on the residuals themselves give the noise."""

_MOST_OF_FEW = 0.15  # one of 7 to 13 targets, two of 14 and more
_GLOBAL_TEST_NORMAL = 3.09  # quantile of the normal distribution: error probability 0.1 %
_AFTER_REJECTION_NORMAL = 1.28  # 10 %


def limit_2d(alpha: float, uncertainty: Array) -> Array:
    """Limit of a point's test at error probability alpha where the noise was found, not known.

    uncertainty: one over the degrees of freedom with which it was found. The quantile of 2 F(2, m),
    which has a closed form too; a median of n points' tests is worth n degrees of freedom.
    """
    if alpha <= 0:
        return np.full(np.shape(uncertainty), np.inf)
    known = np.maximum(uncertainty, 1e-9)
    return np.asarray(np.expm1(-2.0 * known * log(alpha)) / known)


def fails_global_test(
    unit: ArrayLike, redundancy: ArrayLike, after_rejection: bool = False
) -> NDArray[np.bool_]:
    """Whether residuals are too large for their sigmas, where they are too few to tell the noise.

    unit: variance of unit weight; redundancy: its degrees of freedom. Chi-square at 0.1 %, by
    Wilson and Hilferty's approximation (1931); at 10 % where a target was rejected on the word of
    the stated noise alone: noise three times as large looks the same, and takes the worst with it.
    """
    quantile = _AFTER_REJECTION_NORMAL if after_rejection else _GLOBAL_TEST_NORMAL
    r = np.maximum(np.asarray(redundancy, dtype=float), 1.0)
    ninth = 2.0 / (9.0 * r)
    bound = (1.0 - ninth + quantile * np.sqrt(ninth)) ** 3
    return np.asarray((np.asarray(redundancy) < TRUSTED_REDUNDANCY) & (np.asarray(unit) > bound))


def most_rejected(fraction: float, redundancy: int) -> float:
    """Fraction of the targets that may be rejected.

    Where residuals are few a second gross error is hardly told from the good ones that it bends.
    """
    return min(fraction, _MOST_OF_FEW) if redundancy < TRUSTED_REDUNDANCY else fraction


def point_tests(solution: Solution, use: Mask) -> Array:
    """Return chi-square with 2 degrees of freedom per point (n,).

    A point that takes part has the residual covariance I - h'h, one that does not I + h'h.
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
    # A point that alone carries a parameter has no residual: it cannot be tested.
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
    """Which of those that a round would keep do stay, `use` itself where nothing changes.

    history: of each point 1 if it was taken back, 2 if it was rejected again and stays out, as a
    borderline point would otherwise come and go for ever; 0 at first. Changed in place.
    """
    if keep is use or not np.count_nonzero(keep != use):
        return use
    keep = keep & (history < 2)
    history[(history == 1) & use & ~keep] = 2
    history[keep & ~use] = 1
    return keep if np.count_nonzero(keep != use) else use


def snoop(test: Array, use: Mask, unknowns: int, alpha: float) -> Mask:
    """Which observations stay: the worst are rejected, those that fit again come back.

    test (n,) of `point_tests`; alpha: error probability of one test. `series.snooping` has the same
    rule for many epochs, whose arrays would cost a single one ten times as much.
    """
    if alpha <= 0:
        return use
    n = int(np.count_nonzero(use))
    used = test if n == len(use) else test[use]
    # The median is a scale that the gross errors do not reach.
    ordered = used.copy()
    ordered.partition(n // 2)
    variance = float(ordered[n // 2]) / MEDIAN_CHI2
    few = 2 * n - unknowns < TRUSTED_REDUNDANCY
    if few:
        variance = 1.0  # one gross error reaches every residual: the stated sigmas are the scale
    limit = float(limit_2d(alpha, np.asarray(0.0 if few else 1.0 / n))) * max(variance, 1e-12)
    fits = test <= limit
    if not np.count_nonzero(fits != use):
        return use
    keep: Mask = use | fits
    suspicious = use & ~fits
    if suspicious.any():
        # One gross error lifts its neighbours: only those near the worst go at once.
        near = 1.0 if few else 0.5
        keep[suspicious & (test >= near * used.max())] = False
    return keep
