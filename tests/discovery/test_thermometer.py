"""The thermometer's noise from its readings, and its smooth trajectory."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.sparse import csr_array

from thermocald.thermal.thermometer import (
    Thermometer,
    estimate_reading_noise,
    find_passages,
    find_step,
    find_times_between,
    smooth_channel,
    thermometers,
)


def trajectory(t):
    """The temperature (t,) of a body with a time constant of 250 s that two lamps heat."""
    up = 20 * (1 - np.exp(-np.maximum(t - 200, 0) / 250))
    down = 20 * (1 - np.exp(-np.maximum(t - 805, 0) / 250))
    return 21 + up - down


def read(seed):
    """Return times, which are uneven, and readings with noise and quantisation."""
    rng = np.random.default_rng(seed)
    t = 10.0 * np.arange(180) + rng.uniform(-1, 1, 180)
    raw = trajectory(t) + rng.normal(0, 0.04, 180)
    return t, np.round(raw / 0.0625) * 0.0625


@pytest.fixture
def readings():
    return read(1)


def test_noise_with_quantisation():
    true = np.hypot(0.04, 0.0625 / np.sqrt(12))
    noises = [estimate_reading_noise(*read(seed), 0.0625) for seed in range(40)]
    # 177 correlated third differences: 12 % each, so 2 % for the mean; kinks raise it slightly
    assert np.mean(noises) == pytest.approx(true, rel=0.08)


def test_a_coarse_thermometer_is_read_where_it_changes():
    """Its step shows in its readings, and the errors of its passages are as large as stated."""
    z = []
    for phase in np.arange(0.0, 1.0, 0.05):
        t, y = read(int(20 * phase))
        passages = find_passages(t, np.round(y + phase) - phase, None)
        z.append((passages.values - trajectory(passages.times)) / passages.sd)
    assert 0.5 < np.sqrt(np.mean(np.concatenate(z) ** 2)) < 1.1
    assert find_step(np.round(y), 0.0625) == 1.0
    assert find_step(y, None) < 0.07
    assert find_passages(t, y, 0.0625) is None


def test_a_step_is_not_better_than_itself():
    noise = estimate_reading_noise(10.0 * np.arange(100), np.full(100, 21.0625), 0.0625)
    assert noise == pytest.approx(0.0625 / np.sqrt(12))


@pytest.mark.parametrize("interval", [10.0, 30.0])
def test_kinks_get_a_latent_instant(interval):
    """At 30 s every interval after a lamp's switch bends by more than noise; switches stand out."""
    t = interval * np.arange(1800 / interval)
    y = trajectory(t) + np.random.default_rng(2).normal(0, 0.04, len(t))
    latent, curved = find_times_between(t, y, None)
    assert np.min(np.abs(latent - 200)) < 20
    assert np.min(np.abs(latent - 805)) < 20
    assert len(latent) < 15
    assert (len(curved) > 0) == (interval > 10.0)  # frequent readings need no curve


def smoothed(t, y):
    """Smooth readings as of an instrument that is unknown between two of them."""
    none = np.zeros(len(t), bool)
    return smooth_channel(t, y, ~none, none, none, 0.0625)


def test_course_is_closer_than_readings(readings):
    t, y = readings
    c = smoothed(t, y)
    assert np.std(c.trajectory - trajectory(t)) < 0.7 * np.std(y - trajectory(t))
    assert c.trajectory + c.deviation == pytest.approx(y)


def test_a_missing_reading_is_uncertain(readings):
    t, y = readings
    y = y.copy()
    y[50] = np.nan
    c = smoothed(t, y)
    assert c.deviation[50] == 0.0
    assert c.sd[50] > 2 * c.sd[100]


def test_noise_is_seen_through_a_warm_up():
    """The one estimate for study, fit and discovery is right to its accuracy of 3 %."""
    rng = np.random.default_rng(4)
    t = 10.0 * np.arange(150)
    warm = 25 + 12 * (1 - np.exp(-t / 400.0))
    noisy = [warm + 0.05 * rng.standard_normal(150) for _ in range(200)]
    found = [estimate_reading_noise(t, readings, None) for readings in noisy]
    assert np.mean(found) == pytest.approx(0.05, rel=0.03)


def test_a_reading_without_a_time_is_no_reading():
    t = 10.0 * np.arange(400)
    y = np.random.default_rng(0).normal(20, 0.05, 400)
    t[7] = np.nan
    assert estimate_reading_noise(t, y, None) == pytest.approx(0.05, rel=0.2)


def test_the_noise_of_twenty_readings_with_two_kinks():
    """Up to eight of seventeen third differences include a kink and not only noise."""
    found = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        t = rng.uniform(0, 60) + 60.0 * np.arange(20)
        kinked = 20 + 0.05 * np.clip(t - 200, 0, 600)
        found.append(estimate_reading_noise(t, kinked + rng.normal(0, 0.05, 20), None))
    assert 0.04 < np.median(found) < 0.09
    assert np.mean(np.array(found) > 0.2) < 0.1


def test_between_sparse_readings_the_temperature_follows_its_curve():
    """Straight lines between readings every 30 s of a warm-up are too low by h²/12 T''."""
    # the sharpest intervals, at the beginning, have unknowns of their own
    t, fine = 30.0 * np.arange(15), np.arange(120.0, 420.0, 2.0)
    y = trajectory(t + 300.0) + np.random.default_rng(5).normal(0, 0.001, 15)
    c = thermometers(t, {"T": y}, {"T": None})[1]["T"]
    straight = np.interp(fine, t, y) - trajectory(fine + 300.0)
    curved = np.interp(fine, c.times, c.trajectory) - trajectory(fine + 300.0)
    assert np.mean(straight) < -0.005
    assert abs(np.mean(curved)) < 0.001


def test_on_a_curve_nothing_is_unknown_but_the_readings():
    t = 30.0 * np.arange(15)
    y = trajectory(t + 300.0) + np.random.default_rng(5).normal(0, 0.02, 15)
    c = thermometers(t, {"T": y}, {"T": None})[1]["T"]
    on_curve = c.mixing.diagonal() == 0
    weights = c.mixing.toarray()[on_curve]
    assert on_curve.sum() >= 3 * 9  # the sharpest intervals have unknowns of their own
    assert weights[:, c.real].sum(axis=1) == pytest.approx(1.0)
    assert not weights[:, ~c.real].any()
    # as accurate as a reading, except at the ends, with two neighbours on one side
    assert np.linalg.norm(weights, axis=1).max() < 1.1


def test_jumps_of_a_long_series_need_no_matrix_of_frames_and_readings():
    t = 2.0 * np.arange(20_000)
    T = 20.0 + 0.02 * np.maximum(t - 20_001.0, 0.0)  # a lamp, between two readings
    zero, real = np.zeros(len(t)), np.ones(len(t), dtype=bool)
    thermometer = Thermometer(t, T, zero, zero, csr_array((1, 1)), real, 1e-4)
    frames = 5.0 * np.arange(8_000)
    tracemalloc.start()
    jump = thermometer.slope_jump(frames)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6
    assert frames[jump > 0].tolist() == [20_000.0, 20_005.0]
    assert jump.max() == pytest.approx(0.01, rel=0.01)
