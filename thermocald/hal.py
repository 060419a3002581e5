"""The hardware abstraction layer: the interfaces of cameras, thermometers, outputs and clocks.

The daemon, the demo, a replay and a test differ only in the devices and the clock that they use.
Drivers are found only by entry point; the groups are `thermocald.cameras`,
`thermocald.thermometers` and `thermocald.outputs`. An entry point names a class whose `Options` has
one field per configuration key. A driver module imports no device library at its top: the library
is imported in `open()`.

Nothing is inferred from a driver's name or attributes: all that the program needs to know of a
driver is a member of the classes here, with a default.

Errors are those of `thermocald.errors`: after a `TransientDeviceError` the caller closes and opens
the device again, with back-off; a `PermanentDeviceError` is reported and not retried, except that a
device that is not found or denied is looked for; after a `DeviceFinished`, which is no fault, the
device is not used any more.
"""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from numbers import Real
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
from zlib import crc32

from pydantic import ConfigDict, Field, ValidationError

from thermocald.addresses import hide_secrets
from thermocald.config import Section, in_words
from thermocald.errors import BadReading, ConfigurationError, DeviceGone, DriverMissing, WrongDevice
from thermocald.names import channel_fault as channel_fault
from thermocald.names import require_channels

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

Kind = Literal["camera", "thermometer", "output"]
_ATTEMPTS = 10  # at most, until the clocks were read within _CLOSE_S
_CLOSE_S = 1e-4
_POSSIBLE_C = (-273.15, 3000.0)
_FARTHEST_UTC_S = 7.26e9  # the year 2200; a time in ms is beyond it


def _require_numbers(given: Mapping[str, Any]) -> None:
    """Raise BadReading if what a driver gave is no finite number, or `utc` is not in seconds."""
    for name, value in given.items():
        most = _FARTHEST_UTC_S if name == "utc" else sys.float_info.max
        if not isinstance(value, Real) or not abs(float(value)) <= most:
            raise BadReading(f"its driver gives {value!r:.60} as {name}")


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A frame as a camera delivered it.

    image: (H, W) uint8 or uint16 grey values, read-only; None if `encoded` holds a JPEG, or if the
    frame was measured before and `observations` holds its image points, as
    `thermocald.photogrammetry.field.testfield.observations_from_lists` reads them.
    monotonic, utc: middle of the exposure, s, as exactly as the device reports it, on the clock's
    two scales.
    exposure: s, or None.
    sequence: the device's own frame number, or None.
    settings: {name: value} of the settings that can move the image, read back with this frame:
    focus, exposure, gain, white balance in the device's own units; 1.0 and 0.0 for automatic modes
    on and off. They are stored with the epoch in the columns `camera_<name>`.
    fingerprint: a number that differs between any two images by their noise; None without one.

    Raises BadReading if a time or a setting is no number, if `encoded` holds no bytes, or if
    `image` holds no grey values.
    """

    image: NDArray[np.uint8] | NDArray[np.uint16] | None
    monotonic: float
    utc: float
    exposure: float | None = None
    sequence: int | None = None
    encoded: bytes | None = None
    observations: Mapping[str, Any] | None = None
    settings: Mapping[str, float] = field(default_factory=dict)
    fingerprint: int | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        if self.image is None and self.encoded is None and self.observations is None:
            raise ValueError("a frame needs an image, encoded bytes, or observations")
        times = {"monotonic": self.monotonic, "utc": self.utc, "exposure": self.exposure or 0.0}
        _require_numbers(times)
        _require_numbers(self.settings)
        if not isinstance(self.encoded, bytes | None):
            raise BadReading(f"its driver gives {type(self.encoded).__name__} as encoded bytes")
        data: bytes | memoryview | None = self.encoded
        if self.image is not None:
            given: Any = self.image  # what a driver gives may be anything
            size, kind = getattr(given, "shape", ()), getattr(given, "dtype", type(given).__name__)
            if len(size) != 2 or 0 in size or kind not in ("uint8", "uint16"):
                what = f"{'×'.join(map(str, size))} {kind}".lstrip()
                raise BadReading(
                    f"its driver gives an image of {what}; it must be height × width grey values "
                    "of 8 or 16 bits"
                )
            self.image.setflags(write=False)
            data = self.image.data if self.image.flags.c_contiguous else self.image.tobytes()
        if data is not None:
            object.__setattr__(self, "fingerprint", crc32(data))


@dataclass(frozen=True, slots=True)
class Reading:
    """The values of a thermometer's channels at one time.

    values: {channel: °C}; a channel that could not be read is absent, never repeated or filled in,
    and is in `missing` with the reason; so is a value that is not a possible temperature. Raises
    WrongDevice if a channel has the name of one of the program's columns or holds a character that
    separates columns (`names`), BadReading without any value or with times that are no numbers.
    monotonic, utc: time of the conversion, s, as exactly as the device reports it.
    """

    values: Mapping[str, float]
    monotonic: float
    utc: float
    missing: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        given: Mapping[str, Any] = self.values  # what a driver gives may be anything
        values: dict[str, float] = {}
        missing = dict(self.missing)
        for name, value in given.items():
            if fault := channel_fault(name):
                raise WrongDevice(
                    f"a temperature channel cannot be called {name!r}: it {fault}; give it another "
                    "name in the configuration"
                )
            if isinstance(value, Real) and _POSSIBLE_C[0] <= float(value) <= _POSSIBLE_C[1]:
                values[name] = float(value)
            else:
                missing[name] = f"{name}: {value!r:.60} is not a temperature"
        _require_numbers({"monotonic": self.monotonic, "utc": self.utc})
        if not values:
            raise BadReading("; ".join(missing.values()) or "its driver gives no channel")
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "missing", missing)


@dataclass(frozen=True, slots=True)
class Found:
    """An attached device, as `thermocald devices` lists it.

    options: its stanza without name and driver.
    about: one line for the user.
    certain: False if the port cannot tell what is attached (a serial port, an I2C bus).
    """

    options: Mapping[str, Any]
    about: str
    certain: bool = True

    def __post_init__(self) -> None:
        # a device's name must neither end the comment by a line break nor print an escape code
        shown = "".join(c if c.isprintable() else "?" for c in self.about)
        object.__setattr__(self, "about", shown)


@runtime_checkable
class Clock(Protocol):
    """A clock with two scales; intervals use `monotonic`, files use `utc`."""

    def monotonic(self) -> float:
        """Return seconds that never step."""

    def utc(self) -> float:
        """Return seconds since 1970-01-01 UTC; they may step."""

    def sleep_until(self, monotonic: float, wake: threading.Event | None = None) -> bool:
        """Wait until a time of the monotonic scale; return False if `wake` was set before."""


def read_together(first: Callable[[], float], *others: Callable[[], float]) -> tuple[float, ...]:
    """Read several clocks (s) at one instant.

    The quickest of ten attempts counts: a pause of the thread between two clocks would be an error
    of its length (76 ms on a busy machine).
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
    """The keys of a driver's stanza, with types, bounds and defaults; no type is converted."""

    model_config = ConfigDict(strict=True)

    @classmethod
    def read(cls, stanza: Mapping[str, Any], where: str = "") -> Self:
        """Validate a stanza; raises ConfigurationError, which names the place, key and fault."""
        try:
            return cls.model_validate(dict(stanza))
        except ValidationError as error:
            raise ConfigurationError(in_words(where, error)) from error


