"""Drift and time to the steady state, for known exponentials."""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.analysis.online.equilibrium import EquilibriumWatch, fit_approach, slope

GAIN, POSE = np.zeros((3, 6)), np.zeros(6)


def test_the_sd_of_a_slope_is_true():
    rng = np.random.default_rng(1)
    t = np.arange(30) * 10.0
    deviations = []
    for _ in range(2000):
        values = 0.01 * t + rng.normal(0, 0.05, 30)
        found, sd = slope(t, values[:, None], np.full((30, 1), 0.05))
        deviations.append((found[0] - 0.01) / sd[0])
    # sds are scaled up for large residuals but never down, so they are slightly conservative
    assert 0.85 < np.std(deviations) < 1.03


def test_the_time_to_the_steady_state_is_within_its_sds():
    rng = np.random.default_rng(2)
    tau, size, bound = 300.0, 8.0, 0.05 / 60.0
    t = np.arange(60) * 10.0
    truth = tau * np.log(size / tau * np.exp(-t[-1] / tau) / bound)
    found = []
    for _ in range(200):
        values = size * np.exp(-t / tau) + rng.normal(0, 0.03, 60)
        approach = fit_approach(t, values, np.full(60, 0.03), bound)
        assert approach is not None
        found.append(approach[:2])
    ready, sds = np.array(found).T
    off = (ready - truth) / sds
    assert abs(ready.mean() - truth) < 0.05 * truth
    assert np.mean(np.abs(off) < 2.0) > 0.9
    assert 0.5 < ready.std() / sds.mean() < 1.5


def test_a_straight_line_has_no_steady_state():
    t = np.arange(60) * 10.0
    assert fit_approach(t, 0.01 * t, np.full(60, 0.02), 1e-3) is None


def watch(values_of, epochs: int = 60, noise: float = 0.02) -> EquilibriumWatch:
    rng = np.random.default_rng(3)
    made = EquilibriumWatch()
    for k in range(epochs):
        values = values_of(10.0 * k) + rng.normal(0, noise, 3)
        made.add(10.0 * k, values, GAIN, np.full(3, noise))
    return made


def test_a_warm_camera_is_ready_and_a_warming_one_drifts():
    steady = watch(lambda t: np.zeros(3)).assess(POSE)
    assert steady.state == "ready"
    warming = watch(lambda t: np.array([1.0, 2.0, -2.0]) * np.exp(-t / 400.0)).assess(POSE)
    assert warming.state == "drifting"
    truth = 60.0 * 3.0 / 400.0 * np.exp(-500.0 / 400.0)  # at the middle of the last 3 min
    assert warming.drift == pytest.approx(truth, rel=0.15)
    assert "ready in about" in warming.sentence
    assert watch(lambda t: np.zeros(3), epochs=4).assess(POSE).state == "unknown"


def test_a_held_parameter_does_not_count():
    made = EquilibriumWatch()
    for k in range(30):
        values, sds = np.array([np.nan, 0.0, 0.0]), np.array([np.nan, 0.01, 0.01])
        made.add(10.0 * k, values, GAIN, sds)
    assert made.assess(POSE).state == "ready"


def test_memory_at_20_hz_is_bounded():
    """The watch once went through 14,400 epochs at every epoch."""
    rng = np.random.default_rng(4)
    quick, seldom = EquilibriumWatch(), EquilibriumWatch()
    for k in range(20 * 900):
        time = 0.05 * k
        values = np.array([1.0, 2.0, -2.0]) * np.exp(-time / 400.0) + rng.normal(0, 0.02, 3)
        quick.add(time, values, GAIN, np.full(3, 0.02))
        if k % 200 == 0:
            seldom.add(time, values, GAIN, np.full(3, 0.02))
    assert len(quick._past) <= 4 * 180 + 1
    found, rough = quick.assess(POSE), seldom.assess(POSE)
    assert found.state == "drifting"
    assert found.drift == pytest.approx(rough.drift, abs=3.0 * rough.sd_drift)
    assert found.sd_drift < 0.3 * rough.sd_drift  # all 200 times as many epochs count
