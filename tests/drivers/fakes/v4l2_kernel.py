"""A V4L2 capture device below linuxpy: the ioctls of one camera, with buffers in a file.

The camera writes a frame every `period_s` into the oldest queued buffer, like a kernel driver:
buffers that are not dequeued keep old frames, and frames without a buffer are lost.
"""

from __future__ import annotations

import errno
import mmap
import time
from collections import deque
from typing import TYPE_CHECKING

import numpy as np
from linuxpy.video import raw

from tests.drivers.fakes.smbus import os_error

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

PAGE = mmap.PAGESIZE
INTEGER = 1


AUTO_FOCUS, FOCUS, ZOOM, STABILISE = 0x9A090C, 0x9A090A, 0x9A090D, 0x9A0916
AUTO_EXPOSURE, EXPOSURE, GAIN, FREQUENCY = 0x9A0901, 0x9A0902, 0x980913, 0x980918


class FakeCamera:
    """A camera with controls {id: [name, minimum, maximum, step, value]}; it focuses by itself."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.card, self.capture_device = "Fake Webcam", True
        self.formats = {("GREY", 64, 48), ("YUYV", 64, 48), ("MJPG", 64, 48)}
        self.period_s = 0.01
        self.flags = 0x2000  # monotonic, end of frame
        self.stamp: Callable[[float], float] = lambda now: now
        self.encode: Callable[[np.ndarray, str], bytes] = encode
        self.controls = {
            AUTO_EXPOSURE: ["Auto Exposure", 0, 3, 1, 3],
            EXPOSURE: ["Exposure Time, Absolute", 3, 2047, 1, 250],
            GAIN: ["Gain", 0, 255, 1, 64],
            FREQUENCY: ["Power Line Frequency", 0, 2, 1, 2],
            AUTO_FOCUS: ["Focus, Automatic Continuous", 0, 1, 1, 1],
            FOCUS: ["Focus, Absolute", 0, 255, 5, 35],
            ZOOM: ["Zoom, Absolute", 100, 500, 1, 120],
            STABILISE: ["Image Stabilization", 0, 1, 1, 1],
        }
        self.obeys: Callable[[int, int], int] = lambda _control, value: value
        self.errors: dict[str, int] = {}
        self.broken: set[int] = set()
        self.stalled = False
        self._format = ("GREY", 64, 48)
        self._size = 8 * PAGE
        path.write_bytes(bytes(4 * self._size))
        self._queued: deque[int] = deque()
        self._filled: deque[tuple[int, int, float, int]] = deque()
        self._next_at = 0.0
        self._sequence = 0

    @property
    def values(self) -> dict[int, int]:
        """The controls' values, which the camera itself may change."""
        return {number: control[4] for number, control in self.controls.items()}

    @values.setter
    def values(self, changed: dict[int, int]) -> None:
        for number, value in changed.items():
            self.controls[number][4] = value

    def ioctl(self, device, request, argument=None) -> None:
        name = request.name
        if name in self.errors:
            raise os_error(self.errors[name])
        getattr(self, f"_{name.lower()}")(argument)

    def _querycap(self, a) -> None:
        a.card, a.driver, a.bus_info = self.card.encode(), b"fake", b"usb-1"
        a.device_caps = a.capabilities = 0x04000001 if self.capture_device else 0x04800000

    def _s_fmt(self, a) -> None:
        pix = a.fmt.pix
        wanted = (pix.pixelformat.to_bytes(4, "little").decode(), pix.width, pix.height)
        self._format = wanted if wanted in self.formats else ("GREY", 64, 48)
        self._g_fmt(a)

    def _g_fmt(self, a) -> None:
        fourcc, a.fmt.pix.width, a.fmt.pix.height = self._format
        a.fmt.pix.pixelformat = raw.v4l2_fourcc(*fourcc)
        a.fmt.pix.bytesperline = {"GREY": 1, "YUYV": 2}.get(fourcc, 0) * self._format[1]
        a.fmt.pix.sizeimage = self._size

    def _query_ext_ctrl(self, a) -> None:
        after = a.id & 0x0FFFFFFF
        later = sorted(number for number in self.controls if number > after)
        if not later:
            raise os_error(errno.EINVAL)
        a.id, a.type = later[0], INTEGER
        name, a.minimum, a.maximum, a.step, _ = self.controls[later[0]]
        a.name = name.encode()

    def _g_ctrl(self, a) -> None:
        a.value = self.controls[a.id][4]

    def _s_ctrl(self, a) -> None:
        _, low, high, _, _ = self.controls[a.id]
        if not low <= a.value <= high:
            raise os_error(errno.ERANGE)
        self.controls[a.id][4] = self.obeys(a.id, a.value)

    def _reqbufs(self, a) -> None:
        self._queued.clear()
        self._filled.clear()

    def _querybuf(self, a) -> None:
        a.length, a.m.offset = self._size, a.index * self._size

    def _qbuf(self, a) -> None:
        self._queued.append(a.index)

    def _streamon(self, _a) -> None:
        self._next_at = time.monotonic() + self.period_s

    def _streamoff(self, _a) -> None:
        pass

    def made_by(self, now: float) -> int:
        """Return the number of the first frame after a time."""
        self._make_frames()
        return self._sequence + max(0, int((now - self._next_at) / self.period_s))

    def _make_frames(self) -> None:
        while not self.stalled and self._next_at <= time.monotonic():
            if self._queued:
                index = self._queued.popleft()
                image = np.full(self._format[2:0:-1], self._sequence % 256, np.uint8)
                data = self.encode(image, self._format[0])
                with self.path.open("r+b") as file:
                    file.seek(index * self._size)
                    file.write(data)
                self._filled.append((index, self._sequence, self._next_at, len(data)))
            self._sequence += 1
            self._next_at += self.period_s

    def _dqbuf(self, a) -> None:
        self._make_frames()
        if not self._filled:
            time.sleep(0.001)  # a regular file is always ready: poll would spin
            raise BlockingIOError(errno.EAGAIN, "try again")
        a.index, a.sequence, at, a.bytesused = self._filled.popleft()
        stamp = self.stamp(at)
        a.timestamp.secs, a.timestamp.usecs = int(stamp), round(stamp % 1 * 1e6)
        a.flags = self.flags | (0x40 if a.sequence in self.broken else 0)


def encode(image: np.ndarray, fourcc: str) -> bytes:
    if fourcc == "GREY":
        return image.tobytes()
    if fourcc == "YUYV":
        return np.stack([image, np.full_like(image, 128)], axis=-1).tobytes()
    import simplejpeg

    return simplejpeg.encode_jpeg(
        np.ascontiguousarray(image[..., None]), colorspace="GRAY", quality=95
    )
