"""One clock for all time stamps of a daemon, unaffected by glitches of the machine's clock.

The machine's UTC may be stepped, by NTP or by hand, and a Raspberry Pi without a battery does not
know it at all after booting. Intervals are measured on the monotonic clock, which never steps; UTC
is the monotonic time plus an offset. The offset follows a step of the machine's clock in either
direction: at once if the machine has just learned the time (it was not synchronised, and is now),
else after the new time has lasted for a while. A step that is undone within seconds is a glitch and
is not followed. Every step is reported.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from thermocald.hal import Clock, SystemClock, read_together
from thermocald.machine import NOT_BEFORE, machine_clock_trusted
from thermocald.numbers import duration

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable


log = logging.getLogger(__name__)

_STEP_S = 0.5
_WRONG_S = 1.0
_CONFIRM_S = 60.0  # how long a new time must last before it is followed
_LEAP_S = 3600.0
_SETTLE_S = 86400.0  # after a leap, before ages are trusted


class SteadyClock:
    """A clock for devices and the store; threads may share it.

    synchronised: returns whether the machine's clock is synchronised.
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
        """Return seconds that never step."""
        return self._machine.monotonic()

    def utc(self) -> float:
        """Return UTC, seconds since 1970."""
        return self._machine.monotonic() + self._offset

    def sleep_until(self, monotonic: float, wake: threading.Event | None = None) -> bool:
        """Sleep as `Clock.sleep_until` of the machine's clock."""
        return self._machine.sleep_until(monotonic, wake)

    def check(self) -> tuple[float, bool, str] | None:
        """Return a new step of the machine's clock, or an earlier one that is followed now.

        The step in s, whether time stamps follow it, and a sentence; None without a step.
        """
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
        # a clock that showed a time before this program existed has just learned it, too
        learned |= self.utc() < NOT_BEFORE <= self._machine.utc()
        adopted = pending and (learned or now - self._seen_at >= _CONFIRM_S)
        if adopted:
            self._offset, step, then = offset, ahead, "time stamps follow"
        elif stepped:
            waits = f" until the new time has lasted {_CONFIRM_S:.0f} s" if pending else ""
            then = f"time stamps go on as before{waits}"
        else:
            return None
        where = "forwards" if step > 0 else "back"
        size = duration(abs(step)) if abs(step) >= _LEAP_S else f"{abs(step):.1f} s"
        text = f"the clock was set {where} by {size}; {then}"
        log.warning(text, extra={"event": "clock_step"})
        return step, adopted, text

    @property
    def error_s(self) -> float:
        """The machine's UTC minus ours, s; not 0 while a step is not followed."""
        return self._machine.utc() - self.utc()

    def trusted(self) -> bool:
        """Return whether a time stamp taken now is certainly right to a second."""
        return abs(self.error_s) < _WRONG_S and self._synchronised()

    def settled(self) -> bool:
        """Return whether ages are certain: the clock is trusted, and has not leapt for a day."""
        since_leap = self._machine.monotonic() - self._leapt_at
        return self.trusted() and since_leap >= _SETTLE_S and self.utc() >= NOT_BEFORE


def _offset(machine: Clock) -> float:
    """Return UTC minus monotonic time, s."""
    monotonic, utc = read_together(machine.monotonic, machine.utc)
    return utc - monotonic
