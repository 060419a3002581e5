"""The store that a daemon writes: open, locked, and followed when its files go away underneath.

A deleted file lives on in the process that has it open, and a deleted -wal or -shm file makes other
processes see another state of the store: so all three are watched, what they held is brought to the
path again, and the store is opened once more.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import time
from typing import TYPE_CHECKING

from thermocald.daemon.store_file import StoreFile
from thermocald.errors import OutputError, StoreError
from thermocald.store.database.row import Event
from thermocald.store.database.store import Store
from thermocald.store.database.wal import read_wal_tail

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["FollowedStore"]

log = logging.getLogger(__name__)


class FollowedStore:
    """An open store and its file; used under one lock. Raises StoreError.

    notice: what happened to the file, empty if nothing; events: what is to be stored about that.
    """

    def __init__(self, path: Path, *, durable: bool = True) -> None:
        self.path = path
        self.notice = ""
        self.events: list[Event] = []
        self._durable = durable
        self._open()

    def _open(self) -> None:
        self._file = StoreFile(self.path)
        tail = read_wal_tail(self._file.wal_path)
        kept = self._keep_damaged_wal() if tail.lost else ""
        try:
            self.store = Store.open(self.path, "append", durable=self._durable)
        except BaseException:
            self._file.discard_empty()
            self._file.release()
            raise
        self._file.remember_helpers()
        if tail.lost:
            many = "all transactions" if tail.lost < 0 else f"{tail.lost} transactions"
            text = f"its -wal file was damaged, {many} in it were lost; a copy is in {kept}"
            self._note("wal_damaged", text)
        elif tail.unfinished:
            text = "the last write was cut off when its writer ended; it had not been committed"
            log.info("%s: %s", self.path, text, extra={"event": "wal_unfinished"})
            self.events.append(Event(time.time(), "wal_unfinished", text))

    def _note(self, kind: str, text: str) -> None:
        self.notice = text
        log.error("%s: %s", self.path, text, extra={"event": kind})
        self.events.append(Event(time.time(), kind, f"{self.path.name}: {text}"))

    def _keep_damaged_wal(self) -> str:
        """A copy of the -wal file for who wants to look into it."""
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        copy = self.path.with_name(f"{self.path.stem}-wal-damaged-{stamp}")
        try:
            shutil.copyfile(self._file.wal_path, copy)
        except OSError as error:
            return f"nowhere: {error.strerror}"
        return str(copy)

    @property
    def in_place(self) -> bool:
        """Whether what was committed is in the files that are at their paths."""
        return self._file.there and self._file.helpers_there

    def watch(self) -> bool:
        """Look whether the files are where they were, and go on with what is there.

        Returns whether the store at the path now holds all that was committed before; raises
        StoreError where nothing can be opened there, and tries again when called again.
        """
        try:
            if self.store.closed:
                self._open()
                return False
            self._file.remember_helpers()
            return self.in_place or self._follow()
        except OSError as error:
            raise StoreError(f"{self.path}: cannot be written: {error.strerror}") from error
        except OutputError as error:
            raise StoreError(str(error)) from error

    def _follow(self) -> bool:
        file, copy = self._file, None
        # else what is in a -wal file that has no name any more would be lost with the connection
        if file.deleted or not self._emptied_wal():
            copy = self._rescued()
        there, other = file.there, self.path.exists()
        if there:
            text = "its -wal or -shm file was deleted; what it held was moved into the store"
        elif file.deleted and not other:
            text = "was deleted; it was written again with all that it held"
        else:
            gone = "replaced by another file" if file.deleted else "moved away"
            what = ", which is used now" if file.deleted else "; the file at its path is used now"
            rest = "" if copy is None else f"; what it held is in {copy}"
            text = f"was {gone}{what if other else '; a new store was begun'}{rest}"
        carried = there or (file.deleted and not other)
        self.close()
        if carried and copy is not None:
            os.replace(copy, self.path.resolve())  # a link stays one
        self._open()
        self._note("store_followed", text)
        return carried

    def _emptied_wal(self) -> bool:
        """Whether all of the -wal file could be moved into the file."""
        try:
            return self.store.checkpoint()
        except StoreError as error:
            log.debug("%s", error)
            return False

    def _rescued(self) -> Path:
        """A copy of all that the open store holds, beside where it was."""
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        target = self.path.resolve()
        copy = target.with_name(f"{target.stem}-rescued-{stamp}.db")
        target.parent.mkdir(parents=True, exist_ok=True)
        self.store.copy_to(copy)
        return copy

    def close(self) -> None:
        """Close the store and give its lock back; may be called twice.

        If the files were not in place, the helper files at the path are removed too: they would be
        taken for those of the next database there. Those of another store are left alone.
        """
        if self.store.closed:
            return
        foreign = not self._file.there and self.path.exists() and not self._file.wal_there
        stale = not self.in_place and not foreign
        try:
            self.store.close()
        except StoreError as error:
            log.error("%s", error)
        if stale:
            for name in (self._file.wal_path, self._file.shm_path):
                with contextlib.suppress(OSError):
                    name.unlink(missing_ok=True)
        self._file.release()
