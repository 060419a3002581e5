"""What the drivers share: lazy imports, bounded options, errno as our errors, strict numbers."""

from __future__ import annotations

import errno
import importlib
import math
import re
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import (
    BadReading,
    ConfigurationError,
    DeviceDenied,
    DeviceError,
    DeviceGone,
    DeviceNotFound,
    DeviceTimeout,
    DriverMissing,
    TransientDeviceError,
)
from thermocald.hal import Reading

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from thermocald.hal import Clock

__all__ = [
    "AUTO",
    "Neighbour",
    "absent",
    "believable",
    "choice",
    "denied",
    "fault",
    "library",
    "middle_reading",
    "number",
    "number_or_auto",
    "on_clock",
    "parse_number",
    "programme",
    "text",
]

AUTO = "auto"
"""What a stanza says to leave a setting to the camera."""
CLOCK_TRIES = 10
CLOCK_SPREAD_S = 1e-4
NEIGHBOUR_AGE_S = 60.0
NEIGHBOUR_STEP_K = 5.0
LARGEST = 1e15
LOWEST_C, HIGHEST_C = -273.15, 2000.0
_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:[.,][0-9]*)?|[.,][0-9]+)(?:[eE][-+]?[0-9]{1,2})?")
_GONE = {errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EREMOTEIO, errno.ENOTCONN, errno.ESHUTDOWN}


