"""Cameras of Video4Linux: UVC (USB) cameras, and the Raspberry Pi camera in legacy mode.

    cameras:
      - name: logitech
        driver: v4l2
        device: /dev/v4l/by-id/usb-046d_HD_Pro_Webcam_C920_8A3F-video-index0 # serial: 8A3F
        width: 1920
        height: 1080
        pixel_format: MJPG            # GREY, Y16, YUYV, NV12, MJPG, Bayer (RG10, pRAA) …
        exposure_s: 0.0156            # these four: a value, `auto`, or left out: locked as it is
        gain: 0
        focus: 0                      # focus position in the camera's own unit
        white_balance_k: 4600
        controls: {power_line_frequency: 1, sharpness: 0}     # any other, named as v4l2-ctl does
        card: C920                    # refuses a camera that does not call itself so
        strict: true                  # false: a setting that does not hold is only stored
        timeout_s: 5
        backend: auto                 # linuxpy, opencv; auto: what is installed
        dev: /dev                     # where the nodes are

A camera that focuses is another camera: what is left out is locked at the value that it has when it
is opened, automatic modes are switched off, and `auto` is accepted only by name, with a warning in
the status. Every setting is read back after it was set and with each frame, and stored with the
epoch; a camera that does not obey, or that falls back to automatic, is an error and not a frame.
`thermocald devices` writes the current values into the stanza.

The frame's time is that of its buffer, moved to the middle of the exposure; frames that were
exposed before `capture` was called are discarded.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from thermocald.errors import (
    BadReading,
    ConfigurationError,
    DeviceError,
    DeviceGone,
    DeviceTimeout,
    DriverMissing,
    TransientDeviceError,
    WrongDevice,
)
from thermocald.hal import Camera, DriverOptions, Found, Frame
from thermocald_drivers import pixel_formats, support
from thermocald_drivers.v4l2_controls import LOCKS, CameraControls
from thermocald_drivers.v4l2_stream import (
    BUFFERS,
    OLDEST_S,
    Grab,
    LinuxpyStream,
    OpenCvStream,
    Stream,
    current_settings,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

FUTURE_S = 1.0
"""A time stamp may be this far ahead (vivid: up to a frame); beyond, it is another clock's."""


Whole = Annotated[int | str | None, support.or_auto(0, 1e6)]


class V4l2Options(DriverOptions):
    """None: locked as it is."""

    width: support.Pixels
    height: support.Pixels
    device: support.Text | None = None
    serial: support.Text | None = None
    card: support.Text | None = None
    pixel_format: support.Text = "YUYV"
    exposure_s: Annotated[float | str | None, support.or_auto(1e-5, 60)] = None
    gain: Whole = None
    focus: Whole = None
    white_balance_k: Whole = None
    controls: dict[str, Annotated[int, Field(ge=-(2**31), lt=2**31)]] = {}  # noqa: RUF012
    strict: bool = True
    timeout_s: Annotated[float, Field(ge=0.05, le=600.0)] = 5.0
    backend: Literal["auto", "linuxpy", "opencv"] = "auto"
    dev: support.Text = "/dev"


