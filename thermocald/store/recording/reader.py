"""A recording: a series as an open folder that replays without hardware (CONVENTIONS §3)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from thermocald.epoch import Epoch
from thermocald.errors import RecordingError
from thermocald.names import FileFolder
from thermocald.store.recording.head import CameraSpec, Channel, Head, read_head
from thermocald.store.recording.observation_file import (
    LONG_FROM_BYTES,
    ObservationFile,
    ObservationTable,
)
from thermocald.store.recording.readings import (
    READINGS,
    Readings,
    interpolate_readings,
    read_readings,
    temperature_at_frame,
    temperatures_at_frame,
)
from thermocald.store.recording.sense import (
    pairing_doubts,
    reading_doubts,
    time_doubts,
    time_fault,
)
from thermocald.store.recording.table import Table
from thermocald.store.recording.testfield_file import (
    read_testfield,
    require_millimetres,
    write_testfield,
)
from thermocald.store.recording.writer import RecordingWriter, write_recording

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.photogrammetry.series.normals import ObservationGrid

__all__ = [
    "CameraSpec",
    "Channel",
    "EpochColumns",
    "Head",
    "Recording",
    "RecordingWriter",
    "interpolate_readings",
    "open_recording",
    "read_recording",
    "read_testfield",
    "temperature_at_frame",
    "temperatures_at_frame",
    "write_recording",
    "write_testfield",
]

_KELVIN_FROM = 220.0  # hotter than any camera, and a cold day in kelvin
_HOTTEST_C = 1000.0  # no camera works there: another unit, or a damaged line


@dataclass(frozen=True, slots=True, eq=False)
class EpochColumns:
    """`epochs.csv` in columns.

    numbers (E,), frame_time (E,), temperature_time (E,) s, temperatures {channel: (E,) °C} with
    NaN where there is none; frames: E relative paths, "" for none; extra: unknown columns as text;
    readings: every reading of the log, of a recording that keeps them (`readings.csv`), else None.
    """

    numbers: NDArray[np.int64]
    frame_time: Array
    temperature_time: Array
    temperatures: dict[str, Array]
    frames: tuple[str, ...]
    extra: dict[str, tuple[str, ...]]
    readings: Readings | None = None

    def __len__(self) -> int:
        return len(self.numbers)

    def at_frame(self, channel: str) -> Array:
        """A channel's temperature at the frames' times, (E,) °C."""
        return interpolate_readings(self.frame_time, *self.readings_of(channel))

    def readings_of(self, channel: str) -> tuple[Array, Array]:
        """Times (R,) s and readings (R,) °C of a channel: the log's, else those next to frames."""
        if self.readings is not None:
            return self.readings.times, self.readings.channels[channel]
        return self.temperature_time, self.temperatures[channel]


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording as read: head, test field, epochs. `epochs[i]` is built when it is asked for."""

    path: Path
    head: Head
    testfield: TestField
    columns: EpochColumns
    has_observations: bool

    @property
    def name(self) -> str:
        return self.head.name

    @property
    def series(self) -> str:
        return self.head.series

    @property
    def title(self) -> str:
        """What messages call it."""
        return str(self.path)

    @property
    def interval(self) -> float:
        return self.head.interval

    @property
    def camera(self) -> CameraSpec:
        return self.head.camera

    @property
    def channels(self) -> Mapping[str, Channel]:
        return self.head.channels

    @property
    def extra(self) -> Mapping[str, Any]:
        return self.head.extra

    @cached_property
    def epochs(self) -> Sequence[Epoch]:
        """All epochs with their observations, which are read now if they were not."""
        return _Epochs(self, self._observation_file.load() if self.has_observations else None)

    def iter_epochs(self) -> Iterator[Epoch]:
        """One epoch after the other; a recording of months in constant memory.

        Then the rows of the observations must be in the order of the epochs.
        """
        if "epochs" in self.__dict__ or not self.is_long:
            yield from self.epochs
            return
        for i, observations in enumerate(self._observation_file.stream()):
            yield _epoch(self, i, observations)

    def __len__(self) -> int:
        return len(self.columns)

    def blocks(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """The observations as grids of consecutive epochs, each with its first epoch (from 0).

        windows: only the epochs of these slices. Raises RecordingError, also where the rows are not
        in the order of their epochs.
        """
        return self._observation_file.grids(windows)

    def observations(self, row: int) -> Observations | None:
        """What one epoch (from 0) shows, of a recording that holds observations."""
        if not self.has_observations:
            return None
        if "epochs" in self.__dict__ or not self.is_long:
            return self.epochs[row].observations
        return next(self._observation_file.some(slice(row, row + 1)))

    def doubts(self) -> list[str]:
        """Return what is doubtful in times, readings and repeated epochs, a sentence each.

        Observations too many for memory are not read.
        """
        columns = self.columns
        found = list(time_doubts(columns.numbers, columns.frame_time, self.interval))
        found += pairing_doubts(columns.frame_time, columns.temperature_time, self.interval)
        for name, values in columns.temperatures.items():
            found += reading_doubts(values, name)
        if columns.readings is not None:
            for name, values in columns.readings.channels.items():
                found += reading_doubts(values, f"{name} of {READINGS}")
        if repeated := [f for f, n in Counter(columns.frames).items() if f and n > 1]:
            found.append(f"{len(repeated)} frames stand in several epochs, the first {repeated[0]}")
        if self.has_observations and not self.is_long:
            first: dict[bytes, int] = {}
            twice = []
            for epoch in self.epochs:
                if (o := epoch.observations) is not None and len(o):
                    same = first.setdefault(o.targets.tobytes() + o.points.tobytes(), epoch.number)
                    twice += [(epoch.number, same)] if same != epoch.number else []
            if twice:
                found.append(
                    f"{len(twice)} epochs hold the image points of another one: epoch "
                    f"{twice[0][0]} those of {twice[0][1]}"
                )
        return found

    def framed(self, ok: NDArray[np.bool_]) -> list[tuple[int, Path]]:
        """The first and the last of some epochs (E,), from 0, whose frames were kept, and these."""
        rows = [i for i, frame in enumerate(self.columns.frames) if frame and ok[i]]
        return [(i, self.path / self.columns.frames[i]) for i in rows[:1] + rows[1:][-1:]]

    @property
    def is_long(self) -> bool:
        """Whether its observations are read in parts, as they are too many for memory."""
        size = self._observation_path.stat().st_size if self.has_observations else 0
        return size >= LONG_FROM_BYTES

    @property
    def _observation_path(self) -> Path:
        parquet = self.path / "observations.parquet"
        return parquet if parquet.exists() else self.path / "observations.csv"

    @cached_property
    def _observation_file(self) -> ObservationFile:
        return ObservationFile(
            self._observation_path, self.testfield, self.columns.numbers, self.camera.sensor
        )


class _Epochs(Sequence[Epoch]):
    """Epochs over columns: a day of them costs arrays, not a million objects."""

    def __init__(self, recording: Recording, table: ObservationTable | None) -> None:
        self._recording = recording
        self._table = table

    def __len__(self) -> int:
        return len(self._recording.columns)

    @overload
    def __getitem__(self, index: int) -> Epoch: ...

    @overload
    def __getitem__(self, index: slice) -> list[Epoch]: ...

    def __getitem__(self, index: int | slice) -> Epoch | list[Epoch]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        i = range(len(self))[index]
        return _epoch(self._recording, i, self._table.observations(i) if self._table else None)


def _epoch(recording: Recording, i: int, observations: Any) -> Epoch:
    columns = recording.columns
    frame = columns.frames[i]
    return Epoch(
        number=int(columns.numbers[i]),
        frame_time=float(columns.frame_time[i]),
        temperature_time=float(columns.temperature_time[i]),
        temperatures={name: float(t[i]) for name, t in columns.temperatures.items()},
        frame=recording.path / frame if frame else None,
        observations=observations,
        note="" if frame or observations is not None else "neither frame nor observations",
    )


def open_recording(path: Path) -> Recording:
    """Read everything but the observations, which `epochs` or `iter_epochs` will.

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
    """Read and check a whole recording; nothing is half-read.

    Raises RecordingError or TestFieldError naming file, line and column.
    """
    recording = open_recording(path)
    _ = recording.epochs
    return recording


