"""A measured series: its camera, test field, thermometers, times and observations.

It is read from a recording's folder, a store or a server; callers need not know from which.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.series.drift import with_drifts
from thermocald.analysis.series.recorded import misplaced_doubts, replay_into, series_epochs
from thermocald.analysis.study.measured import measured_series
from thermocald.arrays import spread_rows
from thermocald.errors import DataError, UsageError
from thermocald.names import checked
from thermocald.numbers import celsius, counted
from thermocald.photogrammetry.camera.camera_model import DEFAULT_FREE, IOP_NAMES
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.photogrammetry.field.testfield import FAR_ELSEWHERE
from thermocald.photogrammetry.series.result import EXTERIOR_CHOICES
from thermocald.store.recording.reader import Recording, open_recording
from thermocald.store.recording.sense import interior_doubts, target_doubts
from thermocald.store.server.connection import is_server
from thermocald.store.sources import StoredRecording, open_source, require_source, source_name
from thermocald.thermal.source import series_input

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.analysis.series.epochs import Epochs
    from thermocald.analysis.study.measured import MeasuredSeries
    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.physics.simulation import Simulation
    from thermocald.result import Columns
    from thermocald.store.recording.head import Head
    from thermocald.store.series import StoredSeries
    from thermocald.thermal.series import SeriesInput

Progress = Callable[[int], None] | None
Say = Callable[[str], None] | None
COLDEST_C = -273.15
_LOOKED_AT = 25  # epochs in which the targets are compared with the field


@checked
class Series:
    """A measured series of one camera.

    head: name, interval (s), camera and thermometers; testfield: the control points, mm; source:
    where the series was read from, for messages. Observations are read when they are needed.

    >>> series = tc.open("M1")
    >>> series.camera, series.name, len(series)
    ('rpi-v2.1', 'M1', 150)
    """

    simulation: Simulation | None = None
    """The simulation of a simulated series, else None."""

    def __init__(self, measured: Recording | StoredSeries, store: Path | None = None) -> None:
        """Take a recording, or a series of a store; the store is opened whenever it is read.

        `place` identifies the series: two objects for the same series have the same place.
        """
        self._measured, self._store = measured, store
        self.head: Head = measured.head
        self.testfield: TestField = measured.testfield
        if isinstance(measured, Recording):
            self.source = measured.title
            path = measured.path
            self.place = str(path.resolve()) if path.name else str(id(measured))
        else:
            assert store is not None
            named = f"{measured.camera}/{measured.name}"
            self.source = f"{source_name(store)}: {named}"
            where = store if is_server(store) else store.resolve()
            self.place = f"{where} {named} {measured.id}"

    @property
    def name(self) -> str:
        """The series' name, for example M1."""
        return self.head.series

    @property
    def camera(self) -> str:
        """The camera's name."""
        return self.head.camera.name

    @cached_property
    def frame_time(self) -> Array:
        """(E,) times of the frames, s UTC, corrected where a daemon's clock was wrong."""
        with self._opened() as source:
            return source.columns.frame_time

    @property
    def truth(self) -> Array | None:
        """(E, 10) true interior orientation of a simulated series, else None."""
        return None if self.simulation is None else np.array(self.simulation.truth.iop)

    @property
    def time(self) -> NDArray[np.datetime64]:
        """(E,) times of the frames, UTC, to the microsecond."""
        return np.round(self.frame_time * 1e6).astype(np.int64).astype("datetime64[us]")

    @cached_property
    def temperatures(self) -> dict[str, Array]:
        """{thermometer: (E,) °C} at the frames' times, NaN if unknown; the reference is first."""
        with self._opened() as source:
            return {name: source.columns.at_frame(name) for name in self.head.channels}

    def besides(self, numbers: NDArray[np.int64], *, extra: bool = False) -> Columns:
        """Return further columns for the epochs `numbers` (E,): the thermometers' °C at the frames.

        extra: also the camera's settings, light, blur, the filter's state and a file's unknown
        columns.
        """
        columns: Columns = {f"temperature {n}": column for n, column in self.temperatures.items()}
        with self._opened() as source:
            known = source.columns.numbers
            if extra:
                columns |= source.extra_columns()
        rows = np.searchsorted(known, numbers)
        rows = np.where(np.append(known, -1)[rows] == numbers, rows, -1)
        for name, column in columns.items():
            if isinstance(column, np.ndarray):
                columns[name] = np.append(column, np.nan)[rows]
            else:
                columns[name] = tuple("" if row < 0 else column[row] for row in rows)
        return columns

    @property
    def temperature(self) -> Array:
        """(E,) the reference thermometer's °C at the frames' times, NaN if unknown."""
        return next(iter(self.temperatures.values()), np.full(len(self), np.nan))

    def __len__(self) -> int:
        return len(self.frame_time)

    def __repr__(self) -> str:
        size = f"{counted(len(self), 'epoch')}, {counted(len(self.testfield), 'target')}"
        text = f"<Series {self.camera}/{self.name}: {size}"
        known = self.temperature[np.isfinite(self.temperature)]
        if len(known):
            reference = next(iter(self.temperatures))
            span = f"{celsius(known.min(), 1)} to {celsius(known.max(), 1)} °C"
            text += f", {span} (reference: {reference})"
        return text + ">"

    def calibrate(
        self,
        *,
        exterior: str = "auto",
        free: str | Iterable[str] = DEFAULT_FREE,
        store: Path | str | None = None,
        jobs: int = 1,
        progress: Progress = None,
    ) -> Epochs:
        """Calibrate all epochs in one adjustment of the series.

        exterior: `per_epoch`, `series` (one exterior orientation for all epochs), `mount` (one, and
        the mount's movements) or `auto` (chosen from the data); for a series of a store also
        `stored` (the results as they are stored). free: the parameters of the interior orientation
        to estimate; the others are held. store: for a recording, a file in which all epochs are
        stored; an interrupted run continues there. jobs: number of processes. progress: called with
        the number of further epochs done. Raises DataError if no epoch has a result, StoreError if
        the store cannot be written. Source: Gauss-Markov model with data snooping, Luhmann et al.
        2019, chapter 4.

        >>> epochs = tc.open("M1").calibrate()
        >>> bool(abs(epochs.c[-1] - epochs.c[0]) > 3 * epochs.sd_c[0])
        True
        """
        if exterior != "stored":
            check_exterior(exterior)
        elif isinstance(self._measured, Recording):
            raise UsageError(f"exterior 'stored': {self.source} is a recording, not a store")
        elif free_names(free) != DEFAULT_FREE:
            raise UsageError("--free: stored epochs are not adjusted again; give an --exterior")
        require_within(jobs=(jobs, 1, 256))
        settings = AdjustmentSettings(free=free_names(free))
        if store is None:
            with self._opened() as source:
                return with_drifts(series_epochs(source, settings, exterior, progress, jobs))
        path = source_of(store)
        if not isinstance(self._measured, Recording):
            raise UsageError(f"{path}: {self.source} is in a store already")
        advance = progress or (lambda _: None)
        return replay_into(path, self._measured, settings, exterior, advance, jobs)

    def doubts(
        self,
        epochs: Epochs | None = None,
        interior: Array | None = None,
        offsets: Array | None = None,
    ) -> list[str]:
        """Return probable mistakes in the recorded data, one sentence each.

        epochs: the calibrated epochs, to check the camera and the field as well. interior: an
        interior orientation to check instead, c, x0, y0 (mm) first. offsets: (T, 2) px, by how much
        the targets' images differ from those that a mean camera predicts.

        >>> tc.open("M1").doubts()
        []
        """
        doubts = self._measured.doubts() if isinstance(self._measured, Recording) else []
        good = np.zeros(0, dtype=np.int64) if epochs is None else np.flatnonzero(epochs.ok)
        if epochs is not None and len(good):
            interior = np.median(epochs.values[good, :3], axis=0)
        if interior is not None:
            c, x0, y0 = interior[:3].tolist()
            doubts = [*doubts, *interior_doubts(self.head.camera, c, x0, y0)]
            if offsets is not None:
                c_px = c / self.head.camera.sensor.pixel_pitch
                doubts += target_doubts(self.testfield.names, offsets, c_px, FAR_ELSEWHERE)
        if epochs is not None and len(good) and isinstance(self._measured, Recording):
            some = good[spread_rows(len(good), _LOOKED_AT)]
            doubts = [*doubts, *misplaced_doubts(self._measured, some, epochs.values[some])]
        return doubts

    def measured(
        self,
        label: str | None = None,
        thermometer_sd: float | None = None,
        exterior: str = "auto",
        free: Iterable[str] = DEFAULT_FREE,
        jobs: int = 1,
    ) -> MeasuredSeries:
        """Return the series in the form that a study reads.

        label: series with the same label are one camera; by default the camera's name, for a
        store's series with its start condition. free: by default, for a store's series, as stored;
        then `exterior="per_epoch"` returns its epochs as they are stored.
        """
        check_exterior(exterior)
        usual = self.camera
        if not isinstance(self._measured, Recording):
            usual += f"-{self._measured.start}" if self._measured.start else ""
            if tuple(free) == DEFAULT_FREE:
                free = self._measured.settings.get("free", DEFAULT_FREE)
                exterior = "stored" if exterior == "per_epoch" else exterior
        settings = AdjustmentSettings(free=tuple(free))
        with self._opened() as source:
            source.head.require_calibrated(source.title)
            table = series_epochs(source, settings, exterior, None, jobs)
            found = measured_series(source, table, label or usual, thermometer_sd)
        return replace(found, doubts=tuple(self.doubts(table, found.mean)))

    def observed(self, progress: Progress = None, jobs: int = 1, say: Say = None) -> SeriesInput:
        """Return the series in the form that thermal models and discovery read; measure its frames.

        say: called with a sentence before frames are measured.
        """
        with self._opened() as source:
            return series_input(source, say, progress, jobs)

    @contextmanager
    def _opened(self) -> Iterator[Recording | StoredRecording]:
        """Open the recording or the store for reading."""
        if isinstance(self._measured, Recording):
            yield self._measured
        else:
            assert self._store is not None
            with open_source(self._store) as store:
                yield StoredRecording(store, self._measured)