def library(module: str, extra: str = "") -> Any:
    """Import a device's library when the device is opened; DriverMissing says what to install."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        hint = f": pip install 'thermocald[{extra}]'" if extra else ""
        raise DriverMissing(f"the library {module!r} is not installed{hint} ({error})") from error


def number(
    name: str, value: object, low: float, high: float, unit: str = "", *, whole: bool = False
) -> float:
    """An option as a number within its bounds; ConfigurationError names option, value, limits."""
    suffix = f" {unit}" if unit else ""
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value:
        raise ConfigurationError(f"{name}: {value!r} is not a number{suffix and ' in' + suffix}")
    if abs(value) > LARGEST:  # also infinity, and integers that no float can hold
        raise ConfigurationError(f"{name}: the number is too large{suffix and ' for' + suffix}")
    if not low <= value <= high:
        raise ConfigurationError(
            f"{name}: {value:g}{suffix} is not within {low:g} … {high:g}{suffix}"
        )
    if whole and value != int(value):
        raise ConfigurationError(f"{name}: {value:g} is not a whole number")
    return value


def number_or_auto(
    name: str, value: object, low: float, high: float, unit: str = "", *, whole: bool = False
) -> float | str:
    """A number as `number` bounds it, or the word AUTO."""
    if isinstance(value, str) and value != AUTO:
        raise ConfigurationError(f"{name}: {value!r} is neither a number nor {AUTO}")
    return AUTO if value == AUTO else number(name, value, low, high, unit, whole=whole)


def choice(name: str, value: object, allowed: Sequence[str]) -> str:
    """An option from a list of words; ConfigurationError shows the list."""
    if not isinstance(value, str) or value not in allowed:
        raise ConfigurationError(f"{name}: {value!r} is not one of {', '.join(allowed)}")
    return value


def text(name: str, value: object) -> str:
    """An option that must be a non-empty string; whole numbers are taken as written."""
    if isinstance(value, bool) or not isinstance(value, str | int) or str(value) == "":
        raise ConfigurationError(f"{name}: {value!r} is not text; put it in quotes")
    return str(value)


def absent(message: str, *, seen: bool) -> DeviceError:
    """A missing device: gone (retried) if it was open before, otherwise not found (reported)."""
    return DeviceGone(message) if seen else DeviceNotFound(message)


def denied(message: str, *, seen: bool) -> DeviceError:
    """A device that may not be used: permanent, unless it was open before.

    A device that has just been plugged in again belongs to root until udev has seen it, and other
    programs probe it; a phone is unauthorized until it has recognised the host's key.
    """
    return TransientDeviceError(message) if seen else DeviceDenied(message)


def fault(error: OSError, where: str, *, seen: bool, hint: str = "") -> DeviceError:
    """The device error that a system call's errno stands for.

    where: the device as the user knows it.
    seen: whether it was open before.
    hint: what to do if it is missing or access is denied.
    """
    if isinstance(error, DeviceError):
        return error
    reason = error.strerror or str(error) or type(error).__name__
    advice = f"; {hint}" if hint else ""
    if error.errno in _GONE:
        return absent(f"{where}: {reason}{advice}", seen=seen)
    if error.errno in (errno.EACCES, errno.EPERM):
        return denied(f"{where}: {reason}{advice or '; see the udev rules in systemd/'}", seen=seen)
    if error.errno == errno.EBUSY:
        message = f"{where}: in use by another program or a kernel driver ({reason})"
        return denied(message, seen=seen)
    if error.errno == errno.ETIMEDOUT or isinstance(error, TimeoutError):
        return DeviceTimeout(f"{where}: no answer in time ({reason})")
    return BadReading(f"{where}: {reason}")


def on_clock(clock: Clock, monotonic: float) -> tuple[float, float]:
    """A time of the machine's CLOCK_MONOTONIC (s) on the clock's (monotonic, utc) scales.

    The three clocks are read one after another; a thread that is preempted in between would be
    off by that pause (76 ms on a busy machine), so the closest of several attempts counts.
    """
    tries = []
    for _ in range(CLOCK_TRIES):
        start = time.monotonic()
        scales = clock.monotonic(), clock.utc()
        tries.append((time.monotonic() - start, start, scales))
        if tries[-1][0] < CLOCK_SPREAD_S:
            break
    spread, start, scales = min(tries)
    age = start + spread / 2.0 - monotonic
    return scales[0] - age, scales[1] - age


def middle_reading(
    clock: Clock,
    values: Mapping[str, float],
    start: float,
    metadata: Mapping[str, Any] | None = None,
) -> Reading:
    """A reading timed half-way between `start` (clock's monotonic, s) and now."""
    now = time.monotonic()
    half = (clock.monotonic() - start) / 2.0
    monotonic, utc = on_clock(clock, now)
    return Reading(
        values=dict(values),
        monotonic=monotonic - half,
        utc=utc - half,
        metadata=dict(metadata or {}),
    )


def believable(value_c: float, low_c: float, high_c: float, where: str) -> float:
    """The temperature if it is finite and within the sensor's range; otherwise BadReading."""
    if not math.isfinite(value_c) or not low_c <= value_c <= high_c:
        raise BadReading(
            f"{where}: {value_c:g} °C is outside the sensor's range {low_c:g} … {high_c:g} °C"
        )
    return value_c


def parse_number(text: str, *, comma: bool = False) -> float:
    """The number in a text from a device: ASCII digits, one decimal point, nothing else.

    float() also takes `2_5.0`, `nan`, `infinity` and digits of any script, which a damaged line
    may hold. comma: whether a decimal comma is accepted. Raises ValueError.
    """
    plain = text.strip(" \t\r\n")
    if not _NUMBER.fullmatch(plain) or ("," in plain and not comma):
        raise ValueError(f"{text!r} is not a plain decimal number")
    return float(plain.replace(",", "."))


class Neighbour:
    """The last reading of a channel that was certainly measured.

    A chip that has just been powered holds a fixed value (85 °C, 25 °C, 0 °C) that is also a
    temperature. Such a value is accepted only where a reading less than NEIGHBOUR_AGE_S old and
    within NEIGHBOUR_STEP_K makes it likely; it never supports itself.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._last: tuple[float, float] | None = None

    def measured(self, value_c: float) -> None:
        """Remember a reading that cannot be a power-on value."""
        self._last = (self._clock.monotonic(), value_c)

    def supports(self, value_c: float) -> bool:
        """Whether a recent reading lay near enough."""
        if self._last is None:
            return False
        at, last_c = self._last
        recent = self._clock.monotonic() - at <= NEIGHBOUR_AGE_S
        return recent and abs(last_c - value_c) <= NEIGHBOUR_STEP_K


def programme(points: object) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A list of [seconds, °C] points as times (n,) s and temperatures (n,) °C.

    Raises ConfigurationError for anything else, for times that do not increase, and for
    temperatures that do not exist.
    """
    try:
        pairs = np.array(points, dtype=float)
    except (TypeError, ValueError):
        pairs = np.empty(0)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not np.isfinite(pairs).all():
        raise ConfigurationError("programme: must be a list of [seconds, °C]")
    if np.any(np.diff(pairs[:, 0]) <= 0):
        raise ConfigurationError("programme: its times must increase")
    for value in pairs[:, 1]:
        number("programme: temperature", float(value), LOWEST_C, HIGHEST_C, "°C")
    return pairs[:, 0], pairs[:, 1]