class HeatingStep(DriverOptions):
    """A step of a heating programme: a time (s) and the temperature to hold (°C; None: no heat)."""

    seconds: Annotated[float, Field(ge=1.0, le=1e6)]
    hold_c: Annotated[float, Field(ge=-40.0, le=150.0)] | None


class Device:
    """The base class of drivers: options, `open`, `close`, and use as a context manager.

    The constructor raises a ConfigurationError and does not touch hardware.
    `open` raises a DeviceError; `close` never raises and may be called twice.
    where: the device's name in messages; handle: the opened resource, None while the device is
    closed; seen: whether it was open before, since a device that is missing then has disappeared;
    timeout_s: how long a call may take, s: its option. Some time later it counts as hung.
    """

    Options: ClassVar[type[DriverOptions]] = DriverOptions
    options: Any
    where: str = ""
    handle: Any = None
    seen = False

    device_classes: ClassVar[tuple[str, ...]] = ()
    """The device nodes that it opens, as systemd's DeviceAllow= names them: `char-i2c`."""
    recorded: ClassVar[bool] = False
    """Whether it plays a recording: a camera then waits for the calibration of its epochs, and a
    thermometer is read up to the time of each frame, not at a rhythm."""

    def __init__(self, *, clock: Clock, **options: Any) -> None:
        self.clock = clock
        self.options = self.Options.read(options)
        self.timeout_s: float = getattr(self.options, "timeout_s", 0.0)

    @classmethod
    def attached(cls, sysfs: str = "/sys") -> Sequence[Found]:  # noqa: ARG003
        """List the attached devices of this driver; raises a DeviceError if it cannot look."""
        return []

    def open(self) -> None:
        """Claim the device; a driver that needs a library imports it here."""

    def close(self) -> None:
        """Release the device."""
        handle, self.handle = self.handle, None
        close = getattr(handle, "close", None)  # a path or a flag needs none
        if close is not None:
            close()

    def opened(self) -> Any:
        """Return the handle; raises DeviceGone while the device is closed."""
        if self.handle is None:
            raise DeviceGone(f"{self.where}: not open")
        return self.handle

    def identity(self) -> Mapping[str, str]:
        """Return name, serial number and versions, which distinguish this device from others."""
        return {"name": self.where}

    def warnings(self) -> Sequence[str]:
        """Return one sentence for each setting that harms the results; shown in the status."""
        return []

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class Camera(Device):
    """The base class of cameras."""

    def capture(self) -> Frame:
        """Take and return a frame that is exposed after the call.

        Raises a DeviceError rather than return an old or broken frame.
        """
        raise NotImplementedError

    def frame_size(self) -> tuple[int, int] | None:
        """Return the frames' (width, height), px, before the camera is opened; None if unknown."""
        scene = self.known_scene()
        given = self.options if scene is None else scene[0]
        size: Any = (getattr(given, "width", None), getattr(given, "height", None))
        return None if None in size else size

    def known_scene(self) -> tuple[Any, Any] | None:
        """Return a simulated camera's sensor and test field, None for any other camera.

        The stanza of such a camera needs no test field.
        """
        return None


