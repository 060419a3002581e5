"""The SQLite file of a store: lock it for one writer, open it, copy it, explain its errors.

The lock is on the file itself, under whatever name it was opened.
SQLite writes commits into the file `<store>-wal` and moves them into the store later. To read them,
the helper file `-shm` must exist or be created; a file opened with `immutable=1` is read without
it and lacks those epochs.

SQLite reads the frames of the -wal up to the first whose checksum does not match, and treats the
rest as cut off by a crash. That is right for the last transaction, which may not have been
committed. A transaction that is followed by another, or counted by the index in the -shm file, was
committed: a wrong checksum in it is damage.
Formats: https://www.sqlite.org/fileformat2.html#the_write_ahead_log,
https://www.sqlite.org/walformat.html#the_wal_index_file_format
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import shutil
import sqlite3
import struct
import tempfile
import time
import uuid
from contextlib import closing, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Literal

import numpy as np

from thermocald.errors import (
    OutputError,
    StoreBusyError,
    StoreError,
    StoreFullError,
    StoreVersionError,
    ThermocaldError,
)
from thermocald.files import cannot_write, is_ordinary, new_file, reading
from thermocald.store import schema
from thermocald.store.database.columns import DamageError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from numpy.typing import NDArray


log = logging.getLogger(__name__)

Mode = Literal["read", "append"]

_APPLICATION_ID = 0x74686572  # "ther": distinguishes a store from other SQLite files
# A page of 4 KiB would hold one row of 2.1 to 4 kB and be half empty.
_PAGE_SIZE = 8192
_BUSY_S = 10.0
# A quota or a limit on the size of files shows as an error of writing or growing a file.
_NO_ROOM = ("SQLITE_FULL", "SQLITE_IOERR_WRITE", "SQLITE_IOERR_TRUNCATE", "SQLITE_IOERR_SHMSIZE")
_READ_ONLY = "the file or its folder is read-only; make it writable or choose another store"
_NO_STORE = "it is not a store, or it is damaged ({})"
_ADVICE = {
    "SQLITE_FULL": "the disk is full; free some space; nothing stored before is lost",
    "SQLITE_IOERR": "the disk failed or is full ({}); what was stored before is unchanged",
    "SQLITE_READONLY": _READ_ONLY,
    "SQLITE_PERM": _READ_ONLY,
    "SQLITE_CANTOPEN": "it cannot be opened; check that its folder exists and may be written",
    "SQLITE_BUSY": "another program keeps it locked",
    "SQLITE_NOTADB": _NO_STORE,
    "SQLITE_CORRUPT": f"{_NO_STORE}; if a backup was copied here, remove the old -wal file first",
}
"""Advice by the beginning of SQLite's name of an error; {}: SQLite's message."""
# The -wal file must not fill a small card; a replay need not sync so often.
_WAL_LIMIT_BYTES = {True: 1_000_000, False: 16_000_000}  # durable or not
_WAL_LEAST_BYTES = 100_000  # for a disk that is full when a daemon starts, and freed later
_MMAP_BYTES = 2**31 - 1
_ATTEMPTS = 3
# SQLite's own locks of a file end when this process closes any descriptor of it, so a claimed file
# must not be opened a second time.
_CLAIMED: set[tuple[int, int]] = set()


class StoreFile:
    """A store's file with a lock, which the kernel releases however the process ends.

    Creates an empty file if there is none. Raises StoreError if it cannot be written, or if another
    process holds the lock.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._helpers: dict[str, tuple[int, ...]] = {}
        found = _identity(path)
        if found in _CLAIMED:
            raise _taken(path)
        self._made = found is None
        if found is not None and not path.is_dir() and not is_ordinary(path):
            raise StoreError(f"{path}: is a device or a pipe; a store must be a regular file")
        try:
            self._handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise StoreError(str(cannot_write(path, error))) from error
        status = os.fstat(self._handle)
        self.names = status.st_nlink
        self.identity = (status.st_dev, status.st_ino)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(self._handle)
            raise _taken(path) from error
        except OSError as error:
            self.discard_new()
            os.close(self._handle)
            raise StoreError(
                f"{path}: its folder cannot lock files ({error.strerror}), as some network folders "
                "cannot; choose a store on a disk of this machine"
            ) from error
        _CLAIMED.add(self.identity)

    def release(self) -> None:
        """Release the lock; close the database first."""
        _CLAIMED.discard(self.identity)
        os.close(self._handle)

    def discard_new(self) -> None:
        """Remove the file, and what SQLite put beside it, if it was created for the lock."""
        if self._made and self.there:
            for path in (self.path, *(helper(self.path, kind) for kind in HELPERS)):
                with suppress(OSError):  # its name may be too long
                    path.unlink()

    @property
    def deleted(self) -> bool:
        """Whether the file has no name any more."""
        return os.fstat(self._handle).st_nlink == 0

    @property
    def there(self) -> bool:
        """Whether the path still leads to this file."""
        return _identity(self.path) == self.identity

    def remember_helpers(self) -> None:
        """Remember which -wal and -shm files the open database uses, once they exist."""
        for kind in HELPERS:
            if kind not in self._helpers and (found := _identity(helper(self.path, kind))):
                self._helpers[kind] = found

    def helper_there(self, kind: str) -> bool:
        """Return whether a file of HELPERS is still the one remembered, or none was remembered."""
        return self._helpers.get(kind) in (None, _identity(helper(self.path, kind)))


