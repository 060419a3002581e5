"""Is a parameter's variation larger than its standard deviations explain?

The reference (Elias et al. 2020, section 4.1) compares the two-sided moving variance of a parameter
over n consecutive measurements with the two-sided moving average of its squared standard deviations
by an F-test at each instant, and gives the share of instants at which it succeeds. Neighbouring
windows share n-1 of n measurements, so these tests are not independent and their share has no
p-value. `drift_test` gives one: it compares the mean variance ratio of all windows with the ratios
of driftless series of the same standard deviations and the same autocorrelation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.autocorrelation import noise_autocorrelation

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
_LONG_SERIES = 6000
_SURROGATE_VALUES = 1_500_000


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
    """One p-value for the whole series, whatever the windows share.

    statistic: mean variance ratio of the windows; p_value: share of driftless surrogates that reach
    it; surrogates: how many; windows: how many windows the mean is over.
    """

    statistic: float
    p_value: float
    surrogates: int
    windows: int


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
    values: Array,
    sds: Array,
    redundancy: Array,
    time_s: Array,
    window: int = 31,
    surrogates: int = 999,
    seed: int = 0,
) -> DriftTest | None:
    """Whether the series varies more than its standard deviations explain: one p-value.

    Arguments as `moving_f_test`. The surrogates are noise of the stated standard deviations (drawn
    as their redundancy lets them be uncertain) with the autocorrelation that the series itself has,
    drift included, which makes the test cautious. Long series are tested on evenly spaced stretches
    that do not overlap. None where no window is unbroken.
    """
    starts = unbroken_windows(time_s, window)
    if not len(starts):
        return None
    noise = noise_autocorrelation((values - values.mean()) / sds, variance=1.0)
    rng = np.random.default_rng(seed)
    if len(values) <= _LONG_SERIES:
        stretches = [slice(int(a), int(b)) for a, b in _runs(starts, window)]
        statistic_windows = len(starts)
    else:
        spaced = starts[np.linspace(0, len(starts) - 1, _LONG_SERIES // window).astype(int)]
        stretches = [slice(int(a), int(a) + window) for a in spaced]
        statistic_windows = len(spaced)
    length = sum(s.stop - s.start for s in stretches)
    count = int(np.clip(_SURROGATE_VALUES // length, 99, surrogates))
    observed = 0.0
    drawn = np.zeros(count)
    for stretch in stretches:
        sd = sds[stretch]
        mean_square = moving_mean(sd**2, window)
        observed += float(np.sum(moving_variance(values[stretch], window) / mean_square))
        noise_sd = sd * np.sqrt(_chi_square_factor(rng, redundancy[stretch], count))
        series = noise_sd * noise.surrogates(rng, count, len(sd))
        drawn += np.sum(_row_variances(series, window) / mean_square, axis=1)
    reached = int(np.sum(drawn >= observed))
    p_value = (reached + 1) / (count + 1)
    return DriftTest(observed / statistic_windows, p_value, count, statistic_windows)


def _chi_square_factor(rng: np.random.Generator, redundancy: Array, count: int) -> Array:
    """True over stated variance (count, n), given the redundancy of the stated one."""
    degrees = np.maximum(redundancy, 1.0)
    return np.asarray(degrees / rng.chisquare(degrees, size=(count, len(degrees))))


def _row_variances(series: Array, window: int) -> Array:
    """Moving variances of many short series (k, n) → (k, n - window + 1)."""
    # Unit-variance noise without drift: running sums are exact enough here.
    padded = np.concatenate([np.zeros((len(series), 1)), series], axis=1)
    first = np.cumsum(padded, axis=1)
    second = np.cumsum(padded**2, axis=1)
    total = first[:, window:] - first[:, :-window]
    squares = second[:, window:] - second[:, :-window]
    return np.asarray((squares - total**2 / window) / (window - 1))


def _runs(starts: NDArray[np.int64], window: int) -> list[tuple[int, int]]:
    """Stretches of measurements (first, end) that unbroken neighbouring windows cover."""
    breaks = np.flatnonzero(np.diff(starts) > 1)
    first = np.concatenate([starts[:1], starts[breaks + 1]])
    last = np.concatenate([starts[breaks], starts[-1:]])
    return [(int(a), int(b) + window) for a, b in zip(first, last, strict=True)]
