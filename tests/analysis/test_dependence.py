"""Correlation, significance and slope against scipy, York, and simulations."""

import numpy as np
import pytest
from scipy.special import betainc, fdtrc

from tests.analysis.test_drift_test import TIME_S, WARM_UP, N, noise
from thermocald.analysis.statistics.dependence import (
    dependence,
    fit_straight_line,
    holm,
    median_correlations,
    moving_f_test,
    pearson_matrix,
    slope_noise,
    unbroken_windows,
)
from thermocald.photogrammetry.linalg import correlations


def test_pearson_and_its_t_test():
    """The p-value is that of the exact distribution of r, a beta distribution."""
    rng = np.random.default_rng(1)
    temperature = 25 + 10 * WARM_UP
    values = 0.1 * WARM_UP + 0.2 * rng.standard_normal(N)
    result = dependence(values, np.full(N, 0.2), temperature, 0.05)
    assert result.r == pytest.approx(np.corrcoef(values, temperature)[0, 1], abs=1e-12)
    p = 2 * betainc(N / 2 - 1, N / 2 - 1, (1 - abs(result.r)) / 2)
    assert result.p_naive == pytest.approx(p, rel=1e-9)
    assert dependence(WARM_UP, np.full(N, 0.2), 25 + 16 * WARM_UP, 0.05).p_naive == 0


def test_holm():
    """The sorted p times 4, 3, 2, 1, each at least the one before."""
    assert holm(np.array([0.01, 0.04, 0.03, 0.005])) == pytest.approx([0.03, 0.06, 0.06, 0.02])


def test_the_correlation_matrix_equals_numpys_and_is_nan_for_constants():
    rng = np.random.default_rng(3)
    columns = list(rng.standard_normal((4, 50)))
    np.testing.assert_allclose(pearson_matrix(columns), np.corrcoef(columns), atol=1e-12)
    columns[2] = np.full(50, 3.97)
    columns[3] = np.where(np.arange(50) == 7, np.nan, columns[3])
    matrix = pearson_matrix(columns)
    assert np.isnan(matrix[2]).all()
    keep = np.arange(50) != 7
    assert matrix[0, 3] == pytest.approx(np.corrcoef(columns[0][keep], columns[3][keep])[0, 1])


def test_slope_is_unbiased_and_its_sd_true():
    """With 1.5 K of noise on a rise of 12 K, ordinary least squares is 20 % too flat."""
    rng = np.random.default_rng(5)
    truth, sd, thermometer_sd = 0.4, 0.3, 1.5
    slopes, sds, ordinary = [], [], []
    for _ in range(200):
        temperature = 25 + 12 * WARM_UP + thermometer_sd * rng.standard_normal(N)
        values = truth * 12 * WARM_UP + sd * rng.standard_normal(N)
        result = dependence(values, np.full(N, sd), temperature, thermometer_sd)
        slopes.append(result.slope)
        sds.append(result.sd_slope)
        ordinary.append(np.polyfit(temperature, values, 1)[0])
    assert np.mean(slopes) == pytest.approx(truth, abs=4 * np.std(slopes) / np.sqrt(200))
    # Allowing for autocorrelation makes the sd cautious, by 10 to 20 % for white noise
    off = (np.array(slopes) - truth) / sds
    assert 0.75 <= np.sqrt(np.mean(off**2)) <= 1.05
    assert np.mean(ordinary) < 0.9 * truth


def test_the_sd_of_the_slope_includes_scatter_beyond_the_sds():
    rng = np.random.default_rng(6)
    temperature = 25 + 12 * WARM_UP
    values = 0.4 * 12 * WARM_UP + rng.standard_normal(N)
    honest = dependence(values, np.full(N, 1.0), temperature, 0.05)
    optimistic = dependence(values, np.full(N, 0.1), temperature, 0.05)
    assert optimistic.misfit == pytest.approx(10 * honest.misfit, rel=0.1)
    assert optimistic.sd_slope == pytest.approx(honest.sd_slope, rel=0.1)


def _slope(y, x):
    x = x - x.mean()
    return float(x @ y / (x @ x))


@pytest.mark.parametrize(
    "steps",
    [[0, 0, 0, 0, 0, 0, -1, -1, 0, -1, 0, 1, 0, 0, 0], [0, 0, -1, -1, -1, -1],
     [0, 0, 0, 0, 0, 0, 0, 0, -1, -1, -1, -1]],
)  # fmt: skip
def test_a_coarse_thermometer_of_few_steps_gives_a_finite_sd(steps):
    """No frequency alone stands out of the thermometer's noise; the sd once was infinite."""
    y = np.random.default_rng(7).standard_normal(len(steps))
    sd, *_ = slope_noise(y, 25 + 0.5 * np.array(steps), 0.0, 0.5 / np.sqrt(12))
    assert 0.5 < sd < 50


