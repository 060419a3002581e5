"""The F-test against scipy."""

import numpy as np
from scipy import stats

from thermocald.analysis.statistics.dependence import moving, moving_f_test, unbroken_windows

N = 150
TIME_S = np.arange(N) * 10.0
REDUNDANCY = np.full(N, 280.0)


def test_moving_statistics_are_those_of_each_window():
    values = np.random.default_rng(1).standard_normal(200) + 3.97e6
    windows = [values[i : i + 31] for i in range(170)]
    np.testing.assert_allclose(moving(values, 31, np.mean), [w.mean() for w in windows])
    variances = moving(values, 31, np.var, ddof=1)
    np.testing.assert_allclose(variances, [w.var(ddof=1) for w in windows])


def test_f_test_is_scipys():
    rng = np.random.default_rng(2)
    values, sds = rng.standard_normal(N), rng.uniform(0.8, 1.2, N)
    redundancy = rng.integers(200, 280, N).astype(float)
    index, ratio, critical, _ = moving_f_test(values, sds, redundancy, TIME_S, 31, 0.05)
    p = [
        stats.f.sf(
            np.var(values[i : i + 31], ddof=1) / np.mean(sds[i : i + 31] ** 2),
            30,
            redundancy[i : i + 31].sum(),
        )
        for i in range(N - 30)
    ]
    np.testing.assert_array_equal(ratio > critical, np.array(p) < 0.05)
    np.testing.assert_array_equal(index, np.arange(15, N - 15))


def test_windows_across_a_gap_are_left_out():
    time_s = np.concatenate([np.arange(60) * 10.0, 2000 + np.arange(40) * 10.0])
    starts = unbroken_windows(time_s, 31)
    crossing = [i for i in range(70) if i < 60 <= i + 30]
    assert not set(crossing) & set(starts.tolist())
    assert len(starts) == 70 - len(crossing)


def test_single_missing_epochs_break_nothing():
    time_s = np.delete(TIME_S, [20, 50, 51, 90])
    assert len(unbroken_windows(time_s, 31)) == len(time_s) - 30


def test_a_series_shorter_than_the_window_is_not_tested():
    few = slice(0, 20)
    tested = moving_f_test(TIME_S[few], REDUNDANCY[few], REDUNDANCY[few], TIME_S[few], 31, 0.05)
    assert not any(map(len, tested))
