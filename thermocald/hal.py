"""The hardware abstraction: the contracts of cameras, thermometers, outputs and clocks.

The daemon, the demo, a replay and a test differ only in which of these they are given. Drivers are
found by entry point and in no other way; the groups are `thermocald.cameras`,
`thermocald.thermometers` and `thermocald.outputs`. An entry point names a class whose `Options` has
one field per configuration key. A driver module imports no device library at its top: the library
is imported in `open()`.

Nothing is inferred from a driver's name or attributes: what the program needs to know of a driver
is a member of its class here, with a default.

Errors are those of `thermocald.errors`: a `TransientDeviceError` is retried with back-off (the
caller closes and re-opens the device), a `PermanentDeviceError` is reported and not retried, a
`DeviceFinished` ends the device without being a fault.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    Protocol,
    Self,
    runtime_checkable,
)

from pydantic import ConfigDict, Field, ValidationError

from thermocald.addresses import hide_secrets
from thermocald.config import Section, in_words, keys
from thermocald.errors import ConfigurationError, DeviceGone, DriverMissing, WrongDevice
from thermocald.names import channel_fault as channel_fault
from thermocald.names import require_channels

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

Kind = Literal["camera", "thermometer", "output"]
_ATTEMPTS = 10  # at most, until clocks were read within this:
_CLOSE_S = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image as a camera delivered it.

    image: (H, W) uint8 or uint16 grey values, read-only; None where `encoded` holds a JPEG, or
    where the frame was measured before and `observations` holds its image points, as
    `thermocald.photogrammetry.field.testfield.observations_from_lists` reads them.
    monotonic, utc: s, the middle of the exposure as well as the device reports it, on the clock's
    two scales.
    exposure: s, or None.
    sequence: the device's own frame number, or None.
    settings: what moves the image, as read back with this frame, by name: focus, exposure, gain,
    white balance in the device's own units; 1.0 and 0.0 for automatic modes. Stored with the epoch
    as the columns `camera_<name>`.
    """

    image: NDArray[np.uint8] | NDArray[np.uint16] | None
    monotonic: float
    utc: float
    exposure: float | None = None
    sequence: int | None = None
    encoded: bytes | None = None
    observations: Mapping[str, Any] | None = None
    settings: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.image is None and self.encoded is None and self.observations is None:
            raise ValueError("a frame needs an image, encoded bytes, or observations")
        if self.image is not None:
            self.image.setflags(write=False)


@dataclass(frozen=True, slots=True)
class Reading:
    """What a thermometer reported, and when.

    values: {channel: °C}; a channel that could not be read is absent, never repeated or filled in,
    and stands in `missing` with the reason;
    one that is called like a column of the program, or holds a mark that separates columns
    (`names`), is refused as WrongDevice.
    monotonic, utc: s, the time of the conversion as well as the device reports it.
    """

    values: Mapping[str, float]
    monotonic: float
    utc: float
    missing: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in self.values:
            if fault := channel_fault(name):
                raise WrongDevice(
                    f"a temperature channel cannot be called {name!r}: it {fault}; give it another "
                    "name in the configuration"
                )


@dataclass(frozen=True, slots=True)
class Found:
    """An attached device, as `thermocald devices` lists it.

    options: its stanza without name and driver.
    about: one line for the user.
    certain: False if nobody can know what is there (a serial port, an I2C bus).
    """

    options: Mapping[str, Any]
    about: str
    certain: bool = True

    def __post_init__(self) -> None:
        # names come from devices: no line break may leave the comment, no escape code be printed
        shown = "".join(c if c.isprintable() else "?" for c in self.about)
        object.__setattr__(self, "about", shown)


@runtime_checkable
class Clock(Protocol):
    """Two scales and a way to wait; intervals use `monotonic`, files use `utc`."""

    def monotonic(self) -> float:
        """Seconds that never step."""

    def utc(self) -> float:
        """Seconds since 1970-01-01 UTC; may step."""

    def sleep_until(self, monotonic: float, wake: threading.Event | None = None) -> bool:
        """Wait until a time of the monotonic scale; False if `wake` was set first."""


def read_together(first: Callable[[], float], *others: Callable[[], float]) -> tuple[float, ...]:
    """Read some clocks (s) as of one instant.

    The closest of ten attempts: a thread that is kept waiting between two clocks would be off by
    that pause (76 ms on a busy machine).
    """
    best: tuple[float, tuple[float, ...]] = (float("inf"), ())
    for _ in range(_ATTEMPTS):
        start = first()
        rest = tuple(clock() for clock in others)
        spread = first() - start
        best = min(best, (spread, (start + 0.5 * spread, *rest)))
        if spread < _CLOSE_S:
            break
    return best[1]


class DriverOptions(Section):
    """The keys of a driver's stanza: types, bounds, defaults; nothing is converted."""

    model_config = ConfigDict(strict=True)

    @classmethod
    def read(cls, stanza: Mapping[str, Any], where: str = "") -> Self:
        """Validate a stanza; ConfigurationError names the place, the key and what is wrong."""
        try:
            return cls.model_validate(dict(stanza))
        except ValidationError as error:
            raise ConfigurationError(in_words(where, error)) from error


