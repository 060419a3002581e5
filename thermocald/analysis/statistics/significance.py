"""Is a parameter's variation larger than its standard deviations explain?

The reference (Elias et al. 2020, section 4.1) compares the two-sided moving variance of a parameter
over n consecutive measurements with the two-sided moving average of its squared standard deviations
by an F-test at each epoch, and gives the fraction of epochs at which it succeeds. Neighbouring
windows have n-1 of n measurements in common, so these tests are not independent and their fraction
has no p-value; `noise_models` gives one for the whole series.

Of the correlations of the interior orientation the reference (section 4.3) takes the median of
every coefficient over all epochs and both series, and calls their scatter over the epochs the noise
of the coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from thermocald.arrays import Array


_CHUNK = 1 << 15
# A window is broken by gaps when it lasts this much longer than n regular measurements.
_STRETCH = 1.5


@dataclass(frozen=True, eq=False)
class MovingFTest:
    """The F-test of every epoch of a series.

    index: epochs (m,) that are window centres; ratio (m,): of the moving variance over the moving
    mean of the squared standard deviations; critical (m,): of it at the level; degrees_sd (m,): of
    freedom of the mean squared standard deviations.
    """

    index: NDArray[np.int64]
    ratio: Array
    critical: Array
    degrees_sd: NDArray[np.int32]

    @property
    def success(self) -> NDArray[np.bool_]:
        """Where the variance is significantly the greater one (m,)."""
        return np.asarray(self.ratio > self.critical)

    @property
    def success_ratio(self) -> float:
        """Fraction of epochs with success; NaN where nothing could be tested."""
        return float(np.mean(self.success)) if len(self.index) else float("nan")


def moving_mean(values: Array, window: int) -> Array:
    """Return means of `window` consecutive values (n,) → (n - window + 1,)."""
    return _moving(values, window, np.mean)


def moving_variance(values: Array, window: int) -> Array:
    """Return sample variances (n-1) of `window` consecutive values (n,) → (n - window + 1,)."""
    return _moving(values, window, partial(np.var, ddof=1))


def _moving(values: Array, window: int, statistic: Callable[..., Any]) -> Array:
    if len(values) < window:
        return np.empty(0)
    views = np.lib.stride_tricks.sliding_window_view(values, window)
    # In chunks: running sums would cancel where the drift is large against the noise.
    parts = (views[start : start + _CHUNK] for start in range(0, len(views), _CHUNK))
    return np.concatenate([statistic(part, axis=1) for part in parts])


def unbroken_windows(time_s: Array, window: int) -> NDArray[np.int64]:
    """First indices of the windows of consecutive measurements that no gap breaks."""
    n = len(time_s)
    if n < window:
        return np.empty(0, dtype=np.int64)
    interval = float(np.median(np.diff(time_s)))
    span = time_s[window - 1 :] - time_s[: n - window + 1]
    return np.flatnonzero(span <= _STRETCH * (window - 1) * interval)


def moving_f_test(
    values: Array,
    sds: Array,
    redundancy: Array,
    time_s: Array,
    window: int = 31,
    alpha: float = 0.05,
) -> MovingFTest:
    """The reference's F-test at every epoch.

    values, sds (n,): parameter and its standard deviations, finite; redundancy (n,): degrees of
    freedom of each standard deviation (those of its adjustment); time_s (n,): finds gaps; window:
    odd number of measurements; alpha: level of the one-sided test. The squared standard deviations
    of a window carry the sum of its redundancies as degrees of freedom.
    """
    from scipy.stats import f

    if window < 3 or window % 2 == 0:
        raise ValueError(f"the window must be an odd number of at least 3, not {window}")
    starts = unbroken_windows(time_s, window)
    degrees = np.rint(moving_mean(redundancy, window)[starts] * window)
    degrees_sd = np.maximum(degrees, 0).astype(np.int32)
    # one quantile for every number of degrees that occurs, looked up
    different = np.flatnonzero(np.bincount(degrees_sd))
    quantiles = np.zeros(int(different.max(initial=0)) + 1)
    quantiles[different] = f.isf(alpha, window - 1, np.maximum(different, 1.0))
    ratio = moving_variance(values, window)[starts] / moving_mean(sds**2, window)[starts]
    return MovingFTest(starts + window // 2, ratio, quantiles[degrees_sd], degrees_sd)


@dataclass(frozen=True, eq=False)
class IopCorrelations:
    """Median (10, 10) and noise (10, 10) of the coefficients; 0 where a parameter is held fixed.

    noise: standard deviation of a coefficient over the epochs, within its series; largest: the
    largest deviation from the median; epochs: how many matrices were used.
    """

    JSON: ClassVar = {"largest": "largest_deviation"}

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
