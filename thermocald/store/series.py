"""A series in a store, in a file or on a server: its records, and the interface that reads it.

A store holds times as they were stamped. On a machine whose clock was stepped or not yet set, they
run backwards, jump, or are offset as a block. `series_times` corrects them afterwards from the
epochs that follow and from the clock steps that the daemon recorded.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from thermocald.errors import StoreError
from thermocald.numbers import listed

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.epoch.adjustment import Adjustment
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.store.recording.head import Head

NOT_CALIBRATED = "not_calibrated"  # status of an epoch that is not adjusted yet
LOG = "log of series "
_LISTED = 20
_CLOCK_TOLERANCE_S = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class EpochResult:
    """The numbers of one adjustment, in the order of `PARAMETER_NAMES`.

    status: `ok`, or one word for why there is no result; reason: the same in a sentence; values
    (16,), NaN if not estimated; covariance (16, 16), zero for a parameter that was held, None
    without a result; rejected: rows of the test field.
    """

    status: str
    reason: str = ""
    values: Array = field(default_factory=lambda: np.full(16, np.nan))
    covariance: Array | None = None
    sigma0: float = float("nan")
    redundancy: int = 0
    n_observations: int = 0
    rejected: tuple[int, ...] = ()

    @classmethod
    def from_adjustment(cls, adjustment: Adjustment) -> Self:
        """Return the part of an adjustment that a store holds."""
        values = np.full(16, np.nan)
        if adjustment.interior is not None:
            values[:10] = adjustment.interior.as_array()
        if adjustment.exterior is not None:
            values[10:] = adjustment.exterior.as_array()
        solved = adjustment.interior is not None or adjustment.exterior is not None
        return cls(
            adjustment.status, adjustment.reason, values, adjustment.covariance if solved else None,
            float(adjustment.sigma0), int(adjustment.redundancy), int(adjustment.n_observations),
            tuple(int(row) for row in adjustment.rejected),
        )  # fmt: skip

    @property
    def sd(self) -> Array:
        """Standard deviations (16,), NaN for a parameter that was held or not estimated."""
        if self.covariance is None:
            return np.full(16, np.nan)
        variances = np.diag(self.covariance)
        return np.sqrt(np.where(variances > 0, variances, np.nan))


@dataclass(frozen=True, slots=True, eq=False)
class StoredSeries:
    """One series of one camera.

    head: what its recording.yaml would hold; start: the start condition, such as `cold`; identity:
    what the device reported about itself; settings: those of the adjustment (both can be written
    as JSON); created_utc: s.
    """

    id: int
    head: Head
    testfield: TestField
    start: str
    identity: Mapping[str, Any]
    settings: Mapping[str, Any]
    created_utc: float

    @property
    def camera(self) -> str:
        return self.head.camera.name

    @property
    def name(self) -> str:
        return self.head.series

    @property
    def log_name(self) -> str:
        """The thermometer that stands for a recording's log; a configured one has no blanks."""
        return f"{LOG}{self.id}"


@dataclass(frozen=True, slots=True)
class Event:
    """An event: a knock, a device lost or found again, a deletion.

    utc: s; kind: one word; series, epoch: None if it belongs to none; data can be written as JSON.
    """

    utc: float
    kind: str
    text: str
    series: int | None = None
    epoch: int | None = None
    data: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class LoggedReading:
    """A reading of a thermometer that belongs to no epoch: utc s, values {channel: °C}."""

    thermometer: str
    utc: float
    values: Mapping[str, float]
    clock_trusted: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class StoredEpoch:
    """An epoch as stored: what was acquired, its latest calibration, and further columns.

    revision: 0, and one more with each later calibration; extra: further columns by name.
    """

    epoch: Epoch
    result: EpochResult
    extra: Mapping[str, float]
    clock_trusted: bool
    revision: int


