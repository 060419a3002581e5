"""The example driver works, and drivers/README.md shows it unchanged."""

from __future__ import annotations

import errno
import importlib.util
import sys
from pathlib import Path

import pytest
import smbus2

from tests.drivers.fakes.smbus import Chip
from thermocald.errors import BadReading, ConfigurationError, DeviceGone, DeviceNotFound
from thermocald.hal import Thermometer, VirtualClock

DRIVERS = Path(__file__).parents[2] / "drivers"


@pytest.fixture
def example(monkeypatch):
    """The driver, imported without the library of its device."""
    monkeypatch.setitem(sys.modules, "smbus2", None)
    path = DRIVERS / "example_thermometer.py"
    spec = importlib.util.spec_from_file_location("example_thermometer", path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "example_thermometer", module)  # pydantic resolves names there
    spec.loader.exec_module(module)
    device = module.Tc74Thermometer(clock=VirtualClock())
    monkeypatch.setitem(sys.modules, "smbus2", smbus2)
    return device


def test_the_readme_shows_this_file():
    code = (DRIVERS / "example_thermometer.py").read_text()
    assert f"```python\n{code}```" in (DRIVERS / "README.md").read_text()
    assert len(code.splitlines()) < 60


def test_it_keeps_the_contract(example, bus):
    registers = {0: b"\x19", 1: b"\x40"}
    bus.chips[0x4D] = Chip(dict(registers))
    with pytest.raises(ConfigurationError, match="address: is 80"):
        type(example)(clock=VirtualClock(), address=0x50)
    with pytest.raises(DeviceGone):
        example.read()
    bus.error = errno.EREMOTEIO
    with pytest.raises(DeviceNotFound):
        example.open()
    bus.error = 0
    with example:
        assert isinstance(example, Thermometer)
        for raw, celsius in ((0x19, 25.0), (0xFF, -1.0), (0xBF, -65.0), (0, 0.0)):
            bus.chips[0x4D].registers[0] = bytes([raw])
            reading = example.read()
            assert reading.values == {"temperature": celsius}
            assert (reading.monotonic, reading.utc) == (0.0, example.clock.utc())
        for wrong, message in (({1: b"\x00"}, "no conversion"), ({0: b"\x80"}, "-128 °C")):
            bus.chips[0x4D].registers = registers | wrong
            with pytest.raises(BadReading, match=message):
                example.read()
        bus.error = errno.EREMOTEIO
        with pytest.raises(DeviceGone):
            example.read()
    example.close()
