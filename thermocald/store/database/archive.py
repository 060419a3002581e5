"""A series of the store as a recording."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thermocald.atomic_file import new_file
from thermocald.store.recording.paths import FileFolder
from thermocald.store.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.epoch import Epoch
    from thermocald.store.database.row import StoredSeries
    from thermocald.store.database.store import Store

    Array = NDArray[np.float64]

_TOLERANCE_S = 10.0

__all__ = ["archive_readings", "archive_series", "clock_corrections"]


def clock_corrections(
    frame_time: Array, interval: float, trusted: Array | None = None, steps: Sequence[float] = ()
) -> Array:
    """Seconds (E,) to add to times (E,) so that they are right where that is known, and in order.

    trusted: (E,) 0 where the clock was not synchronised; steps: s, those that time stamps followed.
    In this order: what was taken before the machine learned the time moves by that step; what lies
    between a step forwards and the same step back was a glitch of the clock, and moves back; before
    any other step back all that came earlier is moved to end one interval before what follows, as
    the later setting is the better known one. Zero elsewhere.
    """
    corrections = np.zeros(len(frame_time))
    tolerance = max(_TOLERANCE_S, 3.0 * interval)
    for step in steps:
        _learned(frame_time + corrections, interval, trusted, step, tolerance, corrections)
    for j in np.flatnonzero(np.diff(frame_time + corrections) < 0) + 1:
        leaps = np.diff(frame_time + corrections) - interval
        back = -float(leaps[j - 1])
        same = np.flatnonzero((leaps[: j - 1] > 0) & (np.abs(leaps[: j - 1] - back) < tolerance))
        if same.size:
            corrections[same[-1] + 1 : j] -= back
    times = frame_time + corrections
    for last in np.flatnonzero(np.diff(times) < 0)[::-1]:
        corrections[: last + 1] += times[last + 1] - interval - times[last]
    return corrections


def _learned(
    times: Array,
    interval: float,
    trusted: Array | None,
    step: float,
    tolerance: float,
    corrections: Array,
) -> None:
    """Move the epochs before a step forwards that were taken without a synchronised clock."""
    if trusted is None or step < tolerance:
        return
    fits = np.abs(np.diff(times) - interval - step) < tolerance
    for i in np.flatnonzero(fits & (trusted[:-1] == 0)) + 1:
        known = np.flatnonzero(trusted[:i] != 0)
        first = int(known[-1]) + 1 if known.size else 0
        if times[i] - times[i - 1] > tolerance:
            corrections[first:i] += step


def archive_series(
    store: Store, series: StoredSeries, path: Path, frames: Path | None = None
) -> None:
    """Write a series as a recording, in constant memory.

    frames: the folder that relative paths of frames refer to; a frame that was not kept is left
    out. The head also holds what the store knows of the series: `start`, `device`, `calibration`.
    Times that ran backwards are mended (`clock_corrections`), the head then holds `clock_set_back`
    [{epoch, seconds}]. Raises RecordingError, StoreError.
    """
    columns = store.series_columns(series, ["epoch", "frame_time", "clock_trusted"])
    followed = [
        float(event.data["seconds"])
        for event in store.events()
        if event.kind == "clock_step" and event.data.get("adopted") is True
    ]
    corrections = clock_corrections(
        columns["frame_time"], series.head.interval, columns["clock_trusted"], followed
    )
    known = {"start": series.start, "device": series.identity, "calibration": series.settings}
    told = {key: value for key, value in known.items() if value}
    head = replace(series.head, extra={**series.head.extra, **told})
    if set_back := np.flatnonzero(np.diff(corrections)).tolist():
        steps = [
            {
                "epoch": int(columns["epoch"][i + 1]),
                "seconds": float(corrections[i] - corrections[i + 1]),
            }
            for i in set_back
        ]
        head = replace(head, extra={**head.extra, "clock_set_back": steps})
    by_number = dict(zip(columns["epoch"].tolist(), corrections.tolist(), strict=True))
    shifts = np.unique(np.append(corrections, 0.0)).tolist()
    kept = FileFolder(frames or Path())
    with RecordingWriter(path, head, series.testfield) as writer:
        for stored in store.epochs(series):
            epoch = _with_frame(stored.epoch, kept)
            if len(shifts) > 1:
                frame_time = epoch.frame_time + by_number[epoch.number]
                # a reading next to a step of the clock may be stamped by the other of the two
                at = min((epoch.temperature_time + s for s in shifts),
                         key=lambda t, f=frame_time: abs(t - f))  # type: ignore[misc]  # fmt: skip
                epoch = replace(epoch, frame_time=frame_time, temperature_time=at)
            writer.append(epoch)


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
