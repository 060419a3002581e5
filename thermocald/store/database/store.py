"""The store: all data of a daemon in one SQLite file.

It holds several cameras, each with series of epochs. An epoch is one transaction, so a writer that
is killed loses at most the current epoch. Nothing is changed or deleted: a later calibration of an
epoch is a further revision, and triggers in the file refuse any change.
"""

from __future__ import annotations

import json
import logging
import threading
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from thermocald.errors import StoreError, StoreFullError
from thermocald.names import UNEVENTFUL, file_name, relative_path, require_channels
from thermocald.numbers import counted
from thermocald.store.database import columns, epochs
from thermocald.store.database.file import (
    Mode,
    StoreFile,
    connect,
    copy_database,
    helper,
    in_words,
    read_wal_tail,
)
from thermocald.store.recording.head import head_document, parse_head
from thermocald.store.schema import COLUMN_NAMES, sql_name
from thermocald.store.series import (
    LOG,
    NOT_CALIBRATED,
    EpochResult,
    Event,
    LoggedReading,
    SeriesReader,
    StoredEpoch,
    StoredSeries,
)

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.store.recording.head import Head

log = logging.getLogger(__name__)

_EPOCHS_AT_ONCE = 100
_READINGS_AT_ONCE = 1000
_CLAIMED_BUSY_MS = 500


