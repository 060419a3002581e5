"""A measured series: camera, test field, thermometers, times, observations, wherever they lie.

A recording's folder, a store and a server each have a reader here; what is above asks none of them
which one it is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.series.drift import with_drifts
from thermocald.analysis.series.recorded import recorded_table
from thermocald.analysis.series.stored import replay_into, table_of_stored
from thermocald.analysis.study.input import measured_series, stored_series
from thermocald.errors import DataError, UsageError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.photogrammetry.epoch.adjustment import DEFAULT_FREE, AdjustmentSettings
from thermocald.photogrammetry.series.blocks import give_back
from thermocald.photogrammetry.series.result import EXTERIOR_CHOICES
from thermocald.store.recording.reader import Recording, open_recording
from thermocald.store.recording.sense import interior_doubts
from thermocald.store.server.connection import is_server
from thermocald.store.sources import open_source, require_source, source_name
from thermocald.store.stored_recording import StoredRecording
from thermocald.thermal.source import series_input

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import NDArray

    from thermocald.analysis.series.epochs import Epochs
    from thermocald.analysis.study.measured import MeasuredSeries
    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.physics.simulation import Simulation
    from thermocald.store.recording.head import Head
    from thermocald.store.series import StoredSeries
    from thermocald.thermal.series import SeriesInput

    Progress = Callable[[int], None] | None
    Say = Callable[[str], None] | None
    Source = Recording | StoredRecording


class Series(ABC):
    """What was measured: one series of one camera.

    head: name, interval s, camera and thermometers; testfield: the known points, mm; source: where
    it is from, for messages. Observations are read when they are needed.

    >>> series = tc.open("M1")
    >>> series.camera, series.name, len(series)
    ('rpi-v2.1', 'M1', 150)
    """

    head: Head
    testfield: TestField
    source: str
    place: str
    """The same for two that are the same."""
    simulation: Simulation | None = None
    """Where a simulated series comes from, else None."""

    @property
    def name(self) -> str:
        """Its name, such as M1."""
        return self.head.series

    @property
    def camera(self) -> str:
        """The camera's name."""
        return self.head.camera.name

    @property
    @abstractmethod
    def frame_time(self) -> Array:
        """(E,) s UTC: when each frame was taken."""

    @property
    def truth(self) -> Array | None:
        """Of a simulated series the true interior orientation (E, 10), else None."""
        return None if self.simulation is None else np.array(self.simulation.truth.iop)

    @property
    def time(self) -> NDArray[np.datetime64]:
        """(E,): the frames' times, UTC, to the microsecond."""
        return np.round(self.frame_time * 1e6).astype(np.int64).astype("datetime64[us]")

    @property
    @abstractmethod
    def temperatures(self) -> dict[str, Array]:
        """{thermometer: (E,) °C} at the frames' times, NaN where unknown; the first is the
        reference.
        """

    @property
    def temperature(self) -> Array:
        """(E,) °C of the reference at the frames' times, NaN where unknown."""
        return next(iter(self.temperatures.values()), np.full(len(self), np.nan))

    def __len__(self) -> int:
        return len(self.frame_time)

    def __repr__(self) -> str:
        size = f"{len(self)} epochs, {len(self.testfield)} targets"
        text = f"<Series {self.camera}/{self.name}: {size}"
        known = self.temperature[np.isfinite(self.temperature)]
        if len(known):
            reference = next(iter(self.temperatures))
            text += f", {known.min():.1f} to {known.max():.1f} °C (reference: {reference})"
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
        """Calibrate every epoch, in one adjustment of the series.

        exterior: `per_epoch`, `series` (one orientation for all), `mount` (one, and movements of
        the mount), `auto` (what the data show); of a store also `stored`: as they were stored.
        free: the interior orientation to estimate, the rest is held; store: of a recording, a file
        that keeps all epochs; what was interrupted goes on there; jobs: processes; progress:
        receives how many epochs are done. Raises DataError where no epoch has a result, StoreError
        for a store that cannot be written. Source: Gauss-Markov model with data snooping, Luhmann
        et al. 2019, chapter 4.

        >>> epochs = tc.open("M1").calibrate()
        >>> bool(abs(epochs.c[-1] - epochs.c[0]) > 3 * epochs.sd_c[0])
        True
        """
        if exterior != "stored":
            check_exterior(exterior)
        settings = AdjustmentSettings(free=free_names(free))
        if store is not None:
            return self._kept(source_of(store), settings, exterior, progress, jobs)
        with self._opened() as source:
            return with_drifts(self._table(source, settings, exterior, progress, jobs)[0])

    def _kept(
        self,
        store: Path,
        settings: AdjustmentSettings,  # noqa: ARG002
        exterior: str,  # noqa: ARG002
        progress: Progress,  # noqa: ARG002
        jobs: int,  # noqa: ARG002
    ) -> Epochs:
        raise UsageError(f"{store}: {self.source} is in a store already")

    def doubts(self, epochs: Epochs | None = None, interior: Array | None = None) -> list[str]:
        """Return what cannot have been meant in what was recorded, a sentence each.

        epochs: as calibrated, for what their interior orientation tells of the camera; interior:
        that itself, c, x0, y0 in mm and what follows.

        >>> tc.open("M1").doubts()
        []
        """
        if epochs is not None and epochs.ok.any():
            interior = np.median(epochs.values[epochs.ok, :3], axis=0)
        if interior is None:
            return []
        return interior_doubts(self.head.camera, *(float(value) for value in interior[:3]))

    @abstractmethod
    def _opened(self) -> AbstractContextManager[Source]:
        """Open its source for reading."""

    @abstractmethod
    def _table(
        self,
        source: Source,
        settings: AdjustmentSettings,
        exterior: str,
        progress: Progress,
        jobs: int,
    ) -> tuple[Epochs, Callable[[int], Observations | None]]:
        """Return its epochs adjusted, and what shows an epoch's observations."""

    def measured(
        self,
        label: str | None = None,
        thermometer_sd: float | None = None,
        exterior: str = "auto",
        free: Iterable[str] = DEFAULT_FREE,
        jobs: int = 1,
    ) -> MeasuredSeries:
        """Return the series as a study reads it; label: what it treats as one camera."""
        settings = AdjustmentSettings(free=tuple(free))
        with self._opened() as source:
            table, observations = self._table(source, settings, exterior, None, jobs)
            name = label or self.camera
            found = measured_series(source, table, observations, name, thermometer_sd)
        give_back()
        return found

    def observed(self, progress: Progress = None, jobs: int = 1, say: Say = None) -> SeriesInput:
        """Return the series as a thermal model and discovery read it; frames are measured.

        say: is told so beforehand.
        """
        with self._opened() as source:
            return series_input(source, say, progress, jobs)


