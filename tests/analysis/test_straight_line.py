"""York's fit against the published solution of Pearson's data with York's weights."""

import numpy as np
import pytest

from thermocald.analysis.statistics.dependence import fit_straight_line

# Pearson (1901) with the weights of York (1966); solution in York et al. (2004), table II.
X = np.array([0.0, 0.9, 1.8, 2.6, 3.3, 4.4, 5.2, 6.1, 6.5, 7.4])
Y = np.array([5.9, 5.4, 4.4, 4.6, 3.5, 3.7, 2.8, 2.8, 2.4, 1.5])
WX = np.array([1000, 1000, 500, 800, 200, 80, 60, 20, 1.8, 1.0])
WY = np.array([1, 1.8, 4, 8, 20, 20, 70, 70, 100, 500])


def test_pearsons_data_with_yorks_weights():
    slope, sd_slope, chi2 = fit_straight_line(X, Y, 1 / np.sqrt(WX), 1 / np.sqrt(WY))
    assert slope == pytest.approx(-0.480533407, abs=5e-9)
    assert chi2 == pytest.approx(11.8663532, abs=5e-7)
    assert sd_slope == pytest.approx(0.0579850, abs=5e-6)


def test_without_noise_in_x_it_is_least_squares():
    rng = np.random.default_rng(1)
    x = rng.uniform(20, 40, 50)
    y = 3 - 0.2 * x + 0.1 * rng.standard_normal(50)
    slope, sd_slope, _ = fit_straight_line(x, y, 0.0, 0.1)
    expected, covariance = np.polyfit(x, y, 1, w=np.full(50, 10.0), cov="unscaled")
    assert slope == pytest.approx(expected[0])
    assert sd_slope == pytest.approx(np.sqrt(covariance[0, 0]), rel=1e-6)


def test_constant_x_is_refused():
    with pytest.raises(ValueError, match="x that varies"):
        fit_straight_line(np.full(5, 20.0), np.arange(5.0), 0.1, 0.1)
