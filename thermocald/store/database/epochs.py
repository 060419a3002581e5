"""Epochs as rows of a store: one row each, its covariance and observations as compact bytes.

An observation has 18 bytes: target row uint16, x and y int32 in units of 1e-5 px, their standard
deviations float32; 4 more for the covariance of x and y if it is given, 4 for each quality. The
rounding error of 3e-6 px (rms) is a thousandth of the best sd and equals that of observations.csv.
A covariance is the 136 float64 of its upper triangle. All numbers are little-endian.

The module also has the rows of series, and reads damaged, missing and new rows. SQLite's integrity
check finds a broken structure, the checksums a changed value, the epochs' numbers a missing row. As
rows are never changed or deleted, a forwarder only needs to remember the last id it sent.
"""

from __future__ import annotations

import hashlib
import json
import math
import sqlite3
import struct
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.epoch import Epoch
from thermocald.errors import StoreError
from thermocald.names import file_name, relative_path
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.store.database.columns import (
    KEPT,
    DamageError,
    checked_chunks,
    examined_epochs,
    examined_rows,
    insert_row,
    require_checksum,
    row_checksum,
)
from thermocald.store.recording.head import head_document, parse_head
from thermocald.store.recording.testfield_file import parse_testfield, testfield_csv
from thermocald.store.schema import sql_name
from thermocald.store.series import EpochResult, StoredEpoch, StoredSeries

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from thermocald.arrays import Array


POINT_QUANTUM_PX = 1e-5

_HEADER = struct.Struct("<BBIH")  # layout, flags, number of observations, bytes of the names
_LAYOUT = 1
_COVARIANCES, _FLOAT_POINTS = 1, 4
_UPPER = np.triu_indices(16)
_FULL = np.zeros((16, 16), dtype=np.intp)  # places in the upper triangle
_FULL[_UPPER] = _FULL.T[_UPPER] = np.arange(len(_UPPER[0]))
_PARTS = 1024  # detail.id = epoch.id * _PARTS + part; part 0 is the covariance
_PART_BYTES = 1100  # seven to a page
_VALUES = tuple(map(sql_name, PARAMETER_NAMES))
_SDS = tuple(f"sd_{name}" for name in _VALUES)


def pack_covariance(covariance: Array) -> bytes:
    """Pack a covariance (16, 16) into 1088 bytes."""
    upper: Array = covariance[_UPPER]
    return upper.astype("<f8").tobytes()


def unpack_covariance(data: bytes) -> Array:
    """Invert `pack_covariance`. Raises StoreError for another length."""
    if len(data) != 8 * len(_UPPER[0]):
        raise StoreError(f"a covariance of {len(data)} bytes in the store is broken")
    covariance: Array = np.frombuffer(data, "<f8").astype(np.float64)[_FULL]
    return covariance


def pack_observations(seen: Observations) -> bytes:
    """Pack observations; points are rounded to 1e-5 px, the rest to float32."""
    quanta = np.rint(seen.points / POINT_QUANTUM_PX)
    flags = 0
    if seen.covariances is not None:
        flags |= _COVARIANCES
    if not bool(np.all(np.abs(quanta) < 2**31)):
        flags |= _FLOAT_POINTS  # beyond ±21474 px, or not finite: as float64
    names = "\n".join(seen.quality).encode()
    parts = [
        _HEADER.pack(_LAYOUT, flags, len(seen), len(names)) + names,
        seen.targets.astype("<u2").tobytes(),
        (seen.points.astype("<f8") if flags & _FLOAT_POINTS else quanta.astype("<i4")).tobytes(),
    ]
    covariances = [] if seen.covariances is None else [seen.covariances]
    singles = (seen.sigmas, *covariances, *seen.quality.values())
    return b"".join([*parts, *(values.astype("<f4").tobytes() for values in singles)])


