"""gpiozero's mock pins; unplugging takes the pins away from the machine."""

from __future__ import annotations

from contextlib import contextmanager

import gpiozero
from gpiozero.pins.mock import MockFactory

from tests.drivers.laboratory.bench import Bench


@contextmanager
def output(tmp_path, monkeypatch):
    pins = MockFactory()
    monkeypatch.setattr(gpiozero.Device, "pin_factory", pins)

    def none(*_args):
        raise gpiozero.BadPinFactory("no pins here")

    monkeypatch.setattr(gpiozero.Device, "_default_pin_factory", staticmethod(none))
    yield Bench(
        {"pin": 17},
        unplug=lambda: setattr(gpiozero.Device, "pin_factory", None),
        plug=lambda: setattr(gpiozero.Device, "pin_factory", pins),
    )
    pins.close()
