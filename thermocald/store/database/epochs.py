"""Epochs as rows of a store: one row each, its covariance and observations as compact bytes.

An observation is 18 bytes: target row uint16, x and y int32 in units of 1e-5 px, their standard
deviations float32; 4 more for the covariance of x and y where it is known, 4 for each quality.
The rounding of 3e-6 px (rms) is a thousandth of the best measurement and the digits of
observations.csv. A covariance is the 136 float64 of its upper triangle. All little-endian.
"""

from __future__ import annotations

import json
import math
import struct
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.epoch import Epoch
from thermocald.errors import StoreError
from thermocald.names import relative_path
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.store.database.columns import insert_row, require_checksum, row_checksum, rows_of
from thermocald.store.series import EpochResult, ObservationRows, StoredEpoch

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from thermocald.arrays import Array

POINT_QUANTUM_PX = 1e-5

_HEADER = struct.Struct("<BBIH")  # layout, flags, number of observations, bytes of the names
_LAYOUT = 1
_COVARIANCES, _LONG_ROWS, _FLOAT_POINTS = 1, 2, 4
_UPPER = np.triu_indices(16)
_PARTS = 1024  # detail.id = epoch.id * _PARTS + part; part 0 is the covariance
_PART_BYTES = 1100  # seven to a page


def pack_covariance(covariance: Array) -> bytes:
    """(16, 16) → 1088 bytes."""
    upper: Array = covariance[_UPPER]
    return upper.astype("<f8").tobytes()


def unpack_covariance(data: bytes) -> Array:
    """The inverse of `pack_covariance`; raises StoreError for another length."""
    if len(data) != 8 * len(_UPPER[0]):
        raise StoreError(f"a covariance of {len(data)} bytes in the store is broken")
    covariance = np.zeros((16, 16))
    covariance[_UPPER] = np.frombuffer(data, "<f8")
    covariance.T[_UPPER] = covariance[_UPPER]
    return covariance


def pack_observations(seen: Observations) -> bytes:
    """Observations → bytes; points rounded to 1e-5 px, the rest to float32."""
    quanta = np.rint(seen.points / POINT_QUANTUM_PX)
    flags = 0
    if seen.covariances is not None:
        flags |= _COVARIANCES
    if len(seen) and int(seen.targets.max()) > 0xFFFF:
        flags |= _LONG_ROWS
    if not bool(np.all(np.abs(quanta) < 2**31)):
        flags |= _FLOAT_POINTS  # beyond ±21474 px, or no number: kept as it is
    names = "\n".join(seen.quality).encode()
    parts = [
        _HEADER.pack(_LAYOUT, flags, len(seen), len(names)) + names,
        seen.targets.astype("<u4" if flags & _LONG_ROWS else "<u2").tobytes(),
        seen.points.astype("<f8").tobytes()
        if flags & _FLOAT_POINTS
        else quanta.astype("<i4").tobytes(),
        seen.sigmas.astype("<f4").tobytes(),
    ]
    if seen.covariances is not None:
        parts.append(seen.covariances.astype("<f4").tobytes())
    parts += [values.astype("<f4").tobytes() for values in seen.quality.values()]
    return b"".join(parts)


def unpack_observations(data: bytes) -> Observations:
    """The inverse of `pack_observations`; raises StoreError for bytes that are none."""
    try:
        layout, flags, n, names_size = _HEADER.unpack_from(data)
        if layout != _LAYOUT:
            raise ValueError(f"layout {layout}")
        position = _HEADER.size + names_size
        names = data[_HEADER.size : position].decode()

        def take(kind: str, count: int) -> NDArray[np.generic]:
            nonlocal position
            values: NDArray[np.generic] = np.frombuffer(data, kind, count, position)
            position += values.nbytes
            return values

        targets = take("<u4" if flags & _LONG_ROWS else "<u2", n).astype(np.int64)
        if flags & _FLOAT_POINTS:
            points = take("<f8", 2 * n).astype(np.float64)
        else:
            # dividing by 1e5 gives the decimal number's nearest double, times 1e-5 would not
            points = take("<i4", 2 * n).astype(np.float64) / round(1 / POINT_QUANTUM_PX)
        sigmas = take("<f4", 2 * n).astype(np.float64)
        covariances = take("<f4", n).astype(np.float64) if flags & _COVARIANCES else None
        quality = {name: take("<f4", n).astype(np.float64) for name in names.split("\n") if name}
        return Observations(
            targets, points.reshape(n, 2), sigmas.reshape(n, 2), covariances, quality
        )
    except (struct.error, ValueError) as cause:
        raise StoreError(f"observations in the store are broken: {cause}") from cause


def unpack_rows(packed: Mapping[int, bytes]) -> ObservationRows:
    """The observations of many epochs {number: bytes}, without their quality.

    What would be taken epoch by epoch is taken from the bytes of all epochs at once. Raises
    StoreError for bytes that are none.
    """
    kinds: dict[int, list[tuple[int, int, int, bytes]]] = {}
    for number, data in packed.items():
        if len(data) < _HEADER.size or data[0] != _LAYOUT:
            raise StoreError(f"epoch {number}: its observations in the store are broken")
        _, flags, n, names_size = _HEADER.unpack_from(data)
        kinds.setdefault(flags, []).append((number, n, _HEADER.size + names_size, data))
    parts = [_rows_of(flags, epochs) for flags, epochs in kinds.items()] or [_rows_of(0, [])]
    correlated = any(part.covariances is not None for part in parts)
    return ObservationRows(
        np.concatenate([part.numbers for part in parts]),
        np.concatenate([part.targets for part in parts]),
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.sigmas for part in parts]),
        np.concatenate(
            [np.zeros(len(p.numbers)) if p.covariances is None else p.covariances for p in parts]
        )
        if correlated
        else None,
    )


def _rows_of(flags: int, epochs: list[tuple[int, int, int, bytes]]) -> ObservationRows:
    """The rows of epochs of one layout: their number, how many, where they begin, the bytes."""
    sizes = [4 if flags & _LONG_ROWS else 2, 16 if flags & _FLOAT_POINTS else 8, 8]
    if flags & _COVARIANCES:
        sizes.append(4)
    columns: list[list[bytes]] = [[] for _ in sizes]
    for number, n, position, data in epochs:
        if len(data) < position + n * sum(sizes):
            raise StoreError(f"epoch {number}: its observations in the store are broken")
        for column, size in zip(columns, sizes, strict=True):
            column.append(data[position : position + n * size])
            position += n * size
    whole = [b"".join(column) for column in columns]
    points = np.frombuffer(whole[1], "<f8" if flags & _FLOAT_POINTS else "<i4").astype(np.float64)
    if not flags & _FLOAT_POINTS:
        points /= round(1 / POINT_QUANTUM_PX)  # as `unpack_observations` does
    numbers, counts = (np.array([e[k] for e in epochs], dtype=np.int64) for k in (0, 1))
    return ObservationRows(
        np.repeat(numbers, counts),
        np.frombuffer(whole[0], "<u4" if flags & _LONG_ROWS else "<u2").astype(np.int64),
        points.reshape(-1, 2),
        np.frombuffer(whole[2], "<f4").astype(np.float64).reshape(-1, 2),
        np.frombuffer(whole[3], "<f4").astype(np.float64) if flags & _COVARIANCES else None,
    )


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
