"""The F-test against scipy, and what each test claims about driftless series."""

import numpy as np
import pytest
from scipy import signal, stats

from thermocald.analysis.statistics.significance import (
    drift_test,
    moving_f_test,
    moving_mean,
    moving_variance,
    unbroken_windows,
)

N = 150
TIME_S = np.arange(N) * 10.0
REDUNDANCY = np.full(N, 280.0)


def noise(rng, phi, n=N):
    """First-order autoregressive noise of unit variance."""
    drive = rng.standard_normal(n + 300)
    return np.asarray(signal.lfilter([1], [1, -phi], drive))[300:] * np.sqrt(1 - phi**2)


def test_moving_statistics_are_those_of_each_window():
    values = np.random.default_rng(1).standard_normal(200) + 3.97e6
    windows = [values[i : i + 31] for i in range(170)]
    np.testing.assert_allclose(moving_mean(values, 31), [w.mean() for w in windows])
    np.testing.assert_allclose(moving_variance(values, 31), [w.var(ddof=1) for w in windows])


def test_f_test_is_scipys():
    rng = np.random.default_rng(2)
    values, sds = rng.standard_normal(N), rng.uniform(0.8, 1.2, N)
    redundancy = rng.integers(200, 280, N).astype(float)
    test = moving_f_test(values, sds, redundancy, TIME_S, window=31, alpha=0.05)
    p = [
        stats.f.sf(
            np.var(values[i : i + 31], ddof=1) / np.mean(sds[i : i + 31] ** 2),
            30,
            redundancy[i : i + 31].sum(),
        )
        for i in range(N - 30)
    ]
    np.testing.assert_array_equal(test.success, np.array(p) < 0.05)
    assert test.success_ratio == np.mean(np.array(p) < 0.05)
    np.testing.assert_array_equal(test.index, np.arange(15, N - 15))


def test_windows_across_a_gap_are_left_out():
    time_s = np.concatenate([np.arange(60) * 10.0, 2000 + np.arange(40) * 10.0])
    starts = unbroken_windows(time_s, 31)
    crossing = [i for i in range(70) if i < 60 <= i + 30]
    assert not set(crossing) & set(starts.tolist())
    assert len(starts) == 70 - len(crossing)


def test_single_missing_epochs_break_nothing():
    time_s = np.delete(TIME_S, [20, 50, 51, 90])
    assert len(unbroken_windows(time_s, 31)) == len(time_s) - 30


def test_a_slow_drift_below_the_noise_of_an_epoch_is_found():
    values = 0.6 * (1 - np.exp(-TIME_S / 300)) + 0.2 * np.random.default_rng(3).standard_normal(N)
    result = drift_test(values, np.full(N, 0.2), REDUNDANCY)
    assert result is not None
    assert result.p_value <= 0.002


def test_a_series_shorter_than_the_window_is_not_tested():
    few = slice(0, 20)
    assert drift_test(TIME_S[:5], REDUNDANCY[:5], REDUNDANCY[:5]) is None
    assert np.isnan(
        moving_f_test(TIME_S[few], REDUNDANCY[few], REDUNDANCY[few], TIME_S[few]).success_ratio
    )


@pytest.mark.slow
@pytest.mark.parametrize("phi", [0.0, 0.5, 0.8])
def test_false_positives_of_1000_driftless_series(phi):
    """At level 0.05: binomial ±3 sd is 0.029 to 0.071."""
    rng = np.random.default_rng(4)
    sds = np.full(N, 0.7)
    instants, series = [], []
    for i in range(1000):
        values = 0.7 * noise(rng, phi)
        instants.append(moving_f_test(values, sds, REDUNDANCY, TIME_S).success_ratio)
        result = drift_test(values, sds, REDUNDANCY, surrogates=199, seed=i)
        series.append(result.p_value <= 0.05)
    assert 0.029 <= np.mean(series) <= 0.071
    if phi == 0:
        # Windows overlap: the share's own scatter is that of some five windows per series.
        assert np.mean(instants) == pytest.approx(0.05, abs=0.01)