HELPERS = ("wal", "shm")


def helper(path: Path, kind: str) -> Path:
    """Return the path of a store's -wal or -shm file, beside the target of a link."""
    return Path(f"{os.path.realpath(path)}-{kind}")  # `resolve` raises RuntimeError for a loop


def written_elsewhere(path: Path) -> bool:
    """Return whether a file is (or was, by a killed writer) written under another of its names.

    The latest commits are then in a -wal file that can be found from this name only if the other
    one is in the same folder. The file is not opened here, as closing it would end SQLite's locks
    of this process.
    """
    found = path.stat()
    wal = helper(path, "wal")
    if found.st_nlink < 2 or wal.exists():
        return False
    here = (found.st_dev, found.st_ino)
    for left in wal.parent.glob("*-wal"):
        if (
            _identity(left.with_name(left.name.removesuffix("-wal"))) == here
            and left.stat().st_size
        ):
            return True
    try:
        locks = Path("/proc/locks").read_text(encoding="ascii")
    except OSError:
        return False
    return any(
        "FLOCK" in line and line.split()[-3].rsplit(":", 1)[-1] == str(found.st_ino)
        for line in locks.splitlines()
    )


def _taken(path: Path) -> StoreError:
    return StoreError(
        f"{path}: another thermocald process writes to it; stop that one, or choose another store"
    )


def _identity(path: Path, *, data: bool = False) -> tuple[int, ...] | None:
    """Return what identifies a file under all its names; data: also its size and time."""
    try:
        status = path.stat()
    except OSError:
        return None
    found = status.st_dev, status.st_ino
    return (*found, status.st_size, status.st_mtime_ns) if data else found


@contextmanager
def in_words(path: Path, doing: str, *, reading: bool = False) -> Iterator[None]:
    """Turn SQLite's errors into a StoreError that says what to do.

    reading: errors of parsing what was read are damage of the store as well.
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
        name = _name(cause)
        kind = StoreFullError if name.startswith(_NO_ROOM) else StoreError
        kind = StoreBusyError if name.startswith("SQLITE_BUSY") else kind
        advice = next((text for start, text in _ADVICE.items() if name.startswith(start)), "{}")
        raise kind(f"{path}: {doing}: {advice.format(cause)}") from cause
    except (
        ValueError, TypeError, LookupError, AttributeError, RecursionError, OverflowError,
    ) as cause:  # fmt: skip
        if not reading and isinstance(cause, UnicodeEncodeError | OverflowError):
            raise StoreError(f"{path}: {doing}: {cause}") from cause
        if not reading:
            raise
        raise StoreError(f"{path}: {doing}: the store is damaged ({cause})") from cause


def _name(cause: BaseException) -> str:
    """Return SQLite's name of an error, such as SQLITE_IOERR_WRITE; empty for others."""
    return getattr(cause, "sqlite_errorname", "") or ""


