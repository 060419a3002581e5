"""The mock thermometer: programme, lag, offset, noise, quantisation, all seeded."""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.hal import VirtualClock, open_device


def read(times, **options):
    """Return the readings of all channels at times of a new clock, {channel: (n,)}."""
    clock, rows = VirtualClock(), []
    with open_device("thermometer", "mock", {"conversion_s": 0.0, **options}, clock) as device:
        for time in times:
            clock.sleep_until(time)
            rows.append(device.read().values)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def test_lag_offset_gain_and_quantisation():
    deviations = {"plain": {}, "off": {"offset_k": 1.5}, "board": {"gain": 2.0},
                  "coarse": {"resolution_k": 0.5}, "slow": {"lag_s": 40.0}}  # fmt: skip
    quiet = {"noise_k": 0.0, "resolution_k": 0.0}
    channels = {name: {**quiet, **own} for name, own in deviations.items()}
    times = np.arange(0, 100, 7.0)
    found = read(times, programme=[[0, 20], [100, 30]], channels=channels)
    behind = 4.0 * (1 - np.exp(-times / 40.0))  # of a ramp of 0.1 K/s
    assert found["slow"] == pytest.approx(found["plain"] - behind, abs=1e-6)
    assert found["off"] == pytest.approx(found["plain"] + 1.5)
    assert found["board"] == pytest.approx(20 + 2 * (found["plain"] - 20))
    assert np.array_equal(found["coarse"], np.round(found["plain"] * 2) / 2)


def test_noise_has_the_stated_size_and_is_seeded():
    channels = {"a": {"noise_k": 0.05, "resolution_k": 0}, "b": {"noise_k": 0.05}}
    options = {"programme": [[0, 25]], "channels": channels, "seed": 4}
    times = np.arange(1000.0)
    first = read(times, **options)
    assert first["a"].std() == pytest.approx(0.05, rel=0.1)  # 4.5 sds
    assert abs(first["a"].mean() - 25) < 4 * 0.05 / np.sqrt(1000)
    assert abs(np.corrcoef(first["a"], first["b"])[0, 1]) < 0.16
    # the noise depends on the time, not on the number of earlier readings
    assert np.array_equal(first["a"][::2], read(times[::2], **options)["a"])
    assert not np.array_equal(first["a"], read(times, **options | {"seed": 5})["a"])
