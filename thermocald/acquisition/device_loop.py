"""A device in its own thread with its own schedule: if slow or dead, it delays no other device.

The schedule has absolute deadlines on the monotonic clock, so that it does not drift and ticks do
not queue up. Tick k is due at begin + k·period. A loop that is late for a tick gets the next one;
missed ticks are counted and not made up for.

The link opens the device when it is needed, and again after faults, with growing pauses. It reports
once that a device goes away, and once that it is back. A permanent fault ends the link until the
configuration is read again. A device that was not found is looked for again, since it may be
plugged in later; so is a camera or thermometer that is denied: at boot its node belongs to root
until udev has handled it, another program probes it, and a person may yet unlock a phone. An output
is not, since a server may lock out who repeats a wrong password. A device that comes and goes all
the time is reported once, then only counted.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

from thermocald.addresses import without_secrets
from thermocald.errors import (
    DeviceDenied,
    DeviceFinished,
    DeviceNotFound,
    PermanentDeviceError,
    TransientDeviceError,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from thermocald.hal import Clock, Kind, Output

    OnEvent = Callable[[float, str, str], None]

_QUEUE = 400  # results that may wait for an output: an hour at one every 10 s
_RETRY_S = 0.5  # while an output is away
_LATEST_START = 0.1  # of a period; a tick that would begin later is skipped
_REMEMBERED = 1000


@dataclass(eq=False)
class Schedule:
    """The ticks of one device; one thread waits for them, others may read the statistics."""

    clock: Clock
    period_s: float
    begin: float

    def __post_init__(self) -> None:
        self._next = 0
        self._ticks = 0
        self._skipped = 0
        self._late: deque[float] = deque(maxlen=_REMEMBERED)

    def due(self, index: int) -> float:
        """Return the deadline of a tick; not summed up, so that no rounding accumulates."""
        return self.begin + index * self.period_s

    def wait(self, wake: threading.Event | None = None) -> int | None:
        """Wait for the next tick that is not too late, and return its number.

        Returns None if `wake` was set first.
        """
        behind = (self.clock.monotonic() - self.begin) / self.period_s - _LATEST_START
        index = max(self._next, math.ceil(behind))
        # before its first tick it missed none: a device may join a running schedule
        skipped = index - self._next if self._ticks else 0
        if not self.clock.sleep_until(self.due(index), wake):
            return None
        self._next = index + 1
        self._ticks += 1
        self._skipped += skipped
        self._late.append(self.clock.monotonic() - self.due(index))
        return index

    def stats(self) -> dict[str, float]:
        """Return the counts so far, and the lateness of the last 1000 ticks, s."""
        late = sorted(self._late.copy()) or [0.0]
        return {
            "ticks": self._ticks,
            "skipped": self._skipped,
            "late_p99_s": late[math.ceil(0.99 * len(late)) - 1],
        }


log = logging.getLogger(__name__)

LinkState = Literal["closed", "open", "out", "failed", "finished"]

_FIRST_PAUSE_S = 0.25
_LONGEST_PAUSE_S = 2.0  # or the device's period if that is longer
_SEARCH_PAUSE_S = 10.0
_OFTEN, _OFTEN_S = 10, 3600.0  # outages within a time, from which they are not reported one by one


@dataclass(eq=False)
class Link:
    """One device and its state; one thread uses it, others may read its attributes.

    For the status: state; why: the last fault; out_since: monotonic s; since: UTC s, when the
    device went away or ended, else NaN; faults: number of failed calls. on_event: receives UTC s, a
    kind and a sentence when the device goes away (`device_out`), comes back (`device_back`), fails
    permanently (`device_failed`), or its recording ends (`device_finished`). free_running: retries
    at once, as a recording played fast.
    """

    kind: Kind
    name: str
    device: Any
    clock: Clock
    period_s: float = 1.0
    on_event: OnEvent = lambda *_: None
    free_running: bool = False

    def __post_init__(self) -> None:
        self.called = f"{self.kind} {self.name}"
        self.state: LinkState = "closed"
        self.why = ""
        self.out_since = 0.0
        self.since = math.nan
        self.faults = 0
        self._pause_s = 0.0
        self._retry_at = 0.0
        self._outages: deque[float] = deque(maxlen=_OFTEN)
        self._restless = False
        self._broken: set[str] = set()  # methods of the driver that failed

    @property
    def ended(self) -> bool:
        """Whether the device has failed permanently or its recording has ended."""
        return self.state in ("failed", "finished")

    def do(self, action: Callable[[], object]) -> bool:
        """Call `action` with the device open; return whether it succeeded."""
        waits = not self.free_running and self.clock.monotonic() < self._retry_at
        if self.ended or (self.state == "out" and waits):
            return False
        try:
            if self.state != "open":
                self.device.open()
            action()
        except TransientDeviceError as error:
            self._out(str(error), max(self.period_s, _LONGEST_PAUSE_S))
        except PermanentDeviceError as error:
            denied = isinstance(error, DeviceDenied) and self.kind != "output"
            if denied or isinstance(error, DeviceNotFound):
                self._out(str(error), max(self.period_s, _SEARCH_PAUSE_S))
                return False
            self._ask("close", self.device.close)
            self.since = self.clock.utc()
            self.why = without_secrets(str(error))
            # the end of a recording is not a failure
            finished = isinstance(error, DeviceFinished)
            self.state = "finished" if finished else "failed"
            level = logging.INFO if finished else logging.ERROR
            self._report(level, f"device_{self.state}", f"{self.called}: {self.why}")
        except BaseException as error:
            # an error in a driver, even its sys.exit(), must not stop the daemon
            if self.state != "out" and not self._restless:
                log.exception("%s: its driver failed", self.called)
            self._out(f"{type(error).__name__}: {error}", max(self.period_s, _LONGEST_PAUSE_S))
        else:
            self._back()
            return True
        return False

    def close(self) -> None:
        """Release the device."""
        self._ask("close", self.device.close)
        if not self.ended:
            self.state = "closed"

    def identity(self) -> dict[str, str]:
        """Return the device's identity; empty if it cannot be read."""
        return dict(
            self._ask(
                "identity", lambda: {str(k): str(v) for k, v in self.device.identity().items()}, {}
            )
        )

    def _ask(self, method: str, call: Callable[[], Any], default: Any = None) -> Any:
        """Call a method of the driver that should not fail; log once that it did."""
        try:
            return call()
        except BaseException:
            if method not in self._broken:
                log.exception("%s: its driver failed in `%s`", self.called, method)
            self._broken.add(method)
            return default

    def _back(self) -> None:
        away_s = self.clock.monotonic() - self.out_since
        if self.state == "out" and (not self._restless or away_s > _OFTEN_S):
            self._report(logging.INFO, "device_back", f"{self.called} is back after {away_s:.0f} s")
        self.state = "open"
        self.since = math.nan
        self.why = ""
        self._pause_s = 0.0

    def _out(self, why: str, longest_s: float) -> None:
        self._ask("close", self.device.close)
        why = without_secrets(why)  # a library may quote an address
        self.faults += 1
        self.why = why
        if self.state != "out":
            self.state = "out"
            self.out_since = self.clock.monotonic()
            self.since = self.clock.utc()
            self._outages.append(self.out_since)
            was_restless, count = self._restless, len(self._outages)
            self._restless = count == _OFTEN and self.out_since - self._outages[0] < _OFTEN_S
            if not was_restless or not self._restless:
                often = f", {count} times within an hour; from now on only the status shows it"
                text = f"{self.called} is out: {why}{often if self._restless else ''}"
                self._report(logging.WARNING, "device_out", text)
        # the first retry is at the next tick, since most faults concern a single frame
        now = self.clock.monotonic()
        self._retry_at = now + 0.9 * self._pause_s
        self._pause_s = min(max(2 * self._pause_s, _FIRST_PAUSE_S), longest_s)

    def _report(self, level: int, kind: str, text: str) -> None:
        log.log(level, "%s", text, extra={"device": self.name, "event": kind})
        self.on_event(self.clock.utc(), kind, text)

    def status(self, busy_s: float, hang_after_s: float) -> dict[str, Any]:
        """Return the device's part of the daemon's status."""
        return {
            "device": "hung" if busy_s > hang_after_s else self.state,
            "why": self.why,
            "since": self.since,
            "warnings": self._ask("warnings", lambda: list(map(str, self.device.warnings())), []),
            "faults": self.faults,
        }