class Thermometer(Device):
    """The base class of thermometers."""

    def read(self) -> Reading:
        """Read all channels as they are now; raises a DeviceError if none could be read."""
        raise NotImplementedError

    def named_channels(self) -> Sequence[str]:
        """Return the channels named by the options; () if the device names them when opened."""
        return ()


class Output(Device):
    """The base class of outputs."""

    heats: ClassVar[bool] = False
    """Whether it heats the camera by a `programme`, which a session may replace."""

    def emit(self, result: Mapping[str, Any]) -> None:
        """Pass on an epoch's result: the columns of the CSV export, and `device`, `state`.

        It must not block longer than the option `timeout_s`.
        """
        raise NotImplementedError


class SystemClock:
    """The machine's clocks."""

    def monotonic(self) -> float:
        return time.monotonic()

    def utc(self) -> float:
        return time.time()

    def sleep_until(self, monotonic: float, wake: threading.Event | None = None) -> bool:
        return not (wake or threading.Event()).wait(max(0.0, monotonic - time.monotonic()))


class VirtualClock:
    """A clock that jumps to the end of each wait, so that 25 minutes take no time.

    utc: UTC at the start, when the other scale is at `monotonic`.
    offset: UTC minus the other scale, s; a change imitates a step by NTP.
    """

    def __init__(self, utc: float = 1_600_000_000.0, monotonic: float = 0.0) -> None:
        self.offset = utc - monotonic
        self._now = monotonic
        self._lock = threading.Lock()

    def monotonic(self) -> float:
        return self._now

    def utc(self) -> float:
        return self._now + self.offset

    def sleep_until(self, monotonic: float, wake: threading.Event | None = None) -> bool:
        if wake is not None and wake.is_set():
            return False
        with self._lock:
            self._now = max(self._now, monotonic)
        return True


@cache
def entry_points(group: str) -> metadata.EntryPoints:
    """Return the entry points of a group, cached, since every installed package is searched."""
    return metadata.entry_points(group=group)


def driver_names(kind: Kind) -> list[str]:
    """Return the registered drivers of one kind, sorted."""
    return sorted({point.name for point in entry_points(group=f"thermocald.{kind}s")})


def load_driver(kind: Kind, name: str) -> type[Any]:
    """Return a driver's class.

    Raises ConfigurationError, which lists the installed drivers, DriverMissing if it cannot be
    imported or is no such driver.
    """
    points = {point.name: point for point in entry_points(group=f"thermocald.{kind}s")}
    if name not in points:
        installed = ", ".join(driver_names(kind)) or "none"
        raise ConfigurationError(f"there is no {kind} driver {name!r}; installed are: {installed}")
    try:
        loaded: type[Any] = points[name].load()
    except Exception as error:  # whatever a module raises that somebody else wrote
        why = f"{type(error).__name__}: {error}"
        raise DriverMissing(f"{kind} driver {name!r} cannot be imported: {why}") from error
    base = {"camera": Camera, "thermometer": Thermometer, "output": Output}[kind]
    if not (isinstance(loaded, type) and issubclass(loaded, base)):
        why = f"is no class derived from thermocald.hal.{base.__name__}"
        raise DriverMissing(f"{kind} driver {name!r} {why}")
    return loaded


def open_device(kind: Kind, name: str, options: Mapping[str, Any], clock: Clock) -> Any:
    """Construct a driver from its configuration; the caller opens it.

    Raises ConfigurationError, which names the option that is missing, unknown or wrong.
    """
    driver = load_driver(kind, name)
    where = f"{kind} driver {name!r}"
    hide_secrets(options)
    try:
        device = driver(clock=clock, **options)
    except Exception as error:
        known = isinstance(
            error, ConfigurationError | TypeError
        )  # TypeError: a key that is no text
        why = error if known else f"its driver failed: {type(error).__name__}: {error}"
        raise ConfigurationError(f"{where}: {why}") from error
    if kind == "thermometer":
        require_channels(device.named_channels(), where, ConfigurationError)
    return device
