"""Opening the store's SQLite file, and its errors in words."""

from __future__ import annotations

import logging
import os
import sqlite3
from contextlib import contextmanager
from typing import TYPE_CHECKING, Literal

from thermocald.errors import StoreError, StoreFullError, StoreVersionError, ThermocaldError
from thermocald.store.database.checksum import DamageError
from thermocald.store.database.columns import build_all_chunks
from thermocald.store.database.copies import copy_database, open_copy
from thermocald.store.database.migrations import APPLICATION_ID, PAGE_SIZE, VERSION, migrate

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["Mode", "connect", "in_words"]

log = logging.getLogger(__name__)

Mode = Literal["read", "append"]

_BUSY_S = 10.0
# A quota or a limit on the size of files shows as an error of writing or growing a file.
_NO_ROOM = ("SQLITE_FULL", "SQLITE_IOERR_WRITE", "SQLITE_IOERR_TRUNCATE", "SQLITE_IOERR_SHMSIZE")
# A small card must not be full of what waits to be moved; a replay need not sync so often.
_WAL_LIMIT_BYTES = {True: 1_000_000, False: 4_000_000}  # durable or not
_MMAP_BYTES = 2**31 - 1


@contextmanager
def in_words(path: Path, doing: str, *, reading: bool = False) -> Iterator[None]:
    """Turn SQLite's errors into a StoreError that says what to do.

    reading: what was read may be no text or number of ours, which tells of damage as well.
    """
    try:
        yield
    except DamageError as error:
        if str(error).startswith(str(path)):
            raise
        raise DamageError(f"{path}: {error}") from error
    except ThermocaldError:
        raise
    except sqlite3.Error as cause:
        full = _name(cause).startswith(_NO_ROOM)
        kind = StoreFullError if full else StoreError
        raise kind(f"{path}: {doing}: {_advice(cause)}") from cause
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as cause:
        if not reading:
            raise
        raise StoreError(f"{path}: {doing}: the store is damaged ({cause})") from cause


def _name(cause: sqlite3.Error) -> str:
    """SQLite's name of the error, such as SQLITE_IOERR_WRITE; empty where Python raised it."""
    return getattr(cause, "sqlite_errorname", "") or ""


def _advice(cause: sqlite3.Error) -> str:
    name = _name(cause)
    if name.startswith("SQLITE_FULL"):
        return "the disk is full; free some space, nothing that was stored before is lost"
    if name.startswith("SQLITE_IOERR"):
        return f"the disk failed or is full ({cause}); what was stored before is not touched"
    if name.startswith(("SQLITE_READONLY", "SQLITE_PERM")):
        return "the file or its folder is read-only; make it writable or choose another store"
    if name.startswith("SQLITE_CANTOPEN"):
        return "it cannot be opened; does its folder exist, and may this user write there?"
    if name.startswith("SQLITE_BUSY"):
        return f"another process kept it locked for more than {_BUSY_S:g} s"
    if name.startswith(("SQLITE_NOTADB", "SQLITE_CORRUPT")):
        return f"it is not a store, or it is damaged ({cause})"
    return str(cause)


def connect(path: Path, mode: Mode, *, durable: bool) -> sqlite3.Connection:
    """Open or, for appending, make the file; older versions are brought up to date.

    Raises StoreError, StoreVersionError for a file of a newer program.
    """
    if mode == "read" and not path.is_file():
        raise StoreError(f"{path}: there is no such store")
    with in_words(path, "the store cannot be opened", reading=True):
        connection = _open(path, mode)
    try:
        with in_words(path, "the store cannot be opened", reading=True):
            version = _version(connection, path)
            if version == 0 and mode == "read":
                raise StoreError(f"{path}: is empty, nothing was stored yet")
            if version < VERSION:
                connection = _bring_up_to_date(connection, path, version, mode)
            if mode == "append":
                connection.execute("PRAGMA journal_mode = WAL")  # a restored backup has it not
                # with FULL, what is committed survives a power cut; with NORMAL, a killed process
                connection.execute(f"PRAGMA synchronous = {'FULL' if durable else 'NORMAL'}")
                limit = _WAL_LIMIT_BYTES[durable]
                connection.execute(f"PRAGMA journal_size_limit = {limit}")
                connection.execute(f"PRAGMA wal_autocheckpoint = {limit // PAGE_SIZE}")
            else:
                connection.execute(f"PRAGMA mmap_size = {_MMAP_BYTES}")
            connection.execute("PRAGMA foreign_keys = ON")
    except BaseException:
        connection.close()
        raise
    return connection


