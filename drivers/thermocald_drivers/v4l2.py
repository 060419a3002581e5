"""Video4Linux cameras: UVC (USB) cameras, and the Raspberry Pi camera in legacy mode.

    cameras:
      - name: logitech
        driver: v4l2
        device: /dev/v4l/by-id/usb-046d_HD_Pro_Webcam_C920_8A3F-video-index0 # serial: 8A3F
        width: 1920
        height: 1080
        pixel_format: MJPG            # GREY, Y16, YUYV, NV12, MJPG, Bayer (RG10, pRAA) …
        exposure_s: 0.0156            # these four: a value, `auto`, or omitted: locked as it is
        gain: 0
        focus: 0                      # focus position in the camera's own unit
        white_balance_k: 4600
        controls: {power_line_frequency: 1, sharpness: 0}     # any others, by v4l2-ctl's names
        card: C920                    # a camera whose name lacks this is rejected
        strict: true                  # false: a setting that changes is stored, not an error
        timeout_s: 5
        backend: auto                 # linuxpy, opencv; auto: linuxpy if installed
        dev: /dev                     # the folder of the device nodes

A camera that refocuses has another calibration. An omitted setting is therefore locked at its value
when the camera is opened, automatic modes are switched off, and `auto` has to be written explicitly
and is shown as a warning in the status. Every setting is read back after it was set and with each
frame, and is stored with the epoch; a setting that the camera ignores or resets to automatic is an
error, and the frame is rejected. `thermocald devices` writes the current values into the stanza.

The frame's time is its buffer's time stamp, moved to the middle of the exposure. Frames that were
exposed before the call of `capture` are discarded.
Source: Linux Documentation/userspace-api/media/v4l/ext-ctrls-camera.rst, control.rst.
"""

from __future__ import annotations

import errno
import time
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from thermocald.errors import (
    BadReading,
    ConfigurationError,
    DeviceTimeout,
    DriverMissing,
    TransientDeviceError,
    WrongDevice,
)
from thermocald.hal import Camera, DriverOptions, Found, Frame
from thermocald_drivers import support
from thermocald_drivers.support import AUTO
from thermocald_drivers.v4l2_stream import BUFFERS, OLDEST_S, LinuxpyStream, OpenCvStream

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald_drivers.v4l2_stream import Control, Grab, Stream


FUTURE_S = 1.0
"""A time stamp may be this far ahead (vivid: up to a frame); a later one is of another clock."""
EXPOSURE = 0x009A0902
_UNREADABLE = {errno.EINVAL, errno.EACCES, errno.ENOTTY}


@dataclass(frozen=True)
class Lock:
    """A setting: its option, the automatic mode and its values, the control and its unit."""

    option: str
    automatic: int
    manual: int
    automatic_values: tuple[int, ...]
    control: int
    unit: float = 1.0


LOCKS = (
    # V4L2_EXPOSURE_MANUAL is 1; aperture priority, automatic, shutter priority are 3, 0, 2
    Lock("exposure_s", 0x009A0901, 1, (3, 0, 2), EXPOSURE, 1e-4),
    Lock("gain", 0x00980912, 0, (1,), 0x00980913),
    Lock("focus", 0x009A090C, 0, (1,), 0x009A090A),
    Lock("white_balance_k", 0x0098090C, 0, (1,), 0x0098091A),
)
HELD = (0x009A0908, 0x009A0909, 0x009A090D, 0x009A0911)  # pan, tilt, zoom, iris
OFF = (0x009A0916,)  # image stabilisation
MODES = {lock.automatic: lock for lock in LOCKS}


FORMATS = ("MJPG", *(name.strip() for name in support.FORMATS))
NO_FORMAT = f"is not one of {', '.join(FORMATS)}"
Whole = Annotated[int | str | None, support.or_auto(0, 1e6)]


