"""Fixed weights: one linear step is as good as the fit, up to 0.15 px."""

from __future__ import annotations

import numpy as np
import pytest

from tests.photogrammetry.single_targets import SingleTargets, single_targets
from thermocald.photogrammetry.frame.tracking import GradientWeights
from thermocald.photogrammetry.targets.circle import fit_circles
from thermocald.photogrammetry.targets.frame_status import NoiseModel

NOISE = NoiseModel(4 + 1 / 12)


@pytest.fixture(scope="module")
def targets() -> SingleTargets:
    return single_targets()


@pytest.fixture(scope="module")
def weights(targets) -> GradientWeights:
    frame = targets.frame(None, 0)
    plain = np.zeros(len(targets.true), dtype=bool)
    fit = fit_circles(frame, targets.maps, noise=NOISE)
    return GradientWeights.build(frame, targets.maps, plain, fit.parameters, NOISE)


def test_a_step_is_at_the_bound_and_its_sigmas_are_true(targets, weights):
    rng = np.random.default_rng(31)
    over_bound, over_stated = [], []
    for _ in range(60):
        step = weights.apply(targets.frame(rng, 2.0))
        error = step.parameters[:, :2] - targets.true
        over_bound.append(error / targets.bound(2.0))
        over_stated.append(error / np.sqrt(np.einsum("nii->ni", step.covariances)))
    assert np.sqrt(np.mean(np.square(over_bound))) <= 1.25
    assert 0.95 <= np.sqrt(np.mean(np.square(over_stated))) <= 1.05


@pytest.mark.parametrize("px", [0.03, 0.15])
def test_a_movement_is_found_whole(targets, weights, px):
    """Weights made for targets that stood px away: the step must bring them back."""
    moved = weights.parameters.copy()
    moved[:, :2] += np.array([px, -0.6 * px])
    frame = targets.frame(None, 0)
    plain = np.zeros(len(targets.true), dtype=bool)
    step = GradientWeights.build(frame, targets.maps, plain, moved, NOISE).apply(frame)
    # The third order: 0.15 px leave a thousandth or two of a pixel, 0.03 px nothing.
    assert np.abs(step.parameters[:, :2] - weights.parameters[:, :2]).max() < 0.002


def test_a_change_of_light_moves_nothing(targets, weights):
    frame = np.rint(targets.frame(None, 0) * 0.8 + 10).astype(np.uint8)
    step = weights.apply(frame)
    assert np.abs(step.parameters[:, :2] - weights.parameters[:, :2]).max() < 0.003
    assert step.parameters[:, 7] == pytest.approx(0.8 * weights.parameters[:, 7], rel=0.01)


def test_the_misfit_tells_what_is_in_the_way(targets, weights):
    frame = targets.frame(np.random.default_rng(2), 2.0)
    x, y = np.rint(targets.true[7]).astype(int)
    frame[y - 4 : y + 5, x : x + 8] = 120
    misfit = weights.apply(frame).misfit
    assert misfit[7] > 3
    assert np.delete(misfit, 7).max() < 1.4