def connect(path: Path, mode: Mode, *, durable: bool) -> sqlite3.Connection:
    """Open the file, or create it to append; an older version is upgraded.

    Raises StoreError; StoreVersionError for a file of a newer version.
    """
    with reading(path, StoreError):
        if mode == "read" and not path.is_file():
            there = "is a folder, not a store" if path.is_dir() else "there is no such store"
            raise StoreError(f"{path}: {there}")
    if mode == "read" and written_elsewhere(path):
        raise StoreError(
            f"{path}: is or was written under another of its names (hard links) and lacks the "
            "latest data; read it under that name"
        )
    with in_words(path, "the store cannot be opened", reading=True):
        connection = _open(path, mode)
        try:
            version = _version(connection, path)
            if version == 0 and mode == "read":
                raise StoreError(f"{path}: is empty; nothing has been stored yet")
            if version < len(schema.FILE_STEPS) and mode == "read":
                connection.close()
                connection = open_copy(path, _upgrade)  # reading must not change the file
            elif version < len(schema.FILE_STEPS):
                if version:
                    _backup_version(connection, path, version)
                else:
                    connection.execute(f"PRAGMA page_size = {_PAGE_SIZE}")
                connection.execute("PRAGMA journal_mode = WAL")
                _upgrade(connection)
            if mode == "append":
                connection.execute("PRAGMA journal_mode = WAL")  # a backup is not in WAL mode
                # with FULL, what is committed survives a power cut; with NORMAL, a killed process
                connection.execute(f"PRAGMA synchronous = {'FULL' if durable else 'NORMAL'}")
                free = shutil.disk_usage(helper(path, "wal").parent).free
                limit = min(_WAL_LIMIT_BYTES[durable], max(free // 4, _WAL_LEAST_BYTES))
                connection.execute(f"PRAGMA journal_size_limit = {limit}")
                connection.execute(f"PRAGMA wal_autocheckpoint = {limit // _PAGE_SIZE}")
            else:
                connection.execute(f"PRAGMA mmap_size = {_MMAP_BYTES}")
            connection.execute("PRAGMA foreign_keys = ON")
        except BaseException:
            connection.close()
            raise
    return connection


def _open(path: Path, mode: Mode) -> sqlite3.Connection:
    connection = _connect(path, "rwc" if mode == "append" else "ro")
    try:
        if mode == "read":
            connection.execute("SELECT 1 FROM sqlite_master").fetchone()
    except BaseException as cause:
        connection.close()
        # WAL's helper files cannot be created if the folder is read-only
        if not _name(cause).startswith(("SQLITE_CANTOPEN", "SQLITE_READONLY")):
            raise
        return open_copy(path)
    return connection


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}",
        uri=True,
        timeout=_BUSY_S,
        isolation_level=None,  # transactions are begun and ended by hand
        check_same_thread=False,
    )
    # a damaged text must give a wrong checksum of its row, not an error of the whole query
    connection.text_factory = lambda data: data.decode(errors="surrogateescape")
    return connection


def _version(connection: sqlite3.Connection, path: Path) -> int:
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (tables,) = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    if application != _APPLICATION_ID and (tables or application or version):
        raise StoreError(f"{path}: is an SQLite file, but not a thermocald store")
    known = len(schema.FILE_STEPS)
    if version > known:
        copy = _copy_of_version(path, known)
        older = f", or use {copy}, the backup made before" if copy.exists() else ""
        raise StoreVersionError(
            f"{path}: is a store of version {version}, but this program reads up to {known}; "
            f"update thermocald{older}"
        )
    return int(version)