class HeatingStep(DriverOptions):
    """A step of a heating programme: hold a temperature (°C; None: do not heat) for a time (s)."""

    seconds: Annotated[float, Field(ge=1.0, le=1e6)]
    hold_c: Annotated[float, Field(ge=-40.0, le=150.0)] | None


class Device:
    """What every driver has: its options, `open`, `close`, and use as a context manager.

    The constructor raises a ConfigurationError and does not touch hardware.
    `open` raises a DeviceError; `close` never raises and may be called twice.
    where: the device in messages; handle: what `open` got hold of, None while it is closed; seen:
    whether it was open before, for what is missing then has gone.
    """

    Options: ClassVar[type[DriverOptions]] = DriverOptions
    options: Any
    where: str = ""
    handle: Any = None
    seen = False

    device_classes: ClassVar[tuple[str, ...]] = ()
    """The nodes in /dev that it opens, as systemd's DeviceAllow= names them: `char-i2c`."""

    def __init__(self, *, clock: Clock, **options: Any) -> None:
        self.clock = clock
        self.options = self.Options.read(options)

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> Sequence[Found]:  # noqa: ARG003
        """List the attached devices of this driver; a DeviceError if it cannot look."""
        return []

    def open(self) -> None:
        """Claim the device; drivers that need a library import it here."""

    def close(self) -> None:
        """Release the device."""
        handle, self.handle = self.handle, None
        if handle is not None:
            handle.close()

    def opened(self) -> Any:
        """Return the handle; DeviceGone while the device is closed."""
        if self.handle is None:
            raise DeviceGone(f"{self.where}: not open")
        return self.handle

    def identity(self) -> Mapping[str, str]:
        """Name, serial number, versions: what distinguishes this device from others."""
        return {}

    def warnings(self) -> Sequence[str]:
        """Return one sentence for each setting that harms the results; shown in the status."""
        return []

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class Camera(Device):
    """`capture()` returns a fresh frame, exposed after the call."""

    def capture(self) -> Frame:
        """Take a frame; raises a DeviceError, never returns an old or a broken one."""
        raise NotImplementedError

    def frame_size(self) -> tuple[int, int] | None:
        """Return (width, height) in px of the frames, where the configuration states it."""
        return None

    def known_scene(self) -> tuple[Any, Any] | None:
        """Return the sensor and the test field it looks at, where a simulated camera knows both.

        It then needs no test field in the stanza.
        """
        return None


class Thermometer(Device):
    """`read()` returns what the device reports now."""

    def read(self) -> Reading:
        """Read all channels; raises a DeviceError if none could be read."""
        raise NotImplementedError

    def named_channels(self) -> Sequence[str]:
        """The channels as the options name them, before it is opened; () if the device does."""
        return ()


class Output(Device):
    """`emit()` passes a result on; it must not block longer than its option `timeout_s`."""

    heats: ClassVar[bool] = False
    """Whether it heats the camera by a `programme`, which a session may replace."""

    def emit(self, result: Mapping[str, Any]) -> None:
        """Pass on one epoch's result: the columns of the CSV export, and `device`, `state`."""
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
    """A clock that jumps to the end of each wait, so that 25 minutes take no time.

    utc: UTC at monotonic 0; `step_utc` imitates an NTP step.
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
        """Let time pass, as a slow device does."""
        with self._lock:
            self._now += seconds

    def step_utc(self, seconds: float) -> None:
        """Set the UTC clock forward or back; the monotonic clock is not affected."""
        self._offset += seconds

    def sleep_until(self, monotonic: float, wake: threading.Event | None = None) -> bool:
        if wake is not None and wake.is_set():
            return False
        with self._lock:
            self._now = max(self._now, monotonic)
        return True


@cache
def entry_points(group: str) -> metadata.EntryPoints:
    """Return the drivers of a group; once, since every installed package is looked through."""
    return metadata.entry_points(group=group)


def driver_names(kind: Kind) -> list[str]:
    """Return the registered drivers of one kind, sorted."""
    return sorted({point.name for point in entry_points(group=f"thermocald.{kind}s")})


def load_driver(kind: Kind, name: str) -> type[Any]:
    """Return the class behind one entry point; ConfigurationError names those that exist."""
    points = {point.name: point for point in entry_points(group=f"thermocald.{kind}s")}
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
    """Return the options of a driver; errors as `load_driver`."""
    return keys(load_driver(kind, name).Options)


def open_device(kind: Kind, name: str, options: Mapping[str, Any], clock: Clock) -> Any:
    """Construct a driver from its configuration; the caller opens it.

    Raises ConfigurationError, which names the option that is missing, unknown or wrong.
    """
    driver = load_driver(kind, name)
    where = f"{kind} driver {name!r}"
    hide_secrets(options)
    try:
        device = driver(clock=clock, **options)
    except (ConfigurationError, TypeError) as error:  # TypeError: a key that is no name
        raise ConfigurationError(f"{where}: {error}") from error
    if kind == "thermometer":
        for channel in device.named_channels():
            require_channels([channel], where, ConfigurationError)
    return device
