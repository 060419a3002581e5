"""Epochs as rows of the store: one row each, covariance and observations with it."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.epoch import Epoch
from thermocald.errors import StoreError
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.store.database.blob import (
    pack_covariance,
    pack_observations,
    unpack_covariance,
    unpack_observations,
    unpack_rows,
)
from thermocald.store.database.checksum import require_checksum, row_checksum
from thermocald.store.database.epoch_columns import insert_row, rows_of
from thermocald.store.database.row import EpochResult
from thermocald.store.recording.paths import relative_path

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Iterator, Mapping

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.store.database.blob import ObservationRows

__all__ = [
    "StoredEpoch",
    "check_details",
    "insert_epoch",
    "select_covariance",
    "select_details",
    "select_epochs",
    "select_observations",
    "stored_epoch",
]

_PARTS = 1024  # detail.id = epoch.id * _PARTS + part; part 0 is the covariance
_PART_BYTES = 1100  # seven to a page


@dataclass(frozen=True, slots=True, eq=False)
class StoredEpoch:
    """An epoch as kept: what was acquired, the latest calibration, and what else was recorded.

    revision: 0, and one more with each later calibration; extra: further columns by name.
    """

    epoch: Epoch
    result: EpochResult
    extra: Mapping[str, float]
    clock_trusted: bool
    revision: int


def insert_epoch(connection: sqlite3.Connection, series: int, stored: StoredEpoch) -> int:
    """Insert one epoch with its details and return its id; within the caller's transaction."""
    epoch, result, seen = stored.epoch, stored.result, stored.epoch.observations
    connection.execute("INSERT OR IGNORE INTO status_code (status) VALUES (?)", (result.status,))
    # not left to SQLite: the id is covered by the checksum, since the details depend on it
    (id_,) = connection.execute("SELECT ifnull(max(id), 0) + 1 FROM epoch").fetchone()
    parts = _parts(epoch.number, id_, result.covariance, seen)
    row: dict[str, Any] = {
        "id": id_,
        "series_id": series,
        "number": epoch.number,
        "revision": stored.revision,
        "frame_time": epoch.frame_time,
        "temperature_time": epoch.temperature_time,
        "clock_trusted": int(stored.clock_trusted),
        "status": result.status,
        "sigma0": result.sigma0,
        "redundancy": result.redundancy,
        "n_observations": result.n_observations,
        "n_rejected": len(result.rejected),
        "measured": None if seen is None else len(seen),
        "temperatures": _numbers_json(epoch.temperatures),
        "extra": _numbers_json(stored.extra),
        "rejected": json.dumps(result.rejected),
        "frame": "" if epoch.frame is None else str(epoch.frame),
        "note": epoch.note,
        "reason": result.reason,
        **dict(zip(PARAMETER_NAMES, result.values.tolist(), strict=True)),
        **dict(zip((f"sd_{n}" for n in PARAMETER_NAMES), result.sd.tolist(), strict=True)),
        "detail_checksum": row_checksum((), data=b"".join(data for _, data in parts)),
    }
    insert_row(connection, row)
    connection.executemany("INSERT INTO detail (id, data) VALUES (?, ?)", parts)
    return int(id_)


def _parts(
    number: int, id_: int, covariance: Array | None, seen: Observations | None
) -> list[tuple[int, bytes]]:
    """Covariance and observations as rows of the table `detail`."""
    first = id_ * _PARTS
    parts: list[tuple[int, bytes]] = []
    if covariance is not None:
        parts.append((first, pack_covariance(covariance)))
    if seen is not None:
        data = pack_observations(seen)
        cuts = range(0, len(data), _PART_BYTES)
        if len(cuts) >= _PARTS:
            raise StoreError(f"epoch {number}: {len(seen)} observations are too many to keep")
        parts += [(first + 1 + i, data[c : c + _PART_BYTES]) for i, c in enumerate(cuts)]
    return parts


def select_epochs(
    connection: sqlite3.Connection,
    series: int,
    first: int = 0,
    last: int | None = None,
    *,
    details: bool = True,
) -> Iterator[StoredEpoch]:
    """The epochs numbered `first` to `last` in their latest revision, one after the other.

    details: False leaves out observations and covariances. Raises StoreError for damage.
    """
    rows = rows_of(connection, series, first, last)
    row = next(rows, None)
    while row is not None:
        latest = measured = row
        # a later calibration of observations that stay the same does not keep them again
        while (row := next(rows, None)) is not None and row["number"] == latest["number"]:
            latest = row
            if row["measured"] is not None:
                measured = row
        yield _epoch(connection, latest, measured, details)