def _upgrade(connection: sqlite3.Connection) -> None:
    """Upgrade a store of any version to this program's, in one transaction."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        # another process may have upgraded it meanwhile
        (before,) = connection.execute("PRAGMA user_version").fetchone()
        version = schema.upgrade(connection.execute, before, schema.FILE_STEPS)
        if not before:
            connection.execute("INSERT INTO store VALUES (1, ?)", (str(uuid.uuid4()),))
        connection.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {version}")
    except BaseException:
        connection.execute("ROLLBACK")
        raise
    connection.execute("COMMIT")


def _copy_of_version(path: Path, version: int) -> Path:
    return path.with_name(f"{path.name}.version-{version}")


def _backup_version(connection: sqlite3.Connection, path: Path, version: int) -> None:
    """Back up an older file before its upgrade, once, as `<name>.version-<version>`."""
    copy = _copy_of_version(path, version)
    if copy.exists():
        return
    try:
        copy_database(connection, copy)
    except (OutputError, sqlite3.Error) as error:
        raise StoreError(
            f"{path}: is of version {version} and must be backed up before its upgrade, but "
            f"{copy} cannot be written ({error.__cause__ or error}); nothing was changed"
        ) from error
    known = len(schema.FILE_STEPS)
    log.info("%s: is upgraded from version %d to %d; backup: %s", path, version, known, copy)


def copy_database(source: sqlite3.Connection, target: Path) -> None:
    """Copy a database (online backup) to a file that appears as a whole or not at all.

    A writer is not blocked. Raises OutputError or sqlite3.Error.
    """
    with new_file(target) as partial:
        if partial == target:
            raise OSError(errno.EINVAL, "is not a regular file")
        with closing(sqlite3.connect(partial)) as copy:
            source.backup(copy)
            copy.execute("PRAGMA journal_mode = DELETE")
        with partial.open("rb") as file:
            os.fsync(file.fileno())


def open_copy(
    path: Path, change: Callable[[sqlite3.Connection], None] | None = None
) -> sqlite3.Connection:
    """Open a store whose folder cannot be written, including its -wal file.

    Without a -wal file it is read in place. Otherwise file and -wal are copied to the folder for
    temporary files, merged there and opened; the copy is gone when the connection is closed.
    change: applied to the copy, which is then always made. Raises StoreError, sqlite3.Error.
    """
    wal = helper(path, "wal")
    if change is None and not (wal.exists() and wal.stat().st_size):
        return _connect(path, "ro&immutable=1")
    try:
        with tempfile.TemporaryDirectory("", "thermocald-", ignore_cleanup_errors=True) as folder:
            copy = Path(folder) / "copy.db"
            _copy_files(path, wal, copy)
            with closing(_connect(copy, "rw")) as connection:
                if change is not None:
                    change(connection)
                connection.execute("PRAGMA journal_mode = DELETE")  # moves the -wal into the file
            opened = _connect(copy, "ro&immutable=1")
            # SQLite opens the file only now, before the folder is removed
            opened.execute("SELECT 1 FROM sqlite_master").fetchone()
            return opened
    except OSError as error:
        raise StoreError(f"{path}: no private copy can be made: {error}") from error


def _copy_files(path: Path, wal: Path, copy: Path) -> None:
    """Copy file and -wal in one state, although another process may be writing."""
    for _ in range(_ATTEMPTS):
        before = _identity(path, data=True), _identity(wal, data=True)
        shutil.copyfile(path, copy)
        if before[1] is not None:
            shutil.copyfile(wal, f"{copy}-wal")
        if (_identity(path, data=True), _identity(wal, data=True)) == before:
            return
    raise StoreError(
        f"{path}: is being written by another process, and you may not read its -shm file; "
        "join that user's group, or use sudo"
    )


_HEADER = struct.Struct(">8I")  # magic, version, page size, sequence, two salts, two checksums
_FRAME = struct.Struct(">6I")  # page, size of the database after a commit, two salts, checksums
_MAGIC = 0x377F0682
_INDEX_BYTES = 48
_DAMAGED_SALT_BITS = 3  # salts of another run differ in about half of their 64 bits
_TRIES, _PAUSE_S = 3, 0.02


def read_wal_tail(path: Path) -> tuple[int, bool]:
    """Return (lost, unfinished) of a -wal file with the -shm file beside it.

    lost: number of committed transactions that cannot be read, -1 for all; unfinished: the last one
    is incomplete and may not have been committed. Its disk was full, its writer was killed, or the
    file was cut off in copying, and more may have followed. The files may be written meanwhile.
    """
    for _ in range(_TRIES):
        committed = _committed_frames(path)  # first: later commits may be read half-written
        tail = 0, False
        with suppress(OSError), path.open("rb") as file:  # long, if a reader kept it
            tail = _read_frames(file, committed)
        if tail == (0, False):
            break
        time.sleep(_PAUSE_S)  # a frame that is only half written looks like damage
    return tail


def _read_frames(file: BinaryIO, committed: Mapping[bytes, int]) -> tuple[int, bool]:
    header = file.read(_HEADER.size)
    if len(header) < _HEADER.size:
        return 0, False
    magic, _, page_size, _, *salts, first, second = _HEADER.unpack(header)
    order = ">" if magic & 1 else "<"
    sums = _checksum(order, header[:24], (0, 0))
    if magic & ~1 != _MAGIC or sums != (first, second) or page_size % 512:
        return -1, False
    broken = earlier = False
    whole = ended = 0  # number of frames, and of those up to the last end of a transaction
    commits: list[int] = []  # numbers of frames that end a transaction, from the broken one on
    step = _FRAME.size + page_size
    while len(frame := file.read(step)) == step:
        number = whole + 1
        _, commit, *frame_salts, first, second = _FRAME.unpack_from(frame)
        if frame_salts != salts:
            pairs = zip(frame_salts, salts, strict=True)
            if sum((one ^ two).bit_count() for one, two in pairs) > _DAMAGED_SALT_BITS:
                earlier = True  # frames from before the -wal file was restarted
                break
            broken = True
        if not broken:
            sums = _checksum(order, frame[:8] + frame[_FRAME.size :], sums)
            broken = sums != (first, second)
        whole, ended = number, number if commit else ended
        if broken and commit:
            commits.append(number)
    frames = committed.get(header[16:24], 0)
    if not broken:
        cut = ended < whole or (not earlier and frame)
        return int(whole < frames), bool(cut) and whole >= frames
    lost = len([n for n in commits if n != commits[-1] or n <= frames])
    return lost, not lost


def _committed_frames(wal: Path) -> dict[bytes, int]:
    """Return {salts of a -wal file: number of its frames that the index counts as committed}."""
    try:
        with wal.with_name(f"{wal.name.removesuffix('-wal')}-shm").open("rb") as file:
            one, two = file.read(_INDEX_BYTES), file.read(_INDEX_BYTES)
    except OSError:
        return {}
    if len(one) < _INDEX_BYTES or one != two:
        return {}
    order = "<" if struct.pack("=I", 1)[0] else ">"
    if _checksum(order, one[:40], (0, 0)) != struct.unpack("=2I", one[40:]):
        return {}
    return {one[32:40]: int(struct.unpack_from("=I", one, 16)[0])}


def _checksum(order: str, data: bytes, start: tuple[int, int]) -> tuple[int, int]:
    given = np.concatenate([np.array(start, np.uint32), np.frombuffer(data, f"{order}u4")])
    a, b = _checksum_matrix(len(data) // 8) @ given.astype(np.uint32)
    return int(a), int(b)


@cache
def _checksum_matrix(pairs: int) -> NDArray[np.uint32]:
    """Return the checksum's derivative by its start and by words: it is linear modulo 2³².

    A pair of words x, y turns (a, b) into (a + b + x, a + 2b + x + y).
    """
    after, of_words = np.eye(2, dtype=np.uint32), []
    for _ in range(pairs):
        of_words.append(after @ np.array([[1, 0], [1, 1]], np.uint32))
        after = after @ np.array([[1, 1], [1, 2]], np.uint32)
    return np.hstack([after, *of_words[::-1]])
