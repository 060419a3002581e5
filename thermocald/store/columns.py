"""Columns of a series as arrays, fast: chunks of whole columns beside the rows.

SQLite hands out rows at some microseconds each; a million epochs would take seconds. So when
CHUNK epochs of a series have accumulated, each of their columns is written once more as one blob
of float64, in the transaction of the last of them. Reading joins the chunks and takes the tail,
and the epochs that were calibrated anew, from the rows. Chunks are derived and can be rebuilt.

Sources of columns are: `number`, times and counts; the parameters and `sd_<parameter>`;
`temperatures.<channel>` as read; `extra.<name>`; `status` as a code of the table status_code.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

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
    "build_missing_chunks",
    "read_columns",
    "rebuild_chunks",
    "status_codes",
]

CHUNK = 4096

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
    """Columns by their source names, (E,) float64 each, NaN where an epoch has none."""
    # named, since the planner would walk all epochs in the index of numbers
    (amended,) = connection.execute(
        "SELECT EXISTS (SELECT 1 FROM epoch INDEXED BY epoch_amended "
        "WHERE series_id = ? AND revision > 0)",
        (series,),
    ).fetchone()
    wanted = list(dict.fromkeys([*names, "number"] if amended else names))
    last, chunks = _chunks_end(connection, series)
    tail = _rows(connection, series, wanted, "number > ? AND revision = 0", last)
    size = chunks * CHUNK + len(next(iter(tail.values()), ()))
    columns = {}
    for name in wanted:
        column = np.empty(size)
        if chunks:
            _fill_from_chunks(connection, series, name, column[: chunks * CHUNK])
        column[chunks * CHUNK :] = tail[name]
        columns[name] = column
    if amended:
        changes = _rows(connection, series, wanted, "revision > ?", 0, order="id")
        rows = np.searchsorted(columns["number"], changes["number"])
        for name in wanted:
            columns[name][rows] = changes[name]
    return {name: columns[name] for name in names}


def build_missing_chunks(connection: sqlite3.Connection, series: int) -> None:
    """Write the chunks that the rows allow; within the caller's transaction."""
    last, chunks = _chunks_end(connection, series)
    while True:
        rows = _select(
            connection, series, _FIELDS, "number > ? AND revision = 0", last, limit=CHUNK
        )
        if len(rows) < CHUNK:
            return
        columns = _columns(connection, _FIELDS, rows)
        last = int(columns["number"][-1])
        connection.executemany(
            "INSERT INTO column_chunk (series_id, name, chunk, last_number, data) "
            "VALUES (?, ?, ?, ?, ?)",
            [(series, n, chunks, last, values.tobytes()) for n, values in columns.items()],
        )
        chunks += 1


def rebuild_chunks(connection: sqlite3.Connection, series: int) -> None:
    """Derive the chunks of a series anew from its rows; within the caller's transaction."""
    connection.execute("DELETE FROM column_chunk WHERE series_id = ?", (series,))
    build_missing_chunks(connection, series)


def _chunks_end(connection: sqlite3.Connection, series: int) -> tuple[int, int]:
    """The last epoch number in a chunk (-1 if none is) and the number of chunks."""
    last, chunks = connection.execute(
        "SELECT max(last_number), max(chunk) FROM column_chunk WHERE series_id = ? "
        "AND name = 'number'",
        (series,),
    ).fetchone()
    return (-1, 0) if last is None else (last, chunks + 1)


def _fill_from_chunks(
    connection: sqlite3.Connection, series: int, name: str, column: Array
) -> None:
    done = 0
    target = memoryview(column).cast("B")  # copies faster than NumPy assigns
    for chunk, data in connection.execute(
        "SELECT chunk, data FROM column_chunk WHERE series_id = ? AND name = ? ORDER BY chunk",
        (series, name),
    ):
        start = chunk * CHUNK
        column[done:start] = np.nan  # a channel that came later
        done = start + CHUNK
        target[8 * start : 8 * done] = data
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
