"""What a store has kept since, row by row in the order in which it was kept: to send elsewhere.

Rows are never changed or deleted, so the last id that was sent is all a sender has to remember.
"""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from thermocald.errors import StoreError
from thermocald.store.database.checksum import require_checksum
from thermocald.store.database.epoch_columns import require_sound
from thermocald.store.database.epoch_table import check_details, select_details
from thermocald.store.database.row import NOT_CALIBRATED
from thermocald.store.recording.paths import relative_path

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["KEPT", "KeptFrame", "frames_after", "rows_after"]

log = logging.getLogger(__name__)

KEPT = ("epoch", "event", "reading")
"""The tables that grow while a daemon runs."""

_CHECKSUMS = ("checksum", "detail_checksum")
# what the checksum of a row is of, in its order: numbers and texts
_CHECKED = {
    "event": (("utc", "series_id", "epoch"), ("kind", "text", "data")),
    "reading": (("utc", "clock_trusted"), ("thermometer", "temperatures")),
}


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
            happened = status not in ("ok", NOT_CALIBRATED) or "event" in json.loads(extra)
        except (StoreError, ValueError) as error:
            log.warning("%s; its frame is left out", error)
        yield KeptFrame(id_, series, number, time, path, happened)