def unpack_observations(data: bytes) -> Observations:
    """Invert `pack_observations`. Raises StoreError for other bytes."""
    if len(data) < _HEADER.size or data[0] != _LAYOUT:
        raise StoreError("observations in the store are broken: their layout is unknown")
    _, flags, n, names_size = _HEADER.unpack_from(data)
    at = _HEADER.size + names_size

    def column(kind: str, width: int = 1) -> Array:
        nonlocal at
        found = np.frombuffer(data, kind, n * width, at)
        at += found.nbytes
        return found.astype(np.float64)

    try:
        names = data[_HEADER.size : at].decode()
        targets = column("<u2").astype(np.int64)
        points = column("<f8" if flags & _FLOAT_POINTS else "<i4", 2)
        if not flags & _FLOAT_POINTS:
            # division by 1e5 gives the double nearest to the decimal; a product with 1e-5 would not
            points /= round(1 / POINT_QUANTUM_PX)
        sigmas = column("<f4", 2)
        covariances = column("<f4") if flags & _COVARIANCES else None
        quality = {name: column("<f4") for name in filter(None, names.split("\n"))}
    except ValueError as cause:
        raise StoreError(f"observations in the store are broken: {cause}") from cause
    return Observations(targets, points.reshape(-1, 2), sigmas.reshape(-1, 2), covariances, quality)


def insert_epoch(connection: sqlite3.Connection, series: int, stored: StoredEpoch) -> None:
    """Insert one epoch with its details, in the caller's transaction."""
    epoch, result, seen = stored.epoch, stored.result, stored.epoch.observations
    connection.execute("INSERT OR IGNORE INTO status_code (status) VALUES (?)", (result.status,))
    covariance = [] if result.covariance is None else [(0, pack_covariance(result.covariance))]
    packed = b"" if seen is None else pack_observations(seen)
    cuts = range(0, len(packed), _PART_BYTES)
    if seen is not None and len(cuts) >= _PARTS:
        raise StoreError(f"epoch {epoch.number}: {len(seen)} observations are too many to store")
    parts = [*covariance, *((1 + i, packed[c : c + _PART_BYTES]) for i, c in enumerate(cuts))]
    row: dict[str, Any] = {
        "series_id": series, "number": epoch.number, "revision": stored.revision,
        "frame_time": epoch.frame_time, "temperature_time": epoch.temperature_time,
        "clock_trusted": int(stored.clock_trusted), "status": result.status,
        "sigma0": result.sigma0, "redundancy": result.redundancy,
        "n_observations": result.n_observations, "n_rejected": len(result.rejected),
        # None where a later calibration uses the observations of the revision before
        "measured": None if seen is None else len(seen),
        "temperatures": _numbers_json(epoch.temperatures), "extra": _numbers_json(stored.extra),
        "rejected": json.dumps(result.rejected), "note": epoch.note, "reason": result.reason,
        "frame": "" if epoch.frame is None else str(epoch.frame),
        **dict(zip(_VALUES, result.values.tolist(), strict=True)),
        **dict(zip(_SDS, result.sd.tolist(), strict=True)),
        "detail_checksum": row_checksum((), data=b"".join(data for _, data in parts)),
    }  # fmt: skip
    first = insert_row(connection, "epoch", **row) * _PARTS
    details = [(first + part, data) for part, data in parts]
    kept = connection.executemany("INSERT INTO detail (id, data) VALUES (?, ?)", details).rowcount
    if parts and kept != len(parts):
        raise sqlite3.IntegrityError("a foreign trigger keeps rows out of detail; drop it")


def latest_epochs(
    rows: Iterable[Mapping[str, Any]],
    details: Callable[[Mapping[str, Any]], tuple[bytes, bytes]] | None,
) -> Iterator[StoredEpoch]:
    """Yield each epoch in its latest revision from rows of a file or a server.

    rows: by number and revision; details: gives a row's packed covariance and observations, empty
    or None if it has none; or None.
    Raises DamageError at a damaged epoch, after those before it.
    """
    for _, revisions in groupby(rows, key=itemgetter("number")):
        covariance = seen = b""
        every = list(revisions)
        if damage := next(filter(None, (row.get("damage") for row in every)), ""):
            raise DamageError(damage)
        if details is not None:
            # a later calibration of the same observations does not store them again
            measured = next((r for r in every[::-1] if r["measured"] is not None), every[-1])
            covariance, seen = details(every[-1])
            if measured is not every[-1]:
                _, seen = details(measured)
        row = every[-1]
        epoch = Epoch(
            row["number"], row["frame_time"], number_or_nan(row["temperature_time"]),
            parse_numbers(row["temperatures"]),
            relative_path(row["frame"], f"epoch {row['number']}: frame", StoreError)
            if row["frame"] else None,
            unpack_observations(seen) if seen else None, row["note"],
        )  # fmt: skip
        result = EpochResult(
            row["status"], row["reason"], np.array([row[name] for name in _VALUES], dtype=float),
            unpack_covariance(covariance) if covariance else None, number_or_nan(row["sigma0"]),
            row["redundancy"], row["n_observations"], tuple(json.loads(row["rejected"])),
        )  # fmt: skip
        yield StoredEpoch(
            epoch, result, parse_numbers(row["extra"]), bool(row["clock_trusted"]), row["revision"]
        )


