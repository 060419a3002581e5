"""Columns of a series as arrays, fast: chunks of whole columns beside the rows.

SQLite hands out rows at some microseconds each; a million epochs would take seconds. So when
CHUNK epochs of a series have accumulated, each of their columns is written once more as one blob
of float64, in the transaction of the last of them; and when MERGED such chunks have accumulated,
they become one, since long blobs are read twice as fast. Reading joins the chunks and takes the
tail, and the epochs that were calibrated anew, from the rows. Chunks are derived and can be
rebuilt.

Sources of columns are: `number`, times and counts; the parameters and `sd_<parameter>`;
`temperatures.<channel>` as read; `extra.<name>`; `status` as a code of the table status_code.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import StoreError
from thermocald.photogrammetry.camera_model import PARAMETER_NAMES
from thermocald.store.schema import sql_name

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

__all__ = [
    "CHUNK",
    "FIXED",
    "MERGED",
    "build_missing_chunks",
    "loose_rows",
    "read_columns",
    "rebuild_chunks",
    "status_codes",
]

CHUNK = 1024
MERGED = 16

FIXED = (
    "number",
    "frame_time",
    "temperature_time",
    "clock_trusted",
    "sigma0",
    "redundancy",
    "n_observations",
    "n_rejected",
    *PARAMETER_NAMES,
    *(f"sd_{name}" for name in PARAMETER_NAMES),
)
_JSON = ("temperatures", "extra")
_FIELDS = (*FIXED, "status", *_JSON)


def read_columns(
    connection: sqlite3.Connection, series: int, names: Sequence[str]
) -> dict[str, Array]:
    """Columns by their source names, (E,) float64 each, NaN where an epoch has none.

    Raises StoreError if a chunk does not fit the others.
    """
    # named, since the planner would walk all epochs in the index of numbers
    (amended,) = connection.execute(
        "SELECT EXISTS (SELECT 1 FROM epoch INDEXED BY epoch_amended "
        "WHERE series_id = ? AND revision > 0)",
        (series,),
    ).fetchone()
    wanted = list(dict.fromkeys([*names, "number"] if amended else names))
    chunks = _Chunks(connection, series)
    tail = _rows(connection, series, wanted, "number > ? AND revision = 0", chunks.last_number)
    columns = {}
    for name in wanted:
        columns[name] = np.empty(chunks.rows + len(tail[name]))
        chunks.fill(name, columns[name][: chunks.rows])
        columns[name][chunks.rows :] = tail[name]
    if amended:
        changes = _rows(connection, series, wanted, "revision > ?", 0, order="id")
        rows = np.searchsorted(columns["number"], changes["number"])
        for name in wanted:
            columns[name][rows] = changes[name]
    return {name: columns[name] for name in names}


def loose_rows(connection: sqlite3.Connection, series: int) -> int:
    """How many epochs of a series are in no chunk yet."""
    last = _Chunks(connection, series).last_number
    (count,) = connection.execute(
        "SELECT count(*) FROM epoch WHERE series_id = ? AND revision = 0 AND number > ?",
        (series, last),
    ).fetchone()
    return int(count)


def build_missing_chunks(connection: sqlite3.Connection, series: int) -> None:
    """Write the chunks that the rows allow; within the caller's transaction."""
    chunks = _Chunks(connection, series)
    first_row, last = chunks.rows, chunks.last_number
    while True:
        rows = _select(
            connection, series, _FIELDS, "number > ? AND revision = 0", last, limit=CHUNK
        )
        if len(rows) < CHUNK:
            return
        columns = _columns(connection, _FIELDS, rows)
        last = int(columns["number"][-1])
        _insert(connection, series, first_row, last, columns)
        first_row += CHUNK
        _merge(connection, series)


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
    for name, first, data in connection.execute(
        "SELECT name, first_row, data FROM column_chunk WHERE series_id = ? AND first_row >= ?",
        where,
    ):
        column = columns.setdefault(name, np.full(MERGED * CHUNK, np.nan))
        column[first - first_rows[0] :][:CHUNK] = np.frombuffer(data)
    connection.execute("DELETE FROM column_chunk WHERE series_id = ? AND first_row >= ?", where)
    _insert(connection, series, first_rows[0], last, columns)


def _insert(
    connection: sqlite3.Connection,
    series: int,
    first_row: int,
    last: int,
    columns: dict[str, Array],
) -> None:
    connection.executemany(
        "INSERT INTO column_chunk (series_id, name, first_row, last_number, data) "
        "VALUES (?, ?, ?, ?, ?)",
        [(series, name, first_row, last, v.tobytes()) for name, v in columns.items()],
    )


def rebuild_chunks(connection: sqlite3.Connection, series: int) -> None:
    """Derive the chunks of a series anew from its rows; within the caller's transaction."""
    connection.execute("DELETE FROM column_chunk WHERE series_id = ?", (series,))
    build_missing_chunks(connection, series)


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
                raise StoreError(f"the column chunks of series {series} are broken; rebuild them")
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
        for first, data in self._connection.execute(
            "SELECT first_row, data FROM column_chunk WHERE series_id = ? AND name = ? "
            "ORDER BY first_row",
            (self._series, name),
        ):
            if self._sizes.get(first) != len(data):
                raise StoreError(f"a chunk of column {name} is broken; rebuild the columns")
            column[done:first] = np.nan
            target[8 * first : 8 * first + len(data)] = data
            done = first + len(data) // 8
        column[done:] = np.nan


def _rows(
    connection: sqlite3.Connection,
    series: int,
    names: Sequence[str],
    where: str,
    value: int,
    order: str = "number",
) -> dict[str, Array]:
    """Columns by their source names from the rows themselves."""
    fields = list(dict.fromkeys(name.split(".")[0] for name in names))
    rows = _select(connection, series, fields, where, value, order)
    found = _columns(connection, fields, rows)
    missing = np.full(len(rows), np.nan)
    return {name: found.get(name, missing) for name in names}


def _select(
    connection: sqlite3.Connection,
    series: int,
    fields: Sequence[str],
    where: str,
    value: int,
    order: str = "number",
    limit: int = -1,
) -> list[tuple[Any, ...]]:
    return connection.execute(
        f"SELECT {', '.join(map(sql_name, fields))} FROM epoch WHERE series_id = ? AND {where} "
        f"ORDER BY {order} LIMIT ?",
        (series, value, limit),
    ).fetchall()


def _columns(
    connection: sqlite3.Connection, fields: Sequence[str], rows: list[tuple[Any, ...]]
) -> dict[str, Array]:
    """Rows of `epoch` → columns; temperatures and extra become one column per name in them."""
    columns: dict[str, Array] = {}
    values = zip(*rows, strict=True) if rows else [()] * len(fields)
    for field, column in zip(fields, values, strict=True):
        if field == "status":
            codes = {status: code for code, status in status_codes(connection)}
            columns[field] = np.array([codes[status] for status in column], dtype=np.float64)
        elif field in _JSON:
            found = [json.loads(text) for text in column]
            for name in dict.fromkeys(name for mapping in found for name in mapping):
                columns[f"{field}.{name}"] = np.array(
                    [mapping.get(name) for mapping in found], dtype=np.float64
                )
        else:
            columns[field] = np.array(column, dtype=np.float64)  # None, SQL's NULL, becomes NaN
    return columns


def status_codes(connection: sqlite3.Connection) -> list[tuple[int, str]]:
    return connection.execute("SELECT code, status FROM status_code").fetchall()