@dataclass(eq=False)
class DeviceLoop:
    """Calls `action` at every tick, with the device open.

    `action` raises what the device raises; `lost` counts the ticks at which it failed or the device
    was away. free_running: no schedule, as fast as `action` returns. idle: called at every tick;
    while it returns true, the device is closed and not used.
    """

    link: Link
    action: Callable[[], object]
    begin: float
    free_running: bool = False
    idle: Callable[[], bool] = lambda: False

    def __post_init__(self) -> None:
        self.clock = self.link.clock
        self.schedule = Schedule(self.clock, self.link.period_s, self.begin)
        self.lost = 0
        self._stop = threading.Event()
        self._busy_since: float | None = None
        # a hung driver cannot be stopped, and must not keep the process alive
        self._thread = threading.Thread(target=self._run, name=self.link.called, daemon=True)

    def start(self) -> None:
        """Start at the next tick."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the loop after the current call; returns at once."""
        self._stop.set()

    def join(self, timeout_s: float) -> bool:
        """Wait for the loop to end, as it does with its link; False if it has not in time."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def busy_s(self) -> float:
        """Return how long the current call has taken beyond its time-out, s; 0 between calls."""
        since = self._busy_since
        allowed_s: float = self.link.device.timeout_s
        return 0.0 if since is None else max(0.0, self.clock.monotonic() - since - allowed_s)

    def _run(self) -> None:
        try:
            while not self._stop.is_set() and not self.link.ended:
                if not self.free_running and self.schedule.wait(self._stop) is None:
                    break
                self._busy_since = self.clock.monotonic()
                if self.idle():
                    if self.link.state == "open":  # a device that is away stays "out"
                        self.link.close()
                elif not self.link.do(self.action):
                    self.lost += 1
                self._busy_since = None
        finally:
            self._busy_since = None
            self.link.close()


class OutputLoop:
    """Hands results to one output, in order; if it is slow or away, it loses the oldest ones."""

    def __init__(self, name: str, output: Output, clock: Clock, on_event: OnEvent) -> None:
        self.link = Link("output", name, output, clock, on_event=on_event)
        self.emitted = 0
        self.lost = 0
        self._queue: deque[Mapping[str, Any]] = deque()
        self._changed = threading.Condition()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=self.link.called, daemon=True)

    def start(self) -> None:
        """Start the thread; the output is opened in it."""
        self._thread.start()

    def put(self, result: Mapping[str, Any]) -> None:
        """Queue a result; returns at once."""
        with self._changed:
            if len(self._queue) >= _QUEUE:
                self._queue.popleft()
                self.lost += 1
            self._queue.append(result)
            self._changed.notify()

    def stop(self, grace_s: float) -> bool:
        """Emit the waiting results within the grace and close; False if that took too long."""
        with self._changed:
            self._stopping.set()
            self._changed.notify()
        self._thread.join(grace_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        self.link.do(lambda: None)
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._stopping.is_set())
                if not self._queue:
                    break
                result = self._queue[0]
            done = self.link.do(partial(self.link.device.emit, result))
            if not (done or self.link.ended or self._stopping.wait(_RETRY_S)):
                continue  # it waits until the output is back, unless newer ones displace it
            with self._changed:
                waited = bool(self._queue) and self._queue[0] is result
                if waited:
                    self._queue.popleft()
                self.emitted += done
                self.lost += waited - done  # a displaced one was counted as lost
        self.link.close()
