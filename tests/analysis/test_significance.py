"""Drift, correlation and slope: false alarms and power, against scipy, York, and simulations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.fft import dct, next_fast_len
from scipy.special import betainc, fdtrc

from tests.marks import mostly_slow
from thermocald.analysis.statistics.dependence import (
    dependence,
    fit_straight_line,
    holm,
    moving_f_test,
    slope_noise,
    slope_p_value,
    unbroken_windows,
)
from thermocald.analysis.statistics.noise_models import Frequencies, cosines, drift_test

N = 150
TIME_S = np.arange(N) * 10.0
ONES = np.ones(N)
REDUNDANCY = np.full(N, 280.0)
WARM_UP = 1 - np.exp(-TIME_S / 300)
UP_AND_DOWN = 1 - np.abs(2 * TIME_S / TIME_S[-1] - 1)
NOISES = [(1.0, 0.5, 1.0), (1.0, 0.9, 3.0), (0.5, 0.97, 1.0), (0.5, 0.8, 3.0), (0.5, 0.99, 1.0)]
"""Coloured part of the variance, its φ, and the sd."""


def noise(rng, coloured=0.0, phi=0.0, n=N):
    """Draw noise of unit variance: first-order autoregressive plus white."""
    white = rng.standard_normal(n)
    if not coloured:
        return white
    from scipy.signal import lfilter  # half a second, of one worker

    slow = lfilter([1], [1, -phi], rng.standard_normal(n + 600))[600:]
    slow = np.asarray(slow) * np.sqrt(1 - phi**2)
    return np.sqrt(coloured) * slow + np.sqrt(1 - coloured) * white


@pytest.mark.parametrize(("coloured", "phi", "size"), mostly_slow(NOISES, (0.5, 0.97, 1.0)))
def test_at_most_one_in_twenty_driftless_series_drifts_or_exceeds_its_sds(coloured, phi, size):
    """200 series each, with noise of any memory and one or three times the stated size.

    The 99.9 % point of a binomial share of 5 % is 0.105. A comparison with the stated sds alone
    found drift in 91 to 100 % of the series whose noise exceeds them. Of AR(1) of 0.97 plus white
    noise of equal size, 9.5 % exceeded their sds. The audit's section `significance` has more.
    """
    rng = np.random.default_rng(5)
    found = [drift_test(size * noise(rng, coloured, phi), ONES, REDUNDANCY) for _ in range(200)]
    assert np.mean([one.p_value <= 0.05 for one in found]) <= 0.105
    assert size > 1 or np.mean([one.p_excess <= 0.05 for one in found]) <= 0.105


@pytest.mark.parametrize(
    "drift",
    [
        pytest.param(10 * WARM_UP, id="warm-up"),
        pytest.param(10 * UP_AND_DOWN, id="up and down"),
        pytest.param(20.0 * (np.arange(N) > 70), id="slip"),
        pytest.param(1000 * (1 - np.exp(-TIME_S / 100)), id="fast and large"),
        pytest.param(3 * np.sin(2 * np.pi * np.arange(20_000) / 8640), id="two days"),
    ],
)
def test_drift_of_some_sds_is_found(drift):
    rng, n = np.random.default_rng(8), len(drift)
    draws = 50 if n == N else 3
    tests = [
        drift_test(drift + noise(rng, n=n), np.ones(n), np.full(n, 280.0)) for _ in range(draws)
    ]
    assert np.mean([one.p_value <= 0.05 for one in tests]) >= 0.85
    assert all(one.p_excess <= 1e-6 for one in tests)


@pytest.mark.parametrize(("epochs", "bad"), [(N, 40), (10, 9)])
def test_one_bad_epoch_is_no_drift(epochs, bad):
    rng = np.random.default_rng(10)
    spike = 100.0 * (np.arange(N) == bad)
    series = [(spike + noise(rng))[:epochs] for _ in range(50)]
    found = [drift_test(y, ONES[:epochs], REDUNDANCY[:epochs]).p_value for y in series]
    assert min(found) > 0.01


def test_a_warm_up_with_a_gap_is_found():
    kept = np.delete(np.arange(N), slice(60, 100))
    y = 40 * WARM_UP[kept] + noise(np.random.default_rng(15))[kept]
    assert drift_test(y, ONES[kept], REDUNDANCY[kept], times=TIME_S[kept]).p_value < 1e-3
    assert slope_p_value(y, WARM_UP[kept], TIME_S[kept]) < 1e-3


def test_means_of_stretches_have_the_covariance_of_their_noise():
    epoch = np.r_[0:12, 30:38]
    of = np.array([epoch < 20, epoch > 20]) / np.sqrt([[12.0], [8.0]])
    true = of @ 0.9 ** np.abs(epoch - epoch[:, None]) @ of.T
    found = Frequencies.of(len(epoch), 10.0 * epoch).means_covariance(0.9)
    np.testing.assert_allclose(found, true, rtol=1e-9)


def test_a_series_of_prime_length_is_shortened_by_a_few_epochs():
    prime_length = 200_003
    y = np.random.default_rng(1).normal(size=prime_length)
    found = cosines(y)
    n = len(found) + 1
    assert prime_length - 200 < n < prime_length
    assert next_fast_len(n) - n < 2000
    np.testing.assert_allclose(found, dct(y[:n] - y[:n].mean(), norm="ortho")[1:], atol=1e-9)
    assert len(cosines(np.arange(997.0))) == 996  # a short series is not shortened


def test_pearson_and_its_t_test():
    """The p-value is that of the exact distribution of r, a beta distribution."""
    temperature = 25 + 10 * WARM_UP
    values = 0.1 * WARM_UP + 0.2 * noise(np.random.default_rng(1))
    result = dependence(values, 0.2 * ONES, temperature, 0.05)
    assert result.r == pytest.approx(np.corrcoef(values, temperature)[0, 1], abs=1e-12)
    p = 2 * betainc(N / 2 - 1, N / 2 - 1, (1 - abs(result.r)) / 2)
    assert result.p_naive == pytest.approx(p, rel=1e-9)
    assert dependence(WARM_UP, 0.2 * ONES, 25 + 16 * WARM_UP, 0.05).p_naive == 0


def test_holm():
    """The sorted p times 4, 3, 2, 1, each at least the one before."""
    assert holm(np.array([0.01, 0.04, 0.03, 0.005])) == pytest.approx([0.03, 0.06, 0.06, 0.02])


def test_slope_is_unbiased_and_its_sd_true():
    """With 1.5 K of noise on a rise of 12 K, ordinary least squares is 20 % too flat."""
    rng = np.random.default_rng(5)
    truth, sd, thermometer_sd = 0.4, 0.3, 1.5
    slopes, sds, ordinary = [], [], []
    for _ in range(200):
        temperature = 25 + 12 * WARM_UP + thermometer_sd * noise(rng)
        values = truth * 12 * WARM_UP + sd * noise(rng)
        result = dependence(values, sd * ONES, temperature, thermometer_sd)
        slopes.append(result.slope)
        sds.append(result.sd_slope)
        ordinary.append(np.polyfit(temperature, values, 1)[0])
    assert np.mean(slopes) == pytest.approx(truth, abs=4 * np.std(slopes) / np.sqrt(200))
    # Allowing for autocorrelation makes the sd cautious, by 10 to 20 % for white noise
    off = (np.array(slopes) - truth) / sds
    assert 0.75 <= np.sqrt(np.mean(off**2)) <= 1.05
    assert np.mean(ordinary) < 0.9 * truth


def test_the_sd_of_the_slope_includes_scatter_beyond_the_sds():
    temperature = 25 + 12 * WARM_UP
    values = 0.4 * 12 * WARM_UP + noise(np.random.default_rng(6))
    honest, optimistic = (dependence(values, sd * ONES, temperature, 0.05) for sd in (1.0, 0.1))
    assert optimistic.misfit == pytest.approx(10 * honest.misfit, rel=0.1)
    assert optimistic.sd_slope == pytest.approx(honest.sd_slope, rel=0.1)


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
    white = [slope_noise(noise(rng), WARM_UP, 0.0)[3] for _ in range(5)]
    assert np.mean(short) > 0.5
    assert not any(white)


@pytest.mark.parametrize(
    ("n", "draws", "phi", "rel"),
    [(4000, 20, 0.0, 0.2), (4000, 20, 0.6, 0.3), (4000, 20, 0.9, 0.3), (200_000, 1, 0.9, 0.4)],
)
def test_the_effective_number_of_epochs_with_autoregressive_noise(n, draws, phi, rel):
    """The slope's variance is (1 + phi)/(1 - phi) times that with white noise, for a slow x.

    Frequencies of a long series are pooled.
    """
    rng, found = np.random.default_rng(2), []
    x = np.sin(2 * np.pi * np.arange(n) / n)
    for _ in range(draws):
        y = noise(rng, 1.0, phi, n)
        found.append(slope_noise(y, x, float(x @ (y - y.mean()) / (x @ x)))[1:3])
    n_effective, lag_one = np.median(found, axis=0)
    assert n_effective == pytest.approx(n * (1 - phi) / (1 + phi), rel=rel)
    assert lag_one == pytest.approx(phi, abs=0.06)


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
    values, sds = 3.97e6 + noise(rng), rng.uniform(0.8, 1.2, N)
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
