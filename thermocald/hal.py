"""The hardware abstraction: what a camera, a thermometer, an output and a clock promise.

The daemon, the demo, a replay and a test differ only in which of these they are given. Drivers are
found by entry point and by nothing else; the groups are `thermocald.cameras`,
`thermocald.thermometers`, `thermocald.outputs`. An entry point names a class with one constructor
argument per configuration key. A driver's module imports no device library at its top: the library
is imported in `open()`.

Errors are those of `thermocald.errors`: a `TransientDeviceError` is retried with back-off (the
caller closes and re-opens the device), a `PermanentDeviceError` is reported and not retried.
"""

from __future__ import annotations

import inspect
import threading
import time
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self, runtime_checkable

from thermocald.errors import ConfigurationError, DriverMissing

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import TracebackType

    import numpy as np
    from numpy.typing import NDArray

__all__ = [
    "Camera",
    "Clock",
    "Device",
    "Frame",
    "Output",
    "Reading",
    "SystemClock",
    "Thermometer",
    "VirtualClock",
    "driver_names",
    "load_driver",
    "open_device",
    "option_names",
]

Kind = Literal["camera", "thermometer", "output"]


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image as a camera gave it.

    image: (H, W) uint8 or uint16 grey values, not writeable; None where `encoded` holds a JPEG, or
    where it was measured before and `metadata["observations"]` says what it showed.
    monotonic, utc: s, the middle of the exposure as well as the device tells it, on the clock's
    two scales; exposure: s or None; sequence: the device's own frame number or None.
    metadata: what else the device said, JSON-able.
    """

    image: NDArray[np.uint8] | NDArray[np.uint16] | None
    monotonic: float
    utc: float
    exposure: float | None = None
    sequence: int | None = None
    encoded: bytes | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.image is None and self.encoded is None and "observations" not in self.metadata:
            raise ValueError(
                "a frame needs an image, encoded bytes, or observations in its metadata"
            )
        if self.image is not None:
            self.image.setflags(write=False)


@dataclass(frozen=True, slots=True)
class Reading:
    """What a thermometer said: {channel: °C}, and when.

    A channel that could not be read is absent, never repeated, never filled in.
    monotonic, utc: s, the instant of the conversion as well as the device tells it.
    """

    values: Mapping[str, float]
    monotonic: float
    utc: float
    metadata: Mapping[str, Any] = field(default_factory=dict)


@runtime_checkable
class Clock(Protocol):
    """Two scales and a way to wait; intervals use `monotonic`, files use `utc`."""

    def monotonic(self) -> float:
        """Seconds that never step."""

    def utc(self) -> float:
        """Seconds since 1970-01-01 UTC; may step."""

    def sleep_until(self, monotonic: float, wake: threading.Event | None = None) -> bool:
        """Wait for an instant; False if `wake` was set first."""


class Device:
    """What every driver has: `open`, `close`, and use as a context manager.

    `open` raises a DeviceError; `close` never raises and may be called twice.
    """

    clock: Clock

    def open(self) -> None:
        """Claim the device; drivers that need a library import it here."""

    def close(self) -> None:
        """Release the device."""

    def identity(self) -> Mapping[str, str]:
        """Name, serial number, versions: what tells this device from another."""
        return {}

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class Camera(Device):
    """`capture()` returns a fresh frame, exposed after the call."""

    def capture(self) -> Frame:
        """Take a frame; raises a DeviceError, never returns an old or a broken one."""
        raise NotImplementedError


class Thermometer(Device):
    """`read()` returns what the device says now."""

    def read(self) -> Reading:
        """Read all channels; raises a DeviceError where none could be read."""
        raise NotImplementedError


class Output(Device):
    """`emit()` tells the world; it must not block longer than its `timeout_s`."""

    def emit(self, result: Mapping[str, Any]) -> None:
        """Hand over one epoch's result: the keys of the CSV export, and `device`, `state`."""
        raise NotImplementedError


class SystemClock:
    """The machine's clocks."""

    def monotonic(self) -> float:
        return time.monotonic()

    def utc(self) -> float:
        return time.time()

    def sleep_until(self, monotonic: float, wake: threading.Event | None = None) -> bool:
        delay = monotonic - time.monotonic()
        if wake is not None:
            return not wake.wait(max(0.0, delay))
        if delay > 0:
            time.sleep(delay)
        return True


class VirtualClock:
    """A clock that jumps to where it is asked to wait: 25 minutes pass in no time.

    utc: the UTC instant at monotonic 0; `step_utc` plays an NTP step.
    """

    def __init__(self, utc: float = 1_600_000_000.0, monotonic: float = 0.0) -> None:
        self._offset = utc - monotonic
        self._now = monotonic
        self._lock = threading.Lock()

    def monotonic(self) -> float:
        return self._now

    def utc(self) -> float:
        return self._now + self._offset

    def advance(self, seconds: float) -> None:
        """Let time pass, as a device does that takes its time."""
        with self._lock:
            self._now += seconds

    def step_utc(self, seconds: float) -> None:
        """Set the UTC clock forth or back; the monotonic clock does not notice."""
        self._offset += seconds

    def sleep_until(self, monotonic: float, wake: threading.Event | None = None) -> bool:
        if wake is not None and wake.is_set():
            return False
        with self._lock:
            self._now = max(self._now, monotonic)
        return True


_GROUPS: Mapping[Kind, str] = {
    "camera": "thermocald.cameras",
    "thermometer": "thermocald.thermometers",
    "output": "thermocald.outputs",
}


def driver_names(kind: Kind) -> list[str]:
    """The registered drivers of one kind, sorted."""
    return sorted({point.name for point in entry_points(group=_GROUPS[kind])})


def load_driver(kind: Kind, name: str) -> type[Any]:
    """The class behind one entry point; ConfigurationError names those that exist."""
    points = {point.name: point for point in entry_points(group=_GROUPS[kind])}
    if name not in points:
        raise ConfigurationError(
            f"there is no {kind} driver {name!r}; installed are: "
            f"{', '.join(sorted(points)) or 'none'}"
        )
    try:
        loaded: type[Any] = points[name].load()
    except ImportError as error:
        raise DriverMissing(f"{kind} driver {name!r} cannot be imported: {error}") from error
    return loaded


def option_names(kind: Kind, name: str) -> list[str]:
    """The options that a driver's constructor takes; errors as `load_driver`."""
    parameters = inspect.signature(load_driver(kind, name)).parameters
    return [parameter for parameter in parameters if parameter != "clock"]


def open_device(kind: Kind, name: str, options: Mapping[str, Any], clock: Clock) -> Any:
    """Construct a driver from its configuration; the caller opens it.

    Raises ConfigurationError where the options do not fit the constructor.
    """
    driver = load_driver(kind, name)
    try:
        device = driver(clock=clock, **options)
    except TypeError as error:
        raise ConfigurationError(f"{kind} driver {name!r}: {error}") from error
    return device
