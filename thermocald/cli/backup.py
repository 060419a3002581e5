"""`thermocald backup`: a verified copy of the store, while the daemon writes it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.common import say, write_json
from thermocald.cli.options import JsonOption, StoreArgument
from thermocald.errors import UsageError


def backup(
    store: StoreArgument = None,
    to: Annotated[
        Path | None, typer.Argument(help="A file that does not exist yet, or a folder.")
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
    from thermocald.store.database.backup import back_up

    if config is not None:
        store, to = load_config(config).store.path, to or store
    if store is None or to is None:
        raise UsageError("give STORE and TO, or --config FILE and TO")
    found, removed = back_up(store, to, keep)
    say(f"{found.path}: {found.epochs} epochs, every row verified")
    for path in removed:
        say(f"{path}: deleted, {keep} newer ones are kept")
    document = {
        "format": "thermocald-backup/1", "store": store, "backup": found.path,
        "epochs": found.epochs, "deleted": removed,
    }  # fmt: skip
    if json is not None:
        write_json(document, json)
