"""What systemd is told: READY, the status line, the watchdog (sd_notify(3))."""

from __future__ import annotations

import contextlib
import os
import socket
import time

__all__ = ["notify", "notify_ready", "notify_reloading", "watchdog_interval_s"]


def notify(message: str) -> bool:
    """Send `KEY=value` lines to the service manager; False if there is none that listens."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return False
    if address.startswith("@"):  # an abstract socket
        address = "\0" + address[1:]
    with (
        contextlib.suppress(OSError),
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel,
    ):
        channel.settimeout(1.0)
        channel.sendto(message.encode(), address)
        return True
    return False


def notify_ready(status: str) -> None:
    """Started, or reloaded."""
    notify(f"READY=1\nSTATUS={status}")


def notify_reloading() -> None:
    """A reload begins; `notify_ready` ends it."""
    notify(f"RELOADING=1\nMONOTONIC_USEC={time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000}")


def watchdog_interval_s() -> float | None:
    """How often the watchdog is to be fed, half of what systemd allows; None if there is none."""
    pid = os.environ.get("WATCHDOG_PID", "")
    if pid and pid != str(os.getpid()):
        return None
    try:
        return int(os.environ["WATCHDOG_USEC"]) / 2e6
    except (KeyError, ValueError):
        return None
