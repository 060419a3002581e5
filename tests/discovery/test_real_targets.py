"""Real image points: markers whose corners err together, boards hidden now and then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermocald.discovery.result import discover_series
from thermocald.errors import DataError
from thermocald.store.recording.reader import read_recording
from thermocald.thermal.reduce import reduce_series
from thermocald.thermal.source import series_input

CAMERAS = ("aviary-cam0", "aviary-cam1", "aviary-cam2", "aviary-cam6")


def with_temperature(shared, camera, kind, stretched=1.0):
    """A recording without thermal effects, with an invented temperature.

    stretched: factor of all times, so that fifty seconds become a quarter of an hour.
    """
    source = series_input(read_recording(shared / "data" / camera))
    t = source.frame_times - source.frame_times[0]
    u = t / t[-1]
    T = 20 + 15 * u if kind == "ramp" else np.zeros(len(u))
    if kind == "lamp":
        state = 20.0
        for i, v in enumerate(u):
            state += ((40 if 0.1 < v < 0.45 else 20) - state) * 0.06
            T[i] = state
    if kind == "steps":
        rng = np.random.default_rng(5)
        levels, state = rng.choice([20, 28, 36, 44], 8), 20.0
        for i, v in enumerate(u):
            state += (levels[min(int(8 * v), 7)] - state) * 0.1
            T[i] = state
    T = T + np.random.default_rng(7).normal(0, 0.04, len(T))
    times = source.frame_times[0] + t * stretched
    return replace(
        source,
        frame_times=times,
        reading_times=times,
        readings={"temperature": np.round(T / 0.0625) * 0.0625},
        resolutions={"temperature": 0.0625},
    )


@pytest.mark.parametrize("camera", CAMERAS)
def test_fifty_seconds_are_too_short(shared, camera):
    with pytest.raises(DataError, match="lasts 50 s"):
        reduce_series(with_temperature(shared, camera, "ramp"))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ramp", "lamp", "steps"])
@pytest.mark.parametrize("camera", CAMERAS)
def test_an_invented_temperature_names_no_effect(shared, camera, kind):
    """Tag 22 of cam2 and camera 6 as a whole do move slightly, which may be `unnamed`."""
    found = discover_series([reduce_series(with_temperature(shared, camera, kind, 20.0))])

    assert {e.effect for e in found.effects} <= {"unnamed"}


def test_a_hidden_board_does_not_pull_at_the_cameras(shared):
    """Offsets and cameras are solved together: each target's residuals have no mean."""
    e = reduce_series(with_temperature(shared, "aviary-cam2", "ramp", 20.0))
    seen = e.weights[..., 0] > 0
    often = seen.sum(axis=0) > 50

    mean = np.nanmean(e.residuals[:, often], axis=0)

    assert np.max(np.abs(mean)) < 1e-3
