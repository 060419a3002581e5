"""A V4L2 capture stream: buffers with the kernel's time stamps and a time-out on every wait.

Two classes implement one contract, with linuxpy's ioctls and with OpenCV. `grab` returns the next
buffer, or None if `accept(stamp, start_of_exposure)` is false (an old frame is not decoded), and
raises BadReading for a damaged one. linuxpy's own frame iterator waits forever after an unplug;
hence the poll here.
"""

from __future__ import annotations

import logging
import os
import select
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from thermocald.errors import BadReading, DeviceGone, DeviceTimeout, WrongDevice
from thermocald_drivers import support

if TYPE_CHECKING:
    from collections.abc import Callable
    from concurrent.futures import Future

    from thermocald_drivers.support import Grey

    Accept = Callable[[float | None, bool], bool]

ERROR, TYPE_MASK, START_OF_EXPOSURE = 0x40, 0xE000, 0x10000
OLDEST_S = 3600.0
BUFFERS = 3
OPENCV_PROPERTIES = {
    # V4L2 control: OpenCV's property
    0x009A0901: "CAP_PROP_AUTO_EXPOSURE",
    0x009A0902: "CAP_PROP_EXPOSURE",
    0x00980913: "CAP_PROP_GAIN",
    0x009A090C: "CAP_PROP_AUTOFOCUS",
    0x009A090A: "CAP_PROP_FOCUS",
    0x0098090C: "CAP_PROP_AUTO_WB",
    0x0098091A: "CAP_PROP_WB_TEMPERATURE",
    0x009A0908: "CAP_PROP_PAN",
    0x009A0909: "CAP_PROP_TILT",
    0x009A090D: "CAP_PROP_ZOOM",
    0x009A0911: "CAP_PROP_IRIS",
}


@dataclass(frozen=True)
class Grab:
    """One buffer; stamp: its time (s, CLOCK_MONOTONIC), None if the driver gives none."""

    image: Grey
    encoded: bytes | None
    stamp: float | None
    start_of_exposure: bool
    sequence: int | None


@dataclass(frozen=True)
class Control:
    """A setting of the camera and its range; name: in lower case with underscores."""

    name: str
    minimum: int
    maximum: int
    step: int


class LinuxpyStream:
    """Memory-mapped capture through linuxpy's ioctl wrappers; `set_format` comes first."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._video = support.library("linuxpy.video.device", "v4l2")
        logging.getLogger("linuxpy").setLevel(logging.WARNING)  # it logs each open and close
        self._device = self._video.Device(path)
        self._capture: Any = None
        self._device.open()
        self.card = ""

    def set_format(self, fourcc: str, width: int, height: int) -> None:
        """Set the format; WrongDevice if the camera chooses another."""
        path, self._fourcc, self._size = self._path, fourcc, (width, height)
        self.card = self._device.info.card
        capabilities = self._device.info.device_capabilities
        if self._video.Capability.VIDEO_CAPTURE not in capabilities:
            raise WrongDevice(
                f"{path}: {self.card!r} is not a capture device; try its first /dev/video"
            )
        kind = self._video.BufferType.VIDEO_CAPTURE
        self._video.set_format(self._device, kind, width, height, fourcc)
        pixels = self._video.get_raw_format(self._device, kind).fmt.pix
        got = pixels.pixelformat.to_bytes(4, "little").decode("ascii", "replace")
        if (pixels.width, pixels.height, got) != (width, height, fourcc):
            raise WrongDevice(
                f"{path}: asked for {width}×{height} {fourcc}, the camera gives "
                f"{pixels.width}×{pixels.height} {got}; see v4l2-ctl --list-formats-ext"
            )
        self._stride = int(pixels.bytesperline)

    def controls(self) -> dict[int, Control]:
        """Return the camera's controls by their V4L2 numbers."""
        return {
            c.id: Control(plain_name(c.name.decode()), c.minimum, c.maximum, c.step)
            for c in self._video.iter_read_controls(self._device)
        }

    def get(self, control: int) -> int:
        return int(self._video.get_control(self._device, control))

    def set(self, control: int, value: int) -> None:
        self._video.set_control(self._device, control, value)

    def start(self) -> None:
        self._capture = self._video.VideoCapture(self._device, size=BUFFERS)
        self._capture.open()

    def grab(self, deadline: float, accept: Accept) -> Grab | None:
        buffer = self._dequeue(deadline)
        stamp: float | None = buffer.timestamp.secs + buffer.timestamp.usecs * 1e-6
        if not stamp or (not buffer.flags & TYPE_MASK and abs(stamp - time.monotonic()) > OLDEST_S):
            stamp = None  # missing, or of another clock (from a driver that does not state which)
        at_start = bool(buffer.flags & START_OF_EXPOSURE)
        try:
            if not accept(stamp, at_start):
                return None
            if buffer.flags & ERROR:
                raise BadReading(
                    f"{self._path}: the driver flags frame {buffer.sequence} as broken"
                )
            used = memoryview(self._capture.buffer.buffers[buffer.index])[: buffer.bytesused]
            try:
                image, encoded = support.decode(used, self._fourcc, *self._size, self._stride)
            finally:
                used.release()
        finally:
            self._video.enqueue_buffer(
                self._device, buffer.type, self._video.Memory.MMAP, 0, buffer.index
            )
        return Grab(image, encoded, stamp, at_start, int(buffer.sequence))

    def _dequeue(self, deadline: float) -> Any:
        poll = select.poll()
        poll.register(self._device.fileno(), select.POLLIN)
        kind, memory = self._video.BufferType.VIDEO_CAPTURE, self._video.Memory.MMAP
        while True:
            try:
                return self._video.dequeue_buffer(self._device, kind, memory)
            except BlockingIOError:
                left = deadline - time.monotonic()
                if left <= 0:
                    raise DeviceTimeout(f"{self._path}: no frame came") from None
                poll.poll(left * 1000.0)

    def close(self) -> None:
        for opened in filter(None, (self._capture, self._device)):
            with suppress(OSError):  # an unplugged camera cannot be stopped
                opened.close()
        self._capture = None


