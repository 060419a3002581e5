"""Columns of a series at the server, by binary COPY into arrays.

Every row of the copy is as long as every other, since a missing number comes as NaN: NumPy reads
blocks of rows as they stand, and neither the server nor this process holds the series as rows.
"""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.store.database.epoch_columns import COLUMN_NAMES, sql_name

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from uuid import UUID

    from numpy.typing import NDArray
    from psycopg import Connection
    from psycopg.sql import Composable, Composed

    from thermocald.arrays import Array
    from thermocald.store.database.row import StoredSeries

__all__ = ["read_columns"]

_HEADER, _TRAILER = 19, 2  # bytes before the first row, and of the message after the last
_BLOCK = 50_000  # rows that become arrays at a time
_ORDER = ("number", "frame_time", "revision")


def read_columns(
    connection: Connection[Any], key: UUID, series: StoredSeries, names: Sequence[str]
) -> dict[str, NDArray[Any]]:
    """Columns (E,) over all epochs of a series by name, each epoch as it was calibrated last.

    connection: within a transaction; key: of the series at the server. Numbers are float64, NaN
    where an epoch has none; `status` is text.
    """
    from psycopg import sql

    words: list[str] = []
    if "status" in names:
        # a station that forwards now must not add a word between the two statements
        connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ")
        found = connection.execute("SELECT DISTINCT status FROM epoch WHERE series = %s", (key,))
        words = sorted(word for (word,) in found)
    wanted = {name: _expression(name, series, words) for name in names}
    wanted |= {f" {name}": sql.SQL("{}::float8").format(sql.Identifier(name)) for name in _ORDER}
    statement = sql.SQL("COPY (SELECT {} FROM epoch WHERE series = {}) TO STDOUT (FORMAT BINARY)")
    values = sql.SQL(", ").join(wanted.values())
    copied = _copy(connection, statement.format(values, sql.Literal(key)), len(wanted))
    columns: dict[str, NDArray[Any]] = dict(zip(wanted, copied, strict=True))
    rows = _latest(*(columns.pop(f" {name}") for name in _ORDER))
    if rows is not None:
        columns = {name: column[rows] for name, column in columns.items()}
    if "status" in columns:
        columns["status"] = np.array(words, dtype=np.str_)[columns["status"].astype(np.int64) - 1]
    return columns


def _copy(connection: Connection[Any], statement: Composed, size: int) -> list[Array]:
    """The columns (E,) of a copy of `size` numbers a row."""
    fields = [("columns", ">i2")]
    for i in range(size):
        fields += [(f"length{i}", ">i4"), (f"value{i}", ">f8")]
    row = np.dtype(fields)
    blocks: list[list[Array]] = [[np.empty(0)] for _ in range(size)]
    with connection.cursor() as cursor, cursor.copy(statement) as copy:
        for messages in _messages(copy):
            found = np.frombuffer(messages, row)
            for i, column in enumerate(blocks):
                column.append(found[f"value{i}"].astype(np.float64))
    return [np.concatenate(column) for column in blocks]


def _messages(copy: Any) -> Iterator[bytes]:
    """The rows of a copy, many at a time, without its header and trailer."""
    start = _HEADER
    messages = iter(copy)
    while block := list(islice(messages, _BLOCK)):
        yield b"".join(m for m in block if len(m) != _TRAILER)[start:]
        start = 0


def _latest(numbers: Array, times: Array, revisions: Array) -> NDArray[np.intp] | None:
    """The rows of the last revisions, ordered by number and time; None where all are, in order."""
    steps = np.diff(numbers)
    if np.all(steps > 0):
        return None
    order: NDArray[np.intp] = np.lexsort((times, numbers))
    if not revisions.any():
        return order
    _, first, counts = np.unique(numbers[order], return_index=True, return_counts=True)
    highest = np.repeat(np.maximum.reduceat(revisions[order], first), counts)
    latest: NDArray[np.intp] = order[revisions[order] == highest]
    return latest


def _expression(name: str, series: StoredSeries, words: Sequence[str]) -> Composable:
    """A column as double precision, NaN for NULL; `status` as its place in `words`, from 1."""
    from psycopg import sql

    if name == "status":
        listed = sql.SQL(", ").join(map(sql.Literal, words))
        return sql.SQL("array_position(ARRAY[{}]::text[], status)::float8").format(listed)
    if name == "epoch":
        return sql.SQL("number::float8")
    if name == "clock_trusted":
        return sql.SQL("clock_trusted::int::float8")
    if name in COLUMN_NAMES:
        return sql.SQL("coalesce({}::float8, 'NaN')").format(sql.Identifier(sql_name(name)))
    column = "temperatures" if name in series.head.channels else "extra"
    return sql.SQL("coalesce(({}::json->>{})::float8, 'NaN')").format(
        sql.Identifier(column), sql.Literal(name)
    )
