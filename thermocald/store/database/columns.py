"""The rows of a store with their checksums, and the numbers of a series' epochs as columns.

Names are those of the tables. A column over a series is a number of the table `epoch`, `status`, or
a number in its texts: `temperatures.<channel>` as read, `extra.<name>`.

SQLite needs some microseconds per row, which would be seconds for a million epochs. So when CHUNK
epochs of a series have accumulated, each of their columns is written again as one blob of float64,
in the transaction of the last epoch; MERGED such chunks are merged into one, since long blobs are
read twice as fast. Reading joins the chunks and takes from the rows the epochs after the last chunk
and those that were calibrated after their chunk was written.

Each row has a checksum, since SQLite's integrity check does not find a bit that changed inside a
value: a CRC-32 of the row's numbers, as little-endian float64 with one NaN for NULL, and then of
its texts, joined by a control character.
"""

from __future__ import annotations

import json
import logging
import math
import sqlite3
import struct
import zlib
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import StoreError
from thermocald.store.schema import EPOCH_NUMBERS, EPOCH_TEXTS

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array

log = logging.getLogger(__name__)

CHUNK = 1024
MERGED = 16
_SEPARATOR = "\x1f"
KEPT = {
    "epoch": (("id", "series_id", *EPOCH_NUMBERS, "detail_checksum"), EPOCH_TEXTS),
    "event": (("id", "utc", "series_id", "epoch"), ("kind", "text", "data")),
    "reading": (("id", "utc", "clock_trusted"), ("thermometer", "temperatures")),
}
"""The tables that grow while a daemon runs: numbers and texts, in the order of the checksum."""
ROW = {table: (*numbers, *texts, "checksum") for table, (numbers, texts) in KEPT.items()}
_INSERT = {
    table: f"INSERT INTO {table} ({', '.join(names)}) VALUES ({', '.join('?' * len(names))})"
    for table, names in ROW.items()
}
_MAPPINGS = ("temperatures", "extra")
CHUNKED = (*(n for n in EPOCH_NUMBERS if n not in ("revision", "measured")), "status", *_MAPPINGS)


class DamageError(StoreError):
    """The error for a damaged row of the store."""


class _ChunkError(StoreError):
    """The error for a damaged chunk, whose numbers can be read from the rows."""


def row_checksum(numbers: Sequence[Any], texts: Iterable[str] = (), data: bytes = b"") -> int:
    """Return the CRC-32 of a row as SQLite returns it: numbers or None, texts, bytes.

    Raises TypeError or ValueError for a value of another type, which is damage too.
    """
    # 0.0 + -0.0 is 0.0: SQLite does not store the sign of a zero
    plain = [math.nan if v is None or v != v else 0.0 + v for v in numbers]
    found = zlib.crc32(struct.pack(f"<{len(plain)}d", *plain))
    found = zlib.crc32(_SEPARATOR.join(texts).encode(errors="surrogateescape"), found)
    return zlib.crc32(data, found)


def require_checksum(
    kept: int, what: str, numbers: Sequence[Any], texts: Iterable[str] = (), data: bytes = b""
) -> None:
    """Raise DamageError naming `what` if a row differs from its checksum."""
    try:
        good = row_checksum(numbers, texts, data) == kept
    except (TypeError, ValueError, OverflowError, struct.error):
        good = False
    if not good:
        raise DamageError(
            f"{what} is damaged: its checksum does not match; `thermocald check` lists all "
            "damage; restore a backup to repair it"
        )


def last_id(connection: sqlite3.Connection, table: str) -> int:
    """Return the id of the last row; 0 without rows."""
    (found,) = connection.execute(f"SELECT ifnull(max(id), 0) FROM {table}").fetchone()
    return int(found)


def insert_row(connection: sqlite3.Connection, table: str, **given: Any) -> int:
    """Insert a row, given without `id` and `checksum`, in the caller's transaction; return its id.

    SQLite does not assign the id, as the checksum covers it.
    """
    row = {"id": last_id(connection, table) + 1, **given}
    numbers, texts = ([row[name] for name in names] for names in KEPT[table])
    values = (*numbers, *texts, row_checksum(numbers, texts))
    if connection.execute(_INSERT[table], values).rowcount != 1:
        raise sqlite3.IntegrityError(f"a foreign trigger keeps rows out of {table}; drop it")
    return int(row["id"])


def examined_rows(
    connection: sqlite3.Connection, table: str, condition: str, values: Sequence[Any] = ()
) -> Generator[dict[str, Any], None, None]:
    """Yield rows as {column: value}, each with its `damage`, a sentence or empty."""
    names, count = ROW[table], len(KEPT[table][0])
    key = "number" if table == "epoch" else "id"
    select = f"SELECT {', '.join(f'{table}.{name}' for name in names)} FROM {table} {condition}"
    for found in connection.execute(select, values):
        row = dict(zip(names, found, strict=True), damage="")
        try:
            what = f"{table} {row[key]}"
            require_checksum(row["checksum"], what, found[:count], found[count:-1])
        except DamageError as error:
            row["damage"] = str(error)
        yield row