def select_epochs(
    connection: sqlite3.Connection, series: int, first: int, last: int | None, details: bool
) -> Generator[StoredEpoch, None, None]:
    """Yield epochs `first` to `last` (numbers). Raises the errors of `latest_epochs`."""
    with closing(examined_epochs(connection, series, first, last)) as rows:
        yield from latest_epochs(rows, partial(read_details, connection) if details else None)


def read_details(connection: sqlite3.Connection, row: Mapping[str, Any]) -> tuple[bytes, bytes]:
    """Read the packed covariance and observations of a row, empty if it has none.

    Raises DamageError if they are damaged.
    """
    parts = connection.execute(
        "SELECT id - :low, data FROM detail WHERE id >= :low AND id < :high ORDER BY id",
        {"low": row["id"] * _PARTS, "high": (row["id"] + 1) * _PARTS},
    ).fetchall()
    covariance = b"".join(bytes(data) for part, data in parts if part == 0)
    seen = b"".join(bytes(data) for part, data in parts if part)
    what = f"epoch {row['number']}: its covariance or its observations"
    require_checksum(row["detail_checksum"], what, (), data=covariance + seen)
    return covariance, seen


def _numbers_json(values: Mapping[str, float]) -> str:
    finite = {n: float(v) if math.isfinite(v) else None for n, v in values.items()}
    return json.dumps(finite)


def parse_numbers(text: str) -> dict[str, float]:
    """Return named numbers from the JSON of a column; NaN where it says null."""
    return {name: number_or_nan(value) for name, value in json.loads(text).items()}


def number_or_nan(value: float | None) -> float:
    """Return a number of a column; NaN for NULL."""
    return math.nan if value is None else value


def series_row(series: StoredSeries) -> tuple[dict[str, Any], str]:
    """Return a series as the row of a file or a server, and its test field as text."""
    csv = testfield_csv(series.testfield)
    row = {
        "camera": series.camera, "name": series.name, "start": series.start,
        "head": to_json(head_document(series.head)), "identity": to_json(series.identity),
        "settings": to_json(series.settings), "digest": hashlib.sha256(csv.encode()).hexdigest(),
        "created_utc": series.created_utc,
    }  # fmt: skip
    return row, csv


def insert_series(connection: sqlite3.Connection, series: StoredSeries) -> None:
    """Insert a series, and its test field if it is new, in the caller's transaction."""
    row, csv = series_row(series)
    *texts, created = row.values()
    connection.execute(
        "INSERT OR IGNORE INTO testfield (digest, csv) VALUES (?, ?)", (row["digest"], csv)
    )
    connection.execute(
        "INSERT INTO series (camera, name, start, head, identity, settings, created_utc, checksum, "
        "testfield_id) SELECT :camera, :name, :start, :head, :identity, :settings, :created_utc, "
        ":checksum, id FROM testfield WHERE digest = :digest",
        {**row, "checksum": row_checksum((created,), texts)},
    )


def parse_series(
    path: Path | str, key: int, head: str, csv: str, start: str, identity: str, settings: str,
    created: float,
) -> StoredSeries:  # fmt: skip
    """Return a series from the row of a file or a server; `path` is for the messages."""
    return StoredSeries(
        key, parse_head(json.loads(head), path), parse_testfield(csv, path), start,
        json.loads(identity), json.loads(settings), created,
    )  # fmt: skip


def select_series(connection: sqlite3.Connection, path: Path) -> Iterator[StoredSeries]:
    """Yield all series in the order in which they were begun; `path` is for the messages."""
    rows = connection.execute(
        "SELECT s.id, created_utc, s.checksum, csv, camera, name, start, head, identity, settings, "
        "digest FROM series s JOIN testfield t ON t.id = testfield_id ORDER BY s.id"
    ).fetchall()
    if not rows and connection.execute("SELECT 1 FROM epoch LIMIT 1").fetchone():
        known = connection.execute("SELECT 1 FROM series JOIN testfield LIMIT 1").fetchone()
        if known is None:
            raise StoreError(f"{path}: is damaged: its series or test fields are missing")
    for id_, created, kept, csv, *texts in rows:
        camera, name, start, head, identity, settings, digest = texts
        what = f"{path}: series {camera}/{name}"
        require_checksum(kept, what, (created,), texts)
        if hashlib.sha256(csv.encode(errors="surrogateescape")).hexdigest() != digest:
            raise StoreError(f"{what}: its test field does not match its digest; restore a backup")
        file_name(camera, f"{what}: camera", StoreError)
        file_name(name, f"{what}: series", StoreError)
        found = parse_series(path, id_, head, csv, start, identity, settings, created)
        if (found.camera, found.name) != (camera, name):
            raise StoreError(f"{what}: its head names {found.camera!r}/{found.name!r}")
        yield found


