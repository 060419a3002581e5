"""The mock thermometer: programme, lag, offset, noise, quantisation, all seeded."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from thermocald.hal import VirtualClock, open_device

QUIET = {"noise_k": 0.0, "resolution_k": 0.0}


def read(options, times):
    """Return the readings of all channels at times of a new clock, {channel: (n,)}."""
    clock = VirtualClock()
    rows = []
    with open_device("thermometer", "mock", {"conversion_s": 0.0, **options}, clock) as device:
        for time in times:
            clock.sleep_until(time)
            rows.append(device.read().values)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def test_lag_against_the_differential_equation():
    times, values, lag = np.array([0.0, 100.0, 250.0]), np.array([20.0, 50.0, 30.0]), 40.0
    instants = np.linspace(0, 600, 61)
    solved = solve_ivp(
        lambda t, y: (np.interp(t, times, values) - y) / lag,
        (0, 600),
        [20.0],
        t_eval=instants,
        rtol=1e-10,
        atol=1e-10,
        max_step=5.0,
    )
    programme = np.stack([times, values], 1).tolist()
    options = {"programme": programme, "channels": {"t": {**QUIET, "lag_s": lag}}}
    assert read(options, instants)["t"] == pytest.approx(solved.y[0], abs=1e-6)


def test_offset_gain_and_quantisation():
    channels = {
        "plain": QUIET,
        "off": {**QUIET, "offset_k": 1.5},
        "board": {**QUIET, "gain": 2.0},
        "coarse": {"noise_k": 0.0, "resolution_k": 0.5},
    }
    found = read({"programme": [[0, 20], [100, 30]], "channels": channels}, np.arange(0, 100, 7.0))
    assert found["off"] == pytest.approx(found["plain"] + 1.5)
    assert found["board"] == pytest.approx(20 + 2 * (found["plain"] - 20))
    assert np.array_equal(found["coarse"], np.round(found["plain"] * 2) / 2)


def test_noise_has_the_stated_size_and_is_seeded():
    options = {
        "programme": [[0, 25]],
        "channels": {"a": {"noise_k": 0.05, "resolution_k": 0}, "b": {"noise_k": 0.05}},
        "seed": 4,
    }
    times = np.arange(1000.0)
    first = read(options, times)
    assert first["a"].std() == pytest.approx(0.05, rel=0.1)  # 4.5 sds
    assert abs(first["a"].mean() - 25) < 4 * 0.05 / np.sqrt(1000)
    assert abs(np.corrcoef(first["a"], first["b"])[0, 1]) < 0.16
    assert np.array_equal(first["a"], read(options, times)["a"])
    # the noise depends on the time, not on the number of earlier readings
    assert np.array_equal(first["a"][::2], read(options, times[::2])["a"])
    assert not np.array_equal(first["a"], read({**options, "seed": 5}, times)["a"])
