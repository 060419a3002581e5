"""Correlations of the interior orientation, from the adjustments' covariance matrices.

The reference (Elias et al. 2020, section 4.3) takes the median of every coefficient over all epochs
and both series, and calls their scatter over the epochs the noise of the coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from thermocald.arrays import Array


@dataclass(frozen=True, eq=False)
class IopCorrelations:
    """Median (10, 10) and noise (10, 10) of the coefficients; 0 where a parameter is held fixed.

    noise: standard deviation of a coefficient over the epochs, within its series; largest: the
    largest deviation from the median; epochs: how many matrices were used.
    """

    median: Array
    noise: Array
    largest: Array
    epochs: int


def correlations_of(covariances: Array) -> Array:
    """Covariances (n, k, k) → correlations; 0 for parameters held fixed, 1 on the diagonal."""
    sd = np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
    inverse = np.divide(1.0, sd, out=np.zeros_like(sd), where=sd > 0)
    r = covariances * inverse[..., :, None] * inverse[..., None, :]
    k = r.shape[-1]
    r[..., np.arange(k), np.arange(k)] = 1.0
    return np.asarray(np.clip(r, -1.0, 1.0))


def median_correlations(series: list[Array]) -> IopCorrelations:
    """Medians over the correlation matrices (n_i, k, k) of several series together.

    Raises ValueError where there is no matrix at all.
    """
    matrices = [m for m in series if len(m)]
    if not matrices:
        raise ValueError("no epoch has a covariance matrix")
    every = np.concatenate(matrices)
    median = np.median(every, axis=0)
    within = np.concatenate([m - m.mean(axis=0) for m in matrices])
    degrees = max(1, len(within) - len(matrices))
    noise = np.sqrt(np.sum(within**2, axis=0) / degrees)
    largest = np.max(np.abs(every - median), axis=0)
    return IopCorrelations(median, noise, largest, len(every))
