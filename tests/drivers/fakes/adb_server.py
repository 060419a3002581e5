"""An adb server on loopback with phones: the protocol that adbutils uses.

Source: packages/modules/adb, OVERVIEW.TXT, SERVICES.TXT, SYNC.TXT. `make hil` uses the real adb
server and a real adbd.
"""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import socket
import struct
import time
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from PIL import Image

from tests.drivers.fakes.line_server import LineServer

if TYPE_CHECKING:
    from collections.abc import Callable


def wait_little(monkeypatch) -> None:
    """Poll for photographs more often, and remove adbutils' pauses at each connection."""
    import adbutils._adb
    from thermocald_drivers import android

    monkeypatch.setattr(android, "POLL_S", 0.01)
    monkeypatch.setattr(adbutils._adb, "time", SimpleNamespace(sleep=lambda _: None))


TAGS = {"exposure": 0x829A, "iso": 0x8827, "distance": 0x9206, "subsecond": 0x9291, "zone": 0x9011,
        "zoom": 0xA404}  # fmt: skip
FOCUS = """  android.lens.focusDistance (80007): float[1]
        [0.25 ]
"""


def photograph(when: float, size=(96, 64), **stated) -> bytes:
    """Return a JPEG with EXIF, exposed at `when` (s UTC; the phone's zone is UTC)."""
    image = Image.fromarray(np.add.outer(np.arange(size[1]), np.arange(size[0])).astype(np.uint8))
    tags = Image.Exif()
    sub = tags.get_ifd(0x8769)
    sub[0x9003] = time.strftime("%Y:%m:%d %H:%M:%S", time.gmtime(when))
    usual = {"exposure": 1 / 60, "iso": 100, "distance": 1.5,
             "subsecond": f"{int(when % 1 * 1000):03d}"}  # fmt: skip
    for name, value in (usual | stated).items():
        if value is not None:
            sub[TAGS[name]] = value
    out = io.BytesIO()
    image.save(out, "JPEG", quality=95, exif=tags)
    return out.getvalue()


def shoot(count=1, writing_s=0.0, **stated) -> Callable[[FakePhone], None]:
    """Return a camera app that writes `count` photographs per trigger."""

    def write(phone: FakePhone) -> None:
        for k in range(count):
            name = f"IMG_{len(phone.files):04d}_{k}.jpg"
            phone.add(name, photograph(phone.now(), **stated), writing_s)

    return write


@dataclass
class FakePhone:
    """A phone's files, shell answers and camera behaviour; tests set its fields."""

    folder: str = "/sdcard/DCIM/Camera"
    clock_offset: float = 0.0
    date: str = "%.9f +0000"
    files: dict[str, bytes] = field(default_factory=dict)
    growing: dict[str, tuple[float, float]] = field(default_factory=dict)
    awake: bool = False
    locked: bool = False
    stays_locked: bool = False
    free_kb: int = 5_000_000
    trigger: str = "input keyevent 27"
    shoot: Callable[[FakePhone], None] | None = field(default_factory=shoot)
    state: str = "device"
    battery: str = "  voltage: 4100\n  temperature: 287\n"
    thermal: str = ""
    zones: str = ""
    media_camera: str = FOCUS
    hang_s: float = 0.0
    cut_transfer: bool = False
    load: bool = False
    commands: list[str] = field(default_factory=list)

    def now(self) -> float:
        return time.time() + self.clock_offset

    def add(self, name: str, data: bytes, writing_s: float = 0.0) -> None:
        self.files[name] = data
        if writing_s:
            self.growing[name] = (time.monotonic(), writing_s)

    def content(self, name: str) -> bytes:
        data, (begin, takes) = self.files[name], self.growing.get(name, (0.0, 1e-9))
        return data[: int(len(data) * min(1.0, (time.monotonic() - begin) / takes))]

    def shell(self, command: str) -> str:
        self.commands.append(command)
        if command.startswith("input keyevent 224"):
            self.awake, self.locked = True, self.stays_locked
        if command == self.trigger and self.shoot:
            self.shoot(self)
        if command.startswith("rm -f"):
            self.files.pop(shlex.split(command)[2].rsplit("/", 1)[1], None)
        if command.startswith(("timeout", "pkill")):
            self.load = command.startswith("timeout")
        answers = {
            "date": self.date % self.now() + "\n",
            "dumpsys power": f"  mWakefulness={'Awake' if self.awake else 'Asleep'}\n"
            f"  mShowingLockscreen={str(self.locked).lower()}\n",
            "df": f"Filesystem 1K-blocks Used Available Use% On\n/dev/x 9 9 {self.free_kb} 9% /\n",
            "for z in /sys/class/thermal": self.zones,
            "dumpsys battery": self.battery,
            "dumpsys thermalservice": self.thermal,
            "dumpsys media.camera": self.media_camera,
        }
        return next((text for begin, text in answers.items() if command.startswith(begin)), "")


