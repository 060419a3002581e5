"""A look at every row of a store: what is damaged, and which epochs are missing.

SQLite's integrity check finds a broken structure, the checksums a value that changed, the numbers
of the epochs a row that is gone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from thermocald.errors import StoreError
from thermocald.store.database.checksum import require_checksum
from thermocald.store.database.columns import checked_chunks, forgotten_calibrations
from thermocald.store.database.epoch_columns import all_rows
from thermocald.store.database.epoch_table import check_details

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable, Iterator

__all__ = ["Examination", "Gap", "examine"]


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
    """damaged: a sentence each; unchecked: epochs of an older version, which have no checksum;
    unfinished: the last write to the -wal file was cut off, see `wal`.
    """

    damaged: tuple[str, ...]
    gaps: tuple[Gap, ...]
    epochs: int
    unchecked: int
    unfinished: bool = False


def examine(connection: sqlite3.Connection) -> Examination:
    """Read everything; raises sqlite3.Error where the file's structure is broken."""
    damaged = [
        f"the file's structure: {verdict}"
        for (verdict,) in connection.execute("PRAGMA integrity_check(20)")
        if verdict != "ok"
    ]
    epochs = unchecked = 0
    for row in all_rows(connection):
        epochs += 1
        if isinstance(row, StoreError):
            damaged.append(_short(row))
            continue
        unchecked += row["checksum"] is None
        damaged += _failure(check_details, connection, row)
    damaged += checked_chunks(connection)
    if not damaged:
        damaged += forgotten_calibrations(connection)
    damaged += _orphans(connection)
    damaged += _events_and_readings(connection)
    return Examination(tuple(damaged), tuple(_gaps(connection)), epochs, unchecked)


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