def open(source: Path | str, series: str | None = None) -> Series:  # noqa: A001
    """Open a series from a recording's folder or a store (a file or `postgresql://…`).

    series: `CAMERA/SERIES` or `SERIES`, needed if a store holds several. Frames and observations
    are read when they are needed. Raises StoreError if nothing is there or several series match,
    RecordingError, which names file, line and column, if the recording is broken.

    >>> tc.open("M1")
    <Series rpi-v2.1/M1: 150 epochs, 147 targets, 25.0 to 50.0 °C (reference: temperature)>
    """
    path = source_of(source)
    if require_source(path).is_dir():
        found = Series(open_recording(path))
        if series not in (None, found.name, f"{found.camera}/{found.name}"):
            raise DataError(f"{path}: is {found.camera}/{found.name}, not {series}")
        return found
    with open_source(path) as store:
        return Series(store.only_series(series), path)


def open_all(source: Path | str) -> list[Series]:
    """Open all series of a store or a server, or the one series of a recording's folder.

    Raises StoreError if nothing is there, DataError if the store holds no series.

    >>> len(tc.open_all("thermocald.db"))
    1
    """
    path = source_of(source)
    if require_source(path).is_dir():
        return [open(path)]
    with open_source(path) as store:
        found = [Series(stored, path) for stored in store.all_series()]
    if not found:
        raise DataError(f"{source_name(path)}: the store holds no series")
    return found


