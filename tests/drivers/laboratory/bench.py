"""What a driver's laboratory hands to the contract test."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

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
