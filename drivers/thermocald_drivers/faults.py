"""Faults on demand: how the mocks fail as hardware fails.

    faults:
      - {kind: timeout, at: 3}                      # the 3rd capture or reading does not answer
      - {kind: unplugged, at_s: 60, for_s: 30}      # s after the first open; open fails meanwhile
      - {kind: stuck, at: 10, count: 20}            # 20 times the same value

Kinds: `timeout` (no answer within `timeout_s`), `unplugged` (gone, also for `open`), `truncated`
(half a frame, half a line: what a driver refuses as a bad reading), `wrong_size` (a frame of
another size, an answer of another length), `stuck` (the same value or image with new times, which
no driver can detect). A test may also call `inject` while the device is open.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal, get_args

from thermocald.errors import BadReading, ConfigurationError, DeviceGone, DeviceTimeout
from thermocald_drivers import support

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.hal import Clock

__all__ = ["Fault", "Faults", "Kind", "MockDevice"]

Kind = Literal["timeout", "unplugged", "truncated", "wrong_size", "stuck"]


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: `count` calls from call number `at`, or `for_s` seconds from `at_s`."""

    kind: Kind
    at: int = 1
    count: int = 1
    at_s: float | None = None
    for_s: float = 0.0

    def active(self, call: int, elapsed_s: float) -> bool:
        if self.at_s is not None:
            return self.at_s <= elapsed_s < self.at_s + self.for_s
        return self.at <= call < self.at + self.count


class Faults:
    """The faults of one mock device; ConfigurationError for an invalid plan."""

    def __init__(
        self, where: str, clock: Clock, plan: Sequence[Mapping[str, object]], timeout_s: float = 1.0
    ) -> None:
        self._where = where
        self._clock = clock
        self._timeout_s = support.number(f"{where}: timeout_s", timeout_s, 0.0, 3600.0, "s")
        self._faults = [_parse(where, entry) for entry in plan]
        self._calls = 0
        self._started: float | None = None

    def inject(self, kind: Kind, count: int = 1) -> None:
        """Let the next `count` calls fail."""
        self._faults.append(
            _parse(self._where, {"kind": kind, "at": self._calls + 1, "count": count})
        )

    def clear(self) -> None:
        """Remove all faults: the device is plugged in again."""
        self._faults.clear()

    def on_open(self) -> None:
        """Called by `open`: DeviceGone while unplugged; such an attempt counts as a call."""
        if self._started is None:
            self._started = self._clock.monotonic()
        if self._kind(self._calls + 1) == "unplugged":
            self._calls += 1
            raise DeviceGone(f"{self._where}: unplugged")

    def on_call(self) -> Kind | None:
        """Called by every capture or reading.

        Raises DeviceTimeout, after the time has passed, or DeviceGone. Returns a kind that the mock
        itself must imitate, None without a fault.
        """
        self._calls += 1
        kind = self._kind(self._calls)
        if kind == "timeout":
            self._clock.sleep_until(self._clock.monotonic() + self._timeout_s)
            raise DeviceTimeout(f"{self._where}: no answer within {self._timeout_s:g} s")
        if kind == "unplugged":
            raise DeviceGone(f"{self._where}: unplugged")
        return kind

    def refuse(self, kind: Kind | None, unit: str) -> None:
        """Raise BadReading for an answer that a driver must refuse."""
        if kind in ("truncated", "wrong_size"):
            what = "is cut off" if kind == "truncated" else "has the wrong size"
            raise BadReading(f"{self._where}: the {unit} {what}")

    def _kind(self, call: int) -> Kind | None:
        now = self._clock.monotonic()
        elapsed = 0.0 if self._started is None else now - self._started
        return next((f.kind for f in self._faults if f.active(call, elapsed)), None)


class MockDevice:
    """What the mocks share: opening and closing with faults, and the time since the first opening.

    name: for messages. A subclass sets `clock` and `faults`.
    """

    name: ClassVar[str]
    clock: Clock
    faults: Faults
    _open = False
    _started: float | None = None

    def open(self) -> None:
        self.faults.on_open()
        if self._started is None:
            self._started = self.clock.monotonic()
        self._open = True

    def close(self) -> None:
        self._open = False

    def _require_open(self) -> None:
        if not self._open:
            raise DeviceGone(f"{self.name}: it is not open")

    def _elapsed(self, monotonic: float) -> float:
        """Seconds from the first opening to a time of the monotonic clock; 0 before it."""
        return monotonic - (monotonic if self._started is None else self._started)


def _parse(where: str, entry: object) -> Fault:
    if not isinstance(entry, dict):
        raise ConfigurationError(f"{where}: faults must be a list of {{kind: …, at: …}}")
    known = set(Fault.__slots__)
    if unknown := set(entry) - known:
        raise ConfigurationError(
            f"{where}: a fault has no key {min(map(str, unknown))!r}; known are {', '.join(known)}"
        )
    kind = support.choice(f"{where}: faults.kind", entry.get("kind"), get_args(Kind))
    whole = {
        name: int(support.number(f"{where}: faults.{name}", entry[name], 1, 1e9, whole=True))
        for name in ("at", "count")
        if name in entry
    }
    seconds = {
        name: support.number(f"{where}: faults.{name}", entry[name], 0.0, 1e9, "s")
        for name in ("at_s", "for_s")
        if name in entry
    }
    return Fault(kind, **whole, **seconds)  # type: ignore[arg-type]
