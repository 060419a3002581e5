"""Correlation, its p-values and the slope against scipy, statsmodels, and their own claims."""

import numpy as np
import pytest
from scipy import signal, stats

from thermocald.analysis.statistics.dependence import correlation_matrix, dependence, holm

N = 150
TIME_S = np.arange(N) * 10.0
WARM = 1 - np.exp(-TIME_S / 300)
HEATED = np.where(TIME_S < 750, WARM, (1 - np.exp(-2.5)) * np.exp(-(TIME_S - 750) / 300))


def test_pearson_and_its_t_test_are_scipys():
    rng = np.random.default_rng(1)
    temperature = 25 + 10 * WARM
    values = 0.1 * WARM + 0.2 * rng.standard_normal(N)
    result = dependence(values, np.full(N, 0.2), temperature, 0.05)
    expected = stats.pearsonr(values, temperature)
    assert result.r == pytest.approx(expected.statistic, abs=1e-12)
    assert result.p_naive == pytest.approx(expected.pvalue, rel=1e-9)


def test_p_value_of_a_perfect_correlation():
    assert dependence(WARM, np.full(N, 0.2), 25 + 16 * WARM, 0.05).p_naive == 0


def test_holm_is_statsmodels():
    from statsmodels.stats.multitest import multipletests

    p = np.random.default_rng(2).uniform(0, 0.1, 9)
    assert holm(p) == pytest.approx(multipletests(p, method="holm")[1])


def test_correlation_matrix_is_numpys_and_silent_on_constants():
    rng = np.random.default_rng(3)
    columns = list(rng.standard_normal((4, 50)))
    np.testing.assert_allclose(correlation_matrix(columns), np.corrcoef(columns), atol=1e-12)
    columns[2] = np.full(50, 3.97)
    columns[3] = np.where(np.arange(50) == 7, np.nan, columns[3])
    matrix = correlation_matrix(columns)
    assert np.isnan(matrix[2]).all()
    keep = np.arange(50) != 7
    assert matrix[0, 3] == pytest.approx(np.corrcoef(columns[0][keep], columns[3][keep])[0, 1])


@pytest.mark.slow
@pytest.mark.parametrize("thermometer_sd", [0.05, 1.5])
def test_slope_is_unbiased_and_its_sd_true(thermometer_sd):
    """A thermometer with 1.5 K on a rise of 12 K: ordinary least squares is 20 % too flat."""
    rng = np.random.default_rng(5)
    truth, sd = 0.4, 0.3
    slopes, sds, ordinary = [], [], []
    for _ in range(600):
        temperature = 25 + 12 * WARM + thermometer_sd * rng.standard_normal(N)
        values = truth * 12 * WARM + sd * rng.standard_normal(N)
        result = dependence(values, np.full(N, sd), temperature, thermometer_sd)
        slopes.append(result.slope)
        sds.append(result.sd_slope)
        ordinary.append(np.polyfit(temperature, values, 1)[0])
    assert np.mean(slopes) == pytest.approx(truth, abs=4 * np.std(slopes) / np.sqrt(600))
    # Counting possible autocorrelation makes the sd cautious, by 10 to 20 % for white noise.
    off = (np.array(slopes) - truth) / sds
    assert 0.75 <= np.sqrt(np.mean(off**2)) <= 1.05
    if thermometer_sd > 1:
        assert np.mean(ordinary) < 0.9 * truth


def test_scatter_beyond_the_sds_goes_into_the_sd_of_the_slope():
    rng = np.random.default_rng(6)
    temperature = 25 + 12 * WARM
    values = 0.4 * 12 * WARM + rng.standard_normal(N)
    honest = dependence(values, np.full(N, 1.0), temperature, 0.05)
    optimistic = dependence(values, np.full(N, 0.1), temperature, 0.05)
    assert optimistic.misfit == pytest.approx(10 * honest.misfit, rel=0.1)
    assert optimistic.sd_slope == pytest.approx(honest.sd_slope, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("course", [WARM, HEATED], ids=["warm-up", "heating and cooling"])
@pytest.mark.parametrize("phi", [0.0, 0.5, 0.8, 0.9])
def test_false_positives_of_1000_driftless_series(course, phi):
    """At level 0.05 at most 3 binomial sd above; the naive test reaches 0.6 on the same series."""
    rng = np.random.default_rng(7)
    temperature = 25 + 12 * course
    naive, counted = [], []
    for _ in range(1000):
        drive = rng.standard_normal(N + 300)
        values = np.asarray(signal.lfilter([1], [1, -phi], drive))[300:]
        result = dependence(values, np.ones(N), temperature, 0.05)
        naive.append(result.p_naive < 0.05)
        counted.append(result.p_value < 0.05)
    assert np.mean(counted) <= 0.071
    if phi == 0:
        assert np.mean(naive) == pytest.approx(0.05, abs=0.021)
    else:
        assert np.mean(naive) > 0.15


@pytest.mark.slow
def test_familywise_false_positives_after_holm():
    """Eight driftless parameters: any of them significant in at most 5 % of 1000 series."""
    rng = np.random.default_rng(8)
    temperature = 25 + 12 * WARM
    any_found = []
    for _ in range(1000):
        p = [
            dependence(rng.standard_normal(N), np.ones(N), temperature, 0.05).p_value
            for _ in range(8)
        ]
        any_found.append(min(holm(p)) < 0.05)
    assert np.mean(any_found) <= 0.071
