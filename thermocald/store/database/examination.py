"""The rows of a store as they lie in the file: what is damaged or missing, and what came since.

SQLite's integrity check finds a broken structure, the checksums a value that changed, the numbers
of the epochs a row that is gone. Rows are never changed or deleted, so the last id that was sent
elsewhere is all a sender has to remember.
"""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from thermocald.errors import StoreError
from thermocald.names import WITH_VALUES, relative_path
from thermocald.store.database.columns import (
    KEPT,
    ROW,
    checked_chunks,
    require_sound,
    select_rows,
)
from thermocald.store.database.epochs import read_details
from thermocald.store.series import NOT_CALIBRATED

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Iterator, Sequence
    from pathlib import Path

log = logging.getLogger(__name__)

_CHECKSUMS = ("checksum", "detail_checksum")


@dataclass(frozen=True, slots=True)
class Gap:
    """Epochs `first` to `last` of a series are not in the store."""

    camera: str
    series: str
    first: int
    last: int

    @property
    def text(self) -> str:
        """The gap in a sentence."""
        if self.first == self.last:
            return f"{self.camera}/{self.series}: epoch {self.first} is missing"
        count = self.last - self.first + 1
        where = f"{self.camera}/{self.series}"
        return f"{where}: epochs {self.first} to {self.last} are missing ({count})"


@dataclass(frozen=True, slots=True)
class Examination:
    """damaged: a sentence each; epochs: how many rows were read;
    unfinished: the last write to the -wal file was cut off, see `wal`.
    """

    damaged: tuple[str, ...]
    gaps: tuple[Gap, ...]
    epochs: int
    unfinished: bool = False


def examine(connection: sqlite3.Connection) -> Examination:
    """Read everything; raises sqlite3.Error where the file's structure is broken."""
    damaged = [
        f"the file's structure: {verdict}"
        for (verdict,) in connection.execute("PRAGMA integrity_check(20)")
        if verdict != "ok"
    ]
    epochs = 0
    cameras = dict(connection.execute("SELECT id, camera || '/' || name FROM series"))
    for table in KEPT:
        for values in select_rows(connection, table, "NOT INDEXED ORDER BY id"):
            row = _read_row(connection, table, values)
            epochs += table == "epoch"
            if row["damage"] and table == "epoch":
                series = row["series_id"]
                damaged.append(f"{cameras.get(series, f'series {series}')}, epoch {row['number']}")
            elif row["damage"]:
                damaged.append(row["damage"].partition(":")[0])
    damaged += checked_chunks(connection)
    (orphans,) = connection.execute(
        "SELECT count(DISTINCT id / 1024) FROM detail "
        "WHERE id / 1024 NOT IN (SELECT id FROM epoch NOT INDEXED)"
    ).fetchone()
    if orphans:
        damaged.append(f"{orphans} epochs have observations but no row")
    return Examination(tuple(damaged), tuple(_gaps(connection)), epochs)


def _gaps(connection: sqlite3.Connection) -> Iterator[Gap]:
    query = "SELECT id, camera, name FROM series ORDER BY id"
    for series, camera, name in connection.execute(query).fetchall():
        before = 0
        for (number,) in connection.execute(
            "SELECT DISTINCT number FROM epoch WHERE series_id = ? ORDER BY number", (series,)
        ):
            if number > before + 1:
                yield Gap(camera, name, before + 1, number - 1)
            before = number


def rows_after(
    connection: sqlite3.Connection, table: str, after: int, limit: int
) -> Iterator[dict[str, Any]]:
    """Up to `limit` rows of a table in KEPT with an id above `after`, as {column: value}.

    An epoch also has `covariance` and `observations`, bytes as `blob` packs them, or None. Every
    row has `damage`: empty, or in a sentence how it is not as it was written.
    """
    for values in select_rows(
        connection, table, "WHERE id > ? ORDER BY id LIMIT ?", (after, limit)
    ):
        row = _read_row(connection, table, values)
        for name in _CHECKSUMS:  # of this file's rows, as SQLite gives them back
            row.pop(name, None)
        yield row


def _read_row(connection: sqlite3.Connection, table: str, values: Sequence[Any]) -> dict[str, Any]:
    """Return a row by column, an epoch's with its details, and its `damage`."""
    row = dict(zip(ROW[table], values, strict=True))
    row["damage"] = ""
    try:
        require_sound(table, values)
        if table == "epoch":
            covariance, observations = read_details(connection, row)
            row |= {"covariance": covariance or None, "observations": observations or None}
    except StoreError as error:
        row["damage"] = str(error)
    return row


@dataclass(frozen=True, slots=True)
class KeptFrame:
    """An epoch's row, and where its frame was kept: path relative to the frames' folder or None.

    eventful: without a result, or something happened to the camera.
    """

    id: int
    series: int
    number: int
    frame_time: float
    path: Path | None
    eventful: bool


def frames_after(connection: sqlite3.Connection, after: int, limit: int) -> Iterator[KeptFrame]:
    """Up to `limit` epochs with an id above `after`, with or without a frame."""
    for id_, series, number, time, status, extra, frame in connection.execute(
        "SELECT id, series_id, number, frame_time, status, extra, frame FROM epoch "
        "WHERE id > ? ORDER BY id LIMIT ?",
        (after, limit),
    ):
        path, happened = None, False
        try:
            path = relative_path(frame, f"epoch {number}: frame", StoreError) if frame else None
            happened = status not in (*WITH_VALUES, NOT_CALIBRATED) or "event" in json.loads(extra)
        except (StoreError, ValueError) as error:
            log.warning("%s; its frame is left out", error)
        yield KeptFrame(id_, series, number, time, path, happened)
