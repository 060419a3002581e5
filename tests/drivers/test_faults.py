"""Faults on demand: the mocks fail as hardware does, and come back."""

from __future__ import annotations

from typing import get_args

import pytest
from thermocald_drivers.mock import Kind

from tests.drivers.test_contract import use
from thermocald.errors import BadReading, DeviceGone, DeviceTimeout
from thermocald.hal import VirtualClock, open_device


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


def outcomes(kind, device, calls: int) -> list[str]:
    """Return the outcome of each use."""
    found = []
    for _ in range(calls):
        try:
            use(kind, device)
        except (DeviceTimeout, DeviceGone, BadReading) as error:
            found.append(type(error).__name__)
        else:
            found.append("ok")
    return found


KINDS = {
    "timeout": "DeviceTimeout",
    "unplugged": "DeviceGone",
    "truncated": "BadReading",
    "wrong_size": "BadReading",
    "stuck": "ok",
}


def test_every_kind_is_tested():
    assert set(KINDS) == set(get_args(Kind))


@pytest.mark.parametrize(("kind", "error"), KINDS.items())
@pytest.mark.parametrize("device", ["thermometer", "output"])
def test_by_call(clock, device, kind, error):
    options = {"faults": [{"kind": kind, "at": 2, "count": 3}]}
    with open_device(device, "mock", options, clock) as mock:
        assert outcomes(device, mock, 6) == ["ok", error, error, error, "ok", "ok"]


def test_stuck_repeats_the_value_with_new_instants(clock):
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


def test_an_output_that_fails_keeps_nothing(clock):
    with open_device("output", "mock", {"faults": [{"kind": "timeout"}]}, clock) as output:
        with pytest.raises(DeviceTimeout):
            output.emit({"epoch": 1})
        output.emit({"epoch": 2})
    assert list(output.results) == [{"epoch": 2}]
