"""Copies of a store's file: a verified one to keep, a private one where it cannot be opened.

SQLite keeps what was committed last in the file `<store>-wal` until it is moved into the store. To
read it, the helper file `-shm` must be there, or be made; a file opened with `immutable=1`
is read without it, and lacks those epochs.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from thermocald.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["copy_database", "open_copy"]

_ATTEMPTS = 3


def copy_database(source: sqlite3.Connection, target: Path) -> None:
    """Copy what a connection sees to a file that appears whole or not at all (online backup).

    A writer is not held up. Raises OSError or sqlite3.Error.
    """
    partial = target.with_name(f".{target.name}.partial")
    try:
        partial.unlink(missing_ok=True)
        partial.touch()  # SQLite would not say why it cannot
        with closing(sqlite3.connect(partial)) as copy:
            source.backup(copy)
            copy.execute("PRAGMA journal_mode = DELETE")
        descriptor = os.open(partial, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        os.replace(partial, target)
    except BaseException:
        for name in (partial, partial.with_name(f"{partial.name}-journal")):
            with suppress(OSError):
                name.unlink(missing_ok=True)
        raise


def open_copy(
    path: Path, change: Callable[[sqlite3.Connection], None] | None = None
) -> sqlite3.Connection:
    """Open a store whose folder cannot be written, with all that its -wal file holds.

    Without a -wal file it is read where it is. Else file and -wal are copied to the folder for
    temporary files, joined there and opened; the copy is gone with the connection. change: made to
    the copy first, which then is needed in any case. Raises StoreError, sqlite3.Error.
    """
    wal = Path(f"{path.resolve()}-wal")  # SQLite follows links too
    if change is None and not (wal.exists() and wal.stat().st_size):
        return _connect(path, "mode=ro&immutable=1")
    try:
        folder = Path(tempfile.mkdtemp(prefix="thermocald-"))
    except OSError as error:
        raise StoreError(f"{path}: no private copy can be made: {error}") from error
    try:
        copy = folder / "copy.db"
        _copy_files(path, wal, copy)
        with closing(_connect(copy, "mode=rw")) as connection:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            if change is not None:
                change(connection)
            connection.execute("PRAGMA journal_mode = DELETE")
        opened = _connect(copy, "mode=ro&immutable=1")
        opened.execute("SELECT 1 FROM sqlite_master").fetchone()  # opens the file before it goes
        return opened
    except OSError as error:
        raise StoreError(f"{path}: no private copy can be made: {error}") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _copy_files(path: Path, wal: Path, copy: Path) -> None:
    """Copy file and -wal as they are at one time: a writer elsewhere may be at work."""
    for _ in range(_ATTEMPTS):
        before = _state(path), _state(wal)
        shutil.copyfile(path, copy)
        if before[1] is not None:
            shutil.copyfile(wal, f"{copy}-wal")
        if (_state(path), _state(wal)) == before:
            return
    raise StoreError(
        f"{path}: is being written by another process, and its -shm file may not be read by you; "
        "join that user's group, or use sudo"
    )


def _state(path: Path) -> tuple[int, int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns


def _connect(path: Path, options: str) -> sqlite3.Connection:
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?{options}",
        uri=True,
        isolation_level=None,
        check_same_thread=False,
    )
    connection.text_factory = lambda data: data.decode(errors="surrogateescape")
    return connection
