"""The observations of a stored series as blocks of epochs, read again at will."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.series.blocks import runs
from thermocald.photogrammetry.series.normals import ObservationGrid

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.store.database.row import StoredSeries
    from thermocald.store.database.series_reader import SeriesReader

__all__ = ["StoredBlocks"]

_GRID_POINTS = 300_000  # cells of a block


@dataclass(frozen=True, eq=False)
class StoredBlocks:
    """The observations of a series in a store; numbers (E,): of its epochs."""

    store: SeriesReader
    series: StoredSeries
    numbers: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.numbers)

    def blocks(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """Grids of consecutive epochs, each with its first epoch (from 0); only of windows."""
        field = self.series.testfield
        size = max(_GRID_POINTS // len(field), 1)
        for rows in runs(len(self), size, windows):
            numbers = self.numbers[rows]
            part: list[Observations | None] = [None] * len(numbers)
            found = self.store.epochs(self.series, int(numbers[0]), int(numbers[-1]))
            for stored in found:
                row = int(np.searchsorted(numbers, stored.epoch.number))
                if row < len(numbers) and numbers[row] == stored.epoch.number:
                    part[row] = stored.epoch.observations
            yield rows.start, ObservationGrid.from_observations(field, part)
