"""A series in a store, of a file or of a server: what it is, what its epochs leave, how it is read.

A store holds times as they were stamped: on a machine whose clock was stepped or did not know the
time yet they run backwards, leap, or are wrong as a block. What is right is known afterwards, from
the epochs that follow and from the steps that the daemon noted (`series_times`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from thermocald.errors import StoreError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.epoch.adjustment import Adjustment
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.store.recording.head import Head
    from thermocald.store.recording.observation_file import ObservationRows

NOT_CALIBRATED = "not_calibrated"  # the status of an epoch that has not been adjusted yet
_LISTED = 20
_CLOCK_TOLERANCE_S = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class EpochResult:
    """The numbers of one adjustment, in the order of `PARAMETER_NAMES`.

    status: `ok` or one word for why there is no result, `reason` in a sentence; values (16,), NaN
    where there is none; covariance (16, 16), zero where a parameter was held, None without a
    result; rejected: rows of the test field.
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
        """The part of an adjustment that is kept."""
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
        """Standard deviations (16,), NaN where a parameter was held or nothing was estimated."""
        if self.covariance is None:
            return np.full(16, np.nan)
        variances = np.diag(self.covariance)
        return np.sqrt(np.where(variances > 0, variances, np.nan))


@dataclass(frozen=True, slots=True, eq=False)
class StoredSeries:
    """One series of one camera.

    head: what its recording.yaml would say; start: the start condition, such as `cold`; identity:
    what the device said it is; settings: how it was adjusted (both JSON-able); created_utc: s.
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


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened: a knock, a device gone or back, a deletion.

    utc: s; kind: one word; series and epoch: where it belongs to one; data: JSON-able.
    """

    utc: float
    kind: str
    text: str
    series: int | None = None
    epoch: int | None = None
    data: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class LoggedReading:
    """What a thermometer said that belongs to no epoch: utc s, values {channel: °C}."""

    thermometer: str
    utc: float
    values: Mapping[str, float]
    clock_trusted: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class StoredEpoch:
    """An epoch as kept: what was acquired, the latest calibration, and what else was recorded.

    revision: 0, and one more with each later calibration; extra: further columns by name.
    """

    epoch: Epoch
    result: EpochResult
    extra: Mapping[str, float]
    clock_trusted: bool
    revision: int