class OpenCvStream:
    """OpenCV's V4L2 back end; a grab that blocks (10 s) is abandoned in its own thread."""

    card = "unknown: OpenCV does not report it"

    def __init__(self, path: str) -> None:
        self._cv2 = cv2 = support.library("cv2")
        self._path = path
        self._pending: Future[Grab] | None = None
        os.close(os.open(path, os.O_RDWR))  # says why it fails, which OpenCV does not
        self._capture = cv2.VideoCapture(path, cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise DeviceGone(f"{path}: OpenCV cannot open it (busy, or not a capture device)")

    def set_format(self, fourcc: str, width: int, height: int) -> None:
        """Set the format; WrongDevice if the camera chooses another size."""
        cv2, self._fourcc, self._size = self._cv2, fourcc, (width, height)
        # OpenCV resets a device to 640×480 on opening; the format has to be set before the size
        self._capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*fourcc))
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
        self._capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        sides = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT
        got = [int(self._capture.get(side)) for side in sides]
        if got != [width, height]:
            raise WrongDevice(
                f"{self._path}: asked for {width}×{height}, the camera gives {got[0]}×{got[1]}"
            )

    def controls(self) -> dict[int, Control]:
        return {
            number: Control(name.removeprefix("CAP_PROP_").lower(), -(2**31), 2**31 - 1, 1)
            for number, name in OPENCV_PROPERTIES.items()
            if self._capture.get(getattr(self._cv2, name)) != -1
        }

    def get(self, control: int) -> int:
        value: float = self._capture.get(getattr(self._cv2, OPENCV_PROPERTIES[control]))
        return round(value)

    def set(self, control: int, value: int) -> None:
        self._capture.set(getattr(self._cv2, OPENCV_PROPERTIES[control]), value)

    def start(self) -> None:
        """Do nothing: OpenCV streams from the first grab."""

    def grab(self, deadline: float, accept: Accept) -> Grab | None:
        if self._pending is None or self._pending.done():
            self._pending = support.in_thread(self._read, "opencv-grab")
        late = f"{self._path}: no frame came"
        grab = support.result_in_time(self._pending, deadline - time.monotonic(), late)
        return grab if accept(grab.stamp, False) else None

    def _read(self) -> Grab:
        good, raw = self._capture.read()
        if not good:
            raise DeviceGone(f"{self._path}: OpenCV gets no frame (unplugged?)")
        stamp = self._capture.get(self._cv2.CAP_PROP_POS_MSEC) / 1000.0
        data = memoryview(raw.reshape(-1).view("u1"))
        image, encoded = support.decode(data, self._fourcc, *self._size)
        return Grab(image, encoded, stamp if stamp > 0 else None, False, None)

    def close(self) -> None:
        if self._pending is not None and not self._pending.done():
            capture = self._capture  # released by the thread that still uses it
            self._pending.add_done_callback(lambda _: capture.release())
            return
        self._capture.release()


Stream = LinuxpyStream | OpenCvStream


def plain_name(name: str) -> str:
    """Convert `Exposure Time, Absolute` to v4l2-ctl's form: exposure_time_absolute."""
    return "_".join("".join(c if c.isalnum() else " " for c in name.lower()).split())
