"""Faults on demand: the mocks fail as hardware does, and come back."""

from __future__ import annotations

from contextlib import nullcontext
from typing import get_args

import pytest
from thermocald_drivers.mock import Kind

from tests.drivers.test_contract import use
from thermocald.errors import BadReading, DeviceGone, DeviceTimeout
from thermocald.hal import VirtualClock, open_device

ERRORS = {"timeout": DeviceTimeout, "unplugged": DeviceGone, "truncated": BadReading,
          "wrong_size": BadReading, "stuck": None}  # fmt: skip


@pytest.mark.parametrize("kind", get_args(Kind))
@pytest.mark.parametrize("device", ["thermometer", "output"])
def test_by_call(device, kind):
    options = {"faults": [{"kind": kind, "at": 2, "count": 3}]}
    with open_device(device, "mock", options, VirtualClock()) as mock:
        for call in range(1, 7):
            fails = ERRORS[kind] is not None and 2 <= call < 5
            with pytest.raises(ERRORS[kind]) if fails else nullcontext():
                use(device, mock)
    if device == "output":  # one that fails keeps nothing
        assert len(mock.results) == (6 if kind == "stuck" else 3)


def test_stuck_repeats_the_value_with_new_instants():
    clock = VirtualClock()
    options = {"faults": [{"kind": "stuck", "at": 3, "count": 3}]}
    with open_device("thermometer", "mock", options, clock) as device:
        readings = []
        for _ in range(7):
            readings.append(device.read())
            clock.advance(20.0)
    values = [reading.values["temperature"] for reading in readings]
    assert values[1:5] == [values[1]] * 4
    assert len({values[0], values[1], values[5], values[6]}) == 4
    assert len({reading.monotonic for reading in readings}) == 7