class SeriesReader(ABC):
    """An open store that is read, of a file or of a server; use it in a `with` block.

    Each has its own way to list series and to read their columns and epochs as they were stamped;
    finding a series and corrected times follow from these.
    """

    path: Path
    corrected = False
    """Whether times are given as they should have been, see `series_times`."""
    _times: dict[int, SeriesTimes | None] | None = None
    # how one of several series is selected
    _remedy = "; select one: --series CAMERA/SERIES, or thermocald archive makes recordings of all"

    @abstractmethod
    def all_series(self) -> list[StoredSeries]:
        """All series, in the order in which they were started."""

    @abstractmethod
    def stamped_columns(
        self, series: StoredSeries, names: Sequence[str]
    ) -> dict[str, NDArray[Any]]:
        """Columns (E,) over all epochs by name, with times as they were stamped."""

    @abstractmethod
    def clock_steps(self, series: StoredSeries) -> list[Event]:
        """The steps of the clock while this series ran, oldest first."""

    @abstractmethod
    def covariances(self, series: StoredSeries, numbers: Sequence[int]) -> Array:
        """(E, 16, 16) covariances of some epochs, NaN for those without a result."""

    @abstractmethod
    def observation_rows(self, series: StoredSeries, first: int, last: int) -> ObservationRows:
        """The observations of the epochs numbered `first` to `last`, without their quality."""

    @abstractmethod
    def _epochs(
        self, series: StoredSeries, first: int, last: int | None, details: bool
    ) -> Iterator[StoredEpoch]: ...

    @abstractmethod
    def close(self) -> None:
        """Close it; may be called twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def epochs(
        self, series: StoredSeries, first: int = 0, last: int | None = None, *, details: bool = True
    ) -> Iterator[StoredEpoch]:
        """The epochs numbered `first` to `last`, one after the other, in constant memory.

        details: False leaves out observations and covariances, and is faster.
        """
        found = self._epochs(series, first, last, details)
        times = self._corrected_times(series) if self.corrected else None
        return found if times is None else map(times.correct, found)

    def series_columns(self, series: StoredSeries, names: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Columns over all epochs by name, (E,) each: a million epochs in a fraction of a second.

        Names are `epoch`, `frame_time`, `c`, `sd_c`, `sigma0`, a temperature channel (°C as read),
        an extra column such as `blur_px`; numbers are float64, NaN where an epoch has none;
        `status` is text.
        """
        columns = self.stamped_columns(series, names)
        timed = {"frame_time", "temperature_time"} & set(names)
        if self.corrected and timed and (times := self._corrected_times(series)) is not None:
            right = {"frame_time": times.frame, "temperature_time": times.reading}
            columns |= {name: right[name] for name in timed}
        return columns

    def _corrected_times(self, series: StoredSeries) -> SeriesTimes | None:
        """The times of a series; None where they are as they were stamped."""
        if self._times is None:
            self._times = {}
        if series.id not in self._times:
            times = series_times(self, series)
            self._times[series.id] = times if np.any(times.corrections) else None
        return self._times[series.id]

    @property
    def where(self) -> str:
        """What messages call it: an address without its password."""
        return str(self.path)

    def only_series(self, name: str | None) -> StoredSeries:
        """The series `CAMERA/SERIES` or `SERIES` that --series names, None: the only one.

        Raises StoreError, listing what there is and naming the option, if none or several fit.
        """
        camera, _, series = (name or "").rpartition("/")
        return self.find_series(camera or None, series or None)

    def find_series(self, camera: str | None = None, name: str | None = None) -> StoredSeries:
        """The one series of a camera and a name, either of which may be left open.

        Raises StoreError, listing what there is, if none or several fit.
        """
        every = self.all_series()
        found = [s for s in every if camera in (None, s.camera) and name in (None, s.name)]
        if len(found) != 1:
            there = ", ".join(self._label(s) for s in every[:_LISTED]) or "none"
            more = f" and {len(every) - _LISTED} more" if len(every) > _LISTED else ""
            raise StoreError(
                f"{self.where}: {'several series fit' if found else 'there is no such series'}; "
                f"camera/series in this store: {there}{more}{self._remedy}"
            )
        return found[0]

    def _label(self, series: StoredSeries) -> str:
        return f"{series.camera}/{series.name}"


@dataclass(frozen=True, slots=True, eq=False)
class SeriesTimes:
    """Corrected times of a series.

    numbers (E,): of its epochs; frame, reading (E,) s: of the frames and of the readings;
    corrections (E,) s: what was added to the times of the frames.
    """

    numbers: NDArray[np.int64]
    frame: Array
    reading: Array
    corrections: Array

    def correct(self, stored: StoredEpoch) -> StoredEpoch:
        """The epoch with its corrected times."""
        row = int(np.searchsorted(self.numbers, stored.epoch.number))
        frame_time, temperature_time = float(self.frame[row]), float(self.reading[row])
        epoch = replace(stored.epoch, frame_time=frame_time, temperature_time=temperature_time)
        return replace(stored, epoch=epoch)


def series_times(source: SeriesReader, series: StoredSeries) -> SeriesTimes:
    """The corrected times of all epochs of a series. Raises StoreError."""
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
    # a reading next to a step of the clock may be stamped by the other of the two
    nearest = reading.copy()
    for shift in np.unique(corrections):
        moved = reading + shift
        nearest = np.where(np.abs(moved - frame) < np.abs(nearest - frame), moved, nearest)
    return SeriesTimes(columns["epoch"].astype(np.int64), frame, nearest, corrections)


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
    tolerance = max(_CLOCK_TOLERANCE_S, 3.0 * interval)
    for step in steps:
        if trusted is None or step < tolerance:
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