def test_a_memory_as_long_as_the_series_is_reported():
    rng = np.random.default_rng(5)
    short = [slope_noise(noise(rng, 1.0, 0.99), WARM_UP, 0.0)[3] for _ in range(10)]
    white = [slope_noise(noise(rng, 0.0, 0.0), WARM_UP, 0.0)[3] for _ in range(5)]
    assert np.mean(short) > 0.5
    assert not any(white)


@pytest.mark.parametrize(("phi", "rel"), [(0.0, 0.2), (0.6, 0.3), (0.9, 0.3)])
def test_slow_variations_of_x_under_autoregressive_noise(phi, rel):
    """The slope's variance is (1 + phi)/(1 - phi) times that with white noise."""
    from scipy.signal import lfilter  # half a second, of one worker

    rng = np.random.default_rng(2)
    n = 4000
    x = np.sin(2 * np.pi * np.arange(n) / n)
    found = []
    for _ in range(20):
        y = np.asarray(lfilter([1], [1, -phi], rng.standard_normal(n + 300)))[300:]
        found.append(slope_noise(y, x, _slope(y, x))[1])
    assert np.median(found) == pytest.approx(n * (1 - phi) / (1 + phi), rel=rel)


def test_pooled_frequencies_of_a_long_series_give_the_same_result():
    from scipy.signal import lfilter  # half a second, of one worker

    rng = np.random.default_rng(3)
    y = np.asarray(lfilter([1], [1, -0.9], rng.standard_normal(200_000)))
    x = np.cumsum(rng.standard_normal(200_000))
    _, n_effective, lag_one, _ = slope_noise(y, x, _slope(y, x))
    assert n_effective == pytest.approx(200_000 / 19, rel=0.4)
    assert lag_one == pytest.approx(0.9, abs=0.06)


# Pearson (1901) with the weights of York (1966); solution in York et al. (2004), table II.
PEARSON_X = np.array([0.0, 0.9, 1.8, 2.6, 3.3, 4.4, 5.2, 6.1, 6.5, 7.4])
PEARSON_Y = np.array([5.9, 5.4, 4.4, 4.6, 3.5, 3.7, 2.8, 2.8, 2.4, 1.5])
YORK_WX = np.array([1000, 1000, 500, 800, 200, 80, 60, 20, 1.8, 1.0])
YORK_WY = np.array([1, 1.8, 4, 8, 20, 20, 70, 70, 100, 500])


def test_pearsons_data_with_yorks_weights():
    sds = 1 / np.sqrt(YORK_WX), 1 / np.sqrt(YORK_WY)
    slope, sd_slope, chi2 = fit_straight_line(PEARSON_X, PEARSON_Y, *sds)
    assert slope == pytest.approx(-0.480533407, abs=5e-9)
    assert chi2 == pytest.approx(11.8663532, abs=5e-7)
    assert sd_slope == pytest.approx(0.0579850, abs=5e-6)


def test_the_f_test_equals_scipys():
    rng = np.random.default_rng(2)
    values, sds = 3.97e6 + rng.standard_normal(N), rng.uniform(0.8, 1.2, N)
    redundancy = rng.integers(200, 280, N).astype(float)
    index, ratio, critical, _ = moving_f_test(values, sds, redundancy, TIME_S, 31, 0.05)
    windows = [slice(i, i + 31) for i in range(N - 30)]
    ratios = [np.var(values[w], ddof=1) / np.mean(sds[w] ** 2) for w in windows]
    p = fdtrc(30, [redundancy[w].sum() for w in windows], ratios)
    np.testing.assert_array_equal(ratio > critical, p < 0.05)
    np.testing.assert_array_equal(index, np.arange(15, N - 15))
    # single missing epochs are not gaps
    time_s = np.delete(TIME_S, [20, 50, 51, 90])
    assert len(unbroken_windows(time_s, 31)) == len(time_s) - 30


def test_correlations_of_a_covariance_with_a_held_parameter():
    covariance = np.array([[[4.0, 3.0, 0.0], [3.0, 9.0, 0.0], [0.0, 0.0, 0.0]]])
    expected = [[[1, 0.5, 0], [0.5, 1, 0], [0, 0, 1]]]
    np.testing.assert_allclose(correlations(covariance), expected)


def test_median_over_both_series_and_noise_within_each():
    rng = np.random.default_rng(1)
    series = []
    for level in (0.5, 0.7):
        matrices = np.tile(np.eye(2), (4000, 1, 1))
        matrices[:, 0, 1] = matrices[:, 1, 0] = level + 0.03 * rng.standard_normal(4000)
        series.append(matrices)
    found = median_correlations(series)
    assert found.median[0, 1] == pytest.approx(0.6, abs=0.02)
    # The step from one series to the other is not noise.
    assert found.noise[0, 1] == pytest.approx(0.03, rel=0.05)
    assert found.epochs == 8000
    assert median_correlations([np.empty((0, 10, 10))]) is None
