"""Reading a store in a file: epochs, columns, events, readings, and what of it is damaged."""

from __future__ import annotations

import logging
import threading
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.atomic_file import cannot_write
from thermocald.errors import StoreError
from thermocald.store.database import columns as column_chunks
from thermocald.store.database.changes import KEPT, KeptFrame, frames_after, rows_after
from thermocald.store.database.connection import in_words
from thermocald.store.database.copies import copy_database
from thermocald.store.database.epoch_columns import COLUMN_NAMES, status_codes
from thermocald.store.database.epoch_table import (
    StoredEpoch,
    select_covariance,
    select_epochs,
    select_observations,
)
from thermocald.store.database.examination import Examination, examine
from thermocald.store.database.series_reader import StampedReader
from thermocald.store.database.series_table import select_events, select_readings, select_series
from thermocald.store.database.wal import read_wal_tail

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.store.database.blob import ObservationRows
    from thermocald.store.database.row import Event, LoggedReading, StoredSeries

__all__ = ["StoreReader"]

log = logging.getLogger(__name__)

_EPOCHS_AT_ONCE = 100
_READINGS_AT_ONCE = 1000


class StoreReader(StampedReader):
    """The reading half of `store.Store`. Threads may share it."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self.closed = False
        self._db = connection
        self._lock = threading.RLock()

    def close(self) -> None:
        """Close the file; may be called twice."""
        with self._lock, in_words(self.path, "the store cannot be closed"):
            self.closed = True
            self._db.close()

    def all_series(self) -> list[StoredSeries]:
        """All series, in the order in which they were begun."""
        return self._select_series()

    def last_epoch(self, series: StoredSeries) -> int | None:
        """The number of the last epoch kept, None if there is none: where to resume."""
        last = self._end(series)[0]
        return None if last < 0 else last

    def _epochs(
        self, series: StoredSeries, first: int, last: int | None, details: bool
    ) -> Iterator[StoredEpoch]:
        """As they are read; what is missing of a whole series is logged at its end."""
        missing, before = 0, first or 1
        for stored in self._pages(series, first, last, details):
            missing += max(0, stored.epoch.number - before)
            before = stored.epoch.number + 1
            yield stored
        if not first and last is None:
            missing += max(0, (self.last_epoch(series) or 0) + 1 - before)
            if missing:
                log.warning(
                    "%s: %d epochs of series %s are missing; `thermocald check` says which",
                    self.path, missing, series.name,
                )  # fmt: skip

    def _pages(
        self, series: StoredSeries, first: int, last: int | None, details: bool
    ) -> Iterator[StoredEpoch]:
        """The epochs page by page: no statement is open while another thread may close the file.

        SQLite's library ends the process where a connection is closed under a statement.
        """
        while True:
            page: list[StoredEpoch] = []
            failed: StoreError | None = None
            try:
                with self._lock, in_words(self.path, "epochs cannot be read", reading=True):
                    found = select_epochs(self._db, series.id, first, last, details=details)
                    page.extend(islice(found, _EPOCHS_AT_ONCE))
                    del found
            except StoreError as error:
                failed = error
            yield from page
            if failed is not None:
                raise failed
            if len(page) < _EPOCHS_AT_ONCE:
                return
            first = page[-1].epoch.number + 1

    def observation_rows(self, series: StoredSeries, first: int, last: int) -> ObservationRows:
        """The observations of the epochs numbered `first` to `last`, without their quality."""
        with self._lock, in_words(self.path, "observations cannot be read", reading=True):
            return select_observations(self._db, series.id, first, last)

    def observations(
        self, series: StoredSeries, numbers: Iterable[int]
    ) -> Iterator[Observations | None]:
        """The observations of some epochs; StoreError for a number that is not there."""
        for number in numbers:
            stored = next(self.epochs(series, number, number), None)
            if stored is None:
                raise StoreError(f"{self.path}: series {series.name!r} has no epoch {number}")
            yield stored.epoch.observations

    def covariances(self, series: StoredSeries, numbers: Sequence[int]) -> Array:
        """(E, 16, 16) covariances of some epochs, NaN for those without a result."""
        result = np.full((len(numbers), 16, 16), np.nan)
        with self._lock, in_words(self.path, "covariances cannot be read", reading=True):
            for i, number in enumerate(numbers):
                covariance = select_covariance(self._db, series.id, int(number))
                if covariance is not None:
                    result[i] = covariance
        return result

    def column_names(self, series: StoredSeries) -> list[str]:
        """What `series_columns` can give, but extra columns."""
        return ["epoch", *COLUMN_NAMES[1:], "status", *series.head.channels]

    def series_columns(self, series: StoredSeries, names: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Columns over all epochs by name, (E,) each: a million epochs in a fraction of a second.

        Names are those of `column_names` and of extra columns: `epoch`, `frame_time`, `c`, `sd_c`,
        `sigma0`, a temperature channel (°C as read; see `temperatures_at_frame`), `blur` …; numbers
        are float64, NaN where an epoch has none; `status` is text.
        """
        source = {name: _source(name, series) for name in names}
        with self._lock, in_words(self.path, "columns cannot be read", reading=True):
            columns: dict[str, NDArray[Any]] = dict(
                column_chunks.read_columns(
                    self._db, series.id, list(dict.fromkeys(source.values()))
                )
            )
            self._name_statuses(columns)
        return {name: columns[source[name]] for name in names}

    def column_pages(
        self, series: StoredSeries, names: Sequence[str], rows: int = 1000
    ) -> Iterator[dict[str, NDArray[Any]]]:
        """The same columns, `rows` epochs at a time, in constant memory.

        Every page is read by itself: who takes long over one holds no writer up, and epochs that
        come meanwhile follow.
        """
        source = {name: _source(name, series) for name in names}
        wanted = list(dict.fromkeys(["number", *source.values()]))
        after = -1
        while True:
            with self._lock, in_words(self.path, "columns cannot be read", reading=True):
                columns: dict[str, NDArray[Any]] = dict(
                    column_chunks.read_page(self._db, series.id, wanted, after, rows)
                )
                self._name_statuses(columns)
            if not len(columns["number"]):
                return
            after = int(columns["number"][-1])
            yield {name: columns[source[name]] for name in names}

    def _name_statuses(self, columns: dict[str, NDArray[Any]]) -> None:
        """Put words in the place of the codes in the column `status`."""
        if "status" in columns:
            codes = status_codes(self._db)
            words = np.array([codes.get(i, "") for i in range(max(codes, default=0) + 1)])
            columns["status"] = words[columns["status"].astype(np.int64)]

    def readings(
        self, thermometer: str | None = None, since_utc: float = 0.0
    ) -> Iterator[LoggedReading]:
        """Readings apart from epochs, in the order they were kept."""
        after = 0
        while True:
            with self._lock, in_words(self.path, "readings cannot be read", reading=True):
                after, page = select_readings(
                    self._db, thermometer, since_utc, after, _READINGS_AT_ONCE
                )
            yield from page
            if not after:
                return

    def events(self, series: StoredSeries | None = None, since_utc: float = 0.0) -> list[Event]:
        """What happened, oldest first; of one series, or all."""
        with self._lock, in_words(self.path, "events cannot be read", reading=True):
            return select_events(self._db, None if series is None else series.id, since_utc)

    def clock_steps(self, series: StoredSeries) -> list[Event]:
        """The steps of the clock that the daemon noted, oldest first: of every series the same."""
        del series
        return [event for event in self.events() if event.kind == "clock_step"]

    def rows_after(self, table: str, after: int, limit: int) -> list[dict[str, Any]]:
        """Rows of a growing table as they were kept, see `changes`: for a forwarder."""
        with self._lock, in_words(self.path, f"{table}s cannot be read", reading=True):
            return list(rows_after(self._db, table, after, limit))

    def frames_after(self, after: int, limit: int) -> list[KeptFrame]:
        """Epochs' frames as they were kept, see `changes`: for a forwarder."""
        with self._lock, in_words(self.path, "frames cannot be listed", reading=True):
            return list(frames_after(self._db, after, limit))

    def rows_waiting(self, after: Mapping[str, int]) -> int:
        """How many rows of the growing tables have ids above those given, by table."""
        return sum(
            int(self._query(f"SELECT count(*) FROM {table} WHERE id > ?", (after[table],))[0][0])
            for table in KEPT
        )

    def check(self) -> None:
        """Read the whole file; StoreError if anything in it is damaged."""
        if damaged := self.examine().damaged:
            more = f" and {len(damaged) - 1} more" if len(damaged) > 1 else ""
            raise StoreError(f"{self.path}: is damaged: {damaged[0]}{more}")

    def examine(self) -> Examination:
        """Read the whole file: what is damaged, and which epochs are missing.

        Raises StoreError where it cannot be read as a store at all.
        """
        with self._lock, in_words(self.path, "the store cannot be read", reading=True):
            found = examine(self._db)
        tail = read_wal_tail(self.path.resolve().with_name(f"{self.path.resolve().name}-wal"))
        if tail.lost:
            many = f"{tail.lost} transaction{'s'[: tail.lost != 1]}"
            many = "all transactions" if tail.lost < 0 else many
            damaged = (f"the -wal file: {many} in it cannot be read", *found.damaged)
            found = replace(found, damaged=damaged)
        found = replace(found, unfinished=tail.unfinished)
        if not found.damaged:
            for series in self.all_series():
                self.series_columns(series, self.column_names(series))
            self.events()
        return found

    def copy_to(self, target: Path) -> None:
        """Copy the store to another file, whole or not at all, while it may be written.

        Raises StoreError; OutputError where that cannot be written.
        """
        with in_words(self.path, f"the copy {target} cannot be made"):
            try:
                copy_database(self._db, target)
            except OSError as error:
                raise cannot_write(target, error) from error

    def _select_series(
        self, camera: str | None = None, name: str | None = None
    ) -> list[StoredSeries]:
        with self._lock, in_words(self.path, "the series cannot be read", reading=True):
            return select_series(self._db, self.path, camera, name)

    def _end(self, series: StoredSeries) -> tuple[int, int]:
        """The last epoch number of a series (-1: none) and how many rows are in no chunk."""
        ((last,),) = self._query(
            "SELECT ifnull(max(number), -1) FROM epoch WHERE series_id = ?", (series.id,)
        )
        with self._lock, in_words(self.path, "the store cannot be read", reading=True):
            return int(last), column_chunks.loose_rows(self._db, series.id)

    def _query(self, statement: str, values: Sequence[Any]) -> list[tuple[Any, ...]]:
        with self._lock, in_words(self.path, "the store cannot be read", reading=True):
            return self._db.execute(statement, values).fetchall()


def _source(name: str, series: StoredSeries) -> str:
    """The name in the chunks of a column by its public name."""
    if name == "epoch":
        return "number"
    if name in COLUMN_NAMES or name == "status":
        return name
    return f"temperatures.{name}" if name in series.head.channels else f"extra.{name}"
