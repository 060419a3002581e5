"""The store under hard conditions: a full disk loses observations before results, and results wait
in memory for a store that cannot be written.
"""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections import deque
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from thermocald.daemon.followed_store import FollowedStore
from thermocald.errors import StoreError, StoreFullError
from thermocald.store.database.row import Event

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.store.database.epoch_table import StoredEpoch
    from thermocald.store.database.row import EpochResult, LoggedReading, StoredSeries
    from thermocald.store.database.store import Store

__all__ = ["Row", "StoreGuard"]

log = logging.getLogger(__name__)

# Results alone take about 1.2 kB an epoch: this is more than a day at one every 10 s.
_RESERVE_BYTES = 16_000_000
_ENOUGH_BYTES = 20_000_000
_MOST_WITH_OBSERVATIONS = 100
_MOST_WAITING = 20_000


@dataclass(eq=False)
class Row:
    """What is kept of one epoch, and who is told: `told(stored)` after the first attempt."""

    series: StoredSeries
    epoch: Epoch
    result: EpochResult | None
    extra: Mapping[str, float]
    clock_trusted: bool
    told: Callable[[bool], None] = field(default=lambda _: None)
    stored: bool = False  # committed, and in the file that is at the store's path

    def thin(self) -> Row:
        """The same without observations and covariance."""
        epoch = replace(self.epoch, observations=None)
        result = None if self.result is None else _without_covariance(self.result)
        return replace(self, epoch=epoch, result=result)


def _without_covariance(result: EpochResult) -> EpochResult:
    """Standard deviations are what is left of a covariance: its diagonal, 16 numbers."""
    if result.covariance is None:
        return result
    import numpy as np

    return replace(result, covariance=np.diag(np.diag(result.covariance)))


