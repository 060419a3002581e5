"""A verified copy of a store, while a daemon writes it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from thermocald.errors import DataError, StoreError, UsageError
from thermocald.store.database.store import Store

if TYPE_CHECKING:
    from pathlib import Path


@dataclass(frozen=True, slots=True)
class Backup:
    """A copy whose every row was read again, and how many epochs it holds."""

    path: Path
    epochs: int


def back_up(store: Path, target: Path, keep: int = 0) -> tuple[Backup, list[Path]]:
    """Copy a store to a file, or into a folder as `<store>-<UTC>.db`, and read the copy again.

    keep: delete all but the newest so many of a folder, 0: none; returns which went too. Raises
    DataError where the file exists, UsageError where its folder does not, StoreError for a damaged
    store, which is not copied.
    """
    if target.is_dir():
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        target = target / f"{store.stem}-{stamp}.db"
    elif keep:
        raise UsageError(f"--keep is for a folder of backups; {target} is not a folder")
    if target.exists():
        raise DataError(f"{target}: exists already; a backup is never written over")
    if not target.absolute().parent.is_dir():
        raise UsageError(f"{target}: the folder {target.absolute().parent} does not exist")
    with Store.open(store) as opened:
        opened.copy_to(target)
    try:
        with Store.open(target) as copy:
            found = copy.examine()
        if found.damaged:
            raise StoreError(
                f"{store}: is damaged, and was not backed up: {found.damaged[0]}; "
                "`thermocald check` lists all"
            )
    except StoreError:
        target.unlink(missing_ok=True)
        raise
    removed = _remove_old(target, store.stem, keep) if keep else []
    return Backup(target, found.epochs), removed


def _remove_old(newest: Path, stem: str, keep: int) -> list[Path]:
    stamp = "[0-9]" * 8 + "T" + "[0-9]" * 6 + "Z"
    there = sorted(newest.parent.glob(f"{stem}-{stamp}.db"))
    old = [path for path in there[:-keep] if path != newest]
    for path in old:
        path.unlink(missing_ok=True)
    return old
