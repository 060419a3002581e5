"""The tables of the store, its version, and how older versions become newer ones.

A new store is made by the same steps that bring an old one up to date, so that every step runs
whenever a store is made. A step is never changed once it was released; a change is a new step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable, Sequence

__all__ = ["APPLICATION_ID", "PAGE_SIZE", "STEPS", "VERSION", "migrate", "sql_name"]

APPLICATION_ID = 0x74686572  # "ther": tells our files from other SQLite files

# 4 KiB pages would hold one row of 2.1 to 4 kB each and stand half empty.
PAGE_SIZE = 8192


def sql_name(name: str) -> str:
    """The column of a field: SQL knows no case, and x0 must not be X0."""
    return f"{name[:-2]}centre_{name[-2:]}" if name[-2:] in ("X0", "Y0", "Z0") else name


_PARAMETERS = ", ".join(
    f"{sql_name(name)} REAL, {sql_name('sd_' + name)} REAL" for name in PARAMETER_NAMES
)


# Append-only is promised by the file itself, not by this program alone.
def _append_only(table: str) -> list[str]:
    return [
        f"CREATE TRIGGER {table}_{verb.lower()} BEFORE {verb} ON {table} "
        f"BEGIN SELECT RAISE(ABORT, 'the store is append-only'); END"
        for verb in ("UPDATE", "DELETE")
    ]


_KEPT_TABLES = ("testfield", "series", "epoch", "detail", "event")
_TRIGGERS = [trigger for table in _KEPT_TABLES for trigger in _append_only(table)]

_BASE = [
    """CREATE TABLE testfield (
        id INTEGER PRIMARY KEY, digest TEXT NOT NULL UNIQUE, csv TEXT NOT NULL)""",
    """CREATE TABLE series (
        id INTEGER PRIMARY KEY, camera TEXT NOT NULL, name TEXT NOT NULL, start TEXT NOT NULL,
        created_utc REAL NOT NULL, testfield_id INTEGER NOT NULL REFERENCES testfield(id),
        head TEXT NOT NULL, identity TEXT NOT NULL, settings TEXT NOT NULL,
        UNIQUE (camera, name))""",
    # a later calibration of the same epoch is a new row with a higher revision
    f"""CREATE TABLE epoch (
        id INTEGER PRIMARY KEY, series_id INTEGER NOT NULL REFERENCES series(id),
        number INTEGER NOT NULL, revision INTEGER NOT NULL, frame_time REAL NOT NULL,
        temperature_time REAL, clock_trusted INTEGER NOT NULL, status TEXT NOT NULL,
        sigma0 REAL, redundancy INTEGER NOT NULL, n_observations INTEGER NOT NULL,
        n_rejected INTEGER NOT NULL, measured INTEGER, {_PARAMETERS},
        temperatures TEXT NOT NULL, extra TEXT NOT NULL, rejected TEXT NOT NULL,
        frame TEXT NOT NULL, note TEXT NOT NULL, reason TEXT NOT NULL,
        UNIQUE (series_id, number, revision))""",
    # id = epoch.id * 1024 + part: covariance and observations, cut so that pages fill
    "CREATE TABLE detail (id INTEGER PRIMARY KEY, data BLOB NOT NULL)",
    """CREATE TABLE event (
        id INTEGER PRIMARY KEY, utc REAL NOT NULL, kind TEXT NOT NULL, text TEXT NOT NULL,
        series_id INTEGER, epoch INTEGER, data TEXT NOT NULL)""",
    *_TRIGGERS,
]

# Derived from `epoch`, and rebuilt from it at any time: whole columns as arrays.
_COLUMN_CHUNKS = [
    """CREATE TABLE column_chunk (
        id INTEGER PRIMARY KEY, series_id INTEGER NOT NULL REFERENCES series(id),
        name TEXT NOT NULL, first_row INTEGER NOT NULL, last_number INTEGER NOT NULL,
        data BLOB NOT NULL, UNIQUE (series_id, name, first_row))""",
    # calibrations of epochs whose chunk had been written before
    "CREATE TABLE late_epoch (epoch_id INTEGER PRIMARY KEY, series_id INTEGER NOT NULL)",
    "CREATE TABLE status_code (code INTEGER PRIMARY KEY, status TEXT NOT NULL UNIQUE)",
    "INSERT INTO status_code (status) SELECT DISTINCT status FROM epoch",
]

_READINGS = [
    """CREATE TABLE reading (
        id INTEGER PRIMARY KEY, thermometer TEXT NOT NULL, utc REAL NOT NULL,
        clock_trusted INTEGER NOT NULL, temperatures TEXT NOT NULL)""",
    "CREATE INDEX reading_thermometer ON reading (thermometer, utc)",
    *_append_only("reading"),
]


def _run(statements: Sequence[str]) -> Callable[[sqlite3.Connection], None]:
    def step(connection: sqlite3.Connection) -> None:
        for statement in statements:
            connection.execute(statement)

    return step


def _add_column_chunks(connection: sqlite3.Connection) -> None:
    from thermocald.store.database.columns import build_missing_chunks

    _run(_COLUMN_CHUNKS)(connection)
    for (series,) in connection.execute("SELECT id FROM series").fetchall():
        build_missing_chunks(connection, series)


STEPS: tuple[Callable[[sqlite3.Connection], None], ...] = (
    _run(_BASE),
    _add_column_chunks,
    _run(_READINGS),
)
VERSION = len(STEPS)


def migrate(connection: sqlite3.Connection, version: int, target: int = VERSION) -> None:
    """Bring a store from `version` (0: an empty file) to `target`, all or nothing.

    The connection must be in autocommit mode. Raises sqlite3.Error.
    """
    connection.execute("BEGIN IMMEDIATE")
    try:
        # another process may have been faster
        (current,) = connection.execute("PRAGMA user_version").fetchone()
        for step in STEPS[max(current, version) : target]:
            step(connection)
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {max(current, target)}")
    except BaseException:
        connection.execute("ROLLBACK")
        raise
    connection.execute("COMMIT")