class Store(SeriesReader):
    """An open store; use `Store.open` and a `with` block. Threads may share it."""

    def __init__(self, path: Path, connection: sqlite3.Connection, file: StoreFile | None) -> None:
        self.path = path
        self.closed = False
        self._db = connection
        self._file = file  # None if the caller holds the lock, or there is none
        self._lock = threading.RLock()
        # {series: last epoch, epochs in no chunk}, the latter -inf if chunks cannot be built
        self._ends: dict[int, tuple[int, float]] = {}

    @classmethod
    def open(
        cls, path: Path, mode: Mode = "read", *, durable: bool = True, claimed: bool = False
    ) -> Self:
        """Open a store; `append` creates it if it does not exist and locks it for one writer.

        durable: a commit survives a power cut; False: only the end of the process, for results that
        can be computed again; claimed: the caller holds the lock, a StoreFile. Raises StoreError,
        StoreVersionError.
        """
        if mode == "read" or claimed:
            connection = connect(path, mode, durable=durable)
            if claimed:  # its rows can wait in memory, and its watchdog cannot
                connection.execute(f"PRAGMA busy_timeout = {_CLAIMED_BUSY_MS}")
            return cls(path, connection, None)
        file = StoreFile(path)
        try:
            if file.names > 1:
                raise StoreError(
                    f"{path}: has {file.names} names (hard links), and SQLite puts the latest data "
                    "beside only one of them; remove the others, or use a symbolic link"
                )
            return cls(path, connect(path, mode, durable=durable), file)
        except BaseException:
            file.discard_new()
            file.release()
            raise

    def close(self) -> None:
        with self._lock, in_words(self.path, "the store cannot be closed"):
            self.closed = True
            self._db.close()
            file, self._file = self._file, None
            if file is not None:
                file.release()

    @property
    def identity(self) -> str:
        """The UUID that the store got when it was created; a copy has the same."""
        return str(self._value("SELECT identity FROM store"))

    def all_series(self) -> list[StoredSeries]:
        with self._reads("the series") as connection:
            return list(epochs.select_series(connection, self.path))

    def last_epoch(self, series: StoredSeries) -> int | None:
        """Return the number of the last epoch, after which to resume; None without epochs."""
        found = self._value("SELECT max(number) FROM epoch WHERE series_id = ?", series.id)
        if found is None or isinstance(found, int):
            return found
        raise StoreError(
            f"{self.path}: the store is damaged: an epoch of {series.head.series} has the number "
            f"{found!r}; restore a backup"
        )

    def deferred_epochs(self, series: StoredSeries, first: int, last: int, most: int) -> list[int]:
        """Return numbers from `first` to `last` of epochs to be calibrated from their frames."""
        with self._reads("epochs") as connection:
            found = connection.execute(
                "SELECT number FROM epoch e WHERE series_id = ? AND number BETWEEN ? AND ? AND "
                f"status = '{NOT_CALIBRATED}' AND frame <> '' AND NOT EXISTS (SELECT 1 FROM epoch "
                "WHERE series_id = e.series_id AND number = e.number AND revision > e.revision) "
                "ORDER BY number LIMIT ?",
                (series.id, first, last, most),
            )
            return [number for (number,) in found]

    def _epochs(
        self, series: StoredSeries, first: int, last: int | None, details: bool
    ) -> Iterator[StoredEpoch]:
        """Yield epochs; after a whole series, log a warning if some of its epochs are missing.

        They are read in pages, so that no statement is open while another thread may close the
        file: SQLite's library crashes if a connection is closed during a statement.
        """
        missing, following, more, end = 0, 1, True, 0
        if whole := not first and last is None:
            with suppress(StoreError):  # of a damaged store, the epochs tell
                end = self.last_epoch(series) or 0  # first: a daemon may write while this reads
        while more:
            page: list[StoredEpoch] = []
            try:
                with self._reads("epochs") as connection:
                    found = epochs.select_epochs(connection, series.id, first, last, details)
                    with closing(found):
                        page.extend(islice(found, _EPOCHS_AT_ONCE))
                more = len(page) == _EPOCHS_AT_ONCE
            except StoreError:
                if not page:  # else the next page begins with the damage
                    raise
            for stored in page:
                missing += max(0, stored.epoch.number - following)
                first = following = stored.epoch.number + 1
                yield stored
        if whole and (missing := missing + max(0, end + 1 - following)):
            log.warning(
                "%s: lacks %s of series %s; `thermocald check` lists what is missing",
                self.path, counted(missing, "epoch"), series.name,
            )  # fmt: skip

    def covariances(self, series: StoredSeries, numbers: Sequence[int]) -> Array:
        result = np.full((len(numbers), 16, 16), np.nan)
        for i, number in enumerate(map(int, numbers)):
            for stored in self._epochs(series, number, number, details=True):
                if stored.result.covariance is not None:
                    result[i] = stored.result.covariance
        return result

    def stamped_columns(
        self, series: StoredSeries, names: Sequence[str]
    ) -> dict[str, NDArray[Any]]:
        source = {name: _chunk_name(name, series) for name in names}
        with self._reads("columns") as connection:
            found = columns.SeriesColumns(connection, series.id).read(sorted({*source.values()}))
        return {name: found[source[name]] for name in names}

    def column_pages(
        self, series: StoredSeries, names: Sequence[str], rows: int
    ) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield the columns of `stamped_columns`, `rows` epochs at a time, in constant memory.

        Each page is a query of its own: a slow reader blocks no writer, and epochs stored meanwhile
        are included. The last page has fewer rows, of a series without epochs none.
        """
        source = {name: _chunk_name(name, series) for name in names}
        wanted = list(dict.fromkeys(["number", *source.values()]))
        after, size = -1, rows
        while size == rows:
            with self._reads("columns") as connection:
                found = columns.SeriesColumns(connection, series.id).read_page(wanted, after, rows)
            yield {name: found[source[name]] for name in names}
            size = len(found["number"])
            after = int(found["number"][-1]) if size else after

    def readings(self, thermometer: str | None = None) -> Iterator[LoggedReading]:
        """Yield the readings that belong to no epoch, in the order in which they were stored."""
        after = -1
        while page := self.rows_after("reading", after, _READINGS_AT_ONCE):
            after = page[-1]["id"]
            for one in _parse_readings(page):
                if thermometer in (None, one.thermometer) and not one.thermometer.startswith(LOG):
                    yield one

    def logged(self, series: StoredSeries) -> list[LoggedReading]:
        with self._reads("readings") as connection:
            condition = "WHERE thermometer = ? ORDER BY utc"
            rows = epochs.whole_rows(connection, "reading", condition, (series.log_name,))
            return list(_parse_readings(rows))

    def events(self) -> list[Event]:
        """Return the events, oldest first."""
        return [
            Event(
                row["utc"], row["kind"], row["text"], row["series_id"], row["epoch"],
                json.loads(row["data"]),
            )
            for row in _intact(self.rows_after("event", -1, -1))
        ]  # fmt: skip

    def clock_steps(self, series: StoredSeries) -> list[Event]:
        """Return the clock steps that the daemon recorded, oldest first, equal for all series."""
        del series
        return [event for event in self.events() if event.kind == "clock_step"]

    def rows_after(self, table: str, after: int, limit: int) -> list[dict[str, Any]]:
        """Return up to `limit` rows of a growing table with ids above `after`, for a forwarder.

        They are those of `database.epochs.whole_rows`.
        """
        with self._reads(f"{table}s") as connection:
            condition = "WHERE id > ? ORDER BY id LIMIT ?"
            return list(epochs.whole_rows(connection, table, condition, (after, limit)))

    def frames_after(self, after: int, limit: int) -> list[epochs.KeptFrame]:
        """Return up to `limit` epochs with ids above `after`, to forward their frames."""
        found = []
        with self._reads("frames") as connection:
            for id_, series, number, time, status, extra, frame in connection.execute(
                "SELECT id, series_id, number, frame_time, status, extra, frame FROM epoch "
                "WHERE id > ? ORDER BY id LIMIT ?",
                (after, limit),
            ):
                path, eventful = None, False
                try:
                    what = f"epoch {number}: frame"
                    path = relative_path(frame, what, StoreError) if frame else None
                    eventful = status not in UNEVENTFUL or "event" in json.loads(extra)
                except (StoreError, ValueError) as error:
                    log.warning("%s; its frame is left out", error)
                found.append(epochs.KeptFrame(id_, series, number, time, path, eventful))
        return found

    def rows_waiting(self, after: Mapping[str, int]) -> int:
        """Count the rows of the growing tables with ids above `after`, given by table."""
        return sum(
            int(self._value(f"SELECT count(*) FROM {table} WHERE id > ?", after[table]))
            for table in columns.KEPT
        )

    def examine(self) -> epochs.Examination:
        """Read the whole file and return what is damaged, and which epochs are missing.

        Raises StoreError if it cannot be read as a store at all.
        """
        with self._reads("the store") as connection:
            found = epochs.examine(connection)
        lost, unfinished = read_wal_tail(helper(self.path, "wal"))
        damaged = list(found.damaged)
        if lost:
            what = "all transactions" if lost < 0 else counted(lost, "transaction")
            damaged.insert(0, f"the -wal file: {what} in it cannot be read")
        found = replace(found, damaged=tuple(damaged), unfinished=unfinished)
        if not found.damaged:
            for series in self.all_series():
                self.series_columns(series, [*COLUMN_NAMES, *series.head.channels])
            self.events()
        return found

    def copy_to(self, target: Path) -> None:
        """Copy the store to another file, as a whole or not at all, also during writing.

        Raises StoreError, or OutputError if the target cannot be written.
        """
        with in_words(self.path, f"the copy {target} cannot be made"):
            copy_database(self._db, target)

    @contextmanager
    def _reads(self, what: str) -> Iterator[sqlite3.Connection]:
        """Lock the connection for this thread; `what` begins the message of an error."""
        with self._lock, in_words(self.path, f"{what} cannot be read", reading=True):
            yield self._db

    def _value(self, statement: str, *values: Any) -> Any:
        """Return the single value that a statement selects."""
        with self._reads("the store") as connection:
            return connection.execute(statement, values).fetchone()[0]

    def create_series(
        self,
        head: Head,
        testfield: TestField,
        *,
        start: str = "",
        identity: Mapping[str, Any] | None = None,
        settings: Mapping[str, Any] | None = None,
        created_utc: float = 0.0,
    ) -> StoredSeries:
        """Begin a series. Raises StoreError if the camera already has one of this name."""
        require_channels(head.channels, f"{self.path}: series {head.series!r}", StoreError)
        parse_head(head_document(head), self.path)  # refuses what could not be read again
        file_name(head.camera.name, "camera", StoreError)
        file_name(head.series, "series", StoreError)
        begun = StoredSeries(0, head, testfield, start, identity or {}, settings or {}, created_utc)
        try:
            with self._transaction(f"series {head.series!r} was not begun"):
                if self.series_of(head.camera.name, head.series) is not None:
                    raise StoreError(
                        f"{self.path}: camera {head.camera.name!r} has a series {head.series!r} "
                        "already; choose another name"
                    )
                epochs.insert_series(self._db, begun)
        except StoreFullError:
            if self._file is not None and not self.all_series():
                self._file.discard_new()
            raise
        return self.find_series(head.camera.name, head.series)

    def append(
        self,
        series: StoredSeries,
        epoch: Epoch,
        result: EpochResult | None = None,
        *,
        extra: Mapping[str, float] | None = None,
        clock_trusted: bool = True,
    ) -> None:
        """Store one epoch and its result, in one transaction.

        result: None if it will be calibrated later, by `amend`; extra: further columns such as
        blur. Raises StoreError if the number is not above the last one, StoreFullError if the disk
        is full; nothing of the epoch is then stored. An epoch without observations is smaller.
        """
        if extra and (taken := extra.keys() & {*COLUMN_NAMES, *series.head.channels}):
            raise StoreError(f"an extra column cannot be called {min(taken)!r}")
        stored = StoredEpoch(
            epoch, result or EpochResult(NOT_CALIBRATED), extra or {}, clock_trusted, 0
        )
        try:
            self._append(series, stored)
        except StoreFullError:
            # the checkpoint empties the -wal file, which may free enough space
            self.checkpoint()
            self._append(series, stored)

    def _append(self, series: StoredSeries, stored: StoredEpoch) -> None:
        epoch = stored.epoch
        with self._transaction(f"epoch {epoch.number} of series {series.name!r} was not stored"):
            last, loose = self._ends.get(series.id) or (self.last_epoch(series), columns.CHUNK)
            if last is not None and epoch.number <= last:
                raise StoreError(
                    f"{self.path}: epoch {epoch.number} of series {series.name!r} comes after "
                    f"epoch {last}; numbers must increase"
                )
            epochs.insert_epoch(self._db, series.id, stored)
            loose += 1
            if loose >= columns.CHUNK:
                loose = self._build_chunks(series)
        self._ends[series.id] = (epoch.number, loose)

    def _build_chunks(self, series: StoredSeries) -> float:
        """Build chunks; return the number of epochs that are in none.

        If old rows are damaged, the series gets no more chunks and is read from its rows.
        """
        self._db.execute("SAVEPOINT chunks")
        loose = -np.inf
        try:
            loose = columns.SeriesColumns(self._db, series.id).build()
        except StoreError as error:
            self._db.execute("ROLLBACK TO chunks")
            log.warning("%s: %s", self.path, error)
        self._db.execute("RELEASE chunks")
        return loose

    def amend(
        self,
        series: StoredSeries,
        number: int,
        result: EpochResult,
        *,
        observations: Observations | None = None,
        extra: Mapping[str, float] | None = None,
    ) -> None:
        """Store a later calibration of an epoch; observations: None if unchanged; extra: added."""
        with self._transaction(f"the calibration of epoch {number} was not stored"):
            found = epochs.select_epochs(self._db, series.id, number, number, details=False)
            if (then := next(found, None)) is None:
                raise StoreError(f"{self.path}: series {series.name!r} has no epoch {number}")
            epoch, more = replace(then.epoch, observations=observations), extra or {}
            later = replace(
                then, epoch=epoch, result=result, extra={**then.extra, **more},
                revision=then.revision + 1,
            )  # fmt: skip
            epochs.insert_epoch(self._db, series.id, later)

    def add_event(self, event: Event) -> None:
        """Store an event."""
        with self._transaction("an event was not stored"):
            columns.insert_row(
                self._db, "event", utc=event.utc, series_id=event.series, epoch=event.epoch,
                kind=event.kind, text=event.text, data=epochs.to_json(event.data),
            )  # fmt: skip

    def add_readings(self, readings: Sequence[LoggedReading]) -> None:
        """Store readings that belong to no epoch, in one transaction."""
        with self._transaction("readings were not stored"):
            for reading in readings:
                columns.insert_row(
                    self._db, "reading", utc=reading.utc, thermometer=reading.thermometer,
                    clock_trusted=int(reading.clock_trusted),
                    temperatures=epochs.to_json(reading.values),
                )  # fmt: skip

    def checkpoint(self) -> bool:
        """Move the -wal file into the store; return False if a reader or the disk prevents it."""
        try:
            busy = self._value("PRAGMA wal_checkpoint(TRUNCATE)")
        except StoreFullError:
            return False
        return not busy

    @contextmanager
    def _transaction(self, failed: str) -> Iterator[None]:
        """Run the block as one transaction; `failed` begins the message of an error."""
        with self._lock, in_words(self.path, failed):
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._db.execute("COMMIT")
            except BaseException:
                # SQLite has rolled back by itself after some errors, such as a full disk
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise


def _intact(rows: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield undamaged rows; skip others with a warning, since no result depends on them."""
    for row in rows:
        if row["damage"]:
            log.warning("%s; it is skipped", row["damage"])
        else:
            yield row


def _parse_readings(rows: Iterable[dict[str, Any]]) -> Iterator[LoggedReading]:
    for row in _intact(rows):
        name = file_name(row["thermometer"], "thermometer", StoreError)
        values, trusted = json.loads(row["temperatures"]), bool(row["clock_trusted"])
        yield LoggedReading(name, row["utc"], values, trusted)


def _chunk_name(name: str, series: StoredSeries) -> str:
    """Return the name in chunks of a column, given its public name."""
    if name in COLUMN_NAMES:
        return sql_name(name)
    return f"temperatures.{name}" if name in series.head.channels else f"extra.{name}"