def _open(path: Path, mode: Mode) -> sqlite3.Connection:
    if mode == "append":
        return _connect(path, "rwc")
    connection = _connect(path, "ro")
    try:
        connection.execute("SELECT 1 FROM sqlite_master").fetchone()
    except sqlite3.OperationalError as cause:
        connection.close()
        # where its folder cannot be written, WAL's helper files cannot be made
        if not _name(cause).startswith(("SQLITE_CANTOPEN", "SQLITE_READONLY")):
            raise
        return open_copy(path)
    except BaseException:
        connection.close()
        raise
    return connection


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}",
        uri=True,
        timeout=_BUSY_S,
        isolation_level=None,  # transactions are begun and ended by hand
        check_same_thread=False,
    )
    # a damaged text must show as a wrong checksum of its row, not as an error of the whole query
    connection.text_factory = _text
    return connection


def _text(data: bytes) -> str:
    return data.decode(errors="surrogateescape")


def _version(connection: sqlite3.Connection, path: Path) -> int:
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (tables,) = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    if application != APPLICATION_ID and (tables or application or version):
        raise StoreError(f"{path}: is an SQLite file, but no thermocald store")
    if version > VERSION:
        copy = _copy_of_version(path, VERSION)
        older = f", or go on with {copy}, the copy made before" if copy.exists() else ""
        raise StoreVersionError(
            f"{path}: is a store of version {version}, this program knows up to {VERSION}; "
            f"update thermocald{older}"
        )
    return int(version)


def _bring_up_to_date(
    connection: sqlite3.Connection, path: Path, version: int, mode: Mode
) -> sqlite3.Connection:
    """Migrate; returns the connection to use, another one where the file cannot be written."""
    if mode == "read":
        if not os.access(path, os.W_OK) or not os.access(path.absolute().parent, os.W_OK):
            connection.close()
            return open_copy(path, _migrate)
        writing = _connect(path, "rw")
        try:
            _backup_version(writing, path, version)
            _migrate(writing)
            writing.execute("PRAGMA wal_checkpoint(TRUNCATE)")  # the reader keeps the log open
        finally:
            writing.close()
        return connection
    if version == 0:
        connection.execute(f"PRAGMA page_size = {PAGE_SIZE}")
    else:
        _backup_version(connection, path, version)
    connection.execute("PRAGMA journal_mode = WAL")
    _migrate(connection)
    return connection


def _migrate(connection: sqlite3.Connection) -> None:
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    migrate(connection, version)
    if version:
        build_all_chunks(connection)


def _copy_of_version(path: Path, version: int) -> Path:
    return path.with_name(f"{path.name}.version-{version}")


def _backup_version(connection: sqlite3.Connection, path: Path, version: int) -> None:
    """Copy an older file before it is changed: `<name>.version-<version>`, made once."""
    copy = _copy_of_version(path, version)
    if copy.exists():
        return
    try:
        copy_database(connection, copy)
    except (OSError, sqlite3.Error) as error:
        raise StoreError(
            f"{path}: is of version {version}; a backup of it must be made before it is brought "
            f"up to date, and {copy} cannot be written ({error}); nothing was changed"
        ) from error
    log.warning("%s: brought from version %d to %d; backup: %s", path, version, VERSION, copy)
