"""The noise of single targets: how far it is believed, and what the test of a point makes of it."""

import numpy as np
import pytest
from scipy import stats

from thermocald.photogrammetry.epoch.snooping import limit_2d
from thermocald.photogrammetry.series.target_noise import correlated_pairs, noise_ratios

TARGETS = 150


def drawn(rng, epochs, spread):
    """Residuals and weights of targets whose standard deviations scatter by exp(spread z)."""
    true = np.exp(2.0 * spread * rng.standard_normal(TARGETS))
    noise = np.sqrt(true)[:, None] * rng.standard_normal((epochs, TARGETS, 2))
    weights = np.ones((epochs, TARGETS, 3))
    return noise, weights, np.ones((epochs, TARGETS), dtype=bool), true


@pytest.mark.parametrize("freedom", [5.0, 30.0, 1000.0])
@pytest.mark.parametrize("alpha", [0.01, 0.0005])
def test_the_limit_is_the_quantile_of_f(freedom, alpha):
    expected = 2.0 * stats.f.isf(alpha, 2, freedom)
    np.testing.assert_allclose(limit_2d(alpha, np.array([1.0 / freedom])), expected, rtol=1e-9)


def test_targets_measured_alike_are_not_told_apart_by_chance():
    rng = np.random.default_rng(5)
    ratio, freedom = noise_ratios(*drawn(rng, 10, 0.0)[:3], 1.0)
    assert np.std(np.log(ratio)) < 0.1  # of single targets: 0.45
    assert freedom.min() > 100


@pytest.mark.parametrize("epochs", [10, 20, 100])
@pytest.mark.parametrize("spread", [0.0, 0.3, 0.8])
def test_as_many_good_points_fail_as_stated(epochs, spread):
    """Points of further epochs, tested with what the first ones showed of each target.

    Medians of few epochs are believed less than they could be: no more than stated, then.
    """
    alpha, outside, tried = 0.002, 0, 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        residuals, weights, used, true = drawn(rng, epochs, spread)
        ratio, freedom = noise_ratios(residuals, weights, used, 1.0)
        further = np.sqrt(true)[:, None] * rng.standard_normal((10, TARGETS, 2))
        tests = (further**2 / ratio).sum(axis=2)
        outside += int((tests > limit_2d(alpha, 1.0 / freedom)).sum())
        tried += tests.size
    assert outside / tried < 1.35 * alpha
    assert outside / tried > 0.5 * alpha or epochs < 100


def test_a_few_jumps_do_not_raise_a_targets_noise():
    rng = np.random.default_rng(8)
    residuals, weights, used, _ = drawn(rng, 40, 0.3)
    before, _ = noise_ratios(residuals, weights, used, 1.0)
    residuals[3, :, 0] += 50.0
    after, _ = noise_ratios(residuals, weights, used, 1.0)
    assert np.median(np.abs(after / before - 1.0)) < 0.2


def corners(rng, epochs, markers, correlation, unknowns):
    """Residuals of markers' corners, and of coordinates that err together how much they do.

    Two corners correlate along the edge that they share; unknowns: of each epoch, adjusted before.
    """
    T = 4 * markers
    error = rng.standard_normal((epochs, T, 2))
    for axis, first, second in ((0, 0, 1), (0, 2, 3), (1, 1, 2), (1, 3, 0)):
        error[:, second::4, axis] *= np.sqrt(1.0 - correlation**2)
        error[:, second::4, axis] += correlation * error[:, first::4, axis]
    flat = error.reshape(epochs, -1)
    base, _ = np.linalg.qr(rng.standard_normal((2 * T, unknowns)))
    left = flat - flat @ base @ base.T
    share = 1.0 - unknowns / (2 * T)
    used = np.ones((epochs, T), dtype=bool)
    return left.reshape(error.shape), used, np.arange(T) // 4, share


@pytest.mark.parametrize("epochs", [10, 20, 39])
@pytest.mark.parametrize("markers", [3, 8, 35])
def test_corners_that_err_by_themselves_are_not_said_to_err_together(epochs, markers):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        assert len(correlated_pairs(*corners(rng, epochs, markers, 0.0, 14))) == 0


@pytest.mark.parametrize("epochs", [10, 20, 60])
def test_few_epochs_show_that_corners_err_together(epochs):
    """A marker's shift then varies by 0.3 of what independent corners leave.

    Less is taken off than could be: n - 1 of n for the mean, and what few epochs leave unsure.
    """
    found = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        residuals, used, group, share = corners(rng, epochs, 35, -0.7, 14)
        pairs = correlated_pairs(residuals, used, group, share)
        mean = np.zeros((len(group), 2, 1))
        mean[:, 0] = 1.0  # a shift in x, of every corner
        weights = np.ones((1, len(group), 3))
        found.append(1.0 + pairs.normal_matrices(weights, mean).item() / len(group))
    np.testing.assert_allclose(np.mean(found), 1.0 - 0.7 * (1.0 - 1.0 / epochs), atol=0.06)
