"""A chip on a fake SMBus adapter; unplugging takes it off its address."""

from __future__ import annotations

from contextlib import contextmanager

import smbus2

from tests.drivers.fakes.chips import CHIPS
from tests.drivers.fakes.smbus import Bus
from tests.drivers.laboratory.bench import Bench


@contextmanager
def thermometer(tmp_path, monkeypatch):
    bus = Bus()
    monkeypatch.setattr(smbus2, "SMBus", bus)
    address, chip, _ = CHIPS["sht3x"]
    bus.chips[address] = chip()
    yield Bench(
        {"bus": 1, "address": address},
        unplug=bus.chips.clear,
        plug=lambda: bus.chips.update({address: chip()}),
    )
