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


def read(seed, step=0.0625):
    """Return times, which are uneven, and readings with noise, in steps K."""
    rng = np.random.default_rng(seed)
    t = 10.0 * np.arange(180) + rng.uniform(-1, 1, 180)
    raw = trajectory(t) + rng.normal(0, 0.04, 180)
    return t, np.round(raw / step) * step if step else raw


@pytest.mark.parametrize(
    ("step", "resolution", "accuracy"), [(0.0625, 0.0625, 0.08), (0.0, None, 0.03)]
)
def test_noise_is_seen_through_a_warm_up(step, resolution, accuracy):
    """The one estimate for study, fit and discovery is right to its accuracy, with steps too.

    Of 177 third differences each is known to 12 %; kinks raise it slightly.
    """
    true = np.hypot(0.04, step / np.sqrt(12))
    found = []
    for seed in range(150):
        t, y = read(seed, step)
        t[7] = np.nan  # no reading
        found.append(estimate_reading_noise(t, y, resolution))
    assert np.mean(found) == pytest.approx(true, rel=accuracy)
    constant = estimate_reading_noise(10.0 * np.arange(100), np.full(100, 21.0625), 0.0625)
    assert constant == pytest.approx(0.0625 / np.sqrt(12))


def test_a_smooth_course_is_closer_than_readings_and_uncertain_where_one_is_missing():
    t, y = read(1)
    y[50] = np.nan
    none = np.zeros(len(t), bool)
    c = smooth_channel(t, y, ~none, none, none, 0.0625)
    assert np.std(c.trajectory - trajectory(t)) < 0.7 * np.nanstd(y - trajectory(t))
    assert (c.trajectory + c.deviation)[51:] == pytest.approx(y[51:])
    assert c.deviation[50] == 0.0
    assert c.sd[50] > 2 * c.sd[100]


@pytest.mark.parametrize(("step", "near", "most"), [(10.0, 12, 15), (30.0, 20, 8)])
def test_kinks_between_readings_get_a_latent_instant(step, near, most):
    """At 30 s every interval after a lamp's switch bends by more than noise; switches stand out."""
    t = np.arange(0.0, 1800.0, step)
    noise = np.random.default_rng(2).normal(0, 0.04, len(t))
    latent, _ = find_times_between(t, trajectory(t) + noise, None)
    assert np.abs(latent[:, None] - [200, 805]).min(axis=0).max() < near
    assert len(latent) < most


def test_a_coarse_thermometer_is_read_where_it_changes():
    """Its step shows in its readings, and the errors of its passages are as large as stated."""
    z = []
    for phase in np.arange(0.0, 1.0, 0.05):
        t, y = read(int(20 * phase))
        passages = find_passages(t, np.round(y + phase) - phase, None)
        z.append((passages.values - trajectory(passages.times)) / passages.sd)
    assert 0.55 < np.sqrt(np.mean(np.concatenate(z) ** 2)) < 0.85
    assert find_step(np.round(y), 0.0625) == 1.0
    assert find_step(y, None) < 0.07
    assert find_passages(t, y, 0.0625) is None


def test_the_errors_of_coarse_and_of_held_readings_are_finite():
    """A coarse thermometer with a reading missing; one that holds fine values for two readings."""
    t, y = read(3, 0.0)
    coarse = np.where(np.arange(180) == 50, np.nan, np.round(2.0 * y) / 2.0)
    for values in (coarse, y[(0.6 * np.arange(180)).astype(int)]):
        sd = thermometers(t, {"T": values}, {"T": None})[1]["T"].sd
        assert np.all((sd > 0.0) & (sd < 20.0))


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


def read_seldom(noise):
    """Return times, readings every 30 s of a warm-up, and their thermometer."""
    t = 30.0 * np.arange(15)
    y = trajectory(t + 300.0) + np.random.default_rng(5).normal(0, noise, 15)
    return t, y, thermometers(t, {"T": y}, {"T": None})[1]["T"]


def test_between_sparse_readings_the_temperature_follows_its_curve():
    """Straight lines between readings every 30 s of a warm-up are too low by h²/12 T''."""
    # the sharpest intervals, at the beginning, have unknowns of their own
    (t, y, c), fine = read_seldom(0.001), np.arange(120.0, 420.0, 2.0)
    straight, curved = (
        np.mean(np.interp(fine, *course) - trajectory(fine + 300.0))
        for course in ((t, y), (c.times, c.trajectory))
    )
    assert straight < -0.005
    assert abs(curved) < 0.001
    # 360 s before the first reading, half of what its slope makes of that
    assert c.sd[0] == pytest.approx(0.5 * 360.0 * 20 / 250 * np.exp(-100 / 250), rel=0.1)


def test_on_a_curve_nothing_is_unknown_but_the_readings():
    _, _, c = read_seldom(0.02)
    on_curve = np.setdiff1d(np.arange(len(c.times)), c.erring)
    mixing = c.mixing.toarray()
    weights = mixing[on_curve]
    assert len(on_curve) >= 3 * 9  # the sharpest intervals have unknowns of their own
    assert not mixing[:, on_curve].any()  # which a likelihood need not carry
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
    between = thermometer.between(np.array([20_000.5]), np.zeros(1), 0.0)
    assert between == pytest.approx(0.05 * 0.02 * 2.0, rel=0.01)
