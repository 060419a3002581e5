"""Series, events, and readings apart from epochs, as rows of the store."""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING

from thermocald.store.database.row import Event, LoggedReading, StoredSeries
from thermocald.store.recording.head import Head, head_document, parse_head
from thermocald.store.recording.testfield_file import parse_testfield, testfield_csv

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path
    from typing import Any

    from thermocald.photogrammetry.field.testfield import TestField

__all__ = [
    "insert_events",
    "insert_readings",
    "insert_series",
    "select_events",
    "select_readings",
    "select_series",
]


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
    connection.execute(
        "INSERT INTO series (camera, name, start, created_utc, head, identity, settings, "
        "testfield_id) SELECT ?, ?, ?, ?, ?, ?, ?, id FROM testfield WHERE digest = ?",
        (
            head.camera.name,
            head.series,
            start,
            created_utc,
            _json(head_document(head)),
            _json(identity),
            _json(settings),
            digest,
        ),
    )


def select_series(
    connection: sqlite3.Connection, path: Path, camera: str | None, name: str | None
) -> list[StoredSeries]:
    """The series of a camera and a name, None for any; `path` is for the messages."""
    rows = connection.execute(
        "SELECT s.id, head, csv, start, identity, settings, created_utc FROM series s "
        "JOIN testfield t ON t.id = testfield_id "
        "WHERE camera = ifnull(?, camera) AND name = ifnull(?, name) ORDER BY s.id",
        (camera, name),
    ).fetchall()
    return [
        StoredSeries(
            number,
            parse_head(json.loads(head), path),
            parse_testfield(csv, path),
            start,
            json.loads(identity),
            json.loads(settings),
            created,
        )
        for number, head, csv, start, identity, settings, created in rows
    ]


def insert_events(connection: sqlite3.Connection, events: Iterable[Event]) -> None:
    """Insert events; within the caller's transaction."""
    connection.executemany(
        "INSERT INTO event (utc, kind, text, series_id, epoch, data) VALUES (?, ?, ?, ?, ?, ?)",
        [(e.utc, e.kind, e.text, e.series, e.epoch, _json(e.data)) for e in events],
    )


def select_events(
    connection: sqlite3.Connection, series: int | None, since_utc: float
) -> list[Event]:
    """Events of a series, None for all, from an instant on, in the order they were kept."""
    rows = connection.execute(
        "SELECT utc, kind, text, series_id, epoch, data FROM event WHERE utc >= ? "
        "AND series_id IS ifnull(?, series_id) ORDER BY id",
        (since_utc, series),
    ).fetchall()
    return [
        Event(utc, kind, text, series_id, epoch, json.loads(data))
        for utc, kind, text, series_id, epoch, data in rows
    ]


def insert_readings(connection: sqlite3.Connection, readings: Iterable[LoggedReading]) -> None:
    """Insert readings; within the caller's transaction."""
    connection.executemany(
        "INSERT INTO reading (thermometer, utc, clock_trusted, temperatures) VALUES (?, ?, ?, ?)",
        [(r.thermometer, r.utc, int(r.clock_trusted), _json(r.values)) for r in readings],
    )


def select_readings(
    connection: sqlite3.Connection, thermometer: str | None, since_utc: float
) -> Iterator[LoggedReading]:
    """Readings of a thermometer, None for all, from an instant on, in the order they were kept."""
    for name, utc, trusted, values in connection.execute(
        "SELECT thermometer, utc, clock_trusted, temperatures FROM reading WHERE utc >= ? "
        "AND thermometer = ifnull(?, thermometer) ORDER BY id",
        (since_utc, thermometer),
    ):
        yield LoggedReading(name, utc, json.loads(values), bool(trusted))


def _json(mapping: Mapping[str, Any]) -> str:
    return json.dumps(dict(mapping), default=str)
