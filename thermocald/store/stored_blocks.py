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

    from thermocald.store.series import SeriesReader, StoredSeries


_GRID_POINTS, _GRID_EPOCHS = 300_000, 4_000  # of a block: 12 MB


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
        size = min(max(_GRID_POINTS // len(self.series.testfield), 1), _GRID_EPOCHS)
        for rows in runs(len(self), size, windows):
            yield rows.start, self._grid(self.numbers[rows])

    def _grid(self, numbers: NDArray[np.int64]) -> ObservationGrid:
        """The grid of some consecutive epochs."""
        found = self.store.observation_rows(self.series, int(numbers[0]), int(numbers[-1]))
        rows = np.searchsorted(numbers, found.numbers)
        # an epoch that came while the series was read is not among them
        known = numbers[np.minimum(rows, len(numbers) - 1)] == found.numbers
        covariances = None if found.covariances is None else found.covariances[known]
        return ObservationGrid.from_rows(
            (len(numbers), len(self.series.testfield)), rows[known], found.targets[known],
            found.points[known], found.sigmas[known], covariances,
        )  # fmt: skip
