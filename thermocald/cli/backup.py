"""`thermocald backup`: a verified copy of the store, while the daemon writes it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.common import say, write_json
from thermocald.cli.options import JsonOption, StoreArgument
from thermocald.errors import DataError, StoreError, UsageError

__all__ = ["backup"]


def backup(
    store: StoreArgument = None,
    to: Annotated[
        Path | None, typer.Argument(help="A file that does not exist yet, or a folder.")
    ] = None,
    folder: Annotated[
        Path | None, typer.Option("--to", help="The same, for use with --config.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="The store of this configuration.")
    ] = None,
    keep: Annotated[
        int, typer.Option(min=0, help="In a folder: delete all but the newest N; 0: none.")
    ] = 0,
    json: JsonOption = None,
) -> None:
    """Copy a store and read the copy again: every row must be as it was written.

    In a folder the copy is called `<store>-<UTC>.db`. A store that is damaged is not copied: exit
    status 1, and older backups stay.

    Example: thermocald backup thermocald.db backups/
    """
    from thermocald.config import load_config
    from thermocald.store.database.store import Store

    if config is not None:
        store, to = load_config(config).store.path, to or store
    target = folder or to
    if store is None or target is None:
        raise UsageError("give STORE and TO, or --config FILE and --to TO")
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
    say(f"{target}: {found.epochs} epochs, every row verified")
    removed = _remove_old(target, store.stem, keep) if keep else []
    for path in removed:
        say(f"{path}: deleted, {keep} newer ones are kept")
    if json is not None:
        write_json(
            {
                "format": "thermocald-backup/1", "store": store, "backup": target,
                "epochs": found.epochs, "deleted": removed,
            },
            json,
        )  # fmt: skip


def _remove_old(newest: Path, stem: str, keep: int) -> list[Path]:
    stamp = "[0-9]" * 8 + "T" + "[0-9]" * 6 + "Z"
    there = sorted(newest.parent.glob(f"{stem}-{stamp}.db"))
    old = [path for path in there[:-keep] if path != newest]
    for path in old:
        path.unlink(missing_ok=True)
    return old
