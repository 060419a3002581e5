"""What is too long for memory: observations in blocks of epochs, read again at will, and columns
of results on disk.
"""

from __future__ import annotations

import ctypes
import gc
import mmap
import tempfile
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from thermocald.photogrammetry.series.normals import ObservationGrid, planes

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import Observations, TestField


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


def runs(count: int, size: int, windows: Sequence[slice] | None = None) -> Iterator[slice]:
    """The rows of `count` epochs, at most `size` at a time.

    windows: only the rows of these slices, ascending; each begins a run.
    """
    for window in windows or (slice(0, count),):
        for first in range(window.start, window.stop, size):
            yield slice(first, min(first + size, window.stop))


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
        """The blocks, as of `runs`."""
        for rows in runs(len(self), self.size, windows):
            yield rows.start, ObservationGrid(self.grid.points[rows], self.grid.weights[rows])


@dataclass(frozen=True, eq=False)
class ObservedBlocks:
    """Observations of epochs in memory, None for an epoch without, laid out `size` at a time."""

    field: TestField
    observations: Sequence[Observations | None]
    size: int = 1000

    def __len__(self) -> int:
        return len(self.observations)

    def blocks(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """The blocks, as of `runs`."""
        for rows in runs(len(self), self.size, windows):
            part = self.observations[rows]
            yield rows.start, ObservationGrid.from_observations(self.field, part)


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
    if isinstance(source, GridBlocks) and len(windows) == 1 and len(source) == windows[0].stop:
        return source.grid
    whole: ObservationGrid | None = None
    done = 0
    for _, grid in source.blocks(windows):
        if whole is None:
            size = sum(w.stop - w.start for w in windows), grid.points.shape[1]
            whole = ObservationGrid(planes(2, *size), planes(3, *size))
        rows = slice(done, done + len(grid))
        whole.points[rows], whole.weights[rows] = grid.points, grid.weights
        done += len(grid)
    return whole or ObservationGrid(planes(2, 0, 0), planes(3, 0, 0))


def recut(
    blocks: Iterable[tuple[int, ObservationGrid]], length: int
) -> Iterator[tuple[int, ObservationGrid]]:
    """The same epochs `length` at a time, so that blocks do not depend on the reader."""
    points: list[Array] = []
    weights: list[Array] = []
    begin = held = 0
    for first, grid in blocks:
        if not held:
            begin = first
        points.append(grid.points)
        weights.append(grid.weights)
        held += len(grid)
        if held < length:
            continue
        p, w = np.concatenate(points), np.concatenate(weights)
        whole = held // length * length
        for k in range(0, whole, length):
            yield begin + k, ObservationGrid(p[k : k + length], w[k : k + length])
        begin, held = begin + whole, held - whole
        points, weights = [p[whole:]], [w[whole:]]
    if held:
        yield begin, ObservationGrid(np.concatenate(points), np.concatenate(weights))


_LONG = 2_000_000  # rows
_MMAP_THRESHOLD, _LARGE_BYTES = -3, 1 << 24  # of malloc.h; two million numbers


class ColumnSpool:
    """An array (rows, columns), column by column in a file without a name.

    array: NaN at first, to be written and read like any other; it ends with its last reference.
    The system may drop what is not in use from memory, and does on `release`.
    """

    def __init__(self, rows: int, columns: int) -> None:
        if rows > _LONG:
            _map_large_arrays()
        size = max(rows * columns, 1) * 8
        with tempfile.TemporaryFile() as file:
            file.truncate(size)
            self._map = mmap.mmap(file.fileno(), size)
        flat = np.frombuffer(self._map, dtype=np.float64)[: rows * columns]
        self.array: Array = flat.reshape(columns, rows).T

    def release(self) -> None:
        """Take what was written or read out of memory."""
        self._map.madvise(mmap.MADV_DONTNEED)


def _map_large_arrays() -> None:
    """Have freed arrays of 16 MB and more leave this process at once.

    Otherwise the C library keeps those of up to 32 MB, a column of a year, for later ones that do
    not fit into their place, and the process holds twice what it uses.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:  # glibc
        mallopt(_MMAP_THRESHOLD, _LARGE_BYTES)


def give_back() -> None:
    """Return what is not used any more to the system.

    A recording that was read is part of a circle of references, which waits to be collected; the C
    library keeps what many blocks have left.
    """
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:  # glibc
        trim(0)


def released(array: Array) -> None:
    """Take an array of a spool, or a view of it, out of memory; others stay as they are."""
    owner: object = array.base
    while owner is not None and not isinstance(owner, mmap.mmap):
        owner = owner.obj if isinstance(owner, memoryview) else getattr(owner, "base", None)
    if isinstance(owner, mmap.mmap):
        owner.madvise(mmap.MADV_DONTNEED)
