"""Correlations from covariances, their medians and their noise."""

import numpy as np
import pytest

from thermocald.analysis.statistics.dependence import correlations_of, median_correlations


def test_correlations_of_a_covariance_with_a_held_parameter():
    covariance = np.array([[[4.0, 3.0, 0.0], [3.0, 9.0, 0.0], [0.0, 0.0, 0.0]]])
    expected = [[[1, 0.5, 0], [0.5, 1, 0], [0, 0, 1]]]
    np.testing.assert_allclose(correlations_of(covariance), expected)


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


def test_no_matrix_at_all_has_no_median():
    assert median_correlations([np.empty((0, 10, 10))]) is None
