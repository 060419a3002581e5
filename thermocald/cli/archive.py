"""`thermocald archive`: the store's series as recordings; frames that may go are deleted."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.atomic_file import make_folder
from thermocald.cli.common import say, write_json
from thermocald.cli.options import JsonOption, StoreArgument
from thermocald.errors import UsageError

if TYPE_CHECKING:
    from thermocald.config import Config

__all__ = ["archive"]


def archive(
    store: StoreArgument = None,
    folder: Annotated[
        Path, typer.Option("--to", help="The folder in which recordings are written.")
    ] = Path(),
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="Store and frames of this configuration.")
    ] = None,
    frames: Annotated[Path | None, typer.Option(help="The daemon's folder of frames.")] = None,
    series: Annotated[
        str | None, typer.Option(help="CAMERA/SERIES or SERIES; default: all.")
    ] = None,
    skip_existing: Annotated[
        bool, typer.Option("--skip-existing", help="Pass over recordings that are there already.")
    ] = False,
    finished: Annotated[
        bool, typer.Option("--finished", help="Only series after which the camera began another.")
    ] = False,
    retention: Annotated[
        bool,
        typer.Option("--retention", help="Then delete frames as the configuration's limits say."),
    ] = False,
    json: JsonOption = None,
) -> None:
    """Write every series as a recording `<camera>-<series>`, a folder that replays anywhere.

    Readings that belong to no epoch become `thermometer-<name>.csv`, unless --finished or --series
    is given.

    Example: thermocald archive thermocald.db --to recordings
    """
    from thermocald.config import load_config
    from thermocald.store.database.archive import archive_readings, archive_series
    from thermocald.store.database.store import Store

    read = None
    if retention and config is None:
        raise UsageError("--retention needs --config FILE: it holds the limits")
    if config is not None:
        read = load_config(config)
        store, frames = store or read.store.path, frames or read.frames.folder
    if store is None:
        raise UsageError("which store? give its file, or --config FILE")
    camera, _, name = (series or "").rpartition("/")
    written: list[dict[str, Any]] = []
    readings: dict[str, Path] = {}
    if finished and not store.exists():
        say(f"{store}: nothing was stored yet")
        return
    with Store.open(store) as opened:
        chosen = (
            opened.all_series()
            if series is None
            else [opened.find_series(camera or None, name or None)]
        )
        if finished:
            newest = {one.camera: one.id for one in opened.all_series()}
            chosen = [one for one in chosen if newest[one.camera] != one.id]
        make_folder(folder)
        for one in chosen:
            path = folder / f"{one.camera}-{one.name}"
            last = opened.last_epoch(one)
            if last is None or (skip_existing and path.exists()):
                continue
            archive_series(opened, one, path, frames)
            say(f"{path}: epochs to {last}")
            written.append(
                {"camera": one.camera, "series": one.name, "path": path, "last_epoch": last}
            )
        if series is None and not finished:
            readings = archive_readings(opened, folder)
    for path in readings.values():
        say(f"{path}: readings")
    deleted = _retention(read) if retention and read is not None else []
    for sentence in deleted:
        say(sentence)
    if json is not None:
        document = {"recordings": written, "readings": readings, "deleted": deleted}
        write_json({"format": "thermocald-archive/1", **document}, json)


def _retention(config: Config) -> list[str]:
    """Have the running daemon delete what may go, or where none runs, do it; both log it."""
    from thermocald.daemon.control import ask
    from thermocald.daemon.live_state import find_state

    told = ask(find_state(config.store.path), "retention")
    if told is not None:
        return [str(sentence) for sentence in told["deleted"]]
    from thermocald.acquisition.frame_folder import FrameFolder
    from thermocald.acquisition.steady_clock import machine_clock_trusted
    from thermocald.daemon.store_guard import StoreGuard
    from thermocald.store.database.row import Event

    guard = StoreGuard(config.store.path)
    try:
        now = time.time() if machine_clock_trusted() else None
        sentences = [deleted.text for deleted in FrameFolder(config.frames).enforce(now)]
        for sentence in sentences:
            guard.event(Event(time.time(), "frames_deleted", sentence))
    finally:
        guard.close()
    return sentences
