"""Functions shared by drivers: lazy imports, bounded options, device errors, strict numbers.

They also convert camera buffers to grey images: GREY, Y10 to Y16, YUYV, UYVY, NV12, YU12, MJPEG and
Bayer formats. Grey means luminance: the Y plane of a colour format; for a Bayer mosaic, OpenCV's
demosaiced grey at full size and depth. A truncated buffer or JPEG raises BadReading.
Source: Linux userspace API, "Image formats" (V4L2 fourcc codes).
"""

from __future__ import annotations

import errno
import importlib
import math
import re
import threading
import time
from concurrent.futures import Future
from typing import TYPE_CHECKING, Annotated, Any, cast

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

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
from thermocald.hal import Reading, Thermometer, read_together

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.hal import Clock

    Grey = NDArray[np.uint8] | NDArray[np.uint16]


def like(pattern: str, words: str) -> AfterValidator:
    """Return a validator that accepts text that matches as a whole; words: what other text is."""

    def check(text: str) -> str:
        if not re.fullmatch(pattern, text):
            raise ConfigurationError(f"{text!r:.60} {words}")
        return text

    return AfterValidator(check)


AUTO = "auto"
"""The value that leaves a setting to the camera."""
Text = Annotated[
    str,
    BeforeValidator(lambda v: str(v) if type(v) is int else v),
    like(r"[^\0]+", "is empty or holds a NUL"),
]
"""A text option; a whole number is accepted as the text that was written."""
Seconds = Annotated[float, Field(ge=0.01, le=600.0)]
"""A time-out."""
Celsius = Annotated[float, Field(ge=-273.15, le=3000.0)]
Pixels = Annotated[int, Field(ge=16, le=20_000)]
Port = Annotated[int, Field(ge=1, le=65_535)]
NEIGHBOUR_AGE_S = 60.0
NEIGHBOUR_STEP_K = 5.0
SWITCH_S = 600.0
UNITS = {"degC": 1.0, "tenths": 0.1, "thousandths": 0.001}
"""Factors that convert a number of the kernel or a phone to °C, by the words of the options."""
_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:[.,][0-9]*)?|[.,][0-9]+)(?:[eE][-+]?[0-9]{1,2})?")
_GONE = {errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EREMOTEIO, errno.ENOTCONN, errno.ESHUTDOWN}


def library(module: str, extra: str = "") -> Any:
    """Import a device's library, on opening the device; DriverMissing names what to install."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        hint = f": pip install 'thermocald[{extra}]'" if extra else ""
        raise DriverMissing(f"the library {module!r} is not installed{hint} ({error})") from error


def or_auto(low: float, high: float) -> AfterValidator:
    """Return a validator that accepts a number within bounds, the word AUTO, or None."""

    def check(value: float | str | None) -> float | str | None:
        if isinstance(value, str) and value != AUTO:
            raise ConfigurationError(f"{value!r} is neither a number nor {AUTO}")
        if isinstance(value, int | float) and not low <= value <= high:
            raise ConfigurationError(f"{value:g} is not within {low:g} … {high:g}")
        return value

    return AfterValidator(check)


def automatic_warnings(options: Mapping[str, Any]) -> list[str]:
    """Return a warning for each option that leaves its setting to the camera."""
    return [
        f"{name}: auto lets the camera change it; every change alters the calibration"
        for name, value in options.items()
        if value == AUTO
    ]


def absent(message: str, *, seen: bool) -> DeviceError:
    """Return the error for a missing device: DeviceGone if `seen`, else DeviceNotFound."""
    return DeviceGone(message) if seen else DeviceNotFound(message)


def denied(message: str, *, seen: bool) -> DeviceError:
    """Return the error for a denied device: permanent, unless it was open before (`seen`).

    A device that has just been plugged in again belongs to root until udev has handled it, and
    other programs probe it; a phone is unauthorized until it has recognised the host's key.
    """
    return TransientDeviceError(message) if seen else DeviceDenied(message)


def fault(error: OSError, where: str, *, seen: bool, hint: str = "") -> DeviceError:
    """Return the device error for the errno of a system call.

    where: the device's name in messages; seen: whether it was open before; hint: advice for a
    missing device or denied access.
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


def reason(error: BaseException) -> str:
    """Return the cause of an error without the library's text, which may quote secrets."""
    cause = getattr(error, "reason", error)  # urllib's URLError wraps the real one
    cause = cause if isinstance(cause, BaseException) else error
    if isinstance(cause, TimeoutError):
        return "no answer in time"
    import ssl  # 1 MB that most daemons do without

    if isinstance(cause, ssl.SSLCertVerificationError):
        return f"its certificate is not trusted: {cause.verify_message}"
    if isinstance(cause, OSError) and cause.errno is not None and cause.strerror:
        return str(cause.strerror)
    return type(cause).__name__


def in_thread(work: Callable[[], Any], name: str) -> Future[Any]:
    """Start work in a new thread, which is abandoned if it hangs; return its future."""
    task: Future[Any] = Future()

    def run() -> None:
        try:
            task.set_result(work())
        except BaseException as error:  # noqa: BLE001 - raised again by `result`
            task.set_exception(error)

    threading.Thread(target=run, daemon=True, name=name).start()
    return task


