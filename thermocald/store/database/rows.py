"""Series, events, and readings apart from epochs, as rows of the store."""

from __future__ import annotations

import hashlib
import json
import logging
from typing import TYPE_CHECKING

from thermocald.errors import StoreError
from thermocald.names import file_name
from thermocald.store.database.columns import require_checksum, row_checksum
from thermocald.store.recording.head import Head, head_document, parse_head
from thermocald.store.recording.testfield_file import parse_testfield, testfield_csv
from thermocald.store.series import Event, LoggedReading, StoredSeries

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path
    from typing import Any

    from thermocald.photogrammetry.field.testfield import TestField

log = logging.getLogger(__name__)


def insert_series(
    connection: sqlite3.Connection,
    head: Head,
    testfield: TestField,
    start: str,
    identity: Mapping[str, Any],
    settings: Mapping[str, Any],
    created_utc: float,
) -> None:
    """Insert a series, and its test field if it is a new one; within the caller's transaction."""
    csv = testfield_csv(testfield)
    digest = hashlib.sha256(csv.encode()).hexdigest()
    connection.execute("INSERT OR IGNORE INTO testfield (digest, csv) VALUES (?, ?)", (digest, csv))
    texts = (
        head.camera.name,
        head.series,
        start,
        _json(head_document(head)),
        _json(identity),
        _json(settings),
    )
    connection.execute(
        "INSERT INTO series (camera, name, start, head, identity, settings, created_utc, checksum, "
        "testfield_id) SELECT ?, ?, ?, ?, ?, ?, ?, ?, id FROM testfield WHERE digest = ?",
        (*texts, created_utc, row_checksum((created_utc,), (*texts, digest)), digest),
    )


def select_series(
    connection: sqlite3.Connection, path: Path, camera: str | None, name: str | None
) -> list[StoredSeries]:
    """The series of a camera and a name, None for any; `path` is for the messages."""
    rows = connection.execute(
        "SELECT s.id, created_utc, s.checksum, csv, camera, name, start, head, identity, settings, "
        "digest FROM series s "
        "JOIN testfield t ON t.id = testfield_id "
        "WHERE camera = ifnull(?, camera) AND name = ifnull(?, name) ORDER BY s.id",
        (camera, name),
    ).fetchall()
    if not rows and connection.execute("SELECT 1 FROM epoch LIMIT 1").fetchone():
        known = connection.execute("SELECT 1 FROM series JOIN testfield LIMIT 1").fetchone()
        if known is None:
            raise StoreError(f"{path}: is damaged: its series or test fields are gone")
    return [_series(path, *row) for row in rows]


def _series(
    path: Path, number: int, created: float, kept: int, csv: str, *texts: str
) -> StoredSeries:
    camera, name, start, head, identity, settings, digest = texts
    what = f"{path}: series {camera}/{name}"
    require_checksum(kept, what, (created,), texts)
    if hashlib.sha256(csv.encode(errors="surrogateescape")).hexdigest() != digest:
        raise StoreError(f"{what}: its test field is damaged: it is not what its digest says")
    file_name(camera, f"{what}: camera", StoreError)
    file_name(name, f"{what}: series", StoreError)
    parsed = parse_head(json.loads(head), path)
    if (parsed.camera.name, parsed.series) != (camera, name):
        raise StoreError(f"{what}: its head is of {parsed.camera.name!r}/{parsed.series!r}")
    return StoredSeries(
        number,
        parsed,
        parse_testfield(csv, path),
        start,
        json.loads(identity),
        json.loads(settings),
        created,
    )


def insert_events(connection: sqlite3.Connection, events: Iterable[Event]) -> None:
    """Insert events; within the caller's transaction."""
    rows = []
    for event in events:
        numbers = (event.utc, event.series, event.epoch)
        texts = (event.kind, event.text, _json(event.data))
        rows.append((*numbers, *texts, row_checksum(numbers, texts)))
    connection.executemany(
        "INSERT INTO event (utc, series_id, epoch, kind, text, data, checksum) "
        "VALUES (?, ?, ?, ?, ?, ?, ?)",
        rows,
    )


def select_events(
    connection: sqlite3.Connection, series: int | None, since_utc: float
) -> list[Event]:
    """Events of a series, None for all, from a time on, in the order they were kept.

    One that is damaged is left out, with a warning: what is computed does not depend on it.
    """
    rows = connection.execute(
        "SELECT checksum, id, utc, series_id, epoch, kind, text, data FROM event WHERE utc >= ? "
        "AND series_id IS ifnull(?, series_id) ORDER BY id",
        (since_utc, series),
    ).fetchall()
    events = []
    for kept, id_, utc, series_id, epoch, kind, text, data in rows:
        if _sound(kept, f"event {id_}", (utc, series_id, epoch), (kind, text, data)):
            events.append(Event(utc, kind, text, series_id, epoch, json.loads(data)))
    return events


def insert_readings(connection: sqlite3.Connection, readings: Iterable[LoggedReading]) -> None:
    """Insert readings; within the caller's transaction."""
    rows = []
    for reading in readings:
        numbers = (reading.utc, int(reading.clock_trusted))
        texts = (reading.thermometer, _json(reading.values))
        rows.append((*numbers, *texts, row_checksum(numbers, texts)))
    connection.executemany(
        "INSERT INTO reading (utc, clock_trusted, thermometer, temperatures, checksum) "
        "VALUES (?, ?, ?, ?, ?)",
        rows,
    )


def select_readings(
    connection: sqlite3.Connection,
    thermometer: str | None,
    since_utc: float,
    after: int,
    limit: int,
) -> tuple[int, list[LoggedReading]]:
    """Readings of a thermometer, None for all, from a time on, in the order they were kept.

    after: the row that the ones before ended with; returns that of these, 0 if there are no more.
    One that is damaged is left out, with a warning.
    """
    rows = connection.execute(
        "SELECT checksum, id, utc, clock_trusted, thermometer, temperatures FROM reading "
        "WHERE id > ? AND utc >= ? AND thermometer = ifnull(?, thermometer) ORDER BY id LIMIT ?",
        (after, since_utc, thermometer, limit),
    ).fetchall()
    readings = []
    for kept, id_, utc, trusted, name, values in rows:
        if _sound(kept, f"reading {id_}", (utc, trusted), (name, values)):
            file_name(name, "thermometer", StoreError)
            readings.append(LoggedReading(name, utc, json.loads(values), bool(trusted)))
    return (rows[-1][1] if len(rows) == limit else 0), readings


def _sound(kept: int, what: str, numbers: Sequence[Any], texts: Sequence[str]) -> bool:
    try:
        require_checksum(kept, what, numbers, texts)
    except StoreError as error:
        log.warning("%s; it is left out", error)
        return False
    return True


def _json(mapping: Mapping[str, Any]) -> str:
    return json.dumps(dict(mapping), default=str)
