"""Write the series of a store as recordings; back up a store while a daemon writes to it."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import DataError, StoreError, UsageError
from thermocald.files import make_folder, utc_stamp, write_parts
from thermocald.names import FileFolder
from thermocald.result import csv_text
from thermocald.store.database.store import Store
from thermocald.store.recording.writer import RecordingWriter
from thermocald.store.series import series_times
from thermocald.store.server.connection import require_file
from thermocald.store.sources import stored_log

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from thermocald.result import Columns
    from thermocald.store.series import StoredSeries


def archive_store(
    path: Path,
    folder: Path,
    frames: Path | None,
    series: str | None,
    finished: bool,
    skip_existing: bool,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Write series of a store as recordings `<camera>-<series>`, and readings without epochs.

    series: `CAMERA/SERIES` or `SERIES`, None: all, with the readings; finished: only series after
    which their camera began another; say: prints a line for each. Returns the document with
    `recordings` and `readings`.
    """
    written: list[dict[str, Any]] = []
    readings: dict[str, Path] = {}
    with Store.open(require_file(path)) as opened:
        every = opened.all_series()
        chosen = every if series is None else [opened.only_series(series)]
        if finished:
            newest = {one.camera: one.id for one in every}
            chosen = [one for one in chosen if newest[one.camera] != one.id]
        make_folder(folder)
        for one in chosen:
            name = f"{one.camera}-{one.name}"
            if sum(f"{other.camera}-{other.name}" == name for other in every) > 1:
                name = f"{one.camera}--{one.name}"  # `a-b`/`c` and `a`/`b-c` must differ
            target = folder / name
            last = opened.last_epoch(one)
            if last is None or (skip_existing and os.path.exists(target)):
                continue
            archive_series(opened, one, target, frames)
            say(f"{target}: epochs to {last}")
            written.append(
                {"camera": one.camera, "series": one.name, "path": target, "last_epoch": last}
            )
        if series is None and not finished:
            readings = archive_readings(opened, folder)
    for target in readings.values():
        say(f"{target}: readings")
    return {"recordings": written, "readings": readings}


def archive_series(
    store: Store, series: StoredSeries, path: Path, frames: Path | None = None
) -> None:
    """Write a series as a recording, in constant memory.

    frames: the folder to which paths of frames are relative; a frame that is not there is left out.
    The head also holds `start`, `device` and `calibration` of the stored series, epochs.csv what
    the frames reported of the camera's settings (`camera_…`). Times are corrected (`series_times`);
    steps back of the clock are in the head as `clock_set_back` [{epoch, seconds}]. Raises
    RecordingError, StoreError.
    """
    times = series_times(store, series)
    set_back = (-np.diff(times.corrections)).tolist()
    known = {
        "start": series.start, "device": series.identity, "calibration": series.settings,
        "clock_set_back": [
            {"epoch": number, "seconds": seconds}
            for number, seconds in zip(times.numbers[1:].tolist(), set_back, strict=True)
            if seconds
        ],
    }  # fmt: skip
    known = {key: value for key, value in known.items() if value}
    head = replace(series.head, extra={**series.head.extra, **known})
    folder = FileFolder(frames or Path())
    extra = {name for stored in store.epochs(series, details=False) for name in stored.extra}
    reported = [name for name in sorted(extra) if name.startswith("camera_")]
    further = dict.fromkeys([*series.settings.get("columns", ()), *reported])
    with RecordingWriter(path, head, series.testfield, further) as writer:
        if (log := stored_log(store, series)) is not None:
            writer.keep_readings(log)
        for stored in store.epochs(series):
            frame = stored.epoch.frame
            found = None if frame is None else folder.find(frame)
            epoch = replace(times.correct(stored).epoch, frame=found)
            writer.append(epoch, extra=stored.extra)


def archive_readings(store: Store, folder: Path) -> dict[str, Path]:
    """Write the readings without epochs; return {thermometer: `thermometer-<name>.csv`}.

    Columns: time (s UTC), clock_trusted, one per channel (°C, empty if not read). Raises
    StoreError; OutputError if the folder cannot be written.
    """
    channels: dict[str, dict[str, None]] = {}
    for reading in store.readings():
        channels.setdefault(reading.thermometer, {}).update(dict.fromkeys(reading.values))
    written = {name: folder / f"thermometer-{name}.csv" for name in channels}
    for name, columns in channels.items():
        rows: Iterator[Columns] = (
            {
                "time": [f"{reading.utc:.6f}"],
                "clock_trusted": [str(int(reading.clock_trusted))],
                **{one: np.array([reading.values.get(one, np.nan)]) for one in columns},
            }
            for reading in store.readings(name)
        )
        write_parts(written[name], csv_text(rows))
    return written


def back_up(store: Path, target: Path, keep: int = 0) -> dict[str, Any]:
    """Copy a store to a file, or into a folder as `<store>-<UTC>.db`, and verify the copy.

    keep: number of newest backups in the folder to keep, older ones are deleted; 0: keep all.
    Returns the document of the command. Raises DataError if the file exists, UsageError if its
    folder does not, StoreError for a damaged store, which is not copied.
    """
    if os.path.isdir(target):  # in a closed folder, the copy cannot be written below
        target = target / f"{store.stem}-{utc_stamp()}.db"
    elif keep:
        raise UsageError(f"--keep is for a folder of backups; {target} is not a folder")
    if os.path.exists(target):
        raise DataError(f"{target}: exists already; choose another name for the backup")
    if not os.path.isdir(target.absolute().parent):
        raise UsageError(f"{target}: the folder {target.absolute().parent} does not exist")
    with Store.open(require_file(store)) as opened:
        opened.copy_to(target)
    try:
        with Store.open(target) as copy:
            found = copy.examine()
        if found.damaged:
            raise StoreError(
                f"{store}: is damaged and was not backed up: {found.damaged[0]}; "
                "`thermocald check` lists all damage"
            )
    except StoreError:
        target.unlink(missing_ok=True)
        raise
    stamp = "[0-9]" * 8 + "T" + "[0-9]" * 6 + "Z"
    there = sorted(target.parent.glob(f"{store.stem}-{stamp}.db"))
    old = [path for path in there[:-keep] if path != target] if keep else []
    for path in old:
        path.unlink(missing_ok=True)
    return {
        "format": "thermocald-backup/1", "store": store, "backup": target, "epochs": found.epochs,
        "deleted": old,
    }  # fmt: skip
