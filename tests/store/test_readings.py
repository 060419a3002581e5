"""The temperature at the frame's instant."""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.store.recording.readings import (
    interpolate_readings,
)


def test_a_ramp_is_exact_between_and_just_outside_readings():
    readings = np.arange(0.0, 100.0, 10.0) + 3.0
    frames = np.arange(0.0, 100.0, 10.0)  # the first lies before the first reading
    assert interpolate_readings(frames, readings, 20 + 0.1 * readings) == pytest.approx(
        20 + 0.1 * frames
    )


def test_missing_readings_are_passed_over():
    times = np.arange(0.0, 60.0, 10.0)
    values = np.array([20.0, np.nan, 22.0, 23.0, np.nan, 25.0])
    assert interpolate_readings([10.0, 40.0], times, values) == pytest.approx([21.0, 24.0])


def test_a_long_gap_is_not_filled():
    times = np.array([0.0, 10.0, 20.0, 1000.0, 1010.0, 1020.0])
    result = interpolate_readings([15.0, 500.0, 1000.0, 1015.0], times, times * 0.01)
    assert result == pytest.approx([0.15, np.nan, 10.0, 10.15], nan_ok=True)


def test_no_guess_far_outside():
    result = interpolate_readings([-50.0, 100.0], [0.0, 10.0, 20.0], [1.0, 2.0, 3.0])
    assert np.isnan(result).all()


@pytest.mark.parametrize("readings", [[], [np.nan, np.nan]])
def test_without_readings_there_is_no_temperature(readings):
    assert np.isnan(interpolate_readings([0.0, 1.0], np.arange(len(readings)), readings)).all()


def test_one_reading_holds_for_its_instant():
    assert interpolate_readings([5.0, 6.0], [5.0], [21.0]) == pytest.approx(
        [21.0, np.nan], nan_ok=True
    )


def test_two_readings_at_one_instant_are_one():
    assert interpolate_readings([1.0], [0.0, 0.0, 2.0], [1.0, 1.0, 3.0]) == pytest.approx([2.0])
