"""The readings of a log, and their interpolation at the times of frames."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.store.recording.sense import time_fault
from thermocald.store.recording.table import Table

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import ArrayLike

    from thermocald.arrays import Array, Mask

READINGS = "readings.csv"
"""The file with every reading of a log, in a recording of frames and a separate log."""
_LARGEST_GAP_IN_INTERVALS = 10.0
_AT_ONCE = 100_000  # frames: a year of them must fit into memory


@dataclass(frozen=True, slots=True, eq=False)
class TemperatureLog:
    """Every reading of a log.

    times (n,) s UTC, increasing; channels {name: (n,) °C}, NaN for a missing reading, the first is
    the reference; notes: sentences for the user on what was found and assumed when it was read.
    """

    times: Array
    channels: dict[str, Array]
    notes: tuple[str, ...] = ()

    @property
    def step(self) -> float:
        """The usual time between readings, s; 0 if there is only one."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else 0.0

    def with_reference(self, name: str | None) -> TemperatureLog:
        """Return the log with the channel `name` first; unchanged if it has no such channel."""
        if name not in self.channels:
            return self
        first = {name: self.channels[name]}
        return replace(self, channels=first | self.channels)

    def known_at(self, times: Array) -> Mask:
        """Return whether the reference is known at times (n,) s: in the log, in no gap of it."""
        reference = next(iter(self.channels.values()))
        known: Mask = np.isfinite(interpolate_readings(times, self.times, reference))
        return known


def write_readings(path: Path, readings: TemperatureLog) -> None:
    """Write readings as `readings.csv`: time and one column per channel."""
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["time", *readings.channels])
        columns = [c.tolist() for c in readings.channels.values()]
        for time, *values in zip(readings.times.tolist(), *columns, strict=True):
            rows.writerow([f"{time:.6f}", *("" if math.isnan(v) else f"{v:.10g}" for v in values)])


def read_readings(path: Path, channels: Sequence[str]) -> TemperatureLog:
    """Read a `readings.csv`. Raises RecordingError naming line and column."""
    table = Table(path, ["time", *channels])
    columns = table.read(numbers=["time"], optional=channels)
    times = columns.pop("time", np.empty(0))
    table.check("time", np.diff(times, prepend=-np.inf) <= 0, "times must increase")
    if fault := time_fault(times):
        table.fail(fault[0], "time", fault[1])
    for name, values in columns.items():
        table.check(name, values < -273.15, "is below absolute zero")
    return TemperatureLog(times, {name: columns.get(name, np.empty(0)) for name in channels})


def interpolate_readings(
    frame_times: ArrayLike, reading_times: ArrayLike, readings: ArrayLike
) -> Array:
    """Return temperatures (E,) °C at `frame_times` (E,) s from `readings` (R,) °C at (R,) s.

    Interpolation is linear; before the first and after the last reading, the line through the two
    outermost is extrapolated for at most one interval. NaN readings are ignored. The result is NaN
    further out, and in a gap of more than ten times the readings' median interval.
    """
    frames = np.asarray(frame_times, dtype=float)
    times, values = np.asarray(reading_times, dtype=float), np.asarray(readings, dtype=float)
    good = np.isfinite(times) & np.isfinite(values)
    if not good.all():
        times, values = times[good], values[good]
    if (np.diff(times) <= 0).any():
        times, unique = np.unique(times, return_index=True)
        values = values[unique]
    if len(times) < 2:
        # one reading gives the temperature at its own time only
        only = float(values[0]) if len(values) else np.nan
        return np.where(np.isin(frames, times), only, np.nan)
    interval = float(np.median(np.diff(times)))
    gap = _LARGEST_GAP_IN_INTERVALS * interval
    result = np.empty(frames.shape)
    for first in range(0, len(frames), _AT_ONCE):
        at = frames[first : first + _AT_ONCE]
        left = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
        span = times[left + 1] - times[left]
        slope = (values[left + 1] - values[left]) / span
        part = values[left] + slope * (at - times[left])
        outside = np.maximum(times[0] - at, at - times[-1])
        on_reading = (at == times[left]) | (at == times[left + 1])
        part[(outside > interval) | ((span > gap) & ~on_reading)] = np.nan
        result[first : first + _AT_ONCE] = part
    return result