def to_json(mapping: Mapping[str, Any]) -> str:
    """Return a mapping as JSON; other values, such as paths, become text."""
    return json.dumps(dict(mapping), default=str)


@dataclass(frozen=True, slots=True)
class Gap:
    """Epochs `first` to `last` of a series that are missing in the store."""

    camera: str
    series: str
    first: int
    last: int

    @property
    def text(self) -> str:
        """The gap in a sentence."""
        where = f"{self.camera}/{self.series}"
        if self.first == self.last:
            return f"{where}: epoch {self.first} is missing"
        count = self.last - self.first + 1
        return f"{where}: epochs {self.first} to {self.last} are missing ({count})"


@dataclass(frozen=True, slots=True)
class Examination:
    """The result of reading a whole store.

    damaged: phrases; epochs: number of their rows; unfinished: the last write to the -wal file was
    cut off.
    """

    damaged: tuple[str, ...]
    gaps: tuple[Gap, ...]
    epochs: int
    unfinished: bool = False


def examine(connection: sqlite3.Connection) -> Examination:
    """Read everything. Raises sqlite3.Error if the file's structure is broken."""
    damaged = [
        f"the file's structure: {verdict}"
        for (verdict,) in connection.execute("PRAGMA integrity_check(20)")
        if verdict != "ok"
    ]
    cameras = dict(connection.execute("SELECT id, camera || '/' || name FROM series"))
    for table in KEPT:
        for row in whole_rows(connection, table, "NOT INDEXED ORDER BY id"):
            if row["damage"] and table == "epoch":
                series = row["series_id"]
                damaged.append(f"{cameras.get(series, f'series {series}')}, epoch {row['number']}")
            elif row["damage"]:
                damaged.append(row["damage"].partition(":")[0])
    damaged += checked_chunks(connection)
    # a later calibration of an epoch is another row of it
    (epochs,) = connection.execute(
        "SELECT count(*) FROM (SELECT DISTINCT series_id, number FROM epoch)"
    ).fetchone()
    (orphans,) = connection.execute(
        "SELECT count(DISTINCT id / 1024) FROM detail "
        "WHERE id / 1024 NOT IN (SELECT id FROM epoch NOT INDEXED)"
    ).fetchone()
    if orphans:
        damaged.append(f"{orphans} epochs have observations but no row")
    gaps = connection.execute(
        "SELECT camera, name, before + 1, number - 1 FROM (SELECT series_id, number, "
        "lag(number, 1, 0) OVER (PARTITION BY series_id ORDER BY number) AS before "
        "FROM (SELECT DISTINCT series_id, number FROM epoch)) JOIN series ON series.id = series_id "
        "WHERE number > before + 1 ORDER BY series_id, number"
    )
    return Examination(tuple(damaged), tuple(Gap(*gap) for gap in gaps), epochs)


def whole_rows(
    connection: sqlite3.Connection, table: str, condition: str, values: Sequence[Any] = ()
) -> Iterator[dict[str, Any]]:
    """Yield rows of a table in KEPT as `examined_rows` does, without the file's checksums.

    An epoch also has `covariance` and `observations`, packed bytes or None.
    """
    for row in examined_rows(connection, table, condition, values):
        if table == "epoch" and not row["damage"]:
            try:
                covariance, observations = read_details(connection, row)
                row |= {"covariance": covariance or None, "observations": observations or None}
            except StoreError as error:
                row["damage"] = str(error)
        del row["checksum"]
        row.pop("detail_checksum", None)
        yield row


@dataclass(frozen=True, slots=True)
class KeptFrame:
    """An epoch and its frame.

    id: of the epoch's row; path: relative to the frames' folder, None without a frame; eventful:
    the epoch has no result, or an event of the camera.
    """

    id: int
    series: int
    number: int
    frame_time: float
    path: Path | None
    eventful: bool
