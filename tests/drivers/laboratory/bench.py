"""What a driver's laboratory hands to the contract test."""

from __future__ import annotations

import shutil
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from tests.drivers.fakes.sysfs import Sysfs
from thermocald.hal import Clock, VirtualClock

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass
class Bench:
    """A device on the bench.

    options: for the driver's constructor; unplug: makes the device vanish below the driver (the
    contract then wants a DeviceError); plug: brings it back. clock: what the driver is given.

    A laboratory is a module `tests/drivers/laboratory/<driver>.py` with a context manager
    `camera(tmp_path, monkeypatch)`, `thermometer(…)` or `output(…)` for each kind under which the
    driver is registered; it yields a Bench and cleans up.
    """

    options: dict[str, Any]
    unplug: Callable[[], None]
    plug: Callable[[], None]
    clock: Clock = field(default_factory=VirtualClock)


def on_loopback(server, options: dict[str, Any], clock: type[Clock] = VirtualClock):
    """The laboratory of an output to a server on loopback; unplugging stops it."""

    @contextmanager
    def output(tmp_path, monkeypatch):
        running = [server()]
        port = running[0].port
        yield Bench(
            {"port": port, **options},
            unplug=running[0].close,
            plug=lambda: running.append(server(port)),
            clock=clock(),
        )
        running[-1].close()

    return output


def on_sysfs(attach, options: dict[str, Any]):
    """The laboratory of a sensor in a sysfs tree; unplugging makes its folder vanish.

    attach: (tree, 0 or 1 the second time) → the folder.
    """

    @contextmanager
    def thermometer(tmp_path, monkeypatch):
        tree = Sysfs(tmp_path)
        folder = attach(tree, 0)
        yield Bench(
            {"sysfs": str(tmp_path), **options},
            unplug=lambda: shutil.rmtree(folder),
            plug=lambda: attach(tree, 1),
        )

    return thermometer


def on_i2c(chip_name: str):
    """The laboratory of a chip on a fake SMBus adapter: one of `fakes.chips`."""

    @contextmanager
    def thermometer(tmp_path, monkeypatch):
        import smbus2

        from tests.drivers.fakes.chips import CHIPS
        from tests.drivers.fakes.smbus import Bus

        bus = Bus()
        monkeypatch.setattr(smbus2, "SMBus", bus)
        address, chip, _ = CHIPS[chip_name]
        bus.chips[address] = chip()
        yield Bench(
            {"bus": 1, "address": address},
            unplug=bus.chips.clear,
            plug=lambda: bus.chips.update({address: chip()}),
        )

    return thermometer


def on_pins(options: dict[str, Any]):
    """The laboratory of an output on gpiozero's mock pins."""

    @contextmanager
    def output(tmp_path, monkeypatch):
        import gpiozero
        from gpiozero.pins.mock import MockFactory

        pins = MockFactory()
        monkeypatch.setattr(gpiozero.Device, "pin_factory", pins)

        def none(*_args):
            raise gpiozero.BadPinFactory("no pins here")

        monkeypatch.setattr(gpiozero.Device, "_default_pin_factory", staticmethod(none))
        yield Bench(
            options,
            unplug=lambda: setattr(gpiozero.Device, "pin_factory", None),
            plug=lambda: setattr(gpiozero.Device, "pin_factory", pins),
        )
        pins.close()

    return output