def on_clock(clock: Clock, monotonic: float) -> tuple[float, float]:
    """Convert a time on the machine's CLOCK_MONOTONIC (s) to the clock's (monotonic, utc)."""
    now, *scales = read_together(time.monotonic, clock.monotonic, clock.utc)
    age = now - monotonic
    return scales[0] - age, scales[1] - age


def middle_reading(
    clock: Clock,
    values: Mapping[str, float],
    start: float,
    missing: Mapping[str, str] | None = None,
) -> Reading:
    """Return a reading whose time is midway between `start` (clock's monotonic, s) and now."""
    monotonic, utc = read_together(clock.monotonic, clock.utc)
    half = (monotonic - start) / 2.0
    return Reading(dict(values), monotonic - half, utc - half, missing or {})


def number_or_nan(value: object) -> float:
    """Return a value of a result as a float, NaN if it is no number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    return float(value)


def read_line(path: Path) -> str:
    """Return the text of a sysfs file in any locale; bytes that are not UTF-8 become �."""
    return path.read_text(encoding="utf-8", errors="replace").strip()


def parse_number(text: str, *, comma: bool = False) -> float:
    """Convert a device's text to a number: ASCII digits, one decimal point, nothing else.

    float() also accepts `2_5.0`, `nan`, `infinity` and digits of any script, which a damaged line
    may contain. comma: whether a decimal comma is accepted. Raises ValueError.
    """
    plain = text.strip(" \t\r\n")
    if not _NUMBER.fullmatch(plain) or ("," in plain and not comma):
        raise ValueError(f"{text!r} is not a plain decimal number")
    return float(plain.replace(",", "."))


def result_in_time(task: Future[Any], seconds: float, late: str) -> Any:
    """Return a task's result, or raise its error; DeviceTimeout with the message `late`."""
    try:
        return task.result(max(0.0, seconds))
    except TimeoutError as error:
        if task.done():
            raise
        raise DeviceTimeout(late) from error


class CheckedThermometer(Thermometer):
    """A thermometer that checks the temperatures of its channels, and makes its readings of them.

    range_c: of the sensor; the options minimum_c and maximum_c replace it. An idle value, which a
    chip reports without having measured (see `chips`), is accepted only if a reading less than
    NEIGHBOUR_AGE_S old, since the opening, lies within NEIGHBOUR_STEP_K of it. An idle value never
    supports another.
    """

    range_c: tuple[float, float]

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        if hasattr(self.options, "minimum_c"):
            self.range_c = low_c, high_c = self.options.minimum_c, self.options.maximum_c
            if low_c >= high_c:
                raise ConfigurationError(f"minimum_c {low_c:g} is not below maximum_c {high_c:g}")
        self._checked: dict[str, tuple[float, float]] = {}
        self._numbers: dict[str, tuple[float, float]] = {}

    def close(self) -> None:
        super().close()
        self._checked.clear()

    def supports(self, channel: str, value_c: float) -> bool:
        """Return whether a recent reading of the channel is close to a value."""
        at, last_c = self._checked.get(channel, (-math.inf, math.nan))
        recent = self.clock.monotonic() - at <= NEIGHBOUR_AGE_S
        return recent and abs(last_c - value_c) <= NEIGHBOUR_STEP_K

    def require_range(self, value_c: float, where: str) -> None:
        """Raise BadReading for a value that is not finite or outside the sensor's range."""
        low_c, high_c = self.range_c
        if not low_c <= value_c <= high_c:
            raise BadReading(
                f"{where}: {value_c:g} °C is outside the sensor's range {low_c:g} … {high_c:g} °C"
            )

    def judge(self, channel: str, where: str, value_c: float, idle: str = "") -> float:
        """Return a temperature that passes the checks; raise BadReading for any other.

        idle: why the value may not have been measured, for the message; "" for a measured value.
        An idle value fails without a recent reading near it; every value fails out of range.
        """
        self.require_range(value_c, where)
        if not idle:
            self._checked[channel] = (self.clock.monotonic(), value_c)
        elif not self.supports(channel, value_c):
            raise BadReading(
                f"{where}: {value_c:g} °C is {idle}, and no recent reading was near it"
            )
        return value_c

    def switched(self, source: str, number: float, scale: float) -> bool:
        """Return whether a number agrees with the source's last one only in another unit.

        Kernels report 45000 for 45 °C and, after an update of the fuel gauge or a suspend, 45. The
        last numbers are retained while the device is closed.
        """
        value, now = number * scale, self.clock.monotonic()
        at, last = self._numbers.get(source, (now, value))
        other = None
        if now - at <= SWITCH_S and abs(value - last) > NEIGHBOUR_STEP_K:
            rest = [number * unit for unit in UNITS.values() if unit != scale]
            other = next((c for c in rest if abs(c - last) <= NEIGHBOUR_STEP_K), None)
        self._numbers[source] = (now, value if other is None else other)
        return other is not None

    def reading(
        self, measures: Mapping[str, tuple[str, Callable[[], float]]], start: float | None = None
    ) -> Reading:
        """Measure every channel; measures: {channel: (where, function that returns °C)}.

        The reading's time is midway between `start` (s, by default the call) and the end. If no
        channel has a value, one error with the reasons of all is raised.
        """
        start = self.clock.monotonic() if start is None else start
        values: dict[str, float] = {}
        missing: dict[str, TransientDeviceError] = {}
        for channel, (where, measure) in measures.items():
            try:
                values[channel] = measure()
            except ValueError as error:
                missing[channel] = BadReading(f"{where}: not a number ({error})")
            except OSError as error:
                problem = fault(error, where, seen=True)
                if not isinstance(problem, TransientDeviceError):
                    raise problem from error
                missing[channel] = problem
        if not values:
            first = next(iter(missing.values()))
            raise type(first)("; ".join(map(str, missing.values()))) from first
        return middle_reading(self.clock, values, start, {k: str(e) for k, e in missing.items()})


