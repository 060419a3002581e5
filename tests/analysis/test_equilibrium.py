"""Drift and time to the steady state, for known exponentials."""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.analysis.online.observer import EquilibriumWatch, fit_approach

GAIN, POSE = np.zeros((3, 6)), np.zeros(6)


@pytest.mark.parametrize("tau", [200.0, 600.0, 2400.0])
def test_drift_now_and_time_to_the_steady_state_have_true_sds(tau):
    """The drift was once that of the middle of the last minutes, 9 sds off."""
    rng = np.random.default_rng(2)
    bound = 0.05 / 60.0
    t = np.arange(60) * 10.0
    now = 6.0 * tau / 300.0 / tau * np.exp(-t[-1] / tau)  # px/s
    truth = tau * np.log(now / bound)
    course = now * tau * np.exp((t[-1] - t) / tau)[:, None] * np.array([1.0, 2.0, -2.0]) / 3.0
    drifts, ready = [], []
    for _ in range(150):
        values = course + rng.normal(0, 0.03, (60, 3))
        speed, sd, ready_in, sd_ready_in, _ = fit_approach(t, values, np.full((60, 3), 0.03), bound)
        drifts.append((speed - now) / sd)
        ready.append((ready_in - truth) / sd_ready_in)
    for errors in (drifts, ready):
        # 150 errors: sd of their RMS 0.06; where the sd differs from fit to fit they are not normal
        assert 0.8 < np.sqrt(np.nanmean(np.square(errors))) < 1.2


def test_a_straight_line_drifts_and_has_no_steady_state():
    rng = np.random.default_rng(5)
    t = np.arange(60) * 10.0
    errors = []
    for _ in range(100):
        values = 0.01 * t[:, None] + rng.normal(0, 0.02, (60, 1))
        speed, sd, ready_in, *_ = fit_approach(t, values, np.full((60, 1), 0.02), 1e-3)
        errors.append((speed - 0.01) / sd)
    assert np.isnan(ready_in)
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.25


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
    truth = 60.0 * 3.0 / 400.0 * np.exp(-590.0 / 400.0)
    assert warming.drift == pytest.approx(truth, abs=3.0 * warming.sd_drift)
    assert warming.sd_drift < 0.1 * truth
    assert "ready in about" in warming.sentence
    assert watch(lambda t: np.zeros(3), epochs=4).assess(POSE).state == "unknown"


def test_a_held_parameter_does_not_count():
    made = EquilibriumWatch()
    for k in range(30):
        values, sds = np.array([np.nan, 0.0, 0.0]), np.array([np.nan, 0.01, 0.01])
        made.add(10.0 * k, values, GAIN, sds)
    assert made.assess(POSE).state == "ready"


def test_memory_at_5_hz_is_bounded():
    """The watch once went through 14,400 epochs at every epoch."""
    rng = np.random.default_rng(4)
    quick, seldom = EquilibriumWatch(), EquilibriumWatch()
    for k in range(5 * 800):
        time = 0.2 * k
        values = np.array([1.0, 2.0, -2.0]) * np.exp(-time / 600.0) + rng.normal(0, 0.02, 3)
        quick.add(time, values, GAIN, np.full(3, 0.02))
        if k % 50 == 0:
            seldom.add(time, values, GAIN, np.full(3, 0.02))
    assert len(quick._past) <= 4 * 180 + 1
    found, rough = quick.assess(POSE), seldom.assess(POSE)
    assert found.state == "drifting"
    assert found.drift == pytest.approx(rough.drift, abs=3.0 * rough.sd_drift)
    assert found.sd_drift < 0.3 * rough.sd_drift  # all 50 times as many epochs count