def select_observations(
    connection: sqlite3.Connection, series: int, first: int, last: int
) -> ObservationRows:
    """The observations of the epochs numbered `first` to `last`, without their quality.

    Raises StoreError where they are not as they were written; their epochs' other columns are left
    unread.
    """
    parts = connection.execute(
        "SELECT epoch.id, epoch.number, measured, detail_checksum, "
        "detail.id - epoch.id * :parts, data "
        "FROM epoch LEFT JOIN detail ON detail.id >= epoch.id * :parts "
        "AND detail.id < (epoch.id + 1) * :parts WHERE series_id = :series "
        "AND epoch.number BETWEEN :first AND :last ORDER BY epoch.number, revision, detail.id",
        {"parts": _PARTS, "series": series, "first": first, "last": last},
    )
    packed: dict[int, bytes] = {}
    for (_, number, measured, checksum), rows in groupby(parts, key=lambda row: row[:4]):
        if measured is None and number in packed:
            continue  # a later calibration of the same observations does not keep them again
        found = [(part, bytes(data)) for *_, part, data in rows if data is not None]
        what = f"epoch {number}: its covariance or its observations"
        require_checksum(checksum, what, (), data=b"".join(data for _, data in found))
        packed[number] = b"".join(data for part, data in found if part)
    return unpack_rows({number: data for number, data in packed.items() if data})


def select_covariance(connection: sqlite3.Connection, series: int, number: int) -> Array | None:
    """The (16, 16) covariance of an epoch's latest calibration, None if there is none."""
    rows = list(rows_of(connection, series, number, number))
    return _details(connection, rows[-1])[0] if rows else None


def check_details(connection: sqlite3.Connection, row: dict[str, Any]) -> None:
    """Raise StoreError where the covariance or the observations of a row are damaged."""
    _details(connection, row)


def select_details(connection: sqlite3.Connection, id_: int) -> tuple[bytes, bytes]:
    """The covariance and the observations of the row `id_`, packed; empty where it has none."""
    parts = _parts_of(connection, id_)
    covariance = b"".join(data for part, data in parts if part == 0)
    return covariance, b"".join(data for part, data in parts if part)


def _parts_of(connection: sqlite3.Connection, id_: int) -> list[tuple[int, bytes]]:
    return connection.execute(
        "SELECT id - :low, data FROM detail WHERE id >= :low AND id < :high ORDER BY id",
        {"low": id_ * _PARTS, "high": (id_ + 1) * _PARTS},
    ).fetchall()


def _epoch(
    connection: sqlite3.Connection, row: dict[str, Any], measured: dict[str, Any], details: bool
) -> StoredEpoch:
    covariance = seen = None
    if details:
        covariance, seen = _details(connection, row)
        if measured is not row:
            _, seen = _details(connection, measured)
    return stored_epoch(row, covariance, seen)


def stored_epoch(
    row: Mapping[str, Any], covariance: Array | None, seen: Observations | None
) -> StoredEpoch:
    """An epoch from a row by column names, of this file or of a server."""
    epoch = Epoch(
        number=row["number"],
        frame_time=row["frame_time"],
        temperature_time=_nan(row["temperature_time"]),
        temperatures=_mapping(row["temperatures"]),
        frame=relative_path(row["frame"], f"epoch {row['number']}: frame", StoreError)
        if row["frame"]
        else None,
        observations=seen,
        note=row["note"],
    )
    result = EpochResult(
        status=row["status"],
        reason=row["reason"],
        values=np.array([row[name] for name in PARAMETER_NAMES], dtype=float),
        covariance=covariance,
        sigma0=_nan(row["sigma0"]),
        redundancy=row["redundancy"],
        n_observations=row["n_observations"],
        rejected=tuple(json.loads(row["rejected"])),
    )
    return StoredEpoch(
        epoch, result, _mapping(row["extra"]), bool(row["clock_trusted"]), row["revision"]
    )


def _details(
    connection: sqlite3.Connection, row: dict[str, Any]
) -> tuple[Array | None, Observations | None]:
    """(covariance, observations) of one row; StoreError where they are not as they were written."""
    parts = _parts_of(connection, row["id"])
    data = b"".join(bytes(part) for _, part in parts)
    what = f"epoch {row['number']}: its covariance or its observations"
    require_checksum(row["detail_checksum"], what, (), data=data)
    covariance = seen = None
    if parts and parts[0][0] == 0:
        covariance, parts = unpack_covariance(parts[0][1]), parts[1:]
    if parts:
        seen = unpack_observations(b"".join(part for _, part in parts))
    return covariance, seen


def _numbers_json(values: Mapping[str, float]) -> str:
    finite = {n: float(v) if math.isfinite(v) else None for n, v in values.items()}
    return json.dumps(finite)


def _mapping(text: str) -> dict[str, float]:
    return {name: _nan(value) for name, value in json.loads(text).items()}


def _nan(value: float | None) -> float:
    return math.nan if value is None else value
