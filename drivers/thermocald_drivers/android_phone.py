"""A phone behind an adb server: state, shell, listing, pull; each fault has its own error.

Uses adbutils, which implements the adb server's protocol (127.0.0.1:5037). The server is Android's
own (`adb start-server`); one server serves several phones by their serial numbers.
"""

from __future__ import annotations

import math
import socket
import stat
import struct
import time
from typing import TYPE_CHECKING, Any

from thermocald.errors import (
    BadReading,
    DeviceError,
    DeviceGone,
    DeviceNotFound,
    DeviceTimeout,
    WrongDevice,
)
from thermocald.hal import DriverOptions
from thermocald_drivers import support

if TYPE_CHECKING:
    from collections.abc import Callable

DENIED = (
    "unauthorized: unlock the phone and confirm 'Allow USB debugging' (tick 'always'); "
    "if nothing is asked: developer options, 'Revoke USB debugging authorizations', re-plug"
)
OFFLINE = (
    "offline: re-plug the cable, or `adb reconnect offline`; an unpowered hub is a common cause"
)

_CLOCK_S = 0.002
ADB_CLASSES = ("char-usb_device",)
"""Opened by the adb server where this driver starts it."""


class PhoneOptions(DriverOptions):
    """The phone, and the adb server behind which it is."""

    serial: support.Text
    host: support.Text = "127.0.0.1"
    port: support.Port = 5037
    start_server: bool = True
    timeout_s: support.Seconds


def list_devices() -> list[tuple[str, str]]:
    """Return (serial, state) of what a running adb server lists; [] without one."""
    adbutils = support.library("adbutils", "android")
    try:
        AdbPhone(PhoneOptions(serial="none", timeout_s=1.0)).require_server()
        return _devices(adbutils.AdbClient(socket_timeout=1.0))
    except (OSError, adbutils.AdbError):
        return []


def _devices(client: Any) -> list[tuple[str, str]]:
    """Return (serial, state) of `host:devices`; adbutils' own list cuts both at blanks."""
    with client.make_connection() as line:
        line.send_command("host:devices")
        line.check_okay()
        rows = line.read_string_block().replace("\r", "").split("\n")
    pairs = [row.partition("\t") for row in rows if "\t" in row]
    return [(serial.strip(), state.strip()) for serial, _, state in pairs]


