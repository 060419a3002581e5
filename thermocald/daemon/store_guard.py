"""The store under hard conditions: a full disk loses observations before results, results wait in
memory for a store that cannot be written, and the file is followed when it goes away underneath.

A deleted file lives on in the process that has it open, and a deleted -wal or -shm file makes other
processes see another state of the store: so all three are watched, what they held is brought to the
path again, and the store is opened once more. A card that is no longer mounted leaves an empty
folder of the system's disk: nothing is begun there, results wait for the card.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import shutil
import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.addresses import without_secrets
from thermocald.errors import OutputError, StoreError, StoreFullError
from thermocald.files import cannot_write, is_unmounted, make_folder, mount_point
from thermocald.store.database.file import HELPERS, StoreFile, helper, read_wal_tail
from thermocald.store.database.store import Store
from thermocald.store.series import Event

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.store.series import EpochResult, LoggedReading, StoredEpoch, StoredSeries

log = logging.getLogger(__name__)


class FollowedStore:
    """An open store and its file; used under one lock. Raises StoreError.

    events: gets what is to be stored about the file; notice: what happened to it, empty if nothing.
    """

    def __init__(self, path: Path, events: deque[Event], *, durable: bool = True) -> None:
        self.path = path
        self.notice = ""
        self._events = events
        self._durable = durable
        self._mount = mount_point(path)
        try:
            self._open()
        except OSError as error:  # a name that is too long for its helper files
            raise StoreError(str(cannot_write(path, error))) from error

    def _open(self) -> None:
        self._require_mount()
        aside = _aside(self.path)
        if aside.exists() and not helper(self.path, "wal").exists():
            os.replace(aside, helper(self.path, "wal"))  # killed while it was away
        self._file = StoreFile(self.path)
        self._mount = mount_point(self.path)
        tail = read_wal_tail(helper(self.path, "wal"))
        kept = self._keep_damaged_wal() if tail.lost else ""
        try:
            self.store = Store.open(self.path, "append", durable=self._durable, claimed=True)
        except BaseException:
            self._file.discard_empty()
            self._file.release()
            raise
        self._file.remember_helpers()
        if self._file.names > 1:
            text = f"the file has {self._file.names} names (hard links): write it under this alone"
            self._note("store_linked", text)
        if tail.lost:
            many = "all transactions" if tail.lost < 0 else f"{tail.lost} transactions"
            text = f"its -wal file was damaged, {many} in it were lost; a copy is in {kept}"
            self._note("wal_damaged", text)
        elif tail.unfinished:
            text = "the last write was cut off when its writer ended; it had not been committed"
            log.info("%s: %s", self.path, text, extra={"event": "wal_unfinished"})
            self._events.append(Event(time.time(), "wal_unfinished", text))

    def _note(self, kind: str, text: str) -> None:
        self.notice = text
        log.error("%s: %s", self.path, text, extra={"event": kind})
        self._events.append(Event(time.time(), kind, f"{self.path.name}: {text}"))

    def _keep_damaged_wal(self) -> str:
        """Copy the -wal file for who wants to look into it; return where."""
        copy = self.path.with_name(f"{self.path.stem}-wal-damaged-{_stamp()}")
        try:
            shutil.copyfile(helper(self.path, "wal"), copy)
        except OSError as error:
            return f"nowhere: {error.strerror}"
        return str(copy)

    @property
    def in_place(self) -> bool:
        """Whether what was committed is in the files that are at their paths."""
        return self._file.there and all(map(self._file.helper_there, HELPERS))

    def watch(self) -> bool:
        """Look whether the files are where they were, and go on with what is there.

        Returns whether the store at the path now holds all that was committed before; raises
        StoreError where nothing can be opened there, and tries again when called again.
        """
        try:
            if self.store.closed:
                self._open()
                return False
            self._file.remember_helpers()
            return self.in_place or self._follow()
        except OSError as error:
            raise StoreError(f"{self.path}: cannot be written: {error.strerror}") from error
        except OutputError as error:
            raise StoreError(str(error)) from error

    def _require_mount(self) -> None:
        """Raise StoreError where the disk of the store is not mounted any more."""
        if is_unmounted(self.path, self._mount):
            raise StoreError(
                f"{self.path}: its disk is gone, {self._mount} is not mounted any more"
            )

    def _follow(self) -> bool:
        self._require_mount()
        file, copy = self._file, None
        covered = mount_point(self.path) != self._mount
        swapped = not covered and not file.deleted and _device(self.path) != file.identity[0]
        # else what is in a -wal file that has no name any more would be lost with the connection;
        # what is below another disk now is not found by its name; what was on another disk stays
        # there, and cannot be read where that was pulled out
        emptied = False
        if not (swapped or file.deleted or covered):
            try:
                emptied = self.store.checkpoint()
            except StoreError as error:
                log.debug("%s", error)
        if not swapped and not emptied:
            copy = self._rescued()
        there, other = file.there, self.path.exists()
        if there:
            text = "its -wal or -shm file was deleted; what it held was moved into the store"
        elif file.deleted and not other:
            text = "was deleted; it was written again with all that it held"
        else:
            gone = "replaced by another file" if file.deleted else "moved away"
            if covered or swapped:
                gone = "on another disk than is mounted there now"
            what = ", which is used now" if file.deleted else "; the file at its path is used now"
            rest = "" if copy is None else f"; what it held is in {copy}"
            text = f"was {gone}{what if other else '; a new store was begun'}{rest}"
        carried = there or (file.deleted and not other)
        self.close()
        make_folder(self.path.resolve().parent)
        if carried and copy is not None:
            os.replace(copy, self.path.resolve())  # a link stays one
        self._open()
        self._note("store_followed", text)
        return carried

    def _rescued(self) -> Path:
        """Copy all that the open store holds beside where it was; return where."""
        target = self.path.resolve()
        copy = target.with_name(f"{target.stem}-rescued-{_stamp()}.db")
        target.parent.mkdir(parents=True, exist_ok=True)
        self.store.copy_to(copy)
        return copy

    def close(self) -> None:
        """Close the store and give its lock back; may be called twice.

        If the files were not in place, the helper files at the path are removed too: they would be
        taken for those of the next database there. Those of another store are left alone.
        """
        if self.store.closed:
            return
        foreign = not self._file.there and self.path.exists() and not self._file.helper_there("wal")
        stale = not self.in_place and not foreign
        wal, aside = helper(self.path, "wal"), _aside(self.path)
        try:
            if foreign and wal.exists():
                # SQLite deletes it by its name, and compares only the numbers of inodes: those of
                # a card that was plugged in again are the same
                os.replace(wal, aside)
            self.store.close()
        except (OSError, StoreError) as error:
            log.error("%s", error)
        finally:
            if aside.exists():
                os.replace(aside, wal)
        if stale:
            for kind in HELPERS:
                with contextlib.suppress(OSError):
                    helper(self.path, kind).unlink(missing_ok=True)
        self._file.release()


def _aside(path: Path) -> Path:
    wal = helper(path, "wal")
    return wal.with_name(f".{wal.name[:60]}.aside")


def _device(path: Path) -> int:
    """The disk on which a path lies, or would lie."""
    return next(folder for folder in path.resolve().parents if folder.exists()).stat().st_dev


def _stamp() -> str:
    return time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())


# Results alone take about 1.2 kB an epoch: this is more than a day at one every 10 s.
_RESERVE_BYTES = 16_000_000
_ENOUGH_BYTES = 20_000_000
_MOST_WITH_OBSERVATIONS = 100
_MOST_WAITING = 20_000


@dataclass(eq=False)
class Row:
    """What is kept of one epoch."""

    series: StoredSeries
    epoch: Epoch
    result: EpochResult | None
    extra: Mapping[str, float]
    clock_trusted: bool
    stored: bool = False  # committed, and in the file that is at the store's path

    def thin(self) -> Row:
        """Return the same without observations, and of the covariance the standard deviations."""
        result = self.result
        if result is not None and result.covariance is not None:
            result = replace(result, covariance=np.diag(np.diag(result.covariance)))
        return replace(self, epoch=replace(self.epoch, observations=None), result=result)


class StoreGuard:
    """An open store that does not give up; threads may share it.

    Raises StoreError only when it is opened.
    """

    def __init__(self, path: Path, *, durable: bool = True) -> None:
        self.path = path
        self.lost = 0  # epochs that were taken and not kept, for whatever reason
        self._lost_at = -math.inf
        self._lost_why = ""
        self.away = ""  # why the store cannot be written, empty while it can
        self.thin = False
        self._waiting: deque[Row] = deque()
        self._events: deque[Event] = deque(maxlen=1000)
        self._readings: deque[LoggedReading] = deque(maxlen=_MOST_WAITING)
        self._lock = threading.RLock()
        self._series: dict[tuple[str, str], StoredSeries] = {}
        self._known: Store | None = None  # whose series are in `_series`
        self._file = FollowedStore(path, self._events, durable=durable)

    @property
    def store(self) -> Store:
        """The open store; another one after its file was followed, so read through the guard."""
        return self._file.store

    @property
    def waiting(self) -> int:
        """Epochs that wait in memory for a store that can be written."""
        return len(self._waiting)

    def close(self) -> None:
        """Try once more to keep what waits, and close."""
        with self._lock:
            self.flush()
            while self._waiting:
                self.lose(f"epoch {self._waiting.popleft().epoch.number}: {self.away}")
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
        """Return the number of the last epoch kept, 0 if there is none."""
        with self._lock:
            return self.store.last_epoch(series) or 0

    def all_series(self) -> list[StoredSeries]:
        """Return all series, in the order in which they were begun."""
        with self._lock:
            return self.store.all_series()

    def stored_events(self) -> list[Event]:
        """Return all events in the store, oldest first."""
        with self._lock:
            return self.store.events()

    def append(self, row: Row) -> bool:
        """Keep an epoch, now or when the store can be written again; whether it is stored."""
        with self._lock:
            self._waiting.append(row)
            self.flush()
            return row.stored

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

    def lose(self, why: str) -> None:
        """Count an epoch that was taken and will not be kept, and tell of it."""
        self.lost += 1
        self._lost_at, self._lost_why = time.monotonic(), why
        log.error("an epoch is lost: %s", why, extra={"event": "epoch_lost"})
        self._events.append(Event(time.time(), "epoch_lost", why))

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
                    self.lose(f"epoch {row.epoch.number} of {row.series.camera}: {error}")
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
            kind, what = "observations_paused", "results are kept, observations no more"
        elif self.thin and free > _ENOUGH_BYTES:
            kind, what = "observations_resumed", "observations are kept again"
        else:
            return
        self.thin = not self.thin
        text = f"{free / 1e6:.0f} MB are free: {what}"
        log.log(logging.WARNING if self.thin else logging.INFO, text, extra={"event": kind})
        self._events.append(Event(row.epoch.frame_time, kind, text))

    def _holds(self, row: Row) -> bool:
        """Return whether a row was committed before its file could be followed."""
        number = row.epoch.number
        try:
            found = self.epochs(self.series(row.series), number, number, details=False)
        except StoreError:
            return False
        return any(stored.epoch.frame_time == row.epoch.frame_time for stored in found)

    def _takes_all_but(self, error: StoreError) -> bool:
        """Return whether the store is well and it is this row that it does not take.

        On a full disk a row may find no room where an event still does: that row waits.
        """
        if self.away or isinstance(error, StoreFullError) or not self._flush_events():
            return False
        try:
            self.store.add_event(Event(time.time(), "row_refused", "probe"))
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
        last = -1 - _MOST_WITH_OBSERVATIONS
        if len(self._waiting) >= -last:
            self._waiting[last] = self._waiting[last].thin()
        if len(self._waiting) > _MOST_WAITING:
            self.lose(f"epoch {self._waiting.popleft().epoch.number}: too many wait: {error}")

    def _back(self) -> None:
        if self.away:
            log.info("%s: can be written again", self.path, extra={"event": "store_back"})
            self.away = ""

    def _flush_events(self) -> bool:
        while self._events:
            try:
                event = self._events[0]
                text = event.text.encode(errors="backslashreplace").decode()  # of a file's name
                self.store.add_event(replace(event, text=without_secrets(text)))
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
        """Return the store's part of what `thermocald status` shows."""
        return {
            "path": str(self.path),
            "state": "out" if self.away else "results_only" if self.thin else "ok",
            "why": self.away,
            "waiting": self.waiting,
            "lost": self.lost,
            "lost_why": self._lost_why,
            "lost_s_ago": time.monotonic() - self._lost_at if self.lost else None,
            "notice": self._file.notice,
        }
