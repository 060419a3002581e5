"""One clock for all time stamps of a daemon, that a glitch of the machine's clock does not move.

The machine's UTC may be stepped, by NTP or by hand, and at boot a Raspberry Pi without a battery
does not know it at all. Intervals are measured on the monotonic clock, which never steps; UTC is
that plus an offset. The offset follows a step of the machine's clock in either direction, at once
where the machine just learned the time (it was not synchronised, and is now), else when the new
time has stood for a while: what is back after some seconds was a glitch, and moves nothing. Every
step is reported.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

from thermocald.hal import Clock, SystemClock, read_together
from thermocald.machine import NOT_BEFORE, machine_clock_trusted

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable


log = logging.getLogger(__name__)

_STEP_S = 0.5
_WRONG_S = 1.0
_CONFIRM_S = 60.0  # for which a new time must stand before it is followed
_LEAP_S = 3600.0
_SETTLE_S = 86400.0  # after a leap, before anything is deleted for its age


@dataclass(frozen=True, slots=True)
class ClockStep:
    """The machine's UTC was stepped by `seconds`, which `text` says in a sentence.

    utc: as stamped from now on; adopted: whether time stamps followed.
    """

    utc: float
    seconds: float
    adopted: bool
    text: str


class SteadyClock:
    """A clock for devices and the store; threads may share it.

    synchronised: whether the machine knows the time.
    """

    def __init__(
        self, machine: Clock | None = None, *, synchronised: Callable[[], bool] | None = None
    ) -> None:
        self._machine = machine or SystemClock()
        self._synchronised = synchronised or machine_clock_trusted
        self._offset = _offset(self._machine)
        self._seen = self._offset
        self._seen_at = float("-inf")
        self._was_synchronised = self._synchronised()
        self._leapt_at = float("-inf")

    def monotonic(self) -> float:
        """Seconds that never step."""
        return self._machine.monotonic()

    def utc(self) -> float:
        """Seconds since 1970."""
        return self._machine.monotonic() + self._offset

    def sleep_until(self, monotonic: float, wake: threading.Event | None = None) -> bool:
        """As the machine's clock."""
        return self._machine.sleep_until(monotonic, wake)

    def check(self) -> ClockStep | None:
        """Look whether the machine's clock was stepped, or a step has stood for long enough."""
        now = self._machine.monotonic()
        offset = _offset(self._machine)
        learned = not self._was_synchronised and self._synchronised()
        self._was_synchronised = self._synchronised()
        step = offset - self._seen
        stepped = abs(step) >= _STEP_S
        if stepped:
            self._seen, self._seen_at = offset, now
            if abs(step) >= _LEAP_S:
                self._leapt_at = now
        ahead = offset - self._offset
        pending = abs(ahead) >= _STEP_S
        # a clock that shows a time before this program existed has just learned the time, too
        learned |= self.utc() < NOT_BEFORE <= self._machine.utc()
        adopted = pending and (learned or now - self._seen_at >= _CONFIRM_S)
        if adopted:
            self._offset, step, then = offset, ahead, "time stamps follow"
        elif stepped:
            waits = f" until that has stood for {_CONFIRM_S:.0f} s" if pending else ""
            then = f"time stamps go on as before{waits}"
        else:
            return None
        where = "forwards" if step > 0 else "back"
        text = f"the clock was set {where} by {abs(step):.1f} s; {then}"
        log.warning(text, extra={"event": "clock_step"})
        return ClockStep(self.utc(), step, adopted, text)

    @property
    def error_s(self) -> float:
        """The machine's UTC minus ours: not 0 while a step is not followed."""
        return self._machine.utc() - self.utc()

    def trusted(self) -> bool:
        """Return whether a time stamp taken now is known to be right to a second."""
        return abs(self.error_s) < _WRONG_S and self._synchronised()

    def settled(self) -> bool:
        """Whether ages may be judged by this clock: it is trusted, and has not leapt for a day."""
        since_leap = self._machine.monotonic() - self._leapt_at
        return self.trusted() and since_leap >= _SETTLE_S and self.utc() >= NOT_BEFORE


def _offset(machine: Clock) -> float:
    """UTC minus monotonic time, s."""
    monotonic, utc = read_together(machine.monotonic, machine.utc)
    return utc - monotonic
