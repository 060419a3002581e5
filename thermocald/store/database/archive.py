"""A series of the store as a recording."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thermocald.atomic_file import new_file
from thermocald.store.database.times import series_times
from thermocald.store.recording.paths import FileFolder
from thermocald.store.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from thermocald.epoch import Epoch
    from thermocald.store.database.row import StoredSeries
    from thermocald.store.database.store import Store

__all__ = ["archive_readings", "archive_series"]


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
