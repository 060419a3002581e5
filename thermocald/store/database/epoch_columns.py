"""The columns of the table `epoch`, listed once, and its rows as checked values or arrays.

Sources of columns are: `number`, times and counts; the parameters and `sd_<parameter>`;
`temperatures.<channel>` as read; `extra.<name>`; `status` as a code of the table status_code.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.store.database.checksum import DamageError, require_checksum, row_checksum

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from thermocald.arrays import Array

__all__ = [
    "CHUNKED",
    "COLUMN_NAMES",
    "all_rows",
    "insert_row",
    "late_columns",
    "latest_columns",
    "require_sound",
    "rows_of",
    "sql_name",
    "status_codes",
]

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
