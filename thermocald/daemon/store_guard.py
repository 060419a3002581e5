"""The store under adverse conditions.

On a full disk, observations are given up before results. Results wait in memory for a store that
cannot be written. If the file is moved or deleted, the guard follows it: a deleted file remains in
the process that has it open, and a deleted -wal or -shm file makes other processes see another
state of the store. So all three files are watched, their content is restored at the path, and the
store is opened again. A card that is no longer mounted leaves an empty folder of the system's disk:
no store is created there, and results wait for the card.
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
from thermocald.errors import OutputError, StoreBusyError, StoreError, StoreFullError
from thermocald.files import cannot_write, is_unmounted, make_folder, mount_point, utc_stamp
from thermocald.numbers import counted
from thermocald.store.database.file import HELPERS, StoreFile, helper, read_wal_tail
from thermocald.store.database.store import Store
from thermocald.store.series import Event

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from thermocald.acquisition.calibrator import CalibratedEpoch
    from thermocald.epoch import Epoch
    from thermocald.store.series import EpochResult, LoggedReading, StoredEpoch, StoredSeries

log = logging.getLogger(__name__)


class FollowedStore:
    """An open store that is followed when its file goes away; used under one lock.

    events: receives the events of the file; notice: what last happened to the file, or ""; series:
    those that were looked up in the open store. Raises StoreError.
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
            os.replace(aside, helper(self.path, "wal"))  # the daemon was killed in `close`
        self._file = StoreFile(self.path)
        self._mount = mount_point(self.path)
        lost, unfinished = read_wal_tail(helper(self.path, "wal"))
        if lost:  # a copy is kept for examination
            kept = str(self.path.with_name(f"{self.path.stem}-wal-damaged-{utc_stamp()}"))
            try:
                shutil.copyfile(helper(self.path, "wal"), kept)
            except OSError as error:
                kept = f"nowhere: {error.strerror}"
        try:
            self.store = Store.open(self.path, "append", durable=self._durable, claimed=True)
        except BaseException:
            self._file.discard_new()
            self._file.release()
            raise
        self.series: dict[tuple[str, str], StoredSeries] = {}
        self._file.remember_helpers()
        if self._file.names > 1:
            text = f"the file has {self._file.names} names (hard links); write it only under this"
            self._note("store_linked", text)
        if lost:
            many = "all transactions" if lost < 0 else counted(lost, "transaction")
            text = f"its -wal file was damaged and has lost {many}; a copy is in {kept}"
            self._note("wal_damaged", text)
        elif unfinished:
            text = "the last write was cut off before its commit: a full disk, or a killed writer"
            log.info("%s: %s", self.path, text, extra={"event": "wal_unfinished"})
            self._events.append(Event(time.time(), "wal_unfinished", text))

    def _note(self, kind: str, text: str) -> None:
        self.notice = text
        log.error("%s: %s", self.path, text, extra={"event": kind})
        self._events.append(Event(time.time(), kind, f"{self.path.name}: {text}"))

    @property
    def in_place(self) -> bool:
        """Whether all commits are in the files at the store's paths."""
        return self._file.there and all(map(self._file.helper_there, HELPERS))

    def watch(self) -> bool:
        """Check that the files are in place; if not, restore them or open the new ones.

        Returns whether the store at the path now holds all earlier commits. Raises StoreError if no
        store can be opened there; the next call tries again.
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
        """Raise StoreError if the store's disk is no longer mounted."""
        if is_unmounted(self.path, self._mount):
            raise StoreError(f"{self.path}: its disk is gone, {self._mount} is no longer mounted")

    def _follow(self) -> bool:
        self._require_mount()
        file, copy = self._file, None
        covered = mount_point(self.path) != self._mount
        place = next(folder for folder in self.path.resolve().parents if folder.exists())
        swapped = not covered and not file.deleted and place.stat().st_dev != file.identity[0]
        # a -wal file without a name would be lost with the connection: a checkpoint, or else a
        # copy, saves its content. A store that another disk covers has no path, and is copied. A
        # store on a disk that was exchanged stays there: a disk that was pulled out is unreadable
        emptied = False
        if not (swapped or file.deleted or covered):
            try:
                emptied = self.store.checkpoint()
            except StoreError as error:
                log.debug("%s", error)
        if not swapped and not emptied:
            target = self.path.resolve()
            copy = target.with_name(f"{target.stem}-rescued-{utc_stamp()}.db")
            target.parent.mkdir(parents=True, exist_ok=True)
            self.store.copy_to(copy)
        there, other = file.there, self.path.exists()
        if there:
            text = "its -wal or -shm file was deleted; its content was moved into the store"
        elif file.deleted and not other:
            text = "was deleted; it was written again with its full content"
        else:
            gone = "replaced by another file" if file.deleted else "moved away"
            if covered or swapped:
                gone = "on another disk than is mounted there now"
            what = ", which is used now" if file.deleted else "; the file at its path is used now"
            rest = "" if copy is None else f"; its content is in {copy}"
            text = f"was {gone}{what if other else '; a new store was created'}{rest}"
        carried = there or (file.deleted and not other)
        self.close()
        make_folder(self.path.resolve().parent)
        if carried and copy is not None:
            os.replace(copy, self.path.resolve())  # a link stays a link
        self._open()
        self._note("store_followed", text)
        return carried

    def close(self) -> None:
        """Close the store and release its lock; may be called twice.

        If the files were not in place, the helper files at the path are deleted, since the next
        database there would take them for its own. The helper files of another store stay.
        """
        if self.store.closed:
            return
        foreign = not self._file.there and self.path.exists() and not self._file.helper_there("wal")
        stale = not self.in_place and not foreign
        wal, aside = helper(self.path, "wal"), _aside(self.path)
        try:
            if foreign and wal.exists():
                # SQLite deletes the file by its name after comparing only inode numbers, which are
                # the same on a card that was plugged in again
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


