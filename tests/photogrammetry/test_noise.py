"""Noise that grows with the light is found in residuals, gross errors notwithstanding."""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.photogrammetry.targets.frame_status import NoiseModel, estimate_noise


def _residuals(floor: float, gain: float, rng: np.random.Generator):
    grey = rng.choice([40.0, 80.0, 120.0, 190.0], 40_000)
    r = rng.normal(0, np.sqrt(floor + gain * grey))
    r[rng.random(len(r)) < 0.02] *= 30
    return grey, r


@pytest.mark.parametrize(("floor", "gain"), [(4.0, 0.0), (1.0, 0.05), (0.5, 0.1)])
def test_variance_is_a_line_in_the_grey_value(floor, gain):
    model = estimate_noise(*_residuals(floor, gain, np.random.default_rng(1)))
    for grey in (40.0, 190.0):
        true = floor + gain * grey
        # The variance of 8,000 residuals in a bin or two is known to some 4 %.
        assert float(model.variance(np.array(grey))) == pytest.approx(true, rel=0.08)


def test_unknowns_are_made_up_for():
    rng = np.random.default_rng(2)
    grey, r = np.full(5000, 100.0), rng.normal(0, 2, 5000)
    assert estimate_noise(grey, r, 1000).floor == pytest.approx(5.0, rel=0.06)


def test_too_few_residuals_give_a_constant():
    assert estimate_noise(np.full(10, 50.0), np.full(10, 2.0)) == NoiseModel(4.0)
    assert estimate_noise(np.zeros(0), np.zeros(0)).floor > 0