class SeriesReader(ABC):
    """An open store, in a file or on a server, to be read from; use it in a `with` block.

    A subclass lists the series and reads their columns and epochs with the times as stamped. This
    class finds a series and corrects the times.
    """

    path: Path
    corrected = False
    """Whether times are corrected, see `series_times`."""
    _times: dict[int, SeriesTimes | None] | None = None
    # ends the message of a selection that fits no series or several
    _remedy = (
        "; export selects one with --series CAMERA/SERIES; for another command write it as a "
        "recording with thermocald archive --series"
    )

    @abstractmethod
    def all_series(self) -> list[StoredSeries]:
        """Return all series, in the order in which they were begun."""

    @abstractmethod
    def stamped_columns(
        self, series: StoredSeries, names: Sequence[str]
    ) -> dict[str, NDArray[Any]]:
        """Return columns (E,) over all epochs by name, with times as stamped."""

    @abstractmethod
    def clock_steps(self, series: StoredSeries) -> list[Event]:
        """Return the steps of the clock while this series ran, oldest first."""

    @abstractmethod
    def covariances(self, series: StoredSeries, numbers: Sequence[int]) -> Array:
        """Return covariances (E, 16, 16) of the epochs `numbers`, NaN without a result."""

    def logged(self, series: StoredSeries) -> list[LoggedReading]:  # noqa: ARG002
        """Return every reading of the log that a replayed recording had; a server has none."""
        return []

    @abstractmethod
    def _epochs(
        self, series: StoredSeries, first: int, last: int | None, details: bool
    ) -> Iterator[StoredEpoch]: ...

    @abstractmethod
    def close(self) -> None:
        """Close the store, and release its lock if it has one; may be called twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def epochs(
        self, series: StoredSeries, first: int = 0, last: int | None = None, *, details: bool = True
    ) -> Iterator[StoredEpoch]:
        """Yield epochs `first` to `last` (numbers) in constant memory.

        details: False leaves out observations and covariances, which is faster.
        """
        stamped = self._epochs(series, first, last, details)
        times = self._corrected_times(series) if self.corrected else None
        return stamped if times is None else map(times.correct, stamped)

    def observations(self, series: StoredSeries, first: int, last: int) -> dict[int, Observations]:
        """Return the latest observations of epochs `first` to `last` (numbers) that have some."""
        epochs = (stored.epoch for stored in self._epochs(series, first, last, details=True))
        return {e.number: e.observations for e in epochs if e.observations is not None}

    def series_columns(self, series: StoredSeries, names: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Return columns (E,) over all epochs by name: a million epochs in a fraction of a second.

        Names are `epoch`, `frame_time`, `c`, `sd_c`, `sigma0`, a temperature channel (°C as read)
        or an extra column such as `blur_px`. Numbers are float64, NaN for an epoch without one;
        `status` is text.
        """
        columns = self.stamped_columns(series, names)
        timed = {"frame_time", "temperature_time"} & set(names)
        if self.corrected and timed and (times := self._corrected_times(series)) is not None:
            corrected = {"frame_time": times.frame, "temperature_time": times.reading}
            columns |= {name: corrected[name] for name in timed}
        return columns

    def _corrected_times(self, series: StoredSeries) -> SeriesTimes | None:
        """Return the corrected times of a series; None if none of them was corrected."""
        if self._times is None:
            self._times = {}
        if series.id not in self._times:
            times = series_times(self, series)
            self._times[series.id] = times if np.any(times.corrections) else None
        return self._times[series.id]

    @property
    def where(self) -> str:
        """The store's name in messages: a path, or an address without its password."""
        return str(self.path)

    def series_of(self, camera: str, name: str) -> StoredSeries | None:
        """Return a camera's series of this name, None if there is none."""
        return next((s for s in self.all_series() if (s.camera, s.name) == (camera, name)), None)

    def only_series(self, name: str | None) -> StoredSeries:
        """Return the series `CAMERA/SERIES` or `SERIES` that --series names; None: the only one.

        Raises StoreError, listing the series and naming the option, if none or several fit.
        """
        camera, _, series = (name or "").rpartition("/")
        return self.find_series(camera or None, series or None)

    def find_series(self, camera: str | None = None, name: str | None = None) -> StoredSeries:
        """Return the one series of a camera and a name; None stands for any.

        Raises StoreError, listing the series, if none or several fit.
        """
        every = self.all_series()
        found = [s for s in every if camera in (None, s.camera) and name in (None, s.name)]
        if len(found) != 1:
            there = listed([self._label(s) for s in every], _LISTED) or "none"
            raise StoreError(
                f"{self.where}: {'several series fit' if found else 'there is no such series'}; "
                f"camera/series in this store: {there}{self._remedy}"
            )
        return found[0]

    def _label(self, series: StoredSeries) -> str:
        return f"{series.camera}/{series.name}"


