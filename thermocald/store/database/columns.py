"""Columns of a series as arrays, fast: chunks of whole columns alongside the rows.

SQLite hands out rows at some microseconds each; a million epochs would take seconds. So when
CHUNK epochs of a series have accumulated, each of their columns is written once more as one blob
of float64, in the transaction of the last of them; and when MERGED such chunks have accumulated,
they become one, since long blobs are read twice as fast. Reading joins the chunks and takes the
tail, and the epochs that were calibrated after their chunk was written, from the rows. Chunks are
derived and can be rebuilt.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import StoreError
from thermocald.store.database.checksum import row_checksum
from thermocald.store.database.epoch_columns import CHUNKED, late_columns, latest_columns

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Iterator, Sequence

    from thermocald.arrays import Array

__all__ = [
    "CHUNK",
    "MERGED",
    "build_all_chunks",
    "build_missing_chunks",
    "checked_chunks",
    "forgotten_calibrations",
    "insert_chunk",
    "loose_rows",
    "note_amended",
    "read_columns",
    "read_page",
    "rebuild_chunks",
]

log = logging.getLogger(__name__)

CHUNK = 1024
MERGED = 16


def read_columns(
    connection: sqlite3.Connection, series: int, names: Sequence[str]
) -> dict[str, Array]:
    """Columns by their source names (see `epoch_columns`), (E,) each, NaN where there is none.

    They share one piece of memory, which lives as long as any of them. Where a chunk is damaged the
    rows are read instead; raises StoreError where these are damaged too.
    """
    try:
        return _read_columns(connection, series, names)
    except _ChunkError as error:
        log.warning("%s; its epochs are read one by one instead", error)
    fields = [name.split(".")[0] for name in names]
    columns = latest_columns(connection, series, fields, -1)
    absent = np.full(columns["number"].size, np.nan)
    return {name: columns.get(name, absent) for name in names}


def _read_columns(
    connection: sqlite3.Connection, series: int, names: Sequence[str]
) -> dict[str, Array]:
    fields = [name.split(".")[0] for name in names]
    chunks = _Chunks(connection, series)
    tail = latest_columns(connection, series, fields, chunks.last_number)
    late = late_columns(connection, series, fields)
    rows = np.empty(0, dtype=np.int64)
    if late["number"].size:
        numbers = np.empty(chunks.rows)
        chunks.fill("number", numbers)
        rows = np.searchsorted(numbers, late["number"])
    # one allocation for all: the system hands it out in huge pages, which halves the time
    columns = np.empty((len(names), chunks.rows + tail["number"].size))
    for name, column in zip(names, columns, strict=True):
        chunks.fill(name, column[: chunks.rows])
        column[chunks.rows :] = tail.get(name, np.nan)
        column[rows] = late.get(name, np.nan)
    return dict(zip(names, columns, strict=True))


def read_page(
    connection: sqlite3.Connection, series: int, names: Sequence[str], after: int, rows: int
) -> dict[str, Array]:
    """Columns of at most `rows` epochs numbered above `after`; as `read_columns`, from the rows."""
    end = connection.execute(
        "SELECT number FROM epoch WHERE series_id = ? AND number > ? AND revision = 0 "
        "ORDER BY number LIMIT 1 OFFSET ?",
        (series, after, rows - 1),
    ).fetchone()
    fields = [name.split(".")[0] for name in names]
    columns = latest_columns(connection, series, fields, after, end[0] if end else None)
    absent = np.full(columns["number"].size, np.nan)
    return {name: columns.get(name, absent) for name in names}


def checked_chunks(connection: sqlite3.Connection) -> Iterator[str]:
    """A sentence for every chunk that is damaged."""
    for row in connection.execute(
        "SELECT checksum, series_id, name, first_row, last_number, data FROM column_chunk"
    ):
        try:
            _require(*row)
        except (_ChunkError, TypeError, ValueError):
            yield f"a chunk of column {row[2]} (its epochs are read one by one instead)"


def forgotten_calibrations(connection: sqlite3.Connection) -> Iterator[str]:
    """A sentence for every series whose columns lack calibrations that were made later.

    Which rows these are is remembered in a table of its own, which may be damaged too.
    """
    compared = ("c", "sigma0", "n_observations")
    listed = connection.execute("SELECT id, camera, name FROM series ORDER BY id").fetchall()
    for series, camera, name in listed:
        later = connection.execute(
            f"SELECT number, {', '.join(compared)} FROM epoch e WHERE series_id = :series "
            "AND revision > 0 AND revision = (SELECT max(revision) FROM epoch "
            "WHERE series_id = :series AND number = e.number) ORDER BY number",
            {"series": series},
        ).fetchall()
        if not later:
            continue
        columns = read_columns(connection, series, ["number", *compared])
        wanted = np.array(later, dtype=np.float64).reshape(-1, 1 + len(compared))
        rows = np.searchsorted(columns["number"], wanted[:, 0])
        found = np.column_stack([np.append(columns[n], np.nan)[rows] for n in compared])
        same = (found == wanted[:, 1:]) | (np.isnan(found) & np.isnan(wanted[:, 1:]))
        if count := int((~same.all(axis=1)).sum()):
            yield f"the columns of {camera}/{name} lack {count} later calibrations"


def loose_rows(connection: sqlite3.Connection, series: int) -> int:
    """How many epochs of a series are in no chunk yet."""
    (count,) = connection.execute(
        "SELECT count(*) FROM epoch WHERE series_id = ? AND revision = 0 AND number > ?",
        (series, _Chunks(connection, series).last_number),
    ).fetchone()
    return int(count)


def note_amended(connection: sqlite3.Connection, series: int, number: int, epoch_id: int) -> None:
    """Remember a later calibration if its epoch is in a chunk; within the caller's transaction."""
    if number <= _Chunks(connection, series).last_number:
        connection.execute(
            "INSERT INTO late_epoch (epoch_id, series_id) VALUES (?, ?)", (epoch_id, series)
        )


