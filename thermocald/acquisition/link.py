"""The link to one device: opened when needed, re-opened after faults with growing pauses.

A device that goes away is told once, and once when it is back. A fault that is not recoverable ends
the link, until the configuration is read again; only a device that was not found is looked for
again, since it may be plugged in later.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from thermocald.addresses import without_secrets
from thermocald.errors import (
    DeviceFinished,
    DeviceNotFound,
    PermanentDeviceError,
    TransientDeviceError,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.hal import Clock, Device, Kind

    T = TypeVar("T")


log = logging.getLogger(__name__)

LinkState = Literal["closed", "open", "out", "failed", "finished"]

_FIRST_PAUSE_S = 0.25
_LONGEST_PAUSE_S = 2.0  # or the device's period, so that no epoch is lost to waiting
_SEARCH_PAUSE_S = 10.0


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """A device went away (`device_out`), came back (`device_back`), or failed for good
    (`device_failed`), or a recording ended (`device_finished`).
    """

    utc: float
    kind: str
    device: str
    text: str


class Link:
    """One device and its state; used by one thread, looked at by others.

    Attributes for the status: state; why: the last fault; out_since: monotonic s; since: UTC s,
    when it went away or ended, NaN while it has not; faults: calls that failed.
    """

    def __init__(
        self,
        kind: Kind,
        name: str,
        device: Device,
        clock: Clock,
        *,
        period_s: float = 1.0,
        is_open: bool = False,
        on_event: Callable[[LinkEvent], None] | None = None,
    ) -> None:
        self.kind = kind
        self.name = name
        self.device = device
        self.state: LinkState = "open" if is_open else "closed"
        self.why = ""
        self.out_since = 0.0
        self.since = math.nan
        self.faults = 0
        self.error: PermanentDeviceError | None = None
        self._clock = clock
        self._period_s = period_s
        self._on_event = on_event
        self._pause_s = 0.0
        self._retry_at = 0.0

    @property
    def ended(self) -> bool:
        """Whether nothing more will come of this device."""
        return self.state in ("failed", "finished")

    def call(self, action: Callable[[], T]) -> T | None:
        """Do something with the open device; None if it is away."""
        if self.ended or (self.state == "out" and self._clock.monotonic() < self._retry_at):
            return None
        try:
            if self.state != "open":
                self.device.open()
            result = action()
        except TransientDeviceError as error:
            self._out(str(error), max(self._period_s, _LONGEST_PAUSE_S))
        except PermanentDeviceError as error:
            self._permanent(error)
        except Exception as error:
            # a driver's own mistake must not end the daemon
            if self.state != "out":
                log.exception("%s %s: its driver failed", self.kind, self.name)
            self._out(f"{type(error).__name__}: {error}", max(self._period_s, _LONGEST_PAUSE_S))
        else:
            self._back()
            return result
        return None

    def close(self) -> None:
        """Release the device."""
        self.device.close()
        if not self.ended:
            self.state = "closed"

    def rest(self) -> None:
        """Release a device that is not needed for now; one that is away stays so."""
        if self.state == "open":
            self.close()

    def identity(self) -> dict[str, Any]:
        """What the device says it is; empty if it cannot say."""
        try:
            return dict(self.device.identity())
        except Exception:
            log.exception("%s %s: does not say what it is", self.kind, self.name)
            return {}

    def warnings(self) -> list[str]:
        """Settings of the device that harm the results, in one sentence each."""
        try:
            return list(self.device.warnings())
        except Exception:
            log.exception("%s %s: its warnings cannot be read", self.kind, self.name)
            return []

    def _back(self) -> None:
        if self.state == "out":
            away_s = self._clock.monotonic() - self.out_since
            text = f"{self.kind} {self.name} is back after {away_s:.0f} s"
            log.info(text, extra={"device": self.name, "event": "device_back"})
            self._tell("device_back", text)
        self.state = "open"
        self.since = math.nan
        self.why = ""
        self._pause_s = 0.0

    def _out(self, why: str, longest_s: float) -> None:
        self.device.close()
        why = without_secrets(why)  # a library may quote an address
        self.faults += 1
        self.why = why
        if self.state != "out":
            self.state = "out"
            self.out_since = self._clock.monotonic()
            self.since = self._clock.utc()
            text = f"{self.kind} {self.name} is out: {why}"
            log.warning(text, extra={"device": self.name, "event": "device_out"})
            self._tell("device_out", text)
        # the first retry comes with the next tick, since most faults are of one frame alone
        now = self._clock.monotonic()
        self._retry_at = now + 0.9 * self._pause_s
        self._pause_s = min(max(2 * self._pause_s, _FIRST_PAUSE_S), longest_s)

    def _permanent(self, error: PermanentDeviceError) -> None:
        if isinstance(error, DeviceNotFound):
            self._out(str(error), max(self._period_s, _SEARCH_PAUSE_S))
            return
        self.device.close()
        self.error = error
        self.since = self._clock.utc()
        self.why = without_secrets(str(error))
        # a recording that has been played to its end is not a failure
        finished = isinstance(error, DeviceFinished)
        self.state = "finished" if finished else "failed"
        level = logging.INFO if finished else logging.ERROR
        kind = f"device_{self.state}"
        log.log(level, "%s %s: %s", self.kind, self.name, self.why, extra={"event": kind})
        self._tell(kind, f"{self.kind} {self.name}: {self.why}")

    def _tell(self, kind: str, text: str) -> None:
        if self._on_event is not None:
            self._on_event(LinkEvent(self._clock.utc(), kind, self.name, text))
