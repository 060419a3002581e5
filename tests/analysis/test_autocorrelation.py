"""How many independent values a series is worth: against the theory of autoregressive noise."""

import numpy as np
import pytest
from scipy import signal

from thermocald.analysis.statistics.autocorrelation import noise_autocorrelation


def test_white_noise_counts_fully():
    rng = np.random.default_rng(1)
    found = [noise_autocorrelation(rng.standard_normal(1500)).n_effective for _ in range(20)]
    assert np.median(found) > 0.9 * 1500


@pytest.mark.parametrize("phi", [0.6, 0.9])
def test_mean_of_autoregressive_noise(phi):
    """Its variance is (1 + phi)/(1 - phi) times that of white noise."""
    rng = np.random.default_rng(2)
    n = 4000
    found = []
    for _ in range(20):
        series = np.asarray(signal.lfilter([1], [1, -phi], rng.standard_normal(n + 300)))[300:]
        found.append(noise_autocorrelation(series).n_effective)
    assert np.median(found) == pytest.approx(n * (1 - phi) / (1 + phi), rel=0.25)


def test_long_series_pool_frequencies_without_changing_the_answer():
    rng = np.random.default_rng(3)
    series = np.asarray(signal.lfilter([1], [1, -0.9], rng.standard_normal(200_000)))
    found = noise_autocorrelation(series, np.cumsum(rng.standard_normal(200_000)))
    assert found.phi == pytest.approx(0.9, abs=0.06)
    assert found.n_effective == pytest.approx(200_000 / 19, rel=0.4)
