"""`thermocald archive`: the store's series as recordings; frames that may go are deleted."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import say, write_json
from thermocald.cli.options import JsonOption, StoreArgument
from thermocald.errors import UsageError


def archive(
    store: StoreArgument = None,
    folder: Annotated[
        Path, typer.Option("--to", help="The folder in which recordings are written.")
    ] = Path(),
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="Store and frames of this configuration.")
    ] = None,
    frames: Annotated[Path | None, expert(help="The daemon's folder of frames.")] = None,
    series: Annotated[
        str | None, typer.Option(help="CAMERA/SERIES or SERIES; default: all.")
    ] = None,
    skip_existing: Annotated[
        bool, expert("--skip-existing", help="Pass over recordings that are there already.")
    ] = False,
    finished: Annotated[
        bool, expert("--finished", help="Only series after which the camera began another.")
    ] = False,
    retention: Annotated[
        bool, expert("--retention", help="Then delete frames as the configuration's limits say.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Write every series as a recording `<camera>-<series>`, a folder that replays anywhere.

    Readings that belong to no epoch become `thermometer-<name>.csv`, unless --finished or --series
    is given.

    Example: thermocald archive thermocald.db --to recordings
    """
    from thermocald.config import load_config
    from thermocald.daemon.control import enforce_retention
    from thermocald.store.database.archive import archive_store

    read = None
    if retention and config is None:
        raise UsageError("--retention needs --config FILE: it holds the limits")
    if config is not None:
        read = load_config(config)
        store, frames = store or read.store.path, frames or read.frames.folder
    if store is None:
        raise UsageError("which store? give its file, or --config FILE")
    if finished and not store.exists():
        say(f"{store}: nothing was stored yet")
        return
    document = archive_store(store, folder, frames, series, finished, skip_existing, say)
    deleted = enforce_retention(read) if retention and read is not None else []
    for sentence in deleted:
        say(sentence)
    if json is not None:
        write_json({"format": "thermocald-archive/1", **document, "deleted": deleted}, json)
