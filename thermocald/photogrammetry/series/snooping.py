"""Data snooping in a series: every point is tested against its own epoch.

The same as `epoch.snooping.point_tests` and `snoop`, for all epochs at once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.epoch.snooping import TRUSTED_REDUNDANCY, limit_2d
from thermocald.photogrammetry.linalg import MEDIAN_CHI2
from thermocald.photogrammetry.series.normals import chunks, products
from thermocald.photogrammetry.series.system import SeriesSystem, alike

if TYPE_CHECKING:
    from thermocald.arrays import Array, Index, Mask


def point_tests(system: SeriesSystem, residuals: Array) -> Array:
    """Return the test (E, T) of every image point against its epoch: χ² with 2 degrees of freedom.

    Points not in use are tested as check points. The common unknowns count as error-free, as they
    come from all epochs.
    """
    first, of = system.alike or alike(system.weights, system.use)
    E, T = residuals.shape[:2]
    pairs = products(system.design.at.A[..., system.design.own])
    shared = _test_weights(system, first, pairs) if len(first) < E else None
    test = np.empty((E, T))
    for part in chunks(E, T):
        if shared is None:
            xx, yy, xy = _test_weights(system, part, pairs)
        else:
            xx, yy, xy = shared if len(first) == 1 else shared[:, of[part]]
        x, y = residuals[part, :, 0], residuals[part, :, 1]
        out = np.multiply(xx, x, out=test[part])
        out += xy * y
        out *= x
        out += yy * y * y
    test[np.isnan(test)] = 0.0
    return test


def _test_weights(
    system: SeriesSystem, epochs: slice | Index, products: tuple[Array, Array, Array]
) -> Array:
    """Return the residuals' inverse covariance (3, M, T): xx, yy, twice xy; 0 without a test."""
    weights = system.weights[epochs]
    rows, columns = np.triu_indices(len(system.design.own))
    Q = system.Q[epochs][:, rows, columns] * np.where(rows == columns, 1.0, 2.0)
    sign = np.where(system.use[epochs], -1.0, 1.0)
    lxx, lyy, lxy = (sign * (Q @ pairs.T) for pairs in products)
    offered = weights[..., 0] > 0
    wx, wy, wxy = (np.where(offered, weights[..., k], k < 2) for k in range(3))
    determinant = wx * wy - wxy * wxy
    vxx, vyy = wy / determinant + lxx, wx / determinant + lyy
    vxy = 0.5 * lxy - wxy / determinant
    d = vxx * vyy - vxy * vxy
    d[~(offered & (d > 1e-9 / determinant))] = np.inf
    inverse = np.stack([vyy, vxx, -2 * vxy])
    inverse /= d
    return inverse


def _variances(tests: Array, used: Mask) -> Array:
    """Return variances of unit weight (E,) from each epoch's median, robust to gross errors."""
    n = used.sum(axis=1)
    half = np.minimum(n // 2, tests.shape[1] - 1)
    ordered = np.where(used, tests, np.inf)
    ordered.sort(axis=1)
    middle = ordered[np.arange(len(n)), half]
    return np.where(n > 0, middle, 1.0) / MEDIAN_CHI2


def typical_variance(tests: Array, used: Mask) -> float:
    """Return the epochs' median variance of unit weight; 1 without residuals."""
    variances = _variances(tests, used)
    return float(np.median(variances[used.any(axis=1)])) or 1.0 if used.any() else 1.0


def snoop_series(
    tests: Array,
    offered: Mask,
    used: Mask,
    unknowns: int,
    alpha: float,
    typical: float,
    freedom: Array | None,
) -> Mask:
    """Return the mask (E, T) of image points to keep, by the rule of `epoch.snooping.snoop`.

    typical: variance of unit weight of the series, for epochs too poor to estimate theirs; freedom
    (T,): degrees of freedom of each target's noise, None if the noise is as stated.
    """
    keep = offered.copy()
    for part in chunks(*used.shape):
        test, use = tests[part], used[part]
        n = use.sum(axis=1)
        few = 2 * n - unknowns < TRUSTED_REDUNDANCY
        variance = np.where(few, typical, _variances(test, use))
        uncertain = np.where(few, 0.0, 1.0 / np.maximum(n, 1))[:, None]
        if freedom is not None:
            uncertain = uncertain + 1.0 / freedom
        fits = test <= np.maximum(variance, 1e-12)[:, None] * limit_2d(alpha, uncertain)
        worst = np.where(use, test, 0.0).max(axis=1, initial=0.0)
        keep[part] &= fits | (use & (test < (np.where(few, 1.0, 0.5) * worst)[:, None]))
    return keep
