"""A series in an open store, read as a recording is: columns, epochs, observations in blocks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.series.blocks import runs
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.store.recording.reader import EpochColumns

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.store.recording.head import Head
    from thermocald.store.series import SeriesReader, StoredSeries


_GRID_POINTS, _GRID_EPOCHS = 300_000, 4_000  # of a block: 12 MB


@dataclass(frozen=True, eq=False)
class StoredRecording:
    """One series of an open store, as `Recording` is one of a folder; it has its observations."""

    store: SeriesReader
    series: StoredSeries
    has_observations = True

    @property
    def head(self) -> Head:
        return self.series.head

    @property
    def testfield(self) -> TestField:
        return self.series.testfield

    @property
    def title(self) -> str:
        """What messages call it."""
        return f"{self.store.path}: {self.series.name}"

    @cached_property
    def columns(self) -> EpochColumns:
        """Times and temperatures; files of frames are asked for one by one, see `framed`."""
        channels = list(self.head.channels)
        names = ["epoch", "frame_time", "temperature_time", *channels]
        found = self.store.series_columns(self.series, names)
        return EpochColumns(
            found["epoch"].astype(np.int64), found["frame_time"], found["temperature_time"],
            {name: found[name] for name in channels}, (), {},
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.columns)

    @property
    def epochs(self) -> list[Epoch]:
        """All epochs with their observations."""
        return [stored.epoch for stored in self.store.epochs(self.series)]

    def observations(self, row: int) -> Observations | None:
        """What one epoch (from 0) shows."""
        return self._epoch(row).observations

    def framed(self, ok: NDArray[np.bool_]) -> list[tuple[int, Path]]:
        """The first and the last of some epochs (E,), from 0, and their frames, where kept."""
        found = [(row, self._epoch(row).frame) for row in np.flatnonzero(ok)[[0, -1]].tolist()]
        return [(row, self.store.path.parent / frame) for row, frame in found if frame is not None]

    def _epoch(self, row: int) -> Epoch:
        number = int(self.columns.numbers[row])
        return next(self.store.epochs(self.series, number, number)).epoch

    def blocks(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """Grids of consecutive epochs, each with its first epoch (from 0); only of windows."""
        size = min(max(_GRID_POINTS // len(self.testfield), 1), _GRID_EPOCHS)
        for rows in runs(len(self), size, windows):
            yield rows.start, self._grid(self.columns.numbers[rows])

    def _grid(self, numbers: NDArray[np.int64]) -> ObservationGrid:
        """The grid of some consecutive epochs."""
        found = self.store.observation_rows(self.series, int(numbers[0]), int(numbers[-1]))
        rows = np.searchsorted(numbers, found.numbers)
        # an epoch that came while the series was read is not among them
        known = numbers[np.minimum(rows, len(numbers) - 1)] == found.numbers
        covariances = None if found.covariances is None else found.covariances[known]
        return ObservationGrid.from_rows(
            (len(numbers), len(self.testfield)), rows[known], found.targets[known],
            found.points[known], found.sigmas[known], covariances,
        )  # fmt: skip