class AdbServer(LineServer):
    """A server with `phones` by serial number; `listing` replaces `adb devices`' output."""

    def __init__(self) -> None:
        self.phones: dict[str, FakePhone] = {}
        self.listing: str | None = None
        super().__init__("adb")

    def _serve(self, line: socket.socket) -> None:
        with line, contextlib.suppress(OSError, ValueError, struct.error):
            self._host(line, line.makefile("rb"))

    def _host(self, line: socket.socket, stream: BinaryIO) -> None:
        request = _request(stream)
        if request == "host:version":
            _block(line, "0029")
        elif request == "host:devices":
            mine = "".join(f"{serial}\t{p.state}\n" for serial, p in self.phones.items())
            _block(line, mine if self.listing is None else self.listing)
        elif match := re.fullmatch(r"host-serial:(.*):features", request):
            if self._phone(line, match[1]):
                _block(line, "shell_v2,cmd,stat_v2")
        elif match := re.fullmatch(r"host:tport:serial:(.*)", request):
            phone = self._phone(line, match[1])
            if phone:
                line.sendall(b"OKAY" + struct.pack("<Q", 1))
                self._device(line, stream, phone)

    def _phone(self, line: socket.socket, serial: str) -> FakePhone | None:
        phone = self.phones.get(serial)
        if phone is None:
            text = f"device '{serial}' not found"
            line.sendall(b"FAIL" + f"{len(text):04x}{text}".encode())
            return None
        time.sleep(phone.hang_s)
        return phone

    def _device(self, line: socket.socket, stream: BinaryIO, phone: FakePhone) -> None:
        request = _request(stream)
        line.sendall(b"OKAY")
        if request.startswith("shell,v2:"):
            text = phone.shell(request.removeprefix("shell,v2:")).encode()
            if text:
                line.sendall(struct.pack("<BI", 1, len(text)) + text)
            line.sendall(struct.pack("<BIB", 3, 1, 0))
        elif request.startswith("shell:"):
            line.sendall(phone.shell(request.removeprefix("shell:")).encode())
        elif request == "sync:":
            self._sync(line, stream, phone)

    def _sync(self, line: socket.socket, stream: BinaryIO, phone: FakePhone) -> None:
        command, size = struct.unpack("<4sI", stream.read(8))
        path = stream.read(size).decode()
        if command == b"LIST":
            entries = [(b".", 0o040755, 0)]
            if path == phone.folder:
                entries += [
                    (n.encode(), 0o100660, len(phone.content(n))) for n in list(phone.files)
                ]
            for name, mode, length in entries:
                head = struct.pack("<4sIIII", b"DENT", mode, length, 1_700_000_000, len(name))
                line.sendall(head + name)
            line.sendall(b"DONE" + bytes(16))
        elif command == b"RECV":
            data = phone.content(path.rsplit("/", 1)[1])
            for at in range(0, len(data), 1024):
                chunk = data[at : at + 1024]
                if phone.cut_transfer and at:
                    line.sendall(b"DATA" + struct.pack("<I", len(chunk)) + chunk[:10])
                    return
                line.sendall(b"DATA" + struct.pack("<I", len(chunk)) + chunk)
            line.sendall(b"DONE" + bytes(4))


def _request(stream: BinaryIO) -> str:
    return stream.read(int(stream.read(4), 16)).decode()


def _block(line: socket.socket, text: str) -> None:
    line.sendall(b"OKAY" + f"{len(text):04x}{text}".encode())
