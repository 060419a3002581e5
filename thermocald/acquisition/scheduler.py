"""The schedule: absolute deadlines on the monotonic clock: nothing drifts, nothing piles up.

Tick k is due at begin + k·period. Who asks for the next tick too late for it gets the one after:
what was missed is counted, never made up for.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import threading

    from thermocald.hal import Clock


_LATEST_START = 0.1  # of a period: a tick that would begin later is skipped
_REMEMBERED = 1000


@dataclass(frozen=True, slots=True)
class Tick:
    """One tick: its index, when it was due (monotonic s), how late it began, how many were missed
    since the one before.
    """

    index: int
    due: float
    late_s: float
    skipped: int


@dataclass(frozen=True, slots=True)
class ScheduleStats:
    """What a schedule has to say about itself; lateness of the last ticks in s."""

    ticks: int
    skipped: int
    late_p99_s: float
    late_max_s: float


class Schedule:
    """The ticks of one device; one thread waits on it, others may ask for its statistics."""

    def __init__(self, clock: Clock, period_s: float, begin: float | None = None) -> None:
        self.clock = clock
        self.period_s = period_s
        self.begin = clock.monotonic() if begin is None else begin
        self._next = 0
        self._ticks = 0
        self._skipped = 0
        self._late: deque[float] = deque(maxlen=_REMEMBERED)

    def due(self, index: int) -> float:
        """The deadline of a tick; computed, not summed up: no rounding accumulates."""
        return self.begin + index * self.period_s

    def wait(self, wake: threading.Event | None = None) -> Tick | None:
        """Wait for the next tick that is not too late already; None if `wake` was set first."""
        behind = (self.clock.monotonic() - self.begin) / self.period_s - _LATEST_START
        index = max(self._next, math.ceil(behind))
        # before the first tick nothing was missed: a device may join a running schedule
        skipped = index - self._next if self._ticks else 0
        if not self.clock.sleep_until(self.due(index), wake):
            return None
        late = self.clock.monotonic() - self.due(index)
        self._next = index + 1
        self._ticks += 1
        self._skipped += skipped
        self._late.append(late)
        return Tick(index, self.due(index), late, skipped)

    def stats(self) -> ScheduleStats:
        """Counts so far, and the lateness of the last 1000 ticks."""
        late = sorted(self._late.copy())
        if not late:
            return ScheduleStats(0, 0, 0.0, 0.0)
        p99 = late[min(len(late) - 1, math.ceil(0.99 * len(late)) - 1)]
        return ScheduleStats(self._ticks, self._skipped, p99, late[-1])
