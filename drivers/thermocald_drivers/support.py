"""What the drivers share: lazy libraries, bounded options, and errno translated into our errors."""

from __future__ import annotations

import errno
import importlib
import math
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
    "absent",
    "believable",
    "choice",
    "denied",
    "fault",
    "library",
    "middle_reading",
    "number",
    "on_clock",
    "programme",
    "text",
]

CLOCK_TRIES = 10
CLOCK_SPREAD_S = 1e-4
_GONE = {errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EREMOTEIO, errno.ENOTCONN, errno.ESHUTDOWN}


def library(module: str, extra: str = "") -> Any:
    """Import a device's library when the device is opened; DriverMissing says how to install it."""
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
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigurationError(f"{name}: {value!r} is not a number{suffix and ' in' + suffix}")
    if not low <= value <= high:
        raise ConfigurationError(
            f"{name}: {value:g}{suffix} is not within {low:g} … {high:g}{suffix}"
        )
    if whole and value != int(value):
        raise ConfigurationError(f"{name}: {value:g} is not a whole number")
    return value


def choice(name: str, value: object, allowed: Sequence[str]) -> str:
    """An option out of a list of words; ConfigurationError shows the list."""
    if not isinstance(value, str) or value not in allowed:
        raise ConfigurationError(f"{name}: {value!r} is none of {', '.join(allowed)}")
    return value


def text(name: str, value: object) -> str:
    """An option that must be a non-empty string; numbers of a YAML file are taken as written."""
    if isinstance(value, bool) or not isinstance(value, str | int) or str(value) == "":
        raise ConfigurationError(f"{name}: {value!r} is not a text; put it in quotes")
    return str(value)


def absent(message: str, *, seen: bool) -> DeviceError:
    """What is not there: gone (retried) if it was opened once before, else not found (reported)."""
    return DeviceGone(message) if seen else DeviceNotFound(message)


def denied(message: str, *, seen: bool) -> DeviceError:
    """What may not be used: for good, unless it was open before.

    A device that has just been plugged in again belongs to nobody until udev has seen it, and other
    programs look into it; a phone is unauthorized until it has found its key.
    """
    return TransientDeviceError(message) if seen else DeviceDenied(message)


def fault(error: OSError, where: str, *, seen: bool, hint: str = "") -> DeviceError:
    """The device error that a system call's errno stands for.

    where: the device as the user knows it; seen: whether it was opened once before; hint: what to
    do where it is missing or denied.
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
    """An instant of the machine's CLOCK_MONOTONIC, s, on the clock's (monotonic, utc) scales.

    The three clocks are read one after the other: a thread that is preempted in between would be
    off by that pause (76 ms were seen on a busy machine). The closest of some tries counts.
    """
    tries = []
    for _ in range(CLOCK_TRIES):
        begin = time.monotonic()
        scales = clock.monotonic(), clock.utc()
        tries.append((time.monotonic() - begin, begin, scales))
        if tries[-1][0] < CLOCK_SPREAD_S:
            break
    spread, begin, scales = min(tries)
    age = begin + spread / 2.0 - monotonic
    return scales[0] - age, scales[1] - age


def middle_reading(
    clock: Clock,
    values: Mapping[str, float],
    begin: float,
    metadata: Mapping[str, Any] | None = None,
) -> Reading:
    """A reading stamped half-way between `begin` (clock's monotonic, s) and now."""
    now = time.monotonic()
    half = (clock.monotonic() - begin) / 2.0
    monotonic, utc = on_clock(clock, now)
    return Reading(
        values=dict(values),
        monotonic=monotonic - half,
        utc=utc - half,
        metadata=dict(metadata or {}),
    )


def believable(value_c: float, low_c: float, high_c: float, where: str) -> float:
    """The temperature, if it is finite and within the sensor's range; BadReading otherwise."""
    if not math.isfinite(value_c) or not low_c <= value_c <= high_c:
        raise BadReading(
            f"{where}: {value_c:g} °C is outside the sensor's range {low_c:g} … {high_c:g} °C"
        )
    return value_c


def programme(points: object) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A course of [seconds, °C] points as times (n,) s and temperatures (n,) °C.

    ConfigurationError where it is none, or its times do not increase.
    """
    try:
        course = np.array(points, dtype=float)
    except (TypeError, ValueError):
        course = np.empty(0)
    if course.ndim != 2 or course.shape[1] != 2 or not np.isfinite(course).all():
        raise ConfigurationError("programme: must be a list of [seconds, °C]")
    if np.any(np.diff(course[:, 0]) <= 0):
        raise ConfigurationError("programme: its times must increase")
    return course[:, 0], course[:, 1]