BAYER_ORDERS = {
    # V4L2 names a format by its first row: RG10 starts with R G
    "RGGB": "RGGB", "RG10": "RGGB", "RG12": "RGGB", "RG16": "RGGB", "pRAA": "RGGB",
    "BA81": "BGGR", "BG10": "BGGR", "BG12": "BGGR", "BYR2": "BGGR", "pBAA": "BGGR",
    "GBRG": "GBRG", "GB10": "GBRG", "GB12": "GBRG", "GB16": "GBRG", "pGAA": "GBRG",
    "GRBG": "GRBG", "BA10": "GRBG", "BA12": "GRBG", "GR16": "GRBG", "pgAA": "GRBG",
}  # fmt: skip
_ONE_BYTE = {"GREY", "NV12", "YU12", "RGGB", "BA81", "GBRG", "GRBG"}  # per pixel, first plane
_TWO_PIXELS = {"YUYV": 0, "UYVY": 1}  # in four bytes: {format: the first byte of Y}
_PACKED = {"pRAA", "pBAA", "pGAA", "pgAA"}
FORMATS = ("GREY", "Y10 ", "Y12 ", "Y16 ", "YUYV", "UYVY", "NV12", "YU12", *BAYER_ORDERS)


def _plane(data: memoryview, height: int, row_bytes: int, stride: int) -> NDArray[np.uint8]:
    """Copy (height, row_bytes) bytes from rows of `stride` bytes; the last may lack padding."""
    stride = max(stride, row_bytes)
    needed = stride * (height - 1) + row_bytes
    if len(data) < needed:
        raise BadReading(f"partial frame: {len(data)} of {needed} bytes")
    flat = np.frombuffer(data, np.uint8)
    rows = np.lib.stride_tricks.as_strided(flat, (height, row_bytes), (stride, 1))
    return rows.copy()  # the camera overwrites its buffer as soon as it is queued again


def _grey(data: memoryview, fourcc: str, width: int, height: int, stride: int) -> Grey:
    """Return the grey image in one buffer."""
    image: Grey
    if fourcc in _TWO_PIXELS:
        first = _TWO_PIXELS[fourcc]
        return np.ascontiguousarray(_plane(data, height, 2 * width, stride)[:, first::2])
    if fourcc in _ONE_BYTE:
        image = _plane(data, height, width, stride)
    elif fourcc in _PACKED:  # MIPI RAW10: four high bytes, then one with four pairs of low bits
        packed = _plane(data, height, width * 5 // 4, stride).reshape(height, -1, 5)
        low = packed[..., 4:] >> np.array([0, 2, 4, 6], np.uint8) & np.uint8(3)
        image = (packed[..., :4].astype(np.uint16) << np.uint16(2) | low).reshape(height, -1)
    else:
        image = _plane(data, height, 2 * width, stride).view("<u2")
    if fourcc not in BAYER_ORDERS:
        return image
    import cv2

    conversion = getattr(cv2, f"COLOR_Bayer{BAYER_ORDERS[fourcc]}2GRAY")
    return cast("Grey", cv2.cvtColor(image, conversion))


def decode_jpeg(encoded: bytes) -> Grey:
    """Return a JPEG's grey image; cameras pad its end, and phones append a video or other data."""
    import simplejpeg

    try:
        return np.ascontiguousarray(simplejpeg.decode_jpeg(encoded, colorspace="GRAY")[:, :, 0])
    except ValueError as error:
        raise BadReading(f"partial frame or broken JPEG, {len(encoded)} bytes ({error})") from error


def decode(
    data: memoryview, fourcc: str, width: int, height: int, stride: int = 0
) -> tuple[Grey, bytes | None]:
    """Return (grey image, the JPEG as received or None); the buffer may then be reused."""
    if fourcc != "MJPG":
        return _grey(data, fourcc, width, height, stride), None
    encoded = bytes(data)
    grey = decode_jpeg(encoded)
    if grey.shape != (height, width):
        raise BadReading(f"the JPEG has {grey.shape[1]}×{grey.shape[0]} px, not {width}×{height}")
    return grey, encoded