def build_missing_chunks(connection: sqlite3.Connection, series: int) -> None:
    """Write the chunks that the rows allow; within the caller's transaction."""
    chunks = _Chunks(connection, series)
    first_row, last = chunks.rows, chunks.last_number
    while end := connection.execute(
        "SELECT number FROM epoch WHERE series_id = ? AND number > ? AND revision = 0 "
        "ORDER BY number LIMIT 1 OFFSET ?",
        (series, last, CHUNK - 1),
    ).fetchone():
        columns = latest_columns(connection, series, CHUNKED, last, end[0])
        last = end[0]
        insert_chunk(connection, series, first_row, last, columns)
        first_row += CHUNK
        _merge(connection, series)


def build_all_chunks(connection: sqlite3.Connection) -> None:
    """Write all chunks that the rows allow, after a migration; damage leaves a series without."""
    for (series,) in connection.execute("SELECT id FROM series").fetchall():
        connection.execute("BEGIN IMMEDIATE")
        try:
            build_missing_chunks(connection, series)
        except StoreError as error:
            connection.execute("ROLLBACK")
            log.warning("%s", error)
        else:
            connection.execute("COMMIT")


def rebuild_chunks(connection: sqlite3.Connection, series: int) -> None:
    """Derive the chunks of a series again from its rows; within the caller's transaction."""
    connection.execute("DELETE FROM column_chunk WHERE series_id = ?", (series,))
    connection.execute("DELETE FROM late_epoch WHERE series_id = ?", (series,))
    build_missing_chunks(connection, series)


def _merge(connection: sqlite3.Connection, series: int) -> None:
    """Make one chunk of the last MERGED small ones."""
    first_rows = _Chunks(connection, series).last_of_size(CHUNK, MERGED)
    if not first_rows:
        return
    where = (series, first_rows[0])
    (last,) = connection.execute(
        "SELECT max(last_number) FROM column_chunk WHERE series_id = ? AND first_row >= ?", where
    ).fetchone()
    columns: dict[str, Array] = {}
    for name, first, end, data, kept in connection.execute(
        "SELECT name, first_row, last_number, data, checksum FROM column_chunk "
        "WHERE series_id = ? AND first_row >= ?",
        where,
    ):
        _require(kept, series, name, first, end, data)
        column = columns.setdefault(name, np.full(MERGED * CHUNK, np.nan))
        column[first - first_rows[0] :][:CHUNK] = np.frombuffer(data)
    connection.execute("DELETE FROM column_chunk WHERE series_id = ? AND first_row >= ?", where)
    insert_chunk(connection, series, first_rows[0], last, columns)


def insert_chunk(
    connection: sqlite3.Connection,
    series: int,
    first_row: int,
    last: int,
    columns: dict[str, Array],
) -> None:
    """Write columns (n,) of epochs `first_row` to number `last` as one chunk."""
    connection.executemany(
        "INSERT INTO column_chunk (series_id, name, first_row, last_number, data, checksum) "
        "VALUES (?, ?, ?, ?, ?, ?)",
        [
            (series, name, first_row, last, data, _checksum(series, name, first_row, last, data))
            for name, data in ((name, values.tobytes()) for name, values in columns.items())
        ],
    )


def _checksum(series: int, name: str, first_row: int, last: int, data: bytes) -> int:
    return row_checksum((series, first_row, last), (name,), data)


def _require(
    kept: int | None, series: int, name: str, first_row: int, last: int, data: bytes
) -> None:
    if kept is not None and kept != _checksum(series, name, first_row, last, data):
        raise _ChunkError(f"a chunk of column {name} is damaged")


class _ChunkError(StoreError):
    """A chunk is damaged: what it holds is in the rows too."""


class _Chunks:
    """The chunks of a series. rows: how many epochs they hold; last_number: of the last of these.

    Files may hold chunks of any length: CHUNK is this program's choice, not the file's.
    """

    def __init__(self, connection: sqlite3.Connection, series: int) -> None:
        self._connection = connection
        self._series = series
        found = connection.execute(
            "SELECT first_row, length(data), last_number FROM column_chunk "
            "WHERE series_id = ? AND name = 'number' ORDER BY first_row",
            (series,),
        ).fetchall()
        self._sizes = {first: size for first, size, _ in found}
        self.rows = 0
        for first, size in self._sizes.items():
            if first != self.rows or size % 8:
                raise _ChunkError(f"the column chunks of series {series} are broken")
            self.rows += size // 8
        self.last_number = int(found[-1][2]) if found else -1

    def last_of_size(self, rows: int, count: int) -> list[int]:
        """The first rows of the last `count` chunks if each has `rows` rows, else nothing."""
        last = list(self._sizes.items())[-count:]
        full = len(last) == count and all(size == 8 * rows for _, size in last)
        return [first for first, _ in last] if full else []

    def fill(self, name: str, column: Array) -> None:
        """Copy a column's chunks into (rows,); NaN where it did not exist yet, or any more."""
        target = column.data.cast("B")  # copies faster than NumPy assigns
        done = 0
        for first, last, data, kept in self._connection.execute(
            "SELECT first_row, last_number, data, checksum FROM column_chunk "
            "WHERE series_id = ? AND name = ? ORDER BY first_row",
            (self._series, name),
        ):
            if self._sizes.get(first) != len(data):
                raise _ChunkError(f"a chunk of column {name} is broken")
            _require(kept, self._series, name, first, last, data)
            column[done:first] = np.nan
            target[8 * first : 8 * first + len(data)] = data
            done = first + len(data) // 8
        column[done:] = np.nan
