"""The store's tables, its version, and the steps that bring older versions up to date.

A step is SQL text and frozen once it was released: it depends on no other module, so a change to
the program cannot change what an old step makes. A change to the tables is a new step. A new store
is made by the same steps that bring an old one up to date.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import sqlite3

__all__ = ["APPLICATION_ID", "PAGE_SIZE", "STEPS", "VERSION", "migrate"]

APPLICATION_ID = 0x74686572  # "ther": distinguishes our files from other SQLite files

# 4 KiB pages would hold one row of 2.1 to 4 kB each and stand half empty.
PAGE_SIZE = 8192

_TABLES = (
    """CREATE TABLE testfield (
        id INTEGER PRIMARY KEY, digest TEXT NOT NULL UNIQUE, csv TEXT NOT NULL)""",
    """CREATE TABLE series (
        id INTEGER PRIMARY KEY, camera TEXT NOT NULL, name TEXT NOT NULL, start TEXT NOT NULL,
        created_utc REAL NOT NULL, testfield_id INTEGER NOT NULL REFERENCES testfield(id),
        head TEXT NOT NULL, identity TEXT NOT NULL, settings TEXT NOT NULL,
        UNIQUE (camera, name))""",
    # a later calibration of the same epoch is a new row with a higher revision
    """CREATE TABLE epoch (
        id INTEGER PRIMARY KEY, series_id INTEGER NOT NULL REFERENCES series(id),
        number INTEGER NOT NULL, revision INTEGER NOT NULL, frame_time REAL NOT NULL,
        temperature_time REAL, clock_trusted INTEGER NOT NULL, status TEXT NOT NULL,
        sigma0 REAL, redundancy INTEGER NOT NULL, n_observations INTEGER NOT NULL,
        n_rejected INTEGER NOT NULL, measured INTEGER,
        c REAL, sd_c REAL, x0 REAL, sd_x0 REAL, y0 REAL, sd_y0 REAL, A1 REAL, sd_A1 REAL, A2
        REAL, sd_A2 REAL, A3 REAL, sd_A3 REAL, B1 REAL, sd_B1 REAL, B2 REAL, sd_B2
        REAL, C1 REAL, sd_C1 REAL, C2 REAL, sd_C2 REAL, omega REAL, sd_omega REAL,
        phi REAL, sd_phi REAL, kappa REAL, sd_kappa REAL, centre_X0 REAL,
        sd_centre_X0 REAL, centre_Y0 REAL, sd_centre_Y0 REAL, centre_Z0 REAL,
        sd_centre_Z0 REAL,
        temperatures TEXT NOT NULL, extra TEXT NOT NULL, rejected TEXT NOT NULL,
        frame TEXT NOT NULL, note TEXT NOT NULL, reason TEXT NOT NULL,
        UNIQUE (series_id, number, revision))""",
    # id = epoch.id * 1024 + part: covariance and observations, cut so that pages fill
    "CREATE TABLE detail (id INTEGER PRIMARY KEY, data BLOB NOT NULL)",
    """CREATE TABLE event (
        id INTEGER PRIMARY KEY, utc REAL NOT NULL, kind TEXT NOT NULL, text TEXT NOT NULL,
        series_id INTEGER, epoch INTEGER, data TEXT NOT NULL)""",
    # append-only is enforced by the file itself, not by this program alone
    """CREATE TRIGGER testfield_update BEFORE UPDATE ON testfield
        BEGIN SELECT RAISE(ABORT, 'the store is append-only'); END""",
    """CREATE TRIGGER testfield_delete BEFORE DELETE ON testfield
        BEGIN SELECT RAISE(ABORT, 'the store is append-only'); END""",
    """CREATE TRIGGER series_update BEFORE UPDATE ON series
        BEGIN SELECT RAISE(ABORT, 'the store is append-only'); END""",
    """CREATE TRIGGER series_delete BEFORE DELETE ON series
        BEGIN SELECT RAISE(ABORT, 'the store is append-only'); END""",
    """CREATE TRIGGER epoch_update BEFORE UPDATE ON epoch
        BEGIN SELECT RAISE(ABORT, 'the store is append-only'); END""",
    """CREATE TRIGGER epoch_delete BEFORE DELETE ON epoch
        BEGIN SELECT RAISE(ABORT, 'the store is append-only'); END""",
    """CREATE TRIGGER detail_update BEFORE UPDATE ON detail
        BEGIN SELECT RAISE(ABORT, 'the store is append-only'); END""",
    """CREATE TRIGGER detail_delete BEFORE DELETE ON detail
        BEGIN SELECT RAISE(ABORT, 'the store is append-only'); END""",
    """CREATE TRIGGER event_update BEFORE UPDATE ON event
        BEGIN SELECT RAISE(ABORT, 'the store is append-only'); END""",
    """CREATE TRIGGER event_delete BEFORE DELETE ON event
        BEGIN SELECT RAISE(ABORT, 'the store is append-only'); END""",
)

# Derived from `epoch`, and rebuilt from it at any time: whole columns as arrays.
_COLUMN_CHUNKS = (
    """CREATE TABLE column_chunk (
        id INTEGER PRIMARY KEY, series_id INTEGER NOT NULL REFERENCES series(id),
        name TEXT NOT NULL, first_row INTEGER NOT NULL, last_number INTEGER NOT NULL,
        data BLOB NOT NULL, UNIQUE (series_id, name, first_row))""",
    # calibrations of epochs whose chunk had been written before
    "CREATE TABLE late_epoch (epoch_id INTEGER PRIMARY KEY, series_id INTEGER NOT NULL)",
    "CREATE TABLE status_code (code INTEGER PRIMARY KEY, status TEXT NOT NULL UNIQUE)",
    "INSERT INTO status_code (status) SELECT DISTINCT status FROM epoch",
)

_READINGS = (
    """CREATE TABLE reading (
        id INTEGER PRIMARY KEY, thermometer TEXT NOT NULL, utc REAL NOT NULL,
        clock_trusted INTEGER NOT NULL, temperatures TEXT NOT NULL)""",
    "CREATE INDEX reading_thermometer ON reading (thermometer, utc)",
    """CREATE TRIGGER reading_update BEFORE UPDATE ON reading
        BEGIN SELECT RAISE(ABORT, 'the store is append-only'); END""",
    """CREATE TRIGGER reading_delete BEFORE DELETE ON reading
        BEGIN SELECT RAISE(ABORT, 'the store is append-only'); END""",
)

# NULL in rows of older versions: what was not checked when it was written cannot be checked now.
_CHECKSUMS = (
    "ALTER TABLE epoch ADD COLUMN checksum INTEGER",
    "ALTER TABLE epoch ADD COLUMN detail_checksum INTEGER",
    "ALTER TABLE series ADD COLUMN checksum INTEGER",
    "ALTER TABLE event ADD COLUMN checksum INTEGER",
    "ALTER TABLE reading ADD COLUMN checksum INTEGER",
    "ALTER TABLE column_chunk ADD COLUMN checksum INTEGER",
)

STEPS: tuple[tuple[str, ...], ...] = (_TABLES, _COLUMN_CHUNKS, _READINGS, _CHECKSUMS)
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
            for statement in step:
                connection.execute(statement)
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {max(current, target)}")
    except BaseException:
        connection.execute("ROLLBACK")
        raise
    connection.execute("COMMIT")
