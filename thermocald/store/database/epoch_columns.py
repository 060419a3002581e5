"""Rows of the table `epoch` as columns of numbers.

Sources of columns are: `number`, times and counts; the parameters and `sd_<parameter>`;
`temperatures.<channel>` as read; `extra.<name>`; `status` as a code of the table status_code.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.store.database.schema import sql_name

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

__all__ = ["FIELDS", "FIXED", "late_columns", "latest_columns", "status_codes"]

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
FIELDS = (*FIXED, "status", *_JSON)


def latest_columns(
    connection: sqlite3.Connection,
    series: int,
    fields: Sequence[str],
    after: int,
    until: int | None = None,
) -> dict[str, Array]:
    """The epochs numbered above `after`, up to `until`, in their latest revision.

    fields: columns of the table; `number` is always among the result's.
    """
    fields = list(dict.fromkeys(["number", *fields]))
    rows = connection.execute(
        f"SELECT {_names(fields)} FROM epoch WHERE series_id = ? AND number > ? "
        "AND number <= ifnull(?, number) ORDER BY number, revision",
        (series, after, until),
    )
    return _columns(connection, fields, list({row[0]: row for row in rows}.values()))


def late_columns(
    connection: sqlite3.Connection, series: int, fields: Sequence[str]
) -> dict[str, Array]:
    """The calibrations that came after their epoch's chunk was written, in their order."""
    fields = list(dict.fromkeys(["number", *fields]))
    rows = connection.execute(
        f"SELECT {_names(fields)} FROM late_epoch JOIN epoch ON epoch.id = epoch_id "
        "WHERE late_epoch.series_id = ? ORDER BY epoch_id",
        (series,),
    )
    return _columns(connection, fields, rows.fetchall())


def status_codes(connection: sqlite3.Connection) -> dict[int, str]:
    """The words that the codes in the column `status` stand for."""
    return dict(connection.execute("SELECT code, status FROM status_code"))


def _names(fields: Sequence[str]) -> str:
    return ", ".join(map(sql_name, fields))


def _columns(
    connection: sqlite3.Connection, fields: Sequence[str], rows: list[tuple[Any, ...]]
) -> dict[str, Array]:
    """Rows → columns; `temperatures` and `extra` become one column per name in them."""
    columns: dict[str, Array] = {}
    values = zip(*rows, strict=True) if rows else [()] * len(fields)
    for field, column in zip(fields, values, strict=True):
        if field == "status":
            codes = {status: code for code, status in status_codes(connection).items()}
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
