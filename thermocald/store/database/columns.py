"""The table `epoch`, listed once: its rows as checked values, its columns over a series as arrays.

Sources of columns are: `number`, times and counts; the parameters and `sd_<parameter>`;
`temperatures.<channel>` as read; `extra.<name>`; `status` as a code of the table status_code.

SQLite hands out rows at some microseconds each; a million epochs would take seconds. So when
CHUNK epochs of a series have accumulated, each of their columns is written once more as one blob
of float64, in the transaction of the last of them; and when MERGED such chunks have accumulated,
they become one, since long blobs are read twice as fast. Reading joins the chunks and takes the
tail, and the epochs that were calibrated after their chunk was written, from the rows. Chunks are
derived and can be rebuilt.

Checksums are of rows, since SQLite's own integrity check does not see a bit that changed inside a
value: a CRC-32 over a row's numbers, as little-endian float64 with one NaN for NULL, and then its
texts, joined by a control character.
"""

from __future__ import annotations

import json
import logging
import math
import struct
import zlib
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import StoreError
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from thermocald.arrays import Array

log = logging.getLogger(__name__)

CHUNK = 1024
MERGED = 16
_SEPARATOR = "\x1f"
_KEYS = ("id", "series_id")
# columns over a series: what `Store.series_columns` offers, with status, channels and extra ones
COLUMN_NAMES = (
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
_MAPPINGS = ("temperatures", "extra")
CHUNKED = (*COLUMN_NAMES, "status", *_MAPPINGS)
# measured: None where a later calibration uses the observations of the revision before
_NUMBERS = (*_KEYS, *COLUMN_NAMES, "revision", "measured", "detail_checksum")
_TEXTS = ("status", *_MAPPINGS, "rejected", "frame", "note", "reason")
_ALL = (*_NUMBERS, *_TEXTS, "checksum")


class DamageError(StoreError):
    """A row of the store is not as it was written."""


def row_checksum(numbers: Sequence[Any], texts: Iterable[str] = (), data: bytes = b"") -> int:
    """CRC-32 of a row as SQLite gives it back: numbers or None, texts, bytes.

    Raises TypeError or ValueError where a value is of another type, which is damage too.
    """
    # 0.0 + -0.0 is 0.0: SQLite does not keep the sign of a zero
    plain = [math.nan if v is None or v != v else 0.0 + v for v in numbers]
    found = zlib.crc32(struct.pack(f"<{len(plain)}d", *plain))
    found = zlib.crc32(_SEPARATOR.join(texts).encode(errors="surrogateescape"), found)
    return zlib.crc32(data, found)


def require_checksum(
    kept: int,
    what: str,
    numbers: Sequence[Any],
    texts: Iterable[str] = (),
    data: bytes = b"",
) -> None:
    """Raise DamageError naming `what` if a row is not as it was written."""
    try:
        good = row_checksum(numbers, texts, data) == kept
    except (TypeError, ValueError, OverflowError, struct.error):
        good = False
    if not good:
        raise DamageError(
            f"{what} is damaged: its checksum does not match; `thermocald check` lists all that "
            "is damaged, a backup has it as it was"
        )


def sql_name(name: str) -> str:
    """The column of a field: SQL ignores case, and x0 must not be X0."""
    return f"{name[:-2]}centre_{name[-2:]}" if name[-2:] in ("X0", "Y0", "Z0") else name


_SELECTED = ", ".join(f"epoch.{sql_name(name)}" for name in _ALL)
_INSERT = (
    f"INSERT INTO epoch ({', '.join(map(sql_name, _ALL))}) VALUES ({', '.join('?' * len(_ALL))})"
)


def insert_row(connection: sqlite3.Connection, row: Mapping[str, Any]) -> None:
    """Insert one row, all columns but `checksum` given; within the caller's transaction."""
    numbers = [row[name] for name in _NUMBERS]
    texts = [row[name] for name in _TEXTS]
    connection.execute(_INSERT, (*numbers, *texts, row_checksum(numbers, texts)))


def rows_of(
    connection: sqlite3.Connection, series: int, first: int, last: int | None
) -> Iterator[dict[str, Any]]:
    """The rows of the epochs numbered `first` to `last`, by number and revision, one by one.

    Raises StoreError for a row whose checksum does not match.
    """
    return _checked(
        connection.execute(
            f"SELECT {_SELECTED} FROM epoch WHERE series_id = ? AND number >= ? "
            "AND number <= ifnull(?, number) ORDER BY number, revision",
            (series, first, last),
        )
    )


def all_rows(connection: sqlite3.Connection) -> Iterator[dict[str, Any] | DamageError]:
    """Every row of the table as it lies in the file, or what is wrong with it."""
    names = dict(connection.execute("SELECT id, camera || '/' || name FROM series"))
    for row in connection.execute(f"SELECT {_SELECTED} FROM epoch NOT INDEXED ORDER BY id"):
        try:
            yield from _checked([row])
        except DamageError:
            series, number = row[_NUMBERS.index("series_id")], row[_NUMBERS.index("number")]
            yield DamageError(f"{names.get(series, f'series {series}')}, epoch {number}")


def require_sound(row: Mapping[str, Any]) -> None:
    """StoreError where a row, by the names of the table's columns, is not as it was written."""
    numbers = [row[sql_name(name)] for name in _NUMBERS]
    texts = [row[sql_name(name)] for name in _TEXTS]
    require_checksum(row["checksum"], f"epoch {row['number']}", numbers, texts)


def latest_columns(
    connection: sqlite3.Connection,
    series: int,
    fields: Sequence[str],
    after: int,
    until: int | None = None,
) -> dict[str, Array]:
    """The epochs numbered above `after`, up to `until`, in their latest revision.

    fields: of `CHUNKED`; `number` is always among the result's. Raises StoreError for damage.
    """
    latest = {row["number"]: row for row in rows_of(connection, series, after + 1, until)}
    return _columns(connection, fields, list(latest.values()))


def late_columns(
    connection: sqlite3.Connection, series: int, fields: Sequence[str]
) -> dict[str, Array]:
    """The calibrations that came after their epoch's chunk was written, in their order."""
    rows = connection.execute(
        f"SELECT {_SELECTED} FROM late_epoch JOIN epoch ON epoch.id = epoch_id "
        "WHERE late_epoch.series_id = ? ORDER BY epoch_id",
        (series,),
    )
    return _columns(connection, fields, list(_checked(rows)))


def status_codes(connection: sqlite3.Connection) -> dict[int, str]:
    """The words that the codes in the column `status` stand for."""
    return dict(connection.execute("SELECT code, status FROM status_code"))


def _checked(rows: Iterable[tuple[Any, ...]]) -> Iterator[dict[str, Any]]:
    count = len(_NUMBERS)
    number = _NUMBERS.index("number")
    for row in rows:
        require_checksum(row[-1], f"epoch {row[number]}", row[:count], row[count:-1])
        yield dict(zip(_ALL, row, strict=True))


def _columns(
    connection: sqlite3.Connection, fields: Sequence[str], rows: list[dict[str, Any]]
) -> dict[str, Array]:
    """Rows → columns; `temperatures` and `extra` become one column per name in them."""
    columns: dict[str, Array] = {}
    for field in dict.fromkeys(["number", *fields]):
        column = [row[field] for row in rows]
        if field == "status":
            codes = {status: code for code, status in status_codes(connection).items()}
            columns[field] = np.array([codes[status] for status in column], dtype=np.float64)
        elif field in _MAPPINGS:
            found = [json.loads(text) for text in column]
            for name in dict.fromkeys(name for mapping in found for name in mapping):
                columns[f"{field}.{name}"] = np.array(
                    [mapping.get(name) for mapping in found], dtype=np.float64
                )
        else:
            columns[field] = np.array(column, dtype=np.float64)  # None, SQL's NULL, becomes NaN
    return columns


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


def _require(kept: int, series: int, name: str, first_row: int, last: int, data: bytes) -> None:
    if kept != _checksum(series, name, first_row, last, data):
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
