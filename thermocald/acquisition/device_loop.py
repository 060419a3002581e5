"""A device in its own thread and with its own schedule: slow or dead, it delays no other."""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING

from thermocald.acquisition.scheduler import Schedule

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.acquisition.link import Link
    from thermocald.hal import Clock


log = logging.getLogger(__name__)


class DeviceLoop:
    """Calls `action` at every tick while the device is there.

    `action` is called with the device open and raises what the device raises. `lost` counts ticks
    in which the device gave nothing. free_running: without a schedule, as fast as `action` returns.
    idle: asked at every tick; while it says so, the device is closed and left alone.
    """

    def __init__(
        self,
        link: Link,
        action: Callable[[], None],
        clock: Clock,
        period_s: float,
        begin: float,
        *,
        free_running: bool = False,
        idle: Callable[[], bool] = lambda: False,
    ) -> None:
        self.link = link
        self.schedule = Schedule(clock, period_s, begin)
        self.done = 0
        self.lost = 0
        self._action = action
        self._free_running = free_running
        self._idle = idle
        self._clock = clock
        self._stop = threading.Event()
        self._busy_since: float | None = None
        # a hung driver cannot be ended; it must not keep the process from ending either
        self._thread = threading.Thread(
            target=self._run, name=f"{link.kind} {link.name}", daemon=True
        )

    def start(self) -> None:
        """Begin at the next tick."""
        self._thread.start()

    def stop(self) -> None:
        """Ask the loop to end after the current call."""
        self._stop.set()

    def join(self, timeout_s: float) -> bool:
        """Wait for the end; False if the device does not return."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def busy_s(self) -> float:
        """For how long the device has not returned from a call; 0 between calls."""
        since = self._busy_since
        return 0.0 if since is None else self._clock.monotonic() - since

    @property
    def alive(self) -> bool:
        """Whether the loop runs; it also ends by itself when nothing more can come."""
        return self._thread.is_alive()

    def _run(self) -> None:
        try:
            while not self._stop.is_set() and not self.link.ended:
                if not self._free_running and self.schedule.wait(self._stop) is None:
                    break
                self._busy_since = self._clock.monotonic()
                if self._idle():
                    self.link.rest()
                elif self.link.call(self._act):
                    self.done += 1
                else:
                    self.lost += 1
                self._busy_since = None
        finally:
            self._busy_since = None
            self.link.close()

    def _act(self) -> bool:
        self._action()
        return True
