"""One clock for all time stamps of a daemon: UTC that never runs backwards while it runs.

The machine's UTC may be stepped, by NTP or by hand, and at boot a Raspberry Pi without a battery
does not know it at all. Intervals are measured on the monotonic clock, which never steps; UTC is
that plus an offset, which follows a step forwards and does not follow one backwards: what was
stored keeps its order. Every step is told.
"""

from __future__ import annotations

import ctypes
import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from thermocald.hal import SystemClock

if TYPE_CHECKING:
    import threading

    from thermocald.hal import Clock

__all__ = ["ClockStep", "SteadyClock", "machine_clock_trusted"]

log = logging.getLogger(__name__)

_STEP_S = 0.5
_WRONG_S = 1.0
_NOT_BEFORE = 1_700_000_000.0  # no machine has taken frames with this program before then
_SYNCHRONISED = Path("/run/systemd/timesync/synchronized")
_STA_UNSYNC = 0x40


@dataclass(frozen=True, slots=True)
class ClockStep:
    """The machine's UTC was stepped by so many seconds; adopted: whether time stamps followed."""

    utc: float
    seconds: float
    adopted: bool

    @property
    def text(self) -> str:
        """The step in a sentence."""
        where = "forwards" if self.seconds > 0 else "back"
        then = "time stamps follow" if self.adopted else "time stamps go on as before"
        return f"the clock was set {where} by {abs(self.seconds):.1f} s; {then}"


class SteadyClock:
    """A clock for devices and the store; threads may share it."""

    def __init__(self, machine: Clock | None = None) -> None:
        self._machine = machine or SystemClock()
        self._offset = self._machine.utc() - self._machine.monotonic()
        self._seen = self._offset

    def monotonic(self) -> float:
        """Seconds that never step."""
        return self._machine.monotonic()

    def utc(self) -> float:
        """Seconds since 1970 that never run backwards."""
        return self._machine.monotonic() + self._offset

    def sleep_until(self, monotonic: float, wake: threading.Event | None = None) -> bool:
        """As the machine's clock."""
        return self._machine.sleep_until(monotonic, wake)

    def check(self) -> ClockStep | None:
        """Look whether the machine's clock was stepped since the last look."""
        offset = self._machine.utc() - self._machine.monotonic()
        step = offset - self._seen
        if abs(step) < _STEP_S:
            return None
        self._seen = offset
        adopted = offset > self._offset
        if adopted:
            self._offset = offset
        found = ClockStep(self.utc(), step, adopted)
        log.warning(found.text, extra={"event": "clock_step"})
        return found

    @property
    def error_s(self) -> float:
        """The machine's UTC minus ours: not 0 after a step back."""
        return self._machine.utc() - self.utc()

    def trusted(self) -> bool:
        """Whether a time stamp taken now is known to be right to a second."""
        return abs(self.error_s) < _WRONG_S and machine_clock_trusted()


class _Timex(ctypes.Structure):
    """struct timex of adjtimex(2): only `status` is read."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 256),
    )


def machine_clock_trusted() -> bool:
    """Whether the machine's clock is synchronised, as systemd-timesyncd or the kernel say."""
    if time.time() < _NOT_BEFORE:
        return False
    if _SYNCHRONISED.exists():
        return True
    timex = _Timex()
    try:
        answer = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    except (OSError, AttributeError):
        return False
    return answer >= 0 and not timex.status & _STA_UNSYNC