# results alone take about 1.2 kB an epoch: enough for more than a day at one every 10 s
_RESERVE_BYTES = 16_000_000
_ENOUGH_BYTES = 20_000_000
_MOST_WITH_OBSERVATIONS = 100
_MOST_WAITING = 20_000
_FLUSH_S = 5.0  # of writing what waited, then others get their turn: the watchdog does not wait
_LAST_WAIT_S = 15.0  # for a lock, when the daemon is stopped
_TELL_EVERY_S = 60.0  # losses are reported this often


@dataclass(eq=False)
class Row:
    """An epoch to be stored."""

    series: StoredSeries
    epoch: Epoch
    result: EpochResult | None
    extra: Mapping[str, float]
    clock_trusted: bool
    stored: bool = False  # committed, and in the file that is at the store's path

    def thin(self) -> Row:
        """Return the row without observations and with the variances alone as covariance."""
        result = self.result
        if result is not None and result.covariance is not None:
            result = replace(result, covariance=np.diag(np.diag(result.covariance)))
        return replace(self, epoch=replace(self.epoch, observations=None), result=result)


class StoreGuard:
    """An open store whose writes wait and are repeated; threads may share it.

    Raises StoreError only when it is opened, if a method does not state otherwise.
    """

    def __init__(self, path: Path, *, durable: bool = True) -> None:
        self.path = path
        self.lost = 0  # epochs that were taken but not stored, for any reason
        self._lost_at = self._lost_told_at = -math.inf
        self._lost_why = ""
        self.away = ""  # why the store cannot be written, else empty
        self.thin = False
        self._waiting: deque[Row] = deque()
        self._events: deque[Event] = deque(maxlen=1000)
        self._readings: deque[LoggedReading] = deque(maxlen=_MOST_WAITING)
        self._retry_at = -math.inf
        self._locked = False  # whether it is away because another program locks it
        self._lock = threading.RLock()
        self._file = FollowedStore(path, self._events, durable=durable)

    @property
    def store(self) -> Store:
        """The open store, which is replaced when its file is followed: read through the guard."""
        return self._file.store

    @property
    def waiting(self) -> int:
        """The number of epochs that wait in memory to be stored."""
        return len(self._waiting)

    def close(self) -> None:
        """Try once more to store what waits, also for a lock to end, then close."""
        deadline = time.monotonic() + _LAST_WAIT_S
        with self._lock:
            self.flush(math.inf)
            while self._waiting and self._locked and time.monotonic() < deadline:
                self.flush(math.inf)  # each waits for the lock for a while
            if self._waiting:
                first, count = self._waiting[0].epoch.number, len(self._waiting)
                self.lose(f"epoch {first}{' and later' if count > 1 else ''}: {self.away}", count)
                self._waiting.clear()
            self._file.close()

    def series(self, wanted: StoredSeries) -> StoredSeries:
        """Return the series of this camera and name in the open store; create it if missing."""
        key = (wanted.camera, wanted.name)
        with self._lock:
            known = self._file.series
            if key not in known:
                known[key] = self.store.series_of(*key) or self.store.create_series(
                    wanted.head,
                    wanted.testfield,
                    start=wanted.start,
                    identity=wanted.identity,
                    settings=wanted.settings,
                    created_utc=wanted.created_utc,
                )
            return known[key]

    def epochs(
        self, series: StoredSeries, first: int, last: int | None = None, *, details: bool = True
    ) -> list[StoredEpoch]:
        """Read some epochs at once, so that the store is not replaced meanwhile."""
        with self._lock:
            return list(self.store.epochs(series, first, last, details=details))

    def last_epoch(self, series: StoredSeries, *, waiting: bool = True) -> int:
        """Return the number of the last epoch that is stored or waits, 0 if there is none."""
        with self._lock:
            rows = self._waiting_of(series.camera, series.name) if waiting else ()
            return max(self.store.last_epoch(series) or 0, *(r.epoch.number for r in rows), 0)

    def find(self, camera: str, name: str) -> StoredSeries | None:
        """Return a camera's series of this name, also one whose rows wait; None without one."""
        with self._lock:
            waiting = (row.series for row in self._waiting_of(camera, name))
            return self.store.series_of(camera, name) or next(waiting, None)

    def _waiting_of(self, camera: str, name: str) -> Iterator[Row]:
        return (r for r in self._waiting if (r.series.camera, r.series.name) == (camera, name))

    def append(self, row: Row) -> bool:
        """Store an epoch now or when the store can be written; return whether it is stored."""
        with self._lock:
            self._waiting.append(row)
            if self.away and time.monotonic() < self._retry_at:
                self._limit_waiting()
            else:
                self.flush()
            return row.stored

    def amend(self, series: StoredSeries, later: CalibratedEpoch, result: EpochResult) -> None:
        """Store a later calibration of an epoch; raises StoreError."""
        with self._lock:
            self._watch()
            seen = None if self.thin else later.epoch.observations
            self.store.amend(
                self.series(series), later.epoch.number, result, observations=seen,
                extra=later.extra,
            )  # fmt: skip

    def event(self, utc: float, kind: str, text: str, **more: Any) -> None:
        """Store an event, now or when the store can be written again; more: as of `Event`."""
        with self._lock:
            self._events.append(Event(utc, kind, text, **more))
            self._flush_events()

    def lose(self, why: str, count: int = 1) -> None:
        """Count epochs that were taken but will not be stored; report this once a minute."""
        self.lost += count
        self._lost_at, self._lost_why = time.monotonic(), why
        if count == 1 and self._lost_at - self._lost_told_at < _TELL_EVERY_S:
            return
        self._lost_told_at = self._lost_at
        log.error("%s lost: %s", counted(self.lost, "epoch"), why, extra={"event": "epoch_lost"})
        self._events.append(Event(time.time(), "epoch_lost", why))

    def reading(self, reading: LoggedReading) -> None:
        """Queue a reading that belongs to no epoch, for the next `flush`."""
        self._readings.append(reading)

    def flush(self, within_s: float = _FLUSH_S) -> None:
        """Write what waits, oldest first, until a write fails or the time is over."""
        with self._lock:
            begin = time.monotonic()
            self._watch()
            while self._waiting and time.monotonic() - begin < within_s:
                row = self._waiting[0]
                error = self._write(row)
                if error is None or self._is_committed(row):
                    if not self._file.in_place and not self._watch():
                        if self.away:
                            return
                        continue  # it was written to a file that is gone: write it again
                    self._waiting.popleft()
                    row.stored = True
                    self._mark_back()
                elif self._refuses_only_this(error):
                    self._waiting.popleft()
                    self.lose(f"epoch {row.epoch.number} of {row.series.camera}: {error}")
                else:
                    self._locked = isinstance(error, StoreBusyError)
                    self._mark_out(error, row.epoch.frame_time)
                    self._limit_waiting()
                    # an attempt at a locked store takes long, and epochs may come faster
                    self._retry_at = 2 * time.monotonic() - begin
                    return
            self._flush_events()
            self._flush_readings()

    def _watch(self) -> bool:
        """Follow the file if it went away; return whether the one at the path has all commits."""
        try:
            return self._file.watch()
        except StoreError as error:
            self._mark_out(error, time.time())
            return False

    def _write(self, row: Row) -> StoreError | None:
        self._check_free_space(row)
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
            except Exception as cause:
                # no row, whatever a driver put into it, may stop the daemon
                log.exception("epoch %d of %s", row.epoch.number, row.series.camera)
                error = error or StoreError(f"{type(cause).__name__}: {cause}")
            else:
                return None
            if isinstance(error, StoreBusyError):
                break
        return error

    def _check_free_space(self, row: Row) -> None:
        try:
            free = shutil.disk_usage(self.path.parent).free
        except OSError:
            return
        if not self.thin and free < _RESERVE_BYTES:
            kind, what = "observations_paused", "results are stored, observations no longer"
        elif self.thin and free > _ENOUGH_BYTES:
            kind, what = "observations_resumed", "observations are stored again"
        else:
            return
        self.thin = not self.thin
        text = f"{free / 1e6:.0f} MB are free: {what}"
        log.log(logging.WARNING if self.thin else logging.INFO, text, extra={"event": kind})
        self._events.append(Event(row.epoch.frame_time, kind, text))

    def _is_committed(self, row: Row) -> bool:
        """Return whether a row was committed before its file was followed."""
        number = row.epoch.number
        try:
            found = self.epochs(self.series(row.series), number, number, details=False)
        except StoreError:
            return False
        return any(stored.epoch.frame_time == row.epoch.frame_time for stored in found)

    def _refuses_only_this(self, error: StoreError) -> bool:
        """Return whether the store can be written, but not with the row of this error.

        On a full disk there may be room for an event but not for a row, and a lock may end while
        the event waits for it: then the row waits.
        """
        if self.away or isinstance(error, StoreFullError | StoreBusyError):
            return False
        if not self._flush_events():
            return False
        try:
            self.store.add_event(Event(time.time(), "row_refused", "probe"))
        except StoreError:
            return False
        return True

    def _mark_out(self, error: StoreError, utc: float) -> None:
        if not self.away:
            log.error("%s; results wait in memory", error, extra={"event": "store_out"})
            self._events.append(Event(utc, "store_out", str(error)))
        self.away = str(error)

    def _limit_waiting(self) -> None:
        """Thin the rows beyond the latest 100, and lose the oldest of too many."""
        last = -1 - _MOST_WITH_OBSERVATIONS
        if len(self._waiting) >= -last:
            self._waiting[last] = self._waiting[last].thin()
        if len(self._waiting) > _MOST_WAITING:
            self.lose(f"epoch {self._waiting.popleft().epoch.number}: too many wait: {self.away}")

    def _mark_back(self) -> None:
        if self.away:
            log.info("%s: can be written again", self.path, extra={"event": "store_back"})
            self.away = ""

    def _flush_events(self) -> bool:
        while self._events:
            try:
                event = self._events[0]
                text = event.text.encode(errors="backslashreplace").decode()  # surrogates of names
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
            self._mark_out(error, batch[0].utc)
            return
        for reading in batch:
            # readings that arrive meanwhile may push the oldest out of a full queue
            if self._readings and self._readings[0] is reading:
                self._readings.popleft()
        self._mark_back()

    def status(self) -> dict[str, Any]:
        """Return the store's part of the status document."""
        return {
            "state": "out" if self.away else "results_only" if self.thin else "ok",
            "why": self.away,
            "waiting": self.waiting,
            "lost": self.lost,
            "lost_why": self._lost_why,
            "lost_s_ago": time.monotonic() - self._lost_at if self.lost else None,
            "notice": self._file.notice,
        }
