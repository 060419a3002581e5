"""A series of the store as a recording."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.files import make_folder, new_file
from thermocald.names import FileFolder
from thermocald.store.database.store import Store
from thermocald.store.recording.writer import RecordingWriter
from thermocald.store.series import series_times

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.epoch import Epoch
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
    """Write the series of a store as recordings `<camera>-<series>`, and what else was read.

    series: `CAMERA/SERIES` or `SERIES`, None: all; finished: only those after which the camera
    began another; say: is told of each. Returns `recordings` and `readings`.
    """
    written: list[dict[str, Any]] = []
    readings: dict[str, Path] = {}
    with Store.open(path) as opened:
        chosen = opened.all_series() if series is None else [opened.only_series(series)]
        if finished:
            newest = {one.camera: one.id for one in opened.all_series()}
            chosen = [one for one in chosen if newest[one.camera] != one.id]
        make_folder(folder)
        every = opened.all_series()
        for one in chosen:
            target = folder / _recording_name(one, every)
            last = opened.last_epoch(one)
            if last is None or (skip_existing and target.exists()):
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


def _recording_name(one: StoredSeries, every: list[StoredSeries]) -> str:
    """`<camera>-<series>`; `a-b`/`c` and `a`/`b-c` are two, with two hyphens each."""
    name = f"{one.camera}-{one.name}"
    alike = sum(f"{other.camera}-{other.name}" == name for other in every)
    return name if alike == 1 else f"{one.camera}--{one.name}"


def archive_series(
    store: Store, series: StoredSeries, path: Path, frames: Path | None = None
) -> None:
    """Write a series as a recording, in constant memory.

    frames: the folder that relative paths of frames refer to; a frame that was not kept is left
    out. The head also holds what the store knows of the series: `start`, `device`, `calibration`.
    Times are corrected (`database.times`), the head then holds `clock_set_back`
    [{epoch, seconds}]. Raises RecordingError, StoreError.
    """
    times = series_times(store, series)
    known = {"start": series.start, "device": series.identity, "calibration": series.settings}
    told = {key: value for key, value in known.items() if value}
    head = replace(series.head, extra={**series.head.extra, **told})
    if set_back := np.flatnonzero(np.diff(times.corrections)).tolist():
        steps = [
            {
                "epoch": int(times.numbers[i + 1]),
                "seconds": float(times.corrections[i] - times.corrections[i + 1]),
            }
            for i in set_back
        ]
        head = replace(head, extra={**head.extra, "clock_set_back": steps})
    kept = FileFolder(frames or Path())
    with RecordingWriter(path, head, series.testfield) as writer:
        for stored in store.epochs(series):
            epoch = _with_frame(stored.epoch, kept)
            frame_time, temperature_time = times.of(epoch.number)
            writer.append(replace(epoch, frame_time=frame_time, temperature_time=temperature_time))


def archive_readings(store: Store, folder: Path) -> dict[str, Path]:
    """Write what thermometers said apart from epochs, {thermometer: `thermometer-<name>.csv`}.

    Columns: time (s UTC), clock_trusted, one per channel (°C, empty where it was not read). Raises
    StoreError, OutputError if the folder cannot be written.
    """
    channels: dict[str, dict[str, None]] = {}
    for reading in store.readings():
        channels.setdefault(reading.thermometer, {}).update(dict.fromkeys(reading.values))
    written: dict[str, Path] = {}
    for name, columns in channels.items():
        written[name] = folder / f"thermometer-{name}.csv"
        with (
            new_file(written[name]) as partial,
            partial.open("w", encoding="utf-8", newline="") as file,
        ):
            rows = csv.writer(file, lineterminator="\n")
            rows.writerow(["time", "clock_trusted", *columns])
            for reading in store.readings(name):
                values = [reading.values.get(channel, "") for channel in columns]
                rows.writerow([f"{reading.utc:.6f}", int(reading.clock_trusted), *values])
    return written


def _with_frame(epoch: Epoch, frames: FileFolder) -> Epoch:
    if epoch.frame is None:
        return epoch
    return replace(epoch, frame=frames.find(epoch.frame))
