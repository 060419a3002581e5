"""The store's file on disk: locked for one writer, and compared with what is at its path now.

The lock is on the file itself, whatever name it was opened by.
"""

from __future__ import annotations

import fcntl
import os
from typing import TYPE_CHECKING

from thermocald.errors import StoreError

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["StoreFile"]

# SQLite's own locks of a file end when any descriptor of it is closed by this process: so a file
# that is claimed already is not opened a second time.
_CLAIMED: set[tuple[int, int]] = set()


class StoreFile:
    """A claimed file; the kernel gives the lock back however the process ends.

    Makes an empty file where there is none. Raises StoreError where it cannot be written, or where
    another process has it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._wal: tuple[int, int] | None = None
        self._shm: tuple[int, int] | None = None
        found = _identity(path)
        if found in _CLAIMED:
            raise _taken(path)
        try:
            self._handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise StoreError(f"{path}: cannot be written: {error.strerror}") from error
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._handle)
            raise _taken(path) from error
        status = os.fstat(self._handle)
        self.identity = (status.st_dev, status.st_ino)
        _CLAIMED.add(self.identity)

    def release(self) -> None:
        """Give the lock back; after the database was closed."""
        _CLAIMED.discard(self.identity)
        os.close(self._handle)

    def discard_empty(self) -> None:
        """Remove a file that was only made to be locked."""
        if os.fstat(self._handle).st_size == 0 and _identity(self.path) == self.identity:
            self.path.unlink(missing_ok=True)

    @property
    def deleted(self) -> bool:
        """Whether no name leads to the file any more."""
        return os.fstat(self._handle).st_nlink == 0

    @property
    def there(self) -> bool:
        """Whether the path still leads to this file."""
        return _identity(self.path) == self.identity

    def remember_helpers(self) -> None:
        """Note which -wal and -shm files the open database uses, as soon as they are there."""
        if self._wal is None:
            self._wal = _identity(self.wal_path)
        if self._shm is None:
            self._shm = _identity(self.shm_path)

    @property
    def helpers_there(self) -> bool:
        """Whether the -wal and the -shm file are still those that were noted."""
        shm_there = self._shm is None or _identity(self.shm_path) == self._shm
        return self.wal_there and shm_there

    @property
    def wal_there(self) -> bool:
        """Whether the -wal file is still the one that was noted."""
        return self._wal is None or _identity(self.wal_path) == self._wal

    @property
    def wal_path(self) -> Path:
        """Of the -wal file: next to the file that a link leads to."""
        resolved = self.path.resolve()
        return resolved.with_name(f"{resolved.name}-wal")

    @property
    def shm_path(self) -> Path:
        """Of the -shm file, the index of the -wal file."""
        return self.wal_path.with_name(f"{self.wal_path.name.removesuffix('-wal')}-shm")


def _taken(path: Path) -> StoreError:
    return StoreError(
        f"{path}: another thermocald writes it; end that one first, or choose another store"
    )


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino
