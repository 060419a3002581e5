"""The daemon's interface to systemd: the journal with its fields, and sd_notify(3).

The fields are THERMOCALD_DEVICE, THERMOCALD_EVENT, CODE_FILE …
Try: journalctl THERMOCALD_EVENT=device_out
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import struct
import sys

from thermocald.addresses import CleanFormatter

_SOCKET = "/run/systemd/journal/socket"
_PRIORITIES = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
_FIELDS = {"device": "THERMOCALD_DEVICE", "event": "THERMOCALD_EVENT"}


class JournalHandler(logging.Handler):
    """A handler that sends records to the journal's native socket (systemd.journal-fields(7))."""

    def __init__(self) -> None:
        super().__init__()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)

    def emit(self, record: logging.LogRecord) -> None:
        priority = next((p for level, p in _PRIORITIES if record.levelno >= level), 7)
        fields = {
            "MESSAGE": self.format(record),
            "PRIORITY": str(priority),
            "SYSLOG_IDENTIFIER": "thermocald",
            "THERMOCALD_LOGGER": record.name,
            "THERMOCALD_THREAD": record.threadName or "",
            "CODE_FILE": record.pathname,
            "CODE_LINE": str(record.lineno),
        }
        for attribute, name in _FIELDS.items():
            if (value := getattr(record, attribute, None)) is not None:
                fields[name] = str(value)
        message = b""
        for name, data in ((name, value.encode()) for name, value in fields.items()):
            # the length precedes a value of several lines
            size = b"\n" + struct.pack("<Q", len(data)) if b"\n" in data else b"="
            message += name.encode() + size + data + b"\n"
        try:
            self._socket.sendto(message, _SOCKET)
        except OSError:
            # no journal, or a message too long for a datagram; systemd also reads stderr
            print(self.format(record), file=sys.stderr)  # noqa: T201

    def close(self) -> None:
        self._socket.close()
        super().close()


def set_up_logging(level: str) -> None:
    """Log to the journal under systemd, to standard error otherwise."""
    handler: logging.Handler = logging.StreamHandler(sys.stderr)
    form = "%(asctime)s %(levelname)s %(name)s: %(message)s"
    if os.environ.get("JOURNAL_STREAM") and os.path.exists(_SOCKET):
        handler, form = JournalHandler(), "%(message)s"
    handler.setFormatter(CleanFormatter(form))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)


def notify(message: str) -> None:
    """Send `KEY=value` lines to the service manager, if one listens."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return
    if address.startswith("@"):  # an abstract socket
        address = "\0" + address[1:]
    with (
        contextlib.suppress(OSError),
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel,
    ):
        channel.settimeout(1.0)
        channel.sendto(message.encode(), address)


def watchdog_interval_s() -> float | None:
    """Return the interval for feeding the watchdog, half of systemd's limit; None without one."""
    pid = os.environ.get("WATCHDOG_PID", "")
    if pid and pid != str(os.getpid()):
        return None
    try:
        return int(os.environ["WATCHDOG_USEC"]) / 2e6
    except (KeyError, ValueError):
        return None
