"""The example driver works, and drivers/README.md shows it unchanged."""

from __future__ import annotations

import errno
import importlib.util
import sys
from pathlib import Path

import pytest
import smbus2

from tests.drivers.fakes.smbus import Bus, Chip
from thermocald.errors import BadReading, ConfigurationError, DeviceGone, DeviceNotFound
from thermocald.hal import Thermometer, VirtualClock

DRIVERS = Path(__file__).parents[2] / "drivers"


@pytest.fixture
def example(monkeypatch):
    path = DRIVERS / "example_thermometer.py"
    spec = importlib.util.spec_from_file_location("example_thermometer", path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "example_thermometer", module)  # pydantic resolves names there
    spec.loader.exec_module(module)
    return module.Tc74Thermometer


@pytest.fixture
def chip(monkeypatch):
    bus = Bus()
    monkeypatch.setattr(smbus2, "SMBus", bus)
    bus.chips[0x4D] = Chip({0: b"\x19", 1: b"\x40"})
    yield bus.chips[0x4D]
    assert bus.opened == 0


def test_the_readme_shows_this_file():
    code = (DRIVERS / "example_thermometer.py").read_text()
    assert f"```python\n{code}```" in (DRIVERS / "README.md").read_text()
    assert len(code.splitlines()) < 60


@pytest.mark.parametrize(("raw", "celsius"), [(0x19, 25.0), (0xFF, -1.0), (0xBF, -65.0), (0, 0.0)])
def test_it_reads(example, chip, raw, celsius):
    chip.registers[0] = bytes([raw])
    clock = VirtualClock()
    with example(clock=clock) as device:
        assert isinstance(device, Thermometer)
        reading = device.read()
    assert reading.values == {"temperature": celsius}
    assert (reading.monotonic, reading.utc) == (clock.monotonic(), clock.utc())


def test_it_fails_as_the_contract_says(example, chip):
    with pytest.raises(ConfigurationError, match="address: is 80"):
        example(clock=VirtualClock(), address=0x50)
    device = example(clock=VirtualClock())
    with pytest.raises(DeviceGone):
        device.read()
    chip.error = errno.EREMOTEIO
    with pytest.raises(DeviceNotFound):
        device.open()
    chip.error = 0
    with device:
        chip.registers[1] = b"\x00"
        with pytest.raises(BadReading, match="no conversion"):
            device.read()
        chip.registers = {0: b"\x80", 1: b"\x40"}
        with pytest.raises(BadReading, match="-128 °C"):
            device.read()
        chip.error = errno.EREMOTEIO
        with pytest.raises(DeviceGone):
            device.read()
    device.close()


def test_importing_it_imports_no_library(example, monkeypatch):
    monkeypatch.setitem(sys.modules, "smbus2", None)
    example(clock=VirtualClock())
