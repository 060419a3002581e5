"""The cosine transform of a long series: of a length with small factors, all but a few epochs."""

from __future__ import annotations

import numpy as np
from scipy.fft import dct

from thermocald.analysis.statistics.noise_models import Frequencies, cosines

PRIME = 200_003


def test_a_prime_length_is_cut_by_a_few_epochs():
    y = np.random.default_rng(1).normal(size=PRIME)
    found = cosines(y)
    n = len(found) + 1
    assert PRIME - 200 < n < PRIME
    for prime in (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31):
        while n % prime == 0:
            n //= prime
    assert n == 1
    whole = y[: len(found) + 1]
    np.testing.assert_allclose(found, dct(whole - whole.mean(), norm="ortho")[1:], atol=1e-9)


def test_a_short_series_is_whole():
    assert len(cosines(np.arange(997.0))) == 996


def test_the_frequencies_are_means_of_what_is_pooled():
    at = Frequencies.of(20_001)
    assert at.count.sum() == 20_000
    every = np.pi * np.arange(1, 20_001) / 20_001
    np.testing.assert_allclose(at.mean, at.sums(every) / at.count, rtol=1e-12)
    assert len(at.mean) < 3001