class AdbPhone:
    """One phone: `connect` before anything else; `seen` once that has succeeded."""

    def __init__(self, options: PhoneOptions) -> None:
        self.serial = options.serial
        self.where = f"phone {self.serial}"
        self._host, self._port = options.host, options.port
        self._timeout_s, self._start_server = options.timeout_s, options.start_server
        self._device: Any = None
        self._lines: list[Any] = []
        self.seen = False

    def connect(self) -> None:
        """Find the phone among the server's devices; DeviceError says why it cannot be used."""
        adbutils = support.library("adbutils", "android")
        if not self._start_server:
            self.require_server()
        client = adbutils.AdbClient(self._host, self._port, socket_timeout=self._timeout_s)
        connect = client.make_connection

        def remembering(timeout: float | None = None) -> Any:
            self._lines.append(connect(timeout))
            return self._lines[-1]

        client.make_connection = remembering
        listed = self._call(lambda: _devices(client))
        states = [state for serial, state in listed if serial == self.serial]
        if len(states) > 1:
            raise WrongDevice(
                f"{self.where}: {len(states)} devices have this serial number "
                f"({', '.join(states)}); cheap phones share one: attach them to different machines"
            )
        if not states:
            others = ", ".join(f"{serial} ({state})" for serial, state in listed) or "none"
            raise support.absent(
                f"{self.where}: not attached; adb lists {others}; is USB debugging on, "
                "the cable one that carries data?",
                seen=self.seen,
            )
        state = states[0]
        if state in ("unauthorized", "offline"):
            raise self._translated(state)
        if state == "no" or state.startswith("no perm"):  # "no permissions (…); see http…"
            message = f"{self.where}: no permissions; see the udev rules in systemd/"
            raise support.denied(message, seen=self.seen)
        if state != "device":
            raise DeviceGone(f"{self.where}: its state is {state!r}; let it boot into Android")
        self._device = client.device(serial=self.serial)
        self.seen = True

    def require_server(self) -> None:
        """Raise a DeviceError unless an adb server answers; none is started."""
        try:
            socket.create_connection((self._host, self._port), timeout=self._timeout_s).close()
        except OSError as error:
            raise support.absent(
                f"no adb server at {self._host}:{self._port} ({error}); run `adb start-server`",
                seen=self.seen,
            ) from error

    def disconnect(self) -> None:
        """Forget the phone; the server keeps running."""
        self._device = None

    def shell(self, command: str) -> str:
        """Return the command's output (both streams); its exit status is ignored."""
        device = self._connected()
        answer = self._call(lambda: device.shell2(command, timeout=self._timeout_s, v2=True))
        return str(answer.output)

    def listing(self, folder: str) -> dict[str, int]:
        """Return {name: bytes} of the plain files of a folder."""
        device = self._connected()
        entries = self._call(lambda: list(device.sync.iter_directory(folder)))
        return {e.path: e.size for e in entries if stat.S_ISREG(e.mode)}

    def pull(self, path: str) -> bytes:
        """Return a file's bytes; BadReading if the phone ends it early."""
        device = self._connected()
        return bytes(self._call(lambda: device.sync.read_bytes(path)))

    def clock_offset(self, tries: int = 12) -> tuple[float, str, float]:
        """Return (phone minus this machine in s, the phone's time zone as +hhmm, uncertainty in s).

        Each round trip bounds the offset by its two ends; the result is the middle of the interval
        that satisfies all bounds, as soon as it is within 2 ms. If the clock is set meanwhile, no
        interval does: the shortest round trip then counts.
        """
        low, high = -math.inf, math.inf
        found: list[tuple[float, str, float]] = []
        while len(found) < tries and high - low > 2 * _CLOCK_S:
            offset, zone, half = self._call(self._ask_clock)
            found.append((offset, zone, half))
            low, high = max(low, offset - half), min(high, offset + half)
        if low > high:
            return min(found, key=lambda one: one[2])
        return (low + high) / 2.0, found[-1][1], (high - low) / 2.0

    def _ask_clock(self) -> tuple[float, str, float]:
        # the connection is opened first: adbutils sleeps 10 ms while opening and closing one, which
        # would lengthen one side of the round trip only
        line = self._connected().open_transport(timeout=self._timeout_s)
        start = time.time()
        line.send_command("shell:date '+%s.%N %z'")
        line.check_okay()
        text = line.read_until_close().split()
        end = time.time()
        try:
            phone = support.parse_number(text[0])
        except (ValueError, IndexError) as error:
            raise BadReading(f"{self.where}: `date` says {' '.join(text)!r}") from error
        return phone - (start + end) / 2.0, "".join(text[1:2]), (end - start) / 2.0

    def _connected(self) -> Any:
        if self._device is None:
            raise DeviceGone(f"{self.where}: not open")
        return self._device

    def _call(self, action: Callable[[], Any]) -> Any:
        """Translate adbutils' errors, by what the server answers."""
        adbutils = support.library("adbutils", "android")
        try:
            return action()
        except (adbutils.AdbTimeout, TimeoutError) as error:
            raise DeviceTimeout(f"{self.where}: no answer in {self._timeout_s:g} s") from error
        except adbutils.AdbError as error:
            raise self._translated(str(error)) from error
        except (EOFError, struct.error, ConnectionError) as error:
            raise DeviceGone(f"{self.where}: the connection broke off ({error})") from error
        except ValueError as error:
            raise BadReading(
                f"{self.where}: the adb server's answer cannot be read ({error})"
            ) from error
        finally:
            for line in self._lines:  # adbutils leaves a refused connection open
                line.close()
            self._lines.clear()

    def _translated(self, message: str) -> DeviceError:
        if "unauthorized" in message:
            return support.denied(f"{self.where}: {DENIED}", seen=self.seen)
        if "offline" in message:
            return DeviceGone(f"{self.where}: {OFFLINE}")
        if "connect to adb server" in message or "No adb exe" in message:
            return DeviceNotFound(f"no adb server at {self._host}:{self._port}: {message}")
        if "not found" in message or "closed" in message or "Unknown data" in message:
            return DeviceGone(f"{self.where}: {message}")
        if "chunk missing" in message or "Invalid sync" in message:
            return DeviceGone(f"{self.where}: a transfer broke off ({message})")
        return BadReading(f"{self.where}: {message}")
