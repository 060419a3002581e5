"""The noise of single targets: its estimation, and its effect on the test of a point."""

import numpy as np
import pytest
from scipy.special import fdtrc

from thermocald.photogrammetry.epoch.snooping import limit_2d
from thermocald.photogrammetry.series.target_noise import neighbours_variance, noise_ratios

TARGETS = 150
ALPHA = 0.002


def drawn(rng, epochs, spread):
    """Draw residuals, weights and true variances of targets whose sds vary by exp(spread z)."""
    true = np.exp(2.0 * spread * rng.standard_normal(TARGETS))
    noise = np.sqrt(true)[:, None] * rng.standard_normal((epochs, TARGETS, 2))
    weights = np.ones((epochs, TARGETS, 3))
    return noise, weights, np.ones((epochs, TARGETS), dtype=bool), true


@pytest.mark.parametrize("alpha", [0.01, 0.0005])
def test_the_limit_is_the_quantile_of_f(alpha):
    freedom = np.array([5.0, 30.0, 1000.0])
    exceeded = fdtrc(2, freedom, limit_2d(alpha, 1.0 / freedom) / 2.0)
    np.testing.assert_allclose(exceeded, alpha, rtol=1e-9)


def failing(epochs, spread, lost):
    """Return the share of good points in further epochs that fail the test, and sd of ln noise.

    The targets' noise is from the first epochs; `lost` of them are used up by offsets.
    """
    outside, tried, scatter = 0, 0, []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        residuals, weights, used, true = drawn(rng, epochs, spread)
        residuals -= residuals.mean(axis=0) * lost
        ratio, freedom = noise_ratios(residuals, weights, used, 1.0, lost)
        scatter.append(np.log(ratio).std())
        further = np.sqrt(true)[:, None] * rng.standard_normal((10, TARGETS, 2))
        tests = (further**2 / ratio).sum(axis=2)
        outside += int((tests > limit_2d(ALPHA, 1.0 / freedom)).sum())
        tried += tests.size
    return outside / tried, np.mean(scatter)


@pytest.mark.parametrize(
    ("epochs", "spread", "lost"),
    [(10, 0.8, 0), (100, 0.3, 0), (4, 0.0, 1), (4, 0.8, 1), (9, 0.0, 1)],
)
def test_as_many_good_points_fail_as_stated(epochs, spread, lost):
    """Medians of few epochs have cautious weights; targets of equal noise hardly differ."""
    share, scatter = failing(epochs, spread, lost)
    assert share < 1.35 * ALPHA
    assert share > 0.5 * ALPHA or epochs < 100
    assert spread > 0 or scatter < 0.1  # from single targets 0.45


def test_a_target_seen_once_has_the_noise_of_the_others():
    residuals, weights, used, _ = drawn(np.random.default_rng(3), 6, 0.5)
    used[1:, 0] = False
    ratio, freedom = noise_ratios(residuals, weights, used, 1.0, 1)
    assert ratio[0] == pytest.approx(np.exp(np.log(ratio).mean(axis=0)), rel=0.5)
    assert freedom[0] == pytest.approx(freedom[1] - 5.0)


def test_a_few_jumps_do_not_raise_a_targets_noise():
    rng = np.random.default_rng(8)
    residuals, weights, used, _ = drawn(rng, 40, 0.3)
    before, _ = noise_ratios(residuals, weights, used, 1.0)
    residuals[3, :, 0] += 50.0
    after, _ = noise_ratios(residuals, weights, used, 1.0)
    assert np.median(np.abs(after / before - 1.0)) < 0.2


def test_the_noise_of_neighbours_follows_slow_changes_and_no_single_epoch():
    unit = np.concatenate([np.ones(30), np.linspace(1.0, 6.0, 50), np.full(20, 40.0)])
    unit[[10, 60, 0]] = 500.0
    all_count = np.ones(100, dtype=bool)
    about = neighbours_variance(unit, all_count)
    assert about[10] == about[0] == 1.0
    assert about[60] == pytest.approx(np.median(unit[53:68]))
    assert about[-1] == 9.0  # three times the noise is the limit
    some = all_count.copy()
    some[20:40] = False
    assert neighbours_variance(unit, some)[30] == 1.0
    assert (neighbours_variance(np.full(9, 5.0), all_count[:9]) == 1.0).all()