class RecordedSeries(Series):
    """A series in a recording's folder, or one that is put together in memory."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.head, self.testfield = recording.head, recording.testfield
        self.source = recording.title
        self.place = str(recording.path.resolve()) if recording.path.name else str(id(recording))

    @property
    def frame_time(self) -> Array:
        """As the recording's."""
        return self.recording.columns.frame_time

    @cached_property
    def temperatures(self) -> dict[str, Array]:
        """As the recording's, interpolated to the frames' times."""
        return {name: self.recording.columns.at_frame(name) for name in self.head.channels}

    def doubts(self, epochs: Epochs | None = None, interior: Array | None = None) -> list[str]:
        """As the base says, with times, readings and repeated epochs."""
        return [*self.recording.doubts(), *super().doubts(epochs, interior)]

    def _opened(self) -> AbstractContextManager[Source]:
        return nullcontext(self.recording)

    def _table(
        self,
        source: Source,
        settings: AdjustmentSettings,
        exterior: str,
        progress: Progress,
        jobs: int,
    ) -> tuple[Epochs, Callable[[int], Observations | None]]:
        assert isinstance(source, Recording)
        if exterior == "stored":
            raise UsageError(f"exterior 'stored': {self.source} is a recording, not a store")
        return recorded_table(source, settings, exterior, progress, jobs)

    def _kept(
        self,
        store: Path,
        settings: AdjustmentSettings,
        exterior: str,
        progress: Progress,
        jobs: int,
    ) -> Epochs:
        tell = progress or (lambda _: None)
        return replay_into(store, self.recording, settings, exterior, tell, jobs)