@dataclass(frozen=True, slots=True, eq=False)
class SeriesTimes:
    """The corrected times of a series.

    numbers (E,): the epochs' numbers; frame, reading (E,) s: times of the frames and of the
    readings; corrections (E,) s: added to the times of the frames.
    """

    numbers: NDArray[np.int64]
    frame: Array
    reading: Array
    corrections: Array

    def correct(self, stored: StoredEpoch) -> StoredEpoch:
        """Return an epoch with its corrected times; one stored since they were read is correct."""
        row = int(np.searchsorted(self.numbers, stored.epoch.number))
        if row == len(self.numbers):
            return stored
        frame_time, temperature_time = float(self.frame[row]), float(self.reading[row])
        epoch = replace(stored.epoch, frame_time=frame_time, temperature_time=temperature_time)
        return replace(stored, epoch=epoch)


def series_times(source: SeriesReader, series: StoredSeries) -> SeriesTimes:
    """Return the corrected times of all epochs of a series. Raises StoreError."""
    names = ["epoch", "frame_time", "temperature_time", "clock_trusted"]
    columns = source.stamped_columns(series, names)
    steps = [
        float(event.data["seconds"])
        for event in source.clock_steps(series)
        if event.data.get("adopted") is True
    ]
    stamped, reading = columns["frame_time"], columns["temperature_time"]
    corrections = clock_corrections(stamped, series.head.interval, columns["clock_trusted"], steps)
    frame = stamped + corrections
    # at a clock step, a reading and its frame may be stamped by different settings
    nearest = reading.copy()
    for shift in np.unique(corrections):
        moved = reading + shift
        nearest = np.where(np.abs(moved - frame) < np.abs(nearest - frame), moved, nearest)
    return SeriesTimes(columns["epoch"].astype(np.int64), frame, nearest, corrections)


def clock_corrections(
    frame_time: Array, interval: float, trusted: Array, steps: Sequence[float]
) -> Array:
    """Return corrections (E,) s that make times (E,) ascend and, where known, right.

    trusted (E,): 0 if the clock was not synchronised; steps, s: those that time stamps followed.
    First, epochs from before the clock was set are moved by the step that set it. Then epochs
    between a step forwards and the same step back, a glitch of the clock, are moved back. Last, at
    any other step back, all earlier epochs are moved to end one interval before the next one, as
    the later setting of the clock is the more reliable. Other corrections are zero.
    """
    corrections = np.zeros(len(frame_time))
    tolerance = max(_CLOCK_TOLERANCE_S, 3.0 * interval)
    for step in steps:
        if step < tolerance:
            continue
        times = frame_time + corrections
        fits = np.abs(np.diff(times) - interval - step) < tolerance
        for i in np.flatnonzero(fits & (trusted[:-1] == 0)) + 1:
            if times[i] - times[i - 1] > tolerance:
                known = np.flatnonzero(trusted[:i] != 0)
                corrections[int(known[-1]) + 1 if known.size else 0 : i] += step
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
