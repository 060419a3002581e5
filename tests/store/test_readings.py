"""The temperature at the time of a frame."""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.store.recording.reader import interpolate_readings

NONE = np.nan
TENS = np.arange(0.0, 100.0, 10.0)
# times of frames, times of readings, readings, temperatures at the frames
INTERPOLATED = {
    "a ramp is exact between readings, and just outside": (
        TENS, TENS + 3.0, 20.3 + 0.1 * TENS, 20 + 0.1 * TENS),
    "missing readings are passed over": (
        [10.0, 40.0], TENS[:6], [20.0, NONE, 22.0, 23.0, NONE, 25.0], [21.0, 24.0]),
    "a long gap is not filled": (
        [15.0, 500.0, 1000.0, 1015.0], [0.0, 10.0, 20.0, 1000.0, 1010.0, 1020.0],
        [0.0, 0.1, 0.2, 10.0, 10.1, 10.2], [0.15, NONE, 10.0, 10.15]),
    "no guess far outside": ([-50.0, 100.0], [0.0, 10.0, 20.0], [1.0, 2.0, 3.0], [NONE, NONE]),
    "no readings": ([0.0, 1.0], [], [], [NONE, NONE]),
    "nothing but missing ones": ([0.0, 1.0], [0.0, 1.0], [NONE, NONE], [NONE, NONE]),
    "one reading holds for its instant": ([5.0, 6.0], [5.0], [21.0], [21.0, NONE]),
    "two readings at one instant are one": ([1.0], [0.0, 0.0, 2.0], [1.0, 1.0, 3.0], [2.0]),
}  # fmt: skip


@pytest.mark.parametrize("case", INTERPOLATED)
def test_temperatures_at_the_frames(case):
    frames, times, readings, expected = INTERPOLATED[case]
    assert interpolate_readings(frames, times, readings) == pytest.approx(expected, nan_ok=True)
