"""Tests for drift and dependence: false alarms in driftless series, power in drifting ones."""

import numpy as np
import pytest
from scipy.fft import dct, next_fast_len

from tests.marks import mostly_slow
from thermocald.analysis.statistics.dependence import holm, slope_p_value
from thermocald.analysis.statistics.noise_models import cosines, drift_test

N = 150
TIME_S = np.arange(N) * 10.0
ONES = np.ones(N)
REDUNDANCY = np.full(N, 280.0)
WARM_UP = 1 - np.exp(-TIME_S / 300)
UP_AND_DOWN = 1 - np.abs(2 * TIME_S / TIME_S[-1] - 1)
NOISES = [(1.0, 0.5, 1.0), (1.0, 0.9, 3.0), (0.5, 0.97, 1.0), (0.5, 0.8, 3.0), (0.5, 0.99, 1.0)]
"""Coloured part of the variance, its φ, and the sd."""


def noise(rng, coloured, phi, n=N):
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


def flicker(rng, exponent, n):
    """Draw noise of spectrum 1/f^exponent and unit variance, an eighth of a longer series."""
    shape = np.zeros(4 * n + 1)
    shape[1:] = np.arange(1, 4 * n + 1) ** (-exponent / 2)
    waves = rng.standard_normal(len(shape)) + 1j * rng.standard_normal(len(shape))
    y = np.fft.irfft(shape * waves, 8 * n)[:n]
    return y / y.std()


@pytest.mark.slow
@pytest.mark.parametrize(("exponent", "white"), [(1.0, 0.0), (1.5, 0.0), (1.0, 0.7)])
def test_flicker_noise_is_no_drift(exponent, white):
    """With autoregressive models only, three parameters in 400 epochs of 1/f drifted in 57 %."""
    rng = np.random.default_rng(16)
    found = []
    for _ in range(200):
        y = np.array([flicker(rng, exponent, 400) for _ in range(3)])
        y = np.sqrt(1 - white**2) * y + white * rng.standard_normal(y.shape)
        p = [drift_test(one, np.ones(400), np.full(400, 280.0)).p_value for one in y]
        found.append(min(holm(p)) <= 0.01)
    assert np.mean(found) <= 0.035  # 99.9 % point of a share of 1 %


@pytest.mark.parametrize(
    "drift",
    [
        pytest.param(10 * WARM_UP, id="warm-up"),
        pytest.param(10 * UP_AND_DOWN, id="up and down"),
        pytest.param(20.0 * (np.arange(N) > 70), id="slip"),
        pytest.param(1000 * (1 - np.exp(-TIME_S / 100)), id="fast and large"),
    ],
)
def test_drift_of_some_sds_is_found(drift):
    rng = np.random.default_rng(8)
    tests = [drift_test(drift + noise(rng, 0, 0), ONES, REDUNDANCY) for _ in range(50)]
    assert np.mean([one.p_value <= 0.05 for one in tests]) >= 0.85
    assert all(one.p_excess <= 1e-6 for one in tests)


def test_one_bad_epoch_is_no_drift():
    rng = np.random.default_rng(10)
    spike = 100.0 * (np.arange(N) == 40)
    found = [drift_test(spike + noise(rng, 0, 0), ONES, REDUNDANCY).p_value for _ in range(50)]
    assert min(found) > 0.05


def test_rounded_values_are_no_drift():
    """Most steps are 0 and the others jumps; 95 % once drifted at 1 %."""
    rng = np.random.default_rng(17)
    found = []
    for _ in range(100):
        y = 2.0 * np.round(noise(rng, 0, 0) / 2.0) + 1e-3 * noise(rng, 0, 0)
        found.append(drift_test(y, ONES, REDUNDANCY).p_value <= 0.01)
    assert np.mean(found) <= 0.05  # 99.9 % point of a share of 1 %


def test_too_few_or_constant_values_are_not_tested():
    assert drift_test(TIME_S[:5], ONES[:5], REDUNDANCY[:5]) is None
    assert drift_test(ONES, ONES, REDUNDANCY) is None


def test_a_daily_cycle_of_a_long_series_is_drift():
    n = 20_000
    daily = 3 * np.sin(2 * np.pi * np.arange(n) / 8640)
    values = daily + np.random.default_rng(12).standard_normal(n)
    result = drift_test(values, np.ones(n), np.full(n, 280.0))
    assert result.p_value < 1e-6


def test_a_warm_up_with_a_gap_is_found():
    rng = np.random.default_rng(15)
    kept = np.delete(np.arange(N), slice(60, 100))
    y = 40 * WARM_UP[kept] + noise(rng, 0, 0)[kept]
    assert drift_test(y, ONES[kept], REDUNDANCY[kept], times=TIME_S[kept]).p_value < 1e-3
    assert slope_p_value(y, WARM_UP[kept], TIME_S[kept]) < 1e-3


def test_a_series_of_prime_length_is_shortened_by_a_few_epochs():
    prime_length = 200_003
    y = np.random.default_rng(1).normal(size=prime_length)
    found = cosines(y)
    n = len(found) + 1
    assert prime_length - 200 < n < prime_length
    assert next_fast_len(n) - n < 2000
    np.testing.assert_allclose(found, dct(y[:n] - y[:n].mean(), norm="ortho")[1:], atol=1e-9)
    assert len(cosines(np.arange(997.0))) == 996  # a short series is not shortened