def _read_epochs(folder: Path, channels: list[str]) -> EpochColumns:
    required = ["epoch", "frame_time", *(["temperature_time", *channels] if channels else [])]
    table = Table(folder / "epochs.csv", [*required, "frame"])
    extra_names = [
        n for n in table.columns if n and n not in {*required, "temperature_time", "frame"}
    ]
    numbers: list[NDArray[np.int64]] = []
    times: dict[str, list[Array]] = {"frame_time": [], "temperature_time": []}
    temperatures: dict[str, list[Array]] = {name: [] for name in channels}
    # Text is kept chunk by chunk: the garbage collector would walk through a list of a year's.
    frames: list[tuple[str, ...]] = []
    files = FileFolder(folder)
    extra: dict[str, list[tuple[str, ...]]] = {name: [] for name in extra_names}
    previous = {"epoch": -1.0, "frame_time": -np.inf, "temperature_time": -np.inf}
    for chunk in table.chunks():
        numbers.append(chunk.integers("epoch"))
        repeated = _steps(numbers[-1], previous["epoch"]) <= 0
        chunk.check("epoch", repeated, "is duplicated or after a later one; numbers must increase")
        previous["epoch"] = float(numbers[-1][-1])
        for name, columns in times.items():
            if name not in table.columns:
                columns.append(np.full(len(chunk), np.nan))
                continue
            columns.append(chunk.numbers(name, empty_is_nan=name == "temperature_time"))
            latest = _running_latest(columns[-1], previous[name])
            chunk.check(
                name,
                columns[-1] < latest[:-1],
                lambda row, v=columns[-1], l=latest: (  # type: ignore[misc]  # noqa: E741
                    f"time runs backwards: {v[row]:.3f} s after {l[row]:.3f} s"
                ),
            )
            if fault := time_fault(columns[-1], previous[name]):
                chunk.fail(fault[0], name, fault[1])
            previous[name] = float(latest[-1])
        for name, readings in temperatures.items():
            readings.append(chunk.numbers(name, empty_is_nan=True))
            untimed = np.isfinite(readings[-1]) & np.isnan(times["temperature_time"][-1])
            chunk.check("temperature_time", untimed, f"is empty although {name} was read")
            chunk.check(name, readings[-1] < -273.15, "is below absolute zero")
            chunk.check(name, readings[-1] > _HOTTEST_C, f"is above {_HOTTEST_C:g} °C")
            known = readings[-1][np.isfinite(readings[-1])]
            if len(known) and known.min() > _KELVIN_FROM:
                chunk.check(
                    name, readings[-1] > _KELVIN_FROM, "reads as kelvin: subtract 273.15, K to °C"
                )
        frames.append(tuple(map(str.strip, chunk.text("frame"))))
        for row, frame in enumerate(frames[-1]):
            if frame and files.find(frame) is None:
                chunk.fail(
                    row,
                    "frame",
                    f"{frame!r} is missing, or leads out of the recording; leave it empty if it "
                    "was not kept",
                )
        for name in extra_names:
            extra[name].append(chunk.text(name))
    if not numbers:
        raise RecordingError(f"{folder / 'epochs.csv'}: holds no epochs")
    joined = {name: np.concatenate(columns) for name, columns in times.items()}
    if len(joined["frame_time"]) > 2 and np.ptp(joined["frame_time"]) == 0:
        table.fail(1, "frame_time", "all epochs have one time; write when each frame was taken")
    return EpochColumns(
        np.concatenate(numbers),
        joined["frame_time"],
        joined["temperature_time"],
        {name: np.concatenate(readings) for name, readings in temperatures.items()},
        tuple(chain.from_iterable(frames)),
        {name: tuple(chain.from_iterable(values)) for name, values in extra.items()},
        read_readings(log, channels) if channels and (log := folder / READINGS).exists() else None,
    )


def _steps(values: NDArray[np.int64], previous: float) -> Array:
    return np.diff(np.concatenate([[previous], values.astype(float)]))


def _running_latest(values: Array, previous: float) -> Array:
    """The latest time before each row, and after the last one; NaN rows are passed over."""
    return np.fmax.accumulate(np.concatenate([[previous], values]))