def check_exterior(exterior: str) -> None:
    """Raise UsageError for an unknown choice of the exterior orientation."""
    if exterior not in EXTERIOR_CHOICES:
        choices = ", ".join(EXTERIOR_CHOICES)
        raise UsageError(f"--exterior {exterior}: must be one of {choices}")


def require_series(series: Sequence[Series]) -> None:
    """Raise UsageError for a series that is given twice."""
    for one, other in combinations(series, 2):
        if one.place == other.place:
            same = f"is the same series as {other.source}"
            fault = "is given twice" if one.source == other.source else same
            raise UsageError(
                f"{one.source} {fault}; give each series once (a copy would count as a second "
                "measurement that agrees perfectly)"
            )


def require_within(**bounds: tuple[Any, float] | tuple[Any, float, float]) -> None:
    """Raise UsageError for an argument, name=(value, least[, most]), out of bounds; None passes."""
    for name, (value, least, *rest) in bounds.items():
        if value is None:
            continue
        if not (least <= value <= (rest[0] if rest else sys.float_info.max)):
            bound = f"from {least:g} to {rest[0]:g}" if rest else f"at least {least:g}"
            raise UsageError(f"{name} is {value}; it must be {bound}")


def free_names(given: str | Iterable[str]) -> tuple[str, ...]:
    """Return the parameters to estimate in the order of IOP_NAMES, from names or `c,x0,y0`.

    `none` frees no parameter. Raises UsageError for an unknown name.
    """
    names = [n.strip() for n in given.split(",")] if isinstance(given, str) else list(given)
    if names == ["none"]:
        return ()
    for name in names:
        if name not in IOP_NAMES:
            choices = ", ".join(IOP_NAMES)
            raise UsageError(
                f"--free: {name!r} is not a parameter of the interior orientation; give some of "
                f"{choices}, or none"
            )
        if names.count(name) > 1:
            raise UsageError(f"--free: {name} is given twice")
    return tuple(name for name in IOP_NAMES if name in names)


def source_of(text: Path | str) -> Path:
    """Return a path with `~` expanded, or a server's address, as the readers take it."""
    if text == "":
        raise UsageError("a path is empty: give a recording (folder) or a store")
    path = Path(text)
    return path if is_server(path) else Path(os.path.expanduser(path))  # Path's raises for ~nobody
