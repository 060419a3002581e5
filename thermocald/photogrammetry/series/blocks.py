"""Observations of a series that is too long for memory: blocks of epochs, read again at will."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from thermocald.photogrammetry.series.normals import ObservationGrid

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

__all__ = ["GridBlocks", "ObservationBlocks", "WithoutTargets", "gathered", "spread_windows"]


class ObservationBlocks(Protocol):
    """The observations of consecutive epochs, on all targets of the field."""

    def __len__(self) -> int: ...

    def blocks(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """Grids of consecutive epochs with the first epoch (from 0) of each.

        windows: only the epochs of these slices, ascending.
        """
        ...


@dataclass(frozen=True, eq=False)
class GridBlocks:
    """A grid in memory as blocks of at most `size` epochs."""

    grid: ObservationGrid
    size: int

    def __len__(self) -> int:
        return len(self.grid)

    def blocks(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """The blocks; of windows, each begins one."""
        for window in windows or (slice(0, len(self)),):
            for first in range(window.start, window.stop, self.size):
                rows = slice(first, min(first + self.size, window.stop))
                yield first, ObservationGrid(self.grid.points[rows], self.grid.weights[rows])


@dataclass(frozen=True, eq=False)
class WithoutTargets:
    """The same as if some targets (rows of the field) had never been observed."""

    source: ObservationBlocks
    targets: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.source)

    def blocks(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """The blocks without the targets."""
        for first, grid in self.source.blocks(windows):
            mask = np.zeros(grid.observed.shape, dtype=bool)
            mask[:, self.targets] = True
            yield first, grid.reject(mask)


def spread_windows(epochs: int, most: int, count: int = 12) -> tuple[slice, ...]:
    """Up to `count` runs of consecutive epochs, `most` epochs in all, from the first to the last.

    All epochs in one where they are not more than that.
    """
    if epochs <= most:
        return (slice(0, epochs),)
    length = max(most // count, 1)
    starts = np.linspace(0, epochs - length, count).round().astype(int)
    return tuple(slice(int(start), int(start) + length) for start in starts)


def gathered(source: ObservationBlocks, windows: Sequence[slice]) -> ObservationGrid:
    """The epochs of some windows on one grid."""
    parts = [grid for _, grid in source.blocks(windows)]
    return ObservationGrid(
        np.concatenate([p.points for p in parts]), np.concatenate([p.weights for p in parts])
    )