class V4l2Camera(Camera):
    """A capture device, streaming while it is open."""

    device_classes = ("char-video4linux",)

    class Options(DriverOptions):
        """The options of `v4l2`; a setting that is None is locked as it is."""

        width: support.Pixels
        height: support.Pixels
        device: support.Text | None = None
        serial: support.Text | None = None
        card: support.Text | None = None
        pixel_format: Annotated[str, support.like("|".join(FORMATS), NO_FORMAT)] = "YUYV"
        exposure_s: Annotated[float | str | None, support.or_auto(1e-5, 60)] = None
        gain: Whole = None
        focus: Whole = None
        white_balance_k: Whole = None
        controls: dict[str, Annotated[int, Field(ge=-(2**31), lt=2**31)]] = {}  # noqa: RUF012
        strict: bool = True
        timeout_s: Annotated[float, Field(ge=0.05, le=600.0)] = 5.0
        backend: Literal["auto", "linuxpy", "opencv"] = "auto"
        dev: support.Text = "/dev"

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        o = self.options
        if (o.device is None) == (o.serial is None):
            raise ConfigurationError("set either device: (/dev/v4l/by-id/…) or serial:")
        self.where = f"camera {o.device or o.serial}"
        self._wanted = {lock.option: getattr(o, lock.option) for lock in LOCKS}
        self._held: dict[int, int] = {}  # also while it is closed and opened again

    @classmethod
    def attached(cls, sysfs: str = "/sys", dev: str = "/dev") -> list[Found]:
        """List capture nodes by their permanent names (by-id, by-path), else /dev/videoN."""
        found = []
        for node in sorted(Path(sysfs).glob("class/video4linux/video*")):
            try:
                name = support.read_line(node / "name")
                if support.read_line(node / "index") != "0":
                    continue  # a UVC camera's second node carries metadata, not frames
            except OSError:
                continue
            path = Path(dev) / node.name
            links = [
                link
                for folder in ("by-id", "by-path")
                for link in sorted((Path(dev) / "v4l" / folder).glob("*"))
                if link.resolve() == path.resolve()
            ]
            lasting = str(links[0] if links else path)
            options = {"device": lasting, "width": 1920, "height": 1080, "pixel_format": "MJPG"}
            options |= current_settings(str(path))
            about = f"{name} ({path}); sizes: v4l2-ctl -d {path} --list-formats-ext"
            found.append(Found(options, about))
        return found

    def open(self) -> None:
        o, path = self.options, self._path()
        try:
            try:
                stream: Stream = (OpenCvStream if o.backend == "opencv" else LinuxpyStream)(path)
            except DriverMissing:
                if o.backend != "auto":
                    raise
                stream = OpenCvStream(path)
            self.handle = stream
            stream.set_format(o.pixel_format.ljust(4), o.width, o.height)
            if o.card is not None and o.card not in stream.card:
                raise WrongDevice(f"{path}: this is {stream.card!r}, not {o.card!r}")
            self._apply()
            stream.start()
        except OSError as error:
            self.close()
            if self.seen and isinstance(error, WrongDevice):
                # another device may have its node until the camera is plugged in again
                raise TransientDeviceError(str(error)) from error
            hint = "check that it is plugged in and the user is in the group video"
            raise support.fault(error, self.where, seen=self.seen, hint=hint) from error
        self.seen = True

    def warnings(self) -> list[str]:
        return support.automatic_warnings(self._wanted)

    def identity(self) -> Mapping[str, str]:
        return {**super().identity(), "card": self.handle.card if self.handle else ""}

    def capture(self) -> Frame:
        stream: Stream = self.opened()
        called = time.monotonic()
        deadline = called + self.options.timeout_s
        try:
            settings = self._settings(self._values())
            # known only in manual exposure
            exposure = None if settings.get("exposure_auto") else settings.get("exposure_s")
            grab, stamp = self._fresh(stream, called, deadline, exposure or 0.0)
            values = self._values()
        except OSError as error:
            raise support.fault(error, self.where, seen=True) from error
        disobeyed = self._deviations(values)
        if disobeyed and self.options.strict:
            raise BadReading(f"{self.where}: {'; '.join(disobeyed)}")
        middle = stamp + (0.5 if grab.start_of_exposure else -0.5) * (exposure or 0.0)
        monotonic, utc = support.on_clock(self.clock, middle)
        return Frame(
            image=grab.image,
            encoded=grab.encoded,
            monotonic=monotonic,
            utc=utc,
            exposure=exposure,
            sequence=grab.sequence,
            settings=self._settings(values),
        )

    def _fresh(
        self, stream: Stream, called: float, deadline: float, exposure_s: float
    ) -> tuple[Grab, float]:
        """Return a frame that was exposed after the call, and its time stamp, s."""
        dropped, arrived = 0, 0.0
        broken: BadReading | None = None

        def accept(stamp: float | None, start_of_exposure: bool) -> bool:
            nonlocal arrived
            arrived = time.monotonic()
            if stamp is not None and not arrived - OLDEST_S < stamp < arrived + FUTURE_S:
                raise WrongDevice(
                    f"{self.where}: the frame's time stamp {stamp:.3f} s is not on this machine's "
                    f"monotonic clock ({arrived:.3f} s)"
                )
            if stamp is None or stamp > arrived:
                return dropped >= BUFFERS  # unknown time: the first frame that cannot have waited
            return stamp - (0.0 if start_of_exposure else exposure_s) >= called

        while True:
            try:
                grab = stream.grab(deadline, accept)
            except BadReading as error:
                broken = error
                if time.monotonic() >= deadline:
                    raise
                continue
            except DeviceTimeout as error:
                if broken is not None:
                    raise BadReading(f"{self.where}: only broken frames; {broken}") from error
                after = f", {dropped} old frames were in the queue" if dropped else ""
                message = f"{self.where}: no new frame in {self.timeout_s:g} s{after}"
                raise DeviceTimeout(message) from error
            if grab is not None:
                stamp = arrived if grab.stamp is None else grab.stamp
                return grab, min(stamp, arrived)
            dropped += 1

    def _path(self) -> str:
        """Return the device node; a serial number is looked up among udev's names."""
        o = self.options
        if o.device is not None:
            return str(o.device)
        folder = Path(o.dev) / "v4l/by-id"
        links = sorted(folder.glob(f"*{o.serial}*-video-index0"))
        if len(links) > 1:
            names = ", ".join(link.name for link in links)
            raise WrongDevice(f"camera {o.serial}: several match: {names}; set device:")
        if not links:
            raise support.absent(f"camera {o.serial}: none in {folder}", seen=self.seen)
        return str(links[0])

    def _apply(self) -> None:
        """Apply all settings, automatic modes first.

        Raises WrongDevice for a setting that the camera does not have or hold.
        """
        self._available: dict[int, Control] = self.handle.controls()
        self._asked: dict[int, int] = {}
        locked = self._collect()
        for control, value in self._asked.items():
            self._set(control, value, locked)
        for control in locked & set(self._asked):
            if control not in MODES:
                # the camera may round: its value is what is locked
                self._asked[control] = self._held[control] = self.handle.get(control)
        problems = self._deviations(self._values())
        if problems and self.options.strict:
            raise WrongDevice(f"{self.where}: {'; '.join(problems)}")

    def _collect(self) -> set[int]:
        """Fill `_asked`; return the controls that the stanza does not set."""
        locked = set()
        for lock in LOCKS:
            wanted = self._wanted[lock.option]
            if wanted == AUTO:
                self._ask_automatic(lock)
                continue
            if wanted is not None and lock.control not in self._available:
                raise WrongDevice(
                    f"{self.where}: {lock.option}: it has no control 0x{lock.control:08x}"
                )
            if wanted is None:
                locked |= {lock.automatic, lock.control}
                value = self._value_to_hold(lock.control)
            else:
                value = round(float(wanted) / lock.unit)
            if lock.automatic in self._available:
                self._asked[lock.automatic] = lock.manual
            if value is not None:
                self._asked[lock.control] = value
        for control in HELD:
            if (value := self._value_to_hold(control)) is not None:
                self._asked[control] = value
                locked.add(control)
        self._asked |= {control: 0 for control in OFF if control in self._available}
        by_name = {control.name: number for number, control in self._available.items()}
        for name, number in self.options.controls.items():
            if name not in by_name:
                known = ", ".join(sorted(by_name)) or "none"
                raise WrongDevice(f"{self.where}: there is no control {name!r}; it has {known}")
            self._asked[by_name[name]] = number
            locked.discard(by_name[name])
        return locked

    def _ask_automatic(self, lock: Lock) -> None:
        if lock.automatic not in self._available:
            raise WrongDevice(f"{self.where}: {lock.option}: auto, but it has no automatic mode")
        if self.handle.get(lock.automatic) != lock.manual:
            return
        for value in lock.automatic_values:
            with suppress(OSError):
                self.handle.set(lock.automatic, value)
                return
        raise WrongDevice(f"{self.where}: {lock.option}: auto is not accepted")

    def _value_to_hold(self, control: int) -> int | None:
        """Return the value held before a re-plug, else the current one; None without either."""
        if control not in self._available:
            return None
        if control not in self._held:
            try:
                value = self.handle.get(control)
            except OSError as error:
                if error.errno not in _UNREADABLE:
                    raise
                return None
            self._held[control] = _bounded(value, self._available[control])
        return self._held[control]

    def _set(self, control: int, value: int, locked: set[int]) -> None:
        try:
            if control in locked and self.handle.get(control) == value:
                return  # some cameras reject a value that they already have
            self.handle.set(control, value)
        except OSError as error:
            if control in locked and control not in MODES:
                return  # it cannot be set, so it may stay; every frame is checked
            name, remedy = self._available[control].name, self._remedy(control, "it takes ")
            raise WrongDevice(
                f"{self.where}: does not take {name} = {value} ({error.strerror}); {remedy}"
            ) from error

    def _values(self) -> dict[int, int]:
        """Return the current values of all locked and automatic settings."""
        free = (lock for lock in LOCKS if self._wanted[lock.option] == AUTO)
        automatic = [control for lock in free for control in (lock.automatic, lock.control)]
        watched = [*self._asked, *(c for c in automatic if c in self._available)]
        return {control: self.handle.get(control) for control in dict.fromkeys(watched)}

    def _deviations(self, values: Mapping[int, int]) -> list[str]:
        """Return a sentence for each control that does not read back as it was set."""
        return [
            f"{self._available[control].name} was set to {asked} and is {values[control]} "
            f"({self._remedy(control)})"
            for control, asked in self._asked.items()
            if values[control] != asked
        ]

    def _settings(self, values: Mapping[int, int]) -> dict[str, float]:
        """Return the values under the options' names and units; automatic modes as 1.0 and 0.0."""
        found: dict[str, float] = {}
        named = set()
        for lock in LOCKS:
            named |= {lock.automatic, lock.control}
            if lock.automatic in values:
                flag = lock.option.removesuffix("_s").removesuffix("_k") + "_auto"
                found[flag] = float(values[lock.automatic] != lock.manual)
            if lock.control in values:
                found[lock.option] = round(values[lock.control] * lock.unit, 9)
        others = {self._available[c].name: float(v) for c, v in values.items() if c not in named}
        return found | others

    def _remedy(self, control: int, range_of: str = "") -> str:
        """Return the advice for a control that does not hold: the option to set, or its range."""
        if lock := MODES.get(control):
            return f"to let it change, set {lock.option}: auto"
        c = self._available[control]
        return f"{range_of}{c.minimum} … {c.maximum} in steps of {c.step}"


def current_settings(path: str) -> dict[str, float]:
    """Return {option: current value} of a camera, unchanged; {} if it cannot be opened."""
    found: dict[str, float] = {}
    with suppress(OSError, DriverMissing), closing(LinuxpyStream(path)) as stream:
        available = stream.controls()
        for lock in LOCKS:
            if lock.control in available:
                with suppress(OSError):
                    value = _bounded(stream.get(lock.control), available[lock.control])
                    found[lock.option] = round(value * lock.unit, 9) if lock.unit != 1 else value
    return found


def _bounded(value: int, limits: Control) -> int:
    return min(max(value, limits.minimum), limits.maximum)
