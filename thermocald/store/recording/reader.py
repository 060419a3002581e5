"""A recording: a series as an open folder that replays without hardware (CONVENTIONS §3)."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import repeat
from typing import TYPE_CHECKING

import numpy as np

from thermocald.epoch import Epoch
from thermocald.errors import RecordingError
from thermocald.names import FileFolder
from thermocald.numbers import counted, stated_unit
from thermocald.photogrammetry.series.normals import runs
from thermocald.store.recording.head import CameraSpec, Head, read_head
from thermocald.store.recording.observation_file import ObservationFile
from thermocald.store.recording.sense import pairing_doubts, reading_doubts, time_doubts, time_fault
from thermocald.store.recording.table import Table
from thermocald.store.recording.testfield_file import read_testfield, require_millimetres

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import ArrayLike, NDArray

    from thermocald.arrays import Array, Mask
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.photogrammetry.series.normals import ObservationGrid

READINGS = "readings.csv"
"""The file with every reading of a log, in a recording of frames and a separate log."""
LARGEST_GAP = 10.0  # of readings, in their usual intervals
_KELVIN_FROM = 220.0  # as °C hotter than any camera, as K colder than any day
_STRETCH = 8192  # readings in a row that are tested for kelvin: a part of a log may be in K
_HOTTEST_C = 1000.0  # no camera works there: another unit, or a damaged line


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


@dataclass(frozen=True, slots=True, eq=False)
class EpochColumns:
    """The columns of `epochs.csv`.

    numbers (E,); frame_time, temperature_time (E,) s; temperatures {channel: (E,) °C}; a missing
    reading is NaN. frames: E relative paths, "" for none; extra: unknown columns as text; readings:
    every reading of the log if the recording has a `readings.csv`, else None.
    """

    numbers: NDArray[np.int64]
    frame_time: Array
    temperature_time: Array
    temperatures: dict[str, Array]
    frames: tuple[str, ...]
    extra: dict[str, tuple[str, ...]]
    readings: TemperatureLog | None = None

    def __len__(self) -> int:
        return len(self.numbers)

    def at_frame(self, channel: str) -> Array:
        """Return a channel's temperature at the frames' times, (E,) °C."""
        return interpolate_readings(self.frame_time, *self.readings_of(channel))

    def readings_of(self, channel: str) -> tuple[Array, Array]:
        """Return times (R,) s and readings (R,) °C of a channel: the log's, else the epochs'."""
        if self.readings is not None:
            return self.readings.times, self.readings.channels[channel]
        return self.temperature_time, self.temperatures[channel]


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording: head, test field and epochs. Observations are read when they are first used."""

    path: Path
    head: Head
    testfield: TestField
    columns: EpochColumns
    has_observations: bool

    @property
    def series(self) -> str:
        return self.head.series

    @property
    def title(self) -> str:
        """The recording's name in messages."""
        return str(self.path)

    @property
    def camera(self) -> CameraSpec:
        return self.head.camera

    def extra_columns(self) -> dict[str, tuple[str, ...]]:
        """Return the unknown columns of epochs.csv, as text."""
        return self.columns.extra

    def further_columns(self) -> dict[str, Array]:
        """Return the unknown numeric columns (E,) of epochs.csv, such as a humidity."""
        out = {}
        for name, texts in self.columns.extra.items():
            try:
                values = np.array([float(t) if t.strip() else np.nan for t in texts])
            except ValueError:
                continue  # a column of text, such as notes
            out[name] = np.where(np.isfinite(values), values, np.nan)
        return out

    @cached_property
    def epochs(self) -> list[Epoch]:
        """All epochs with their observations, which are read at the first access."""
        return list(self.iter_epochs())

    def iter_epochs(self, window: slice = slice(None)) -> Iterator[Epoch]:
        """Yield the epochs, or some of them (from 0).

        A long file of observations is read in constant memory; its rows must be in the order of the
        epochs.
        """
        rows = range(len(self))[window]
        part = slice(rows.start, rows.stop)
        seen = self._observation_file.stream(part) if self.has_observations else repeat(None)
        columns = self.columns
        for i, observations in zip(rows, seen, strict=False):
            frame = columns.frames[i]
            yield Epoch(
                int(columns.numbers[i]), float(columns.frame_time[i]),
                float(columns.temperature_time[i]),
                {name: float(t[i]) for name, t in columns.temperatures.items()},
                self.path / frame if frame else None, observations,
                "" if frame or observations is not None else "neither frame nor observations",
            )  # fmt: skip

    def __len__(self) -> int:
        return len(self.columns)

    def blocks(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """Yield observations as grids of consecutive epochs, each with its first epoch (from 0).

        windows: only the epochs of these slices. Raises RecordingError, also if the rows are not in
        the order of their epochs.
        """
        return self._observation_file.grids(windows)

    def observations(self, row: int) -> Observations | None:
        """Return the observations of one epoch (from 0); None for a recording without any."""
        if not self.has_observations:
            return None
        return next(self._observation_file.stream(slice(row, row + 1)))

    def doubts(self) -> list[str]:
        """Return doubts about times, readings and repeated epochs, a sentence each.

        The observations of a long recording are not read for this.
        """
        columns = self.columns
        found = list(time_doubts(columns.numbers, columns.frame_time, self.head.interval))
        found += pairing_doubts(columns.frame_time, columns.temperature_time, self.head.interval)
        for name, values in columns.temperatures.items():
            found += reading_doubts(columns.temperature_time, values, name)
            if (unit := stated_unit(name)) not in (None, "degC"):
                found.append(f"{name}: its name states {unit}, recording.yaml degC: which is true?")
        if (every := columns.readings) is not None:
            for name, values in every.channels.items():
                found += reading_doubts(every.times, values, f"{name} of {READINGS}")
        if repeated := [f for f, n in Counter(columns.frames).items() if f and n > 1]:
            found.append(
                f"{counted(len(repeated), 'frame')} listed in several epochs, the first "
                f"{repeated[0]}"
            )
        if self.has_observations and not self._observation_file.is_long:
            first: dict[bytes, int] = {}
            twice, last = [], 0
            for epoch in self.epochs:
                if (o := epoch.observations) is not None and len(o):
                    last = epoch.number
                    same = first.setdefault(o.targets.tobytes() + o.points.tobytes(), epoch.number)
                    twice += [(epoch.number, same)] if same != epoch.number else []
            if twice:
                found.append(
                    f"{counted(len(twice), 'epoch')} with the image points of another one: epoch "
                    f"{twice[0][0]} those of {twice[0][1]}"
                )
            if (none := int((columns.numbers > last).sum())) > 1:
                found.append(f"the last {none} epochs have no observations: is the file cut off?")
        return found

    @cached_property
    def _observation_file(self) -> ObservationFile:
        parquet = self.path / "observations.parquet"
        path = parquet if parquet.exists() else self.path / "observations.csv"
        return ObservationFile(path, self.testfield, self.columns.numbers, self.camera.sensor)


def open_recording(path: Path) -> Recording:
    """Read a recording except its observations, which are read when they are first used.

    Raises RecordingError or TestFieldError naming file, line and column.
    """
    head = read_head(path)
    field = read_testfield(path / "testfield.csv")
    require_millimetres(field, str(path / "testfield.csv"), head.camera.principal_distance)
    kept = [n for n in ("observations.csv", "observations.parquet") if (path / n).exists()]
    if len(kept) > 1:
        raise RecordingError(f"{path}: has {' and '.join(kept)}; keep one of them")
    has_observations = bool(kept)
    columns = _read_epochs(path, list(head.channels))
    if not has_observations and not any(columns.frames):
        raise RecordingError(
            f"{path}: has neither observations.csv nor frames named in epochs.csv; there is "
            "nothing to calibrate from"
        )
    return Recording(path, head, field, columns, has_observations)


def read_recording(path: Path) -> Recording:
    """Read and check a whole recording, with its observations.

    Raises RecordingError or TestFieldError naming file, line and column.
    """
    recording = open_recording(path)
    _ = recording.epochs
    return recording


def _read_epochs(folder: Path, channels: list[str]) -> EpochColumns:
    required = ["epoch", "frame_time", *(["temperature_time", *channels] if channels else [])]
    table = Table(folder / "epochs.csv", [*required, "frame"])
    extra = [n for n in table.columns if n and n not in {*required, "temperature_time", "frame"}]
    timed = [n for n in ("temperature_time",) if n in table.columns]
    found = table.read(["epoch"], ["frame_time"], [*timed, *channels], ["frame", *extra])
    numbers, frame_time = found["epoch"], found["frame_time"]
    if not len(numbers):
        raise RecordingError(f"{table.path}: holds no epochs")
    wrong = np.diff(numbers, prepend=-1) <= 0
    table.check("epoch", wrong, "is duplicated or after a later one; numbers must increase")
    for name in ("frame_time", *timed):
        times = found[name]
        fault = time_fault(times)
        behind = times - np.fmax.accumulate(np.concatenate([[-np.inf], times]))[:-1]
        row = int(np.argmax(behind < 0))
        if behind[row] < 0 and not (fault and fault[0] < row):
            earlier = times[row] - behind[row]
            table.fail(row, name, f"time runs backwards: {times[row]:.3f} s after {earlier:.3f} s")
        if fault:
            table.fail(fault[0], name, fault[1])
    temperature_time = found.get("temperature_time", np.full(len(numbers), np.nan))
    for name in channels:
        values = found[name]
        untimed = np.isfinite(values) & np.isnan(temperature_time)
        table.check("temperature_time", untimed, f"is empty although {name} was read")
        _check_celsius(table, name, values)
    frames = tuple(map(str.strip, found["frame"]))
    files = FileFolder(folder)
    for row, frame in enumerate(frames):
        if frame and files.find(frame) is None:
            why = "is missing or outside the recording; leave the field empty if it was not stored"
            table.fail(row, "frame", f"{frame!r} {why}")
    if len(frame_time) > 2 and np.ptp(frame_time) == 0:
        table.fail(1, "frame_time", "all epochs have the same time; give the time of each frame")
    return EpochColumns(
        numbers, frame_time, temperature_time, {name: found[name] for name in channels}, frames,
        {name: found[name] for name in extra},
        _read_readings(log, channels) if channels and (log := folder / READINGS).exists() else None,
    )  # fmt: skip


def _check_celsius(table: Table, name: str, values: Array) -> None:
    """Raise the table's error for a temperature (n,) °C that no camera has."""
    table.check(name, values < -273.15, "is below absolute zero")
    table.check(name, values > _HOTTEST_C, f"is above {_HOTTEST_C:g} °C")
    for rows in runs(len(values), _STRETCH):
        known = rows.start + np.flatnonzero(np.isfinite(values[rows]))
        if len(known) and values[known].min() > _KELVIN_FROM:
            table.fail(int(known[0]), name, "seems to be in kelvin: subtract 273.15 to give °C")


def _read_readings(path: Path, channels: Sequence[str]) -> TemperatureLog:
    """Read a `readings.csv`. Raises RecordingError naming line and column."""
    table = Table(path, ["time", *channels])
    columns = table.read(numbers=["time"], optional=channels)
    times = columns.pop("time")
    table.check("time", np.diff(times, prepend=-np.inf) <= 0, "times must increase")
    if fault := time_fault(times):
        table.fail(fault[0], "time", fault[1])
    for name, values in columns.items():
        _check_celsius(table, name, values)
    return TemperatureLog(times, columns)


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
    times, unique = np.unique(times[good], return_index=True)
    values = values[good][unique]
    if len(times) < 2:
        # one reading gives the temperature at its own time only
        only = float(values[0]) if len(values) else np.nan
        return np.where(np.isin(frames, times), only, np.nan)
    interval = float(np.median(np.diff(times)))
    left = np.clip(np.searchsorted(times, frames, side="right") - 1, 0, len(times) - 2)
    span = times[left + 1] - times[left]
    result: Array = values[left] + (values[left + 1] - values[left]) / span * (frames - times[left])
    outside = np.maximum(times[0] - frames, frames - times[-1])
    on_reading = (frames == times[left]) | (frames == times[left + 1])
    gap = LARGEST_GAP * interval
    result[(outside > interval) | ((span > gap) & ~on_reading)] = np.nan
    return result
