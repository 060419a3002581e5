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
    all_rows,
    checked_chunks,
    forgotten_calibrations,
    require_checksum,
    require_sound,
)
from thermocald.store.database.epochs import check_details, select_details
from thermocald.store.series import NOT_CALIBRATED

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable, Iterator
    from pathlib import Path

log = logging.getLogger(__name__)

KEPT = ("epoch", "event", "reading")
"""The tables that grow while a daemon runs."""

_CHECKSUMS = ("checksum", "detail_checksum")
# what the checksum of a row is of, in its order: numbers and texts
_CHECKED = {
    "event": (("utc", "series_id", "epoch"), ("kind", "text", "data")),
    "reading": (("utc", "clock_trusted"), ("thermometer", "temperatures")),
}


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
    for row in all_rows(connection):
        epochs += 1
        if isinstance(row, StoreError):
            damaged.append(_short(row))
            continue
        damaged += _failure(check_details, connection, row)
    damaged += checked_chunks(connection)
    if not damaged:
        damaged += forgotten_calibrations(connection)
    damaged += _orphans(connection)
    damaged += _events_and_readings(connection)
    return Examination(tuple(damaged), tuple(_gaps(connection)), epochs)


def _failure(check: Callable[..., None], *values: Any) -> list[str]:
    try:
        check(*values)
    except StoreError as error:
        return [_short(error)]
    return []


def _short(error: StoreError) -> str:
    return str(error).partition(":")[0]


def _orphans(connection: sqlite3.Connection) -> list[str]:
    """Details whose epoch is gone."""
    (count,) = connection.execute(
        "SELECT count(DISTINCT id / 1024) FROM detail "
        "WHERE id / 1024 NOT IN (SELECT id FROM epoch NOT INDEXED)"
    ).fetchone()
    return [f"{count} epochs have observations but no row"] if count else []


def _events_and_readings(connection: sqlite3.Connection) -> Iterator[str]:
    tables: tuple[tuple[str, str, int], ...] = (
        ("event", "utc, series_id, epoch, kind, text, data", 3),
        ("reading", "utc, clock_trusted, thermometer, temperatures", 2),
    )
    for table, columns, numbers in tables:
        rows: Iterator[tuple[Any, ...]] = connection.execute(
            f"SELECT checksum, id, {columns} FROM {table} ORDER BY id"
        )
        for kept, id_, *values in rows:
            what = f"{table} {id_}"
            yield from _failure(require_checksum, kept, what, values[:numbers], values[numbers:])


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
    """Up to `limit` rows of one of KEPT with an id above `after`, as {column: value}.

    An epoch also has `covariance` and `observations`, bytes as `blob` packs them, or None. Every
    row has `damage`: empty, or in a sentence how it is not as it was written.
    """
    if table not in KEPT:
        raise ValueError(f"{table!r} is not one of {', '.join(KEPT)}")
    cursor = connection.execute(
        f"SELECT * FROM {table} WHERE id > ? ORDER BY id LIMIT ?", (after, limit)
    )
    names = [column[0] for column in cursor.description]
    for values in cursor:
        row = dict(zip(names, values, strict=True))
        row["damage"] = _damage(connection, table, row)
        for name in _CHECKSUMS:  # of this file's rows, as SQLite gives them back
            row.pop(name, None)
        if table == "epoch":
            covariance, observations = select_details(connection, row["id"])
            row |= {"covariance": covariance or None, "observations": observations or None}
        yield row


def _damage(connection: sqlite3.Connection, table: str, row: dict[str, Any]) -> str:
    try:
        if table == "epoch":
            require_sound(row)
            check_details(connection, row)
        else:
            numbers, texts = _CHECKED[table]
            require_checksum(
                row["checksum"],
                f"{table} {row['id']}",
                [row[name] for name in numbers],
                [row[name] for name in texts],
            )
    except StoreError as error:
        return str(error)
    return ""


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
