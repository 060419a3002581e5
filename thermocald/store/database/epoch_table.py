"""Epochs as rows of the store: one row each, covariance and observations beside it."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
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
)
from thermocald.store.database.row import EpochResult
from thermocald.store.database.schema import sql_name

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from thermocald.photogrammetry.field.testfield import Observations

    Array = NDArray[np.float64]

__all__ = ["StoredEpoch", "insert_epoch", "select_covariance", "select_details", "select_epochs"]

_PARTS = 1024  # detail.id = epoch.id * _PARTS + part; part 0 is the covariance
_PART_BYTES = 1100  # seven to a page

_FIELDS = (
    "number",
    "revision",
    "frame_time",
    "temperature_time",
    "clock_trusted",
    "status",
    "sigma0",
    "redundancy",
    "n_observations",
    "measured",
    "temperatures",
    "extra",
    "rejected",
    "frame",
    "note",
    "reason",
    *PARAMETER_NAMES,
)
_WRITTEN = (*_FIELDS, *(f"sd_{name}" for name in PARAMETER_NAMES), "n_rejected", "series_id")
_INSERT = (
    f"INSERT INTO epoch ({', '.join(map(sql_name, _WRITTEN))}) "
    f"VALUES ({', '.join('?' * len(_WRITTEN))})"
)
_SELECT = (
    f"SELECT id, {', '.join(map(sql_name, _FIELDS))} FROM epoch WHERE series_id = ? "
    "AND number >= ? AND number <= ifnull(?, number) ORDER BY number, revision"
)


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
    cursor = connection.execute(
        _INSERT,
        (
            epoch.number,
            stored.revision,
            epoch.frame_time,
            epoch.temperature_time,
            stored.clock_trusted,
            result.status,
            result.sigma0,
            result.redundancy,
            result.n_observations,
            None if seen is None else len(seen),
            _numbers_json(epoch.temperatures),
            _numbers_json(stored.extra),
            json.dumps(result.rejected),
            "" if epoch.frame is None else str(epoch.frame),
            epoch.note,
            result.reason,
            *result.values.tolist(),
            *result.sd.tolist(),
            len(result.rejected),
            series,
        ),
    )
    assert cursor.lastrowid is not None
    first = cursor.lastrowid * _PARTS
    parts: list[tuple[int, bytes]] = []
    if result.covariance is not None:
        parts.append((first, pack_covariance(result.covariance)))
    if seen is not None:
        data = pack_observations(seen)
        cuts = range(0, len(data), _PART_BYTES)
        if len(cuts) >= _PARTS:
            raise StoreError(f"epoch {epoch.number}: {len(seen)} observations are too many to keep")
        parts += [(first + 1 + i, data[c : c + _PART_BYTES]) for i, c in enumerate(cuts)]
    connection.executemany("INSERT INTO detail (id, data) VALUES (?, ?)", parts)
    return cursor.lastrowid


def select_epochs(
    connection: sqlite3.Connection,
    series: int,
    first: int = 0,
    last: int | None = None,
    *,
    details: bool = True,
) -> Iterator[StoredEpoch]:
    """The epochs numbered `first` to `last` in their latest revision, one after the other.

    details: False leaves out observations and covariances.
    """
    rows = connection.execute(_SELECT, (series, first, last))
    row = next(rows, None)
    while row is not None:
        latest, measured = row, row[0]
        # a later calibration of observations that stay the same does not keep them again
        while (row := next(rows, None)) is not None and row[1] == latest[1]:
            latest = row
            if row[10] is not None:
                measured = row[0]
        yield _epoch(connection, latest, measured, details)


def select_covariance(connection: sqlite3.Connection, series: int, number: int) -> Array | None:
    """The (16, 16) covariance of an epoch's latest calibration, None if there is none."""
    row = connection.execute(
        "SELECT id FROM epoch WHERE series_id = ? AND number = ? ORDER BY revision DESC LIMIT 1",
        (series, number),
    ).fetchone()
    data = b"" if row is None else _detail(connection, row[0], 0, 1)
    return unpack_covariance(data) if data else None


def select_details(connection: sqlite3.Connection, id_: int) -> tuple[bytes, bytes]:
    """The covariance and the observations of the row `id_`, packed; empty where it has none."""
    return _detail(connection, id_, 0, 1), _detail(connection, id_, 1, _PARTS)


def _epoch(
    connection: sqlite3.Connection, row: tuple[Any, ...], measured: int, details: bool
) -> StoredEpoch:
    id_, *values = row
    field = dict(zip(_FIELDS, values, strict=True))
    epoch = Epoch(
        number=field["number"],
        frame_time=field["frame_time"],
        temperature_time=_nan(field["temperature_time"]),
        temperatures=_mapping(field["temperatures"]),
        frame=Path(field["frame"]) if field["frame"] else None,
        note=field["note"],
    )
    result = EpochResult(
        status=field["status"],
        reason=field["reason"],
        values=np.array([field[name] for name in PARAMETER_NAMES], dtype=float),
        sigma0=_nan(field["sigma0"]),
        redundancy=field["redundancy"],
        n_observations=field["n_observations"],
        rejected=tuple(json.loads(field["rejected"])),
    )
    if details:
        covariance = _detail(connection, id_, 0, 1)
        if covariance:
            result = replace(result, covariance=unpack_covariance(covariance))
        epoch = replace(epoch, observations=_observations(connection, measured))
    return StoredEpoch(
        epoch, result, _mapping(field["extra"]), bool(field["clock_trusted"]), field["revision"]
    )


def _observations(connection: sqlite3.Connection, id_: int) -> Observations | None:
    data = _detail(connection, id_, 1, _PARTS)
    return unpack_observations(data) if data else None


def _detail(connection: sqlite3.Connection, id_: int, first: int, stop: int) -> bytes:
    rows = connection.execute(
        "SELECT data FROM detail WHERE id >= ? AND id < ? ORDER BY id",
        (id_ * _PARTS + first, id_ * _PARTS + stop),
    )
    return b"".join(data for (data,) in rows)


def _numbers_json(values: Mapping[str, float]) -> str:
    finite = {n: float(v) if math.isfinite(v) else None for n, v in values.items()}
    return json.dumps(finite)


def _mapping(text: str) -> dict[str, float]:
    return {name: _nan(value) for name, value in json.loads(text).items()}


def _nan(value: float | None) -> float:
    return math.nan if value is None else value