class StoreGuard:
    """An open store that does not give up; threads may share it.

    Raises StoreError only when it is opened.
    """

    def __init__(self, path: Path, *, durable: bool = True) -> None:
        self.path = path
        self.lost = 0
        self.away = ""  # why the store cannot be written, empty while it can
        self.thin = False
        self._waiting: deque[Row] = deque()
        self._events: deque[Event] = deque(maxlen=1000)
        self._readings: deque[LoggedReading] = deque(maxlen=_MOST_WAITING)
        self._lock = threading.RLock()
        self._series: dict[tuple[str, str], StoredSeries] = {}
        self._known: Store | None = None  # whose series are in `_series`
        self._file = FollowedStore(path, durable=durable)
        self._note_events()

    @property
    def store(self) -> Store:
        """The open store; another one after its file was followed, so read through the guard."""
        return self._file.store

    @property
    def notice(self) -> str:
        """What happened to the file while it was open, empty if nothing."""
        return self._file.notice

    def _note_events(self) -> None:
        self._events.extend(self._file.events)
        self._file.events.clear()

    @property
    def waiting(self) -> int:
        """Epochs that wait in memory for a store that can be written."""
        return len(self._waiting)

    def close(self) -> None:
        """Try once more to keep what waits, and close."""
        with self._lock:
            self.flush()
            if self._waiting:
                log.error("%s: %d epochs could not be kept", self.path, len(self._waiting))
            self._file.close()

    def series(self, wanted: StoredSeries) -> StoredSeries:
        """The series of that camera and name in the file that is open now; begun if need be."""
        key = (wanted.camera, wanted.name)
        with self._lock:
            if self._known is not self.store:
                self._known = self.store
                self._series.clear()
            if key not in self._series:
                found = {(s.camera, s.name): s for s in self.store.all_series()}
                self._series[key] = found.get(key) or self.store.create_series(
                    wanted.head,
                    wanted.testfield,
                    start=wanted.start,
                    identity=wanted.identity,
                    settings=wanted.settings,
                    created_utc=wanted.created_utc,
                )
            return self._series[key]

    def epochs(
        self, series: StoredSeries, first: int, last: int | None = None, *, details: bool = True
    ) -> list[StoredEpoch]:
        """Some epochs, read at once: the file must not be followed to another one meanwhile."""
        with self._lock:
            return list(self.store.epochs(series, first, last, details=details))

    def last_epoch(self, series: StoredSeries) -> int:
        """The number of the last epoch kept, 0 if there is none."""
        with self._lock:
            return self.store.last_epoch(series) or 0

    def all_series(self) -> list[StoredSeries]:
        """All series, in the order in which they were begun."""
        with self._lock:
            return self.store.all_series()

    def stored_events(self) -> list[Event]:
        """All events in the store, oldest first."""
        with self._lock:
            return self.store.events()

    def append(self, row: Row) -> None:
        """Keep an epoch, now or when the store can be written again."""
        with self._lock:
            self._waiting.append(row)
            self.flush()
            row.told(row.stored)

    def amend(
        self,
        series: StoredSeries,
        number: int,
        result: EpochResult,
        observations: Observations | None,
        extra: Mapping[str, float],
    ) -> None:
        """Keep a later calibration of an epoch; raises StoreError."""
        with self._lock:
            self._watch()
            self.store.amend(
                self.series(series),
                number,
                result,
                observations=None if self.thin else observations,
                extra=extra,
            )

    def event(self, event: Event) -> None:
        """Keep an event, now or when the store can be written again."""
        with self._lock:
            self._events.append(event)
            self._flush_events()

    def reading(self, reading: LoggedReading) -> None:
        """Keep a reading that belongs to no epoch with the next `flush`; returns at once."""
        self._readings.append(reading)

    def flush(self) -> None:
        """Write what waits, oldest first, until the store refuses."""
        with self._lock:
            self._watch()
            while self._waiting:
                row = self._waiting[0]
                error = self._write(row)
                if error is None or self._holds(row):
                    if not self._file.in_place and not self._watch():
                        if self.away:
                            return
                        continue  # it was written to a file that is gone: once more
                    self._waiting.popleft()
                    row.stored = True
                    self._back()
                elif self._takes_all_but(error):
                    self._waiting.popleft()
                    self.lost += 1
                    log.error("epoch %d was not kept: %s", row.epoch.number, error)
                else:
                    self._refused(error)
                    return
            self._flush_events()
            self._flush_readings()

    def _watch(self) -> bool:
        """Follow the file if it went away; whether what was committed is in the one at the path."""
        try:
            return self._file.watch()
        except StoreError as error:
            self._out(error, time.time())
            return False
        finally:
            self._note_events()

    def _write(self, row: Row) -> StoreError | None:
        self._look_at_the_disk(row)
        attempts = [row.thin()] if self.thin else [row, row.thin()]
        error: StoreError | None = None
        for attempt in attempts:
            try:
                self.store.append(
                    self.series(attempt.series),
                    attempt.epoch,
                    attempt.result,
                    extra=attempt.extra,
                    clock_trusted=attempt.clock_trusted,
                )
            except StoreError as refusal:
                error = error or refusal
            else:
                return None
        return error

    def _look_at_the_disk(self, row: Row) -> None:
        try:
            free = shutil.disk_usage(self.path.parent).free
        except OSError:
            return
        if not self.thin and free < _RESERVE_BYTES:
            self.thin = True
            text = f"{free / 1e6:.0f} MB are free: results are kept, observations no more"
            log.warning(text, extra={"event": "observations_paused"})
            self._events.append(Event(row.epoch.frame_time, "observations_paused", text))
        elif self.thin and free > _ENOUGH_BYTES:
            self.thin = False
            text = f"{free / 1e6:.0f} MB are free: observations are kept again"
            log.info(text, extra={"event": "observations_resumed"})
            self._events.append(Event(row.epoch.frame_time, "observations_resumed", text))

    def _holds(self, row: Row) -> bool:
        """Whether a row was committed before its file could be followed."""
        number = row.epoch.number
        try:
            found = self.epochs(self.series(row.series), number, number, details=False)
        except StoreError:
            return False
        return any(stored.epoch.frame_time == row.epoch.frame_time for stored in found)

    def _takes_all_but(self, error: StoreError) -> bool:
        """Whether the store is well and it is this row that it does not take.

        On a full disk a row may find no room where an event still does: that row waits.
        """
        if self.away or isinstance(error, StoreFullError) or not self._flush_events():
            return False
        try:
            self.store.add_event(Event(self._waiting[0].epoch.frame_time, "row_refused", "probe"))
        except StoreError:
            return False
        return True

    def _out(self, error: StoreError, utc: float) -> None:
        if not self.away:
            log.error("%s; results wait in memory", error, extra={"event": "store_out"})
            self._events.append(Event(utc, "store_out", str(error)))
        self.away = str(error)

    def _refused(self, error: StoreError) -> None:
        self._out(error, self._waiting[0].epoch.frame_time)
        if len(self._waiting) > _MOST_WITH_OBSERVATIONS:
            self._waiting[-1 - _MOST_WITH_OBSERVATIONS] = self._waiting[
                -1 - _MOST_WITH_OBSERVATIONS
            ].thin()
        if len(self._waiting) > _MOST_WAITING:
            self._waiting.popleft()
            self.lost += 1

    def _back(self) -> None:
        if self.away:
            log.info("%s: can be written again", self.path, extra={"event": "store_back"})
            self.away = ""

    def _flush_events(self) -> bool:
        while self._events:
            try:
                self.store.add_event(self._events[0])
            except StoreError as error:
                log.debug("an event waits: %s", error)
                return False
            self._events.popleft()
        return True

    def _flush_readings(self) -> None:
        batch = list(self._readings)
        if not batch:
            return
        try:
            self.store.add_readings(batch)
        except StoreError as error:
            self._out(error, batch[0].utc)
            return
        for _ in batch:
            self._readings.popleft()
        self._back()

    def status(self) -> dict[str, Any]:
        """For `thermocald status`."""
        return {
            "path": str(self.path),
            "state": "out" if self.away else "results_only" if self.thin else "ok",
            "why": self.away,
            "waiting": self.waiting,
            "lost": self.lost,
            "notice": self.notice,
        }
