"""The noise of single targets: its estimation, and its effect on the test of a point."""

import numpy as np
import pytest

from thermocald.photogrammetry.epoch.gauss_markov import limit_2d
from thermocald.photogrammetry.series.target_noise import noise_ratios

TARGETS = 150
ALPHA = 0.002


def drawn(rng, epochs, spread):
    """Draw residuals, weights and true variances of targets whose sds vary by exp(spread z)."""
    true = np.exp(2.0 * spread * rng.standard_normal(TARGETS))
    noise = np.sqrt(true)[:, None] * rng.standard_normal((epochs, TARGETS, 2))
    weights = np.ones((epochs, TARGETS, 3))
    return noise, weights, np.ones((epochs, TARGETS), dtype=bool), true


@pytest.mark.parametrize(
    ("epochs", "spread", "lost"),
    [(10, 0.8, 0), (100, 0.3, 0), (4, 0.0, 1), (4, 0.8, 1), (9, 0.0, 1)],
)
def test_as_many_good_points_fail_as_stated(epochs, spread, lost):
    """The targets' noise is from the first epochs; `lost` of them are used up by offsets.

    Medians of few epochs have cautious weights; targets of equal noise hardly differ.
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
    share = outside / tried
    assert share < 1.35 * ALPHA
    assert share > 0.5 * ALPHA or epochs < 100
    assert spread > 0 or np.mean(scatter) < 0.1  # from single targets 0.45


def test_neither_jumps_nor_a_target_seen_once_change_the_noise():
    residuals, weights, used, _ = drawn(np.random.default_rng(8), 40, 0.3)
    before, _ = noise_ratios(residuals, weights, used, 1.0)
    residuals[3, :, 0] += 50.0
    used[1:, 0] = False
    after, _ = noise_ratios(residuals, weights, used, 1.0)
    assert np.median(np.abs(after / before - 1.0)) < 0.2
    assert after[0] == pytest.approx(np.exp(np.log(before).mean(axis=0)), rel=0.5)