def _intact(rows: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield examined rows. Raises DamageError for a damaged one."""
    for row in rows:
        if row["damage"]:
            raise DamageError(row["damage"])
        yield row


def examined_epochs(
    connection: sqlite3.Connection, series: int, first: int, last: int | None
) -> Generator[dict[str, Any], None, None]:
    """Yield the examined rows of epochs `first` to `last` (numbers), by number and revision."""
    condition = (
        "WHERE series_id = ? AND number >= ? AND number <= ifnull(?, number) "
        "ORDER BY number, revision"
    )
    return examined_rows(connection, "epoch", condition, (series, first, last))


def checked_chunks(connection: sqlite3.Connection) -> Iterator[str]:
    """Yield a phrase for each damaged chunk."""
    for row in connection.execute(
        "SELECT checksum, series_id, name, first_row, last_number, last_id, data FROM column_chunk"
    ):
        try:
            _require_chunk(*row)
        except (_ChunkError, TypeError, ValueError):
            yield f"a chunk of column {row[2]} (its epochs are read one by one instead)"


def _chunk_checksum(series: int, name: str, *row: Any) -> int:
    *numbers, data = row
    return row_checksum((series, *numbers), (name,), data)


def _require_chunk(kept: int, series: int, name: str, *row: Any) -> None:
    if kept != _chunk_checksum(series, name, *row):
        raise _ChunkError(f"a chunk of column {name} is damaged")


def _overwrite(columns: dict[str, Array], numbers: Array, late: dict[str, Array]) -> None:
    """Overwrite columns of the epochs `numbers` with their later calibrations."""
    rows = np.searchsorted(numbers, late["number"])
    for name, column in columns.items():
        column[rows] = late.get(name, np.nan)


class SeriesColumns:
    """The columns of a series.

    A file may hold chunks of any length; CHUNK is only the length that this version writes.
    """

    def __init__(self, connection: sqlite3.Connection, series: int) -> None:
        self._connection = connection
        self._series = series

    def read(self, names: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Return columns (E,) by name, NaN for an epoch without the number.

        They share one block of memory, which is freed with the last of them. If a chunk is damaged,
        the rows are read instead. Raises StoreError if these are damaged too.
        """
        try:
            rows, last = self._find_chunks()
            tail = self.latest(last, names=["number", *names])
            # one allocation for all, which the system makes in huge pages: half the time
            block = np.empty((len(names), rows + tail["number"].size))
            columns = dict(zip(names, block, strict=True))
            for name, column in columns.items():
                self._fill(name, column[:rows])
                column[rows:] = tail[name]
            if late := self._late_rows(0):
                numbers = np.empty(rows)
                self._fill("number", numbers)
                _overwrite(columns, numbers, self._columns(late, ["number", *names]))
        except _ChunkError as error:
            log.warning("%s; its epochs are read one by one instead", error)
            columns = self.latest(-1, names=names)
        return self._name_statuses(columns)

    def read_page(self, names: Sequence[str], after: int, rows: int) -> dict[str, NDArray[Any]]:
        """Return columns of at most `rows` epochs with numbers above `after`, from their rows."""
        return self._name_statuses(self.latest(after, self._number_after(after, rows), names))

    def latest(
        self, after: int, until: int | None = None, names: Sequence[str] | None = None
    ) -> dict[str, Array]:
        """Return columns of the epochs with numbers above `after` up to `until` from their rows.

        These are those of the latest revisions; `status` is a code.
        """
        found = _intact(examined_epochs(self._connection, self._series, after + 1, until))
        return self._columns(list({row["number"]: row for row in found}.values()), names)

    def _columns(
        self, rows: list[dict[str, Any]], names: Sequence[str] | None = None
    ) -> dict[str, Array]:
        """Turn rows into columns, NaN for a row without the number; names: None for all."""
        columns: dict[str, Array] = {}
        for field in CHUNKED if names is None else dict.fromkeys(n.split(".")[0] for n in names):
            column = [row[field] for row in rows]
            if field in _MAPPINGS:
                found = [json.loads(text) for text in column]
                for name in dict.fromkeys(name for mapping in found for name in mapping):
                    columns[f"{field}.{name}"] = np.array(
                        [mapping.get(name) for mapping in found], dtype=np.float64
                    )
                continue
            if field == "status":
                codes = dict(self._connection.execute("SELECT status, code FROM status_code"))
                column = [codes[status] for status in column]
            columns[field] = np.array(column, dtype=np.float64)  # None, SQL's NULL, becomes NaN
        if names is None:
            return columns
        absent = np.full(len(rows), np.nan)
        return {name: columns.get(name, absent) for name in names}

    def _name_statuses(self, columns: dict[str, Array]) -> dict[str, NDArray[Any]]:
        """Replace the codes in the column `status` by their words."""
        named: dict[str, NDArray[Any]] = dict(columns)
        if "status" in columns:
            codes = dict(self._connection.execute("SELECT code, status FROM status_code"))
            words = np.array([codes.get(i, "") for i in range(max(codes, default=0) + 1)])
            named["status"] = words[columns["status"].astype(np.int64)]
        return named

    def _number_after(self, after: int, rows: int) -> int | None:
        """Return the number of the epoch `rows` after a number; None if there are fewer."""
        found = self._connection.execute(
            "SELECT number FROM epoch WHERE series_id = ? AND number > ? AND revision = 0 "
            "ORDER BY number LIMIT 1 OFFSET ?",
            (self._series, after, rows - 1),
        ).fetchone()
        return found[0] if found else None

    def _find_chunks(self) -> tuple[int, int]:
        """Find the chunks; return their number of rows, and that of their last epoch."""
        # (first row, bytes, number of the last epoch, last id of `epoch` when it was written)
        self._chunks: list[tuple[int, int, int, int]] = self._connection.execute(
            "SELECT first_row, length(data), last_number, last_id FROM column_chunk "
            "WHERE series_id = ? AND name = 'number' ORDER BY first_row",
            (self._series,),
        ).fetchall()
        rows = 0
        for first, size, *_ in self._chunks:
            if first != rows or size % 8:
                raise _ChunkError(f"the column chunks of series {self._series} are broken")
            rows += size // 8
        return rows, self._chunks[-1][2] if self._chunks else -1

    def build(self) -> int:
        """Write chunks while there are enough rows, in the caller's transaction.

        Returns the number of epochs that are in no chunk.
        """
        rows, last = self._find_chunks()
        while end := self._number_after(last, CHUNK):
            self.insert(rows, end, self.latest(last, end))
            rows, last = self._find_chunks()
            self._merge(last)
        (loose,) = self._connection.execute(
            "SELECT count(*) FROM epoch WHERE series_id = ? AND number > ? AND revision = 0",
            (self._series, last),
        ).fetchone()
        return int(loose)

    def insert(self, first_row: int, last: int, columns: dict[str, Array]) -> None:
        """Write columns (n,) of the epochs from row `first_row` to number `last` as one chunk."""
        written = last_id(self._connection, "epoch")
        rows = [
            (self._series, name, first_row, last, written, values.tobytes())
            for name, values in columns.items()
        ]
        self._connection.executemany(
            "INSERT INTO column_chunk (series_id, name, first_row, last_number, last_id, data, "
            "checksum) VALUES (?, ?, ?, ?, ?, ?, ?)",
            [(*row, _chunk_checksum(*row)) for row in rows],
        )

    def _merge(self, last: int) -> None:
        """Merge the last MERGED small chunks, with later calibrations of their epochs."""
        chunks = self._chunks[-MERGED:]
        if len(chunks) < MERGED or any(size != 8 * CHUNK for _, size, *_ in chunks):
            return
        late = self._columns(self._late_rows(len(self._chunks) - MERGED))
        start, which = chunks[0][0], "column_chunk WHERE series_id = ? AND first_row >= ?"
        found = self._connection.execute(
            f"SELECT DISTINCT name FROM {which}", (self._series, start)
        )
        columns = {name: np.empty(MERGED * CHUNK) for name in {*(n for (n,) in found), *late}}
        for name, column in columns.items():
            self._fill(name, column, start)
        _overwrite(columns, columns["number"].copy(), late)
        self._connection.execute(f"DELETE FROM {which}", (self._series, start))
        self.insert(start, last, columns)
        self._find_chunks()

    def _late_rows(self, start: int) -> list[dict[str, Any]]:
        """Read the calibrations that are later than their chunk, from chunk `start` on."""
        condition = (
            "INDEXED BY epoch_revised WHERE series_id = ? AND number > ? AND number <= ? "
            "AND revision > 0 AND epoch.id > ? ORDER BY epoch.id"
        )
        rows: list[dict[str, Any]] = []
        before = self._chunks[start - 1][2] if start else -1
        for *_, last, last_id in self._chunks[start:]:
            values = (self._series, before, last, last_id)
            rows += _intact(examined_rows(self._connection, "epoch", condition, values))
            before = last
        return rows

    def _fill(self, name: str, column: Array, start: int = 0) -> None:
        """Copy a column's chunks from a row on into `column`, NaN for chunks without it."""
        target = column.data.cast("B")  # copies faster than NumPy assigns
        done = 0
        for first, *row, data, kept in self._connection.execute(
            "SELECT first_row, last_number, last_id, data, checksum FROM column_chunk "
            "WHERE series_id = ? AND name = ? AND first_row >= ? ORDER BY first_row",
            (self._series, name, start),
        ):
            _require_chunk(kept, self._series, name, first, *row, data)
            at = first - start
            column[done:at] = np.nan
            target[8 * at : 8 * at + len(data)] = data
            done = at + len(data) // 8
        column[done:] = np.nan
