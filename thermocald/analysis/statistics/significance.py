"""Is a parameter's variation larger than its standard deviations explain?

The reference (Elias et al. 2020, section 4.1) compares the two-sided moving variance of a parameter
over n consecutive measurements with the two-sided moving average of its squared standard deviations
by an F-test at each instant, and gives the share of instants at which it succeeds. Neighbouring
windows share n-1 of n measurements, so these tests are not independent and their share has no
p-value. `drift_test` gives one for the whole series: it compares its variance with those of
driftless series of the same standard deviations and the same autocorrelation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.statistics.autocorrelation import noise_autocorrelation

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

__all__ = [
    "DriftTest",
    "MovingFTest",
    "drift_test",
    "moving_f_test",
    "moving_mean",
    "moving_variance",
    "unbroken_windows",
]

_CHUNK = 1 << 15
# A window is broken by gaps when it lasts this much longer than n regular measurements.
_STRETCH = 1.5
_MOST_VALUES = 1500  # epochs of a long series that the drift test uses
_LEAST_VALUES = 8
_SURROGATES_AT_ONCE = 111


@dataclass(frozen=True, eq=False)
class MovingFTest:
    """The F-test of every instant of a series.

    index: epochs (m,) that are window centres; variance, mean_square_sd (m,): moving variance and
    moving mean of the squared standard deviations; critical (m,): of their ratio at `alpha`;
    degrees_variance; degrees_sd (m,); left_out: instants without a test (ends and gaps).
    """

    window: int
    alpha: float
    index: NDArray[np.int64]
    variance: Array
    mean_square_sd: Array
    critical: Array
    degrees_variance: int
    degrees_sd: Array
    left_out: int

    @property
    def ratio(self) -> Array:
        """Variance over mean squared standard deviation (m,)."""
        return self.variance / self.mean_square_sd

    @property
    def success(self) -> NDArray[np.bool_]:
        """Where the variance is significantly the greater one (m,)."""
        return np.asarray(self.ratio > self.critical)

    @property
    def success_ratio(self) -> float:
        """Share of instants with success; NaN where nothing could be tested."""
        return float(np.mean(self.success)) if len(self.index) else float("nan")


@dataclass(frozen=True, slots=True)
class DriftTest:
    """One p-value for the whole series, without windows.

    statistic: variance of the series over its mean squared sd; p_value: share of driftless
    surrogates that reach it; surrogates: how many; epochs: how many were used.
    """

    statistic: float
    p_value: float
    surrogates: int
    epochs: int


def moving_mean(values: Array, window: int) -> Array:
    """Means of `window` consecutive values (n,) → (n - window + 1,), centred on i + window//2."""
    return _moving(values, window, np.mean)


def moving_variance(values: Array, window: int) -> Array:
    """Sample variances (n-1) of `window` consecutive values (n,) → (n - window + 1,)."""
    return _moving(values, window, _variance)


def _variance(block: Array, axis: int) -> Array:
    return np.asarray(np.var(block, axis=axis, ddof=1))


def _moving(values: Array, window: int, statistic: object) -> Array:
    assert callable(statistic)
    if len(values) < window:
        return np.empty(0)
    views = np.lib.stride_tricks.sliding_window_view(values, window)
    result = np.empty(len(views))
    # In chunks: running sums would cancel where the drift is large against the noise.
    for start in range(0, len(views), _CHUNK):
        part = slice(start, start + _CHUNK)
        result[part] = statistic(views[part], axis=1)
    return result


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
    """The reference's F-test at every instant.

    values, sds (n,): parameter and its standard deviations, finite; redundancy (n,): degrees of
    freedom of each standard deviation (those of its adjustment); time_s (n,): finds gaps; window:
    odd number of measurements; alpha: level of the one-sided test. The squared standard deviations
    of a window carry the sum of its redundancies as degrees of freedom.
    """
    from scipy.stats import f

    if window < 3 or window % 2 == 0:
        raise ValueError(f"the window must be an odd number of at least 3, not {window}")
    starts = unbroken_windows(time_s, window)
    degrees_sd = np.rint(moving_mean(redundancy, window)[starts] * window)
    different, which = np.unique(degrees_sd, return_inverse=True)
    critical = np.asarray(f.isf(alpha, window - 1, np.maximum(different, 1.0)))[which]
    return MovingFTest(
        window,
        alpha,
        starts + window // 2,
        moving_variance(values, window)[starts],
        moving_mean(sds**2, window)[starts],
        critical,
        window - 1,
        degrees_sd,
        len(values) - len(starts),
    )


def drift_test(
    values: Array, sds: Array, redundancy: Array, surrogates: int = 999, seed: int = 0
) -> DriftTest | None:
    """Whether the series varies more than its standard deviations explain: one p-value.

    values, sds, redundancy (n,) as for `moving_f_test`. The variance of the series over its mean
    squared sd is compared with that of driftless surrogates: noise of the stated sds (as uncertain
    as their redundancy makes them) with the autocorrelation that is plausible for the series
    itself, its drift included, which makes the test cautious. Of a long series evenly spaced epochs
    are used. None for fewer than 8 epochs.
    """
    step = -(-len(values) // _MOST_VALUES)
    values, sds, redundancy = values[::step], sds[::step], redundancy[::step]
    if len(values) < _LEAST_VALUES:
        return None
    noise = noise_autocorrelation((values - values.mean()) / sds, variance=1.0)
    rng = np.random.default_rng(seed)
    degrees = np.maximum(redundancy, 1.0)
    mean_square = float(np.mean(sds**2))
    observed = float(np.var(values, ddof=1)) / mean_square
    reached = done = 0
    while done < surrogates:
        count = min(_SURROGATES_AT_ONCE, surrogates - done)
        # The true variance over the stated one, given the redundancy of the stated one.
        factor = degrees / rng.chisquare(degrees, size=(count, len(degrees)))
        series = sds * np.sqrt(factor) * noise.surrogates(rng, count, len(sds))
        reached += int(np.sum(np.var(series, axis=1, ddof=1) / mean_square >= observed))
        done += count
    return DriftTest(observed, (reached + 1) / (surrogates + 1), surrogates, len(values))
