"""The sd of a slope under noise with a memory, and how many values a series is worth."""

import numpy as np
import pytest
from scipy import signal

from tests.analysis.test_drift_test import noise
from thermocald.analysis.statistics.dependence import slope_noise

N = 150
WARM_UP = 1 - np.exp(-np.arange(N) / 30)
UP_AND_DOWN = np.where(np.arange(N) < 75, WARM_UP, WARM_UP[75] * np.exp(-(np.arange(N) - 75) / 30))


def slope(y, x):
    x = x - x.mean()
    return float(x @ y / (x @ x))


def error_over_sd(x, coloured, phi, draws, seed, thermometer=0.0):
    rng = np.random.default_rng(seed)
    off = []
    for _ in range(draws):
        y = noise(rng, coloured, phi, len(x))
        read = x + thermometer * rng.standard_normal(len(x))
        b = slope(y, read)
        off.append(b / slope_noise(y, read, b, thermometer).sd)
    return float(np.sqrt(np.mean(np.square(off))))


@pytest.mark.slow
@pytest.mark.parametrize("x", [WARM_UP, UP_AND_DOWN], ids=["warm-up", "up and down"])
@pytest.mark.parametrize(
    ("coloured", "phi"), [(0.0, 0.0), (1.0, 0.5), (1.0, 0.9), (0.5, 0.8), (0.5, 0.97)]
)
def test_errors_of_the_slope_are_as_large_as_its_sd(x, coloured, phi):
    """150 epochs; 400 draws, whose ratio is known to 4 %, under slow noise to 8 % (1.5 before)."""
    assert 0.75 < error_over_sd(x, coloured, phi, 400, 2) < 1.2


def test_a_thermometer_whose_noise_is_an_eighth_of_the_rise():
    assert 0.65 < error_over_sd(WARM_UP, 0.0, 0.0, 400, 4, 0.125) < 1.1


def test_where_the_memory_is_long_against_the_series_it_says_so():
    rng = np.random.default_rng(5)
    short = [slope_noise(noise(rng, 1.0, 0.99), WARM_UP, 0.0).too_short for _ in range(40)]
    white = [slope_noise(noise(rng, 0.0, 0.0), WARM_UP, 0.0).too_short for _ in range(40)]
    assert np.mean(short) > 0.5
    assert not any(white)


def test_white_noise_counts_fully():
    rng = np.random.default_rng(1)
    x = np.arange(1500.0)
    found = []
    for _ in range(20):
        y = rng.standard_normal(1500)
        found.append(slope_noise(y, x, slope(y, x)).n_effective)
    assert np.median(found) > 0.8 * 1500


@pytest.mark.parametrize("phi", [0.6, 0.9])
def test_slow_variations_of_x_under_autoregressive_noise(phi):
    """Their variance is (1 + phi)/(1 - phi) times that of white noise."""
    rng = np.random.default_rng(2)
    n = 4000
    x = np.sin(2 * np.pi * np.arange(n) / n)
    found = []
    for _ in range(20):
        y = np.asarray(signal.lfilter([1], [1, -phi], rng.standard_normal(n + 300)))[300:]
        found.append(slope_noise(y, x, slope(y, x)).n_effective)
    assert np.median(found) == pytest.approx(n * (1 - phi) / (1 + phi), rel=0.3)


def test_long_series_pool_frequencies_without_changing_the_answer():
    rng = np.random.default_rng(3)
    y = np.asarray(signal.lfilter([1], [1, -0.9], rng.standard_normal(200_000)))
    x = np.cumsum(rng.standard_normal(200_000))
    found = slope_noise(y, x, slope(y, x))
    assert found.n_effective == pytest.approx(200_000 / 19, rel=0.4)
    assert found.lag_one == pytest.approx(0.9, abs=0.06)