class KeptSeries(Series):
    """A series in a store, of a file or on a server, which is opened for each reading."""

    def __init__(self, path: Path, stored: StoredSeries) -> None:
        self.path, self.stored = path, stored
        self.head, self.testfield = stored.head, stored.testfield
        self.source = f"{source_name(path)}: {stored.camera}/{stored.name}"
        where = path if is_server(path) else path.resolve()
        self.place = f"{where} {stored.camera}/{stored.name} {stored.id}"

    @cached_property
    def frame_time(self) -> Array:
        """As the store's, corrected where the clock was wrong."""
        with self._opened() as source:
            return source.columns.frame_time

    @cached_property
    def temperatures(self) -> dict[str, Array]:
        """As the store's, interpolated to the frames' times."""
        with self._opened() as source:
            return {name: source.columns.at_frame(name) for name in self.head.channels}

    @contextmanager
    def _opened(self) -> Iterator[StoredRecording]:
        with open_source(self.path) as store:
            yield StoredRecording(store, self.stored)

    def _table(
        self,
        source: Source,
        settings: AdjustmentSettings,
        exterior: str,
        progress: Progress,  # noqa: ARG002
        jobs: int,
    ) -> tuple[Epochs, Callable[[int], Observations | None]]:
        assert isinstance(source, StoredRecording)
        return table_of_stored(source, settings, exterior, jobs), source.observations

    def measured(
        self,
        label: str | None = None,
        thermometer_sd: float | None = None,
        exterior: str = "auto",
        free: Iterable[str] = (),  # noqa: ARG002
        jobs: int = 1,
    ) -> MeasuredSeries:
        """As the base says, by default labelled with the start condition; `free` is the store's.

        `exterior="per_epoch"` gives the epochs as they were stored.
        """
        start = self.stored.start
        label = label or (f"{self.camera}-{start}" if start else self.camera)
        if exterior == "per_epoch":
            with self._opened() as source:
                return stored_series(source, label, thermometer_sd)
        own = self.stored.settings.get("free", DEFAULT_FREE)
        return super().measured(label, thermometer_sd, exterior, own, jobs)


def open_series(source: Path, name: str | None = None) -> Series:
    """Open the one series of a source, or the one called `CAMERA/SERIES` or `SERIES`.

    Raises StoreError, listing what there is, where none or several fit.
    """
    if require_source(source).is_dir():
        series = RecordedSeries(open_recording(source))
        if name not in (None, series.name, f"{series.camera}/{series.name}"):
            raise DataError(f"{source}: is {series.camera}/{series.name}, not {name}")
        return series
    camera, _, series_name = (name or "").rpartition("/")
    with open_source(source) as store:
        return KeptSeries(source, store.find_series(camera or None, series_name or None))


def open_every_series(source: Path) -> list[Series]:
    """Open every series of a source; DataError for a store without any."""
    if require_source(source).is_dir():
        return [RecordedSeries(open_recording(source))]
    with open_source(source) as store:
        found: list[Series] = [KeptSeries(source, stored) for stored in store.all_series()]
    if not found:
        raise DataError(f"{source_name(source)}: the store holds no series")
    return found


def check_exterior(exterior: str) -> None:
    """Raise UsageError for a choice of exterior orientation that there is not."""
    if exterior not in EXTERIOR_CHOICES:
        choices = ", ".join(EXTERIOR_CHOICES)
        raise UsageError(f"--exterior {exterior}: must be one of {choices}")


def free_names(given: str | Iterable[str]) -> tuple[str, ...]:
    """Return which interior orientation is estimated, in its order, from names or `c,x0,y0`.

    `none` frees nothing. Raises UsageError for a name that there is not.
    """
    names = [n.strip() for n in given.split(",")] if isinstance(given, str) else list(given)
    if names in (["none"], [""]):
        return ()
    for name in names:
        if name not in IOP_NAMES:
            raise UsageError(f"--free: {name!r} is no IOP; there are {', '.join(IOP_NAMES)}, none")
    return tuple(name for name in IOP_NAMES if name in names)


def source_of(text: Path | str) -> Path:
    """Return a path, or a server's address, as the readers take it; ~ is one's home."""
    path = Path(text)
    return path if is_server(path) else path.expanduser()