class V4l2Camera(Camera):
    """One capture device, streaming while it is open."""

    device_classes = ("char-video4linux",)

    Options = V4l2Options

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        o = self.options
        if (o.device is None) == (o.serial is None):
            raise ConfigurationError("write either device: (/dev/v4l/by-id/…) or serial:")
        known = ["MJPG", *(name.strip() for name in pixel_formats.FORMATS)]
        if o.pixel_format not in known:
            raise ConfigurationError(
                f"pixel_format: {o.pixel_format!r} is not one of {', '.join(known)}"
            )
        self.where = f"camera {o.device or o.serial}"
        wanted = {lock.option: getattr(o, lock.option) for lock in LOCKS}
        self._controls = CameraControls(self.where, wanted, o.controls)
        self._stream: Stream | None = None
        self._seen = False

    @classmethod
    def attached(cls, sysfs: str = "/sys", dev: str = "/dev") -> list[Found]:
        """Capture nodes by their permanent names (by-id, by-path), else /dev/videoN."""
        found = []
        for node in sorted(Path(sysfs).glob("class/video4linux/video*")):
            try:
                name = (node / "name").read_text().strip()
                if (node / "index").read_text().strip() != "0":
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
        path = self._path()
        try:
            self._stream = self._open_stream(path)
            self._check_card(path)
            self._controls.apply(self._stream, strict=self.options.strict)
            self._stream.start()
        except DeviceError as error:
            self.close()
            if self._seen and isinstance(error, WrongDevice):
                # it was the right one before: another may have its number until the next plug
                raise TransientDeviceError(str(error)) from error
            raise
        except OSError as error:
            self.close()
            hint = "is it plugged in, and the user in the group video?"
            raise support.fault(error, self.where, seen=self._seen, hint=hint) from error
        self._seen = True

    def close(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.close()

    def warnings(self) -> list[str]:
        return self._controls.warnings()

    def identity(self) -> Mapping[str, str]:
        card = self._stream.card if self._stream else ""
        return {"device": str(self.options.device or self.options.serial), "card": card}

    def frame_size(self) -> tuple[int, int]:
        return self.options.width, self.options.height

    def capture(self) -> Frame:
        if self._stream is None:
            raise DeviceGone(f"{self.where}: not open")
        called = time.monotonic()
        deadline = called + self.options.timeout_s
        try:
            exposure = self._exposure(self._controls.values(self._stream))
            grab, stamp, dropped = self._fresh(self._stream, called, deadline, exposure)
            values = self._controls.values(self._stream)
        except DeviceError:
            raise
        except OSError as error:
            raise support.fault(error, self.where, seen=True) from error
        disobeyed = self._controls.deviations(values)
        if disobeyed and self.options.strict:
            raise BadReading(f"{self.where}: {'; '.join(disobeyed)}")
        middle = stamp + (0.5 if grab.start_of_exposure else -0.5) * (exposure or 0.0)
        monotonic, utc = support.on_clock(self.clock, middle)
        metadata: dict[str, Any] = {
            "timestamp": "buffer" if stamp == grab.stamp else "arrival",
            "stale_frames_dropped": dropped,
            "controls": self._controls.configured(values),
        }
        if disobeyed:
            metadata["disobeyed"] = disobeyed
        return Frame(
            image=grab.image,
            encoded=grab.encoded,
            monotonic=monotonic,
            utc=utc,
            exposure=exposure,
            sequence=grab.sequence,
            metadata=metadata,
            settings=self._controls.settings(values),
        )

    def _fresh(
        self, stream: Stream, called: float, deadline: float, exposure: float | None
    ) -> tuple[Grab, float, int]:
        """(frame, its time stamp in s, stale frames dropped): exposed after the call."""
        dropped = 0
        broken: BadReading | None = None
        arrived = 0.0

        def accept(stamp: float | None, start_of_exposure: bool) -> bool:
            nonlocal arrived
            arrived = time.monotonic()
            if stamp is not None and not arrived - OLDEST_S < stamp < arrived + FUTURE_S:
                raise WrongDevice(
                    f"{self.where}: the frame's time stamp {stamp:.3f} s is not of this machine's "
                    f"monotonic clock ({arrived:.3f} s)"
                )
            if stamp is None or stamp > arrived:
                return dropped >= BUFFERS  # no information: take the first that cannot have waited
            return stamp - (0.0 if start_of_exposure else exposure or 0.0) >= called

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
                after = f", {dropped} old ones were in the queue" if dropped else ""
                raise DeviceTimeout(
                    f"{self.where}: no new frame in {self.options.timeout_s:g} s{after}"
                ) from error
            if grab is not None:
                stamp = arrived if grab.stamp is None else grab.stamp
                return grab, min(stamp, arrived), dropped
            dropped += 1

    def _path(self) -> str:
        """The node; a serial number is looked up among udev's names."""
        if self.options.device is not None:
            return str(self.options.device)
        links = sorted(
            (Path(self.options.dev) / "v4l/by-id").glob(f"*{self.options.serial}*-video-index0")
        )
        if len(links) > 1:
            names = ", ".join(link.name for link in links)
            raise WrongDevice(f"camera {self.options.serial}: several fit: {names}; write device:")
        if not links:
            raise support.absent(
                f"camera {self.options.serial}: none in {self.options.dev}/v4l/by-id",
                seen=self._seen,
            )
        return str(links[0])

    def _open_stream(self, path: str) -> Stream:
        arguments = (
            path,
            self.options.pixel_format.ljust(4),
            self.options.width,
            self.options.height,
        )
        if self.options.backend == "opencv":
            return OpenCvStream(*arguments)
        try:
            support.library("linuxpy.video.device", "v4l2")
        except DriverMissing:
            if self.options.backend == "linuxpy":
                raise
            return OpenCvStream(*arguments)
        return LinuxpyStream(*arguments)

    def _check_card(self, path: str) -> None:
        card = self._stream.card if self._stream else ""
        if self.options.card is not None and self.options.card not in card:
            raise WrongDevice(f"{path}: this is {card!r}, not {self.options.card!r}")

    def _exposure(self, values: Mapping[int, int]) -> float | None:
        """s, where the camera is in manual exposure and reports it."""
        settings = self._controls.settings(values)
        return None if settings.get("exposure_auto") else settings.get("exposure_s")
