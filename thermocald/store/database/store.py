"""The store: everything of a daemon in one SQLite file.

Several cameras, each with series of epochs. An epoch is one transaction: a killed writer loses at
most the current epoch. Nothing is changed or deleted: a later calibration of an epoch is a further
revision, and triggers in the file refuse everything else.
"""

from __future__ import annotations

import logging
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

from thermocald.errors import StoreError, StoreFullError
from thermocald.store.database import columns as column_chunks
from thermocald.store.database.connection import Mode, connect, in_words
from thermocald.store.database.epoch_columns import COLUMN_NAMES
from thermocald.store.database.epoch_table import (
    StoredEpoch,
    insert_epoch,
    select_epochs,
)
from thermocald.store.database.row import (
    NOT_CALIBRATED,
    EpochResult,
    Event,
    LoggedReading,
    StoredSeries,
)
from thermocald.store.database.series_table import (
    insert_events,
    insert_readings,
    insert_series,
)
from thermocald.store.database.store_reader import StoreReader
from thermocald.store.recording.paths import file_name

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.store.recording.head import Head

__all__ = ["Store"]

log = logging.getLogger(__name__)

_DERIVED = ("epoch", "status")


class Store(StoreReader):
    """An open store; use `Store.open` and a `with` block. Threads may share it."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        super().__init__(path, connection)
        self._unchunked: set[int] = set()  # series whose chunks cannot be built
        self._ends: dict[int, tuple[int, int]] = {}  # series → last number, rows in no chunk

    @classmethod
    def open(cls, path: Path, mode: Mode = "read", *, durable: bool = True) -> Self:
        """Open a store; for appending it is made if it does not exist.

        durable: what is committed survives a power cut; False: the end of the process only, for
        what can be computed again. Raises StoreError, StoreVersionError.
        """
        return cls(path, connect(path, mode, durable=durable))

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
        """Begin a series; StoreError if the camera has one of this name already."""
        if taken := {*COLUMN_NAMES, *_DERIVED} & set(head.channels):
            raise StoreError(f"a temperature channel cannot be called {min(taken)!r}")
        file_name(head.camera.name, "camera", StoreError)
        file_name(head.series, "series", StoreError)
        with self._transaction(f"series {head.series!r} was not begun"):
            if self._select_series(head.camera.name, head.series):
                raise StoreError(
                    f"{self.path}: camera {head.camera.name!r} has a series {head.series!r} "
                    "already; choose another name"
                )
            insert_series(
                self._db, head, testfield, start, identity or {}, settings or {}, created_utc
            )
        return self.find_series(head.camera.name, head.series)

    def append(
        self,
        series: StoredSeries,
        epoch: Epoch,
        result: EpochResult | None = None,
        *,
        extra: Mapping[str, float] | None = None,
        clock_trusted: bool = True,
        events: Iterable[Event] = (),
    ) -> None:
        """Keep one epoch, its result and what happened meanwhile, in one transaction.

        result: None if it is to be calibrated later, by `amend`. extra: further columns such as
        blur. Keeps nothing of the epoch and raises StoreError if its number does not come after the
        last one, StoreFullError if the disk is full: an epoch without observations is smaller.
        """
        if taken := {*COLUMN_NAMES, *_DERIVED, *series.head.channels} & set(extra or ()):
            raise StoreError(f"an extra column cannot be called {min(taken)!r}")
        stored = StoredEpoch(
            epoch, result or EpochResult(NOT_CALIBRATED), extra or {}, clock_trusted, 0
        )
        happened = list(events)
        try:
            self._append(series, stored, happened)
        except StoreFullError:
            # what waits in the -wal file may be the room that is missing
            self.checkpoint()
            self._append(series, stored, happened)

    def _append(self, series: StoredSeries, stored: StoredEpoch, events: list[Event]) -> None:
        epoch = stored.epoch
        with self._transaction(f"epoch {epoch.number} of series {series.name!r} was not kept"):
            last, loose = self._ends.get(series.id) or self._end(series)
            if epoch.number <= last:
                raise StoreError(
                    f"{self.path}: epoch {epoch.number} of series {series.name!r} comes after "
                    f"epoch {last}; numbers must increase"
                )
            insert_epoch(self._db, series.id, stored)
            insert_events(self._db, events)
            full = loose + 1 >= column_chunks.CHUNK
            if full and series.id not in self._unchunked:
                self._build_chunks(series)
        self._ends[series.id] = (epoch.number, 0 if full else loose + 1)

    def _build_chunks(self, series: StoredSeries) -> None:
        """Damage in an old row must not stop new ones: then columns are read from the rows."""
        self._db.execute("SAVEPOINT chunks")
        try:
            column_chunks.build_missing_chunks(self._db, series.id)
        except StoreError as error:
            self._db.execute("ROLLBACK TO chunks")
            self._unchunked.add(series.id)
            log.warning("%s: %s", self.path, error)
        self._db.execute("RELEASE chunks")

    def amend(
        self,
        series: StoredSeries,
        number: int,
        result: EpochResult,
        *,
        observations: Observations | None = None,
        extra: Mapping[str, float] | None = None,
    ) -> None:
        """Keep a later calibration of an epoch; observations None: as before; extra: added."""
        with self._transaction(f"the calibration of epoch {number} was not kept"):
            then = next(select_epochs(self._db, series.id, number, number, details=False), None)
            if then is None:
                raise StoreError(f"{self.path}: series {series.name!r} has no epoch {number}")
            stored = StoredEpoch(
                replace(then.epoch, observations=observations),
                result,
                {**then.extra, **(extra or {})},
                then.clock_trusted,
                then.revision + 1,
            )
            epoch_id = insert_epoch(self._db, series.id, stored)
            column_chunks.note_amended(self._db, series.id, number, epoch_id)

    def add_event(self, event: Event) -> None:
        """Log something that happened apart from an epoch."""
        with self._transaction("an event was not kept"):
            insert_events(self._db, [event])

    def add_readings(self, readings: Sequence[LoggedReading]) -> None:
        """Keep what thermometers said apart from epochs, in one transaction."""
        with self._transaction("readings were not kept"):
            insert_readings(self._db, readings)

    def rebuild_columns(self, series: StoredSeries) -> None:
        """Derive the column chunks again: after many `amend`s reading is faster for it."""
        with self._transaction("the columns were not rebuilt"):
            column_chunks.rebuild_chunks(self._db, series.id)

    def checkpoint(self) -> bool:
        """Move what is in the -wal file into the store; False if a reader or the disk forbids."""
        try:
            ((busy, _, _),) = self._query("PRAGMA wal_checkpoint(TRUNCATE)", ())
        except StoreFullError:
            return False
        return not busy

    @contextmanager
    def _transaction(self, failed: str) -> Iterator[None]:
        """All or nothing; `failed` begins the message of the error."""
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
