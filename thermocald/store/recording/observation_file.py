"""`observations.csv` (CONVENTIONS §3) or `.parquet`: image points by epoch, whole or as a stream.

Besides the columns of the format, `sxy` (px², the covariance of x and y) is read where it stands,
and further numeric columns become the observations' quality; other columns are ignored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.store.recording.parquet_table import ParquetTable, parse_once
from thermocald.store.recording.sense import frame_fault, point_fault
from thermocald.store.recording.table import Chunk, Table

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor


_GRID_POINTS, _GRID_EPOCHS = 300_000, 4_000  # of a grid: 12 MB
# Of text or Parquet: above it (a day of 150 targets every 10 s) a recording is read in parts.
LONG_FROM_BYTES = 100_000_000
_REQUIRED = ("epoch", "target", "x", "y", "sx", "sy")


@dataclass(frozen=True, slots=True, eq=False)
class ObservationTable:
    """Observations of many epochs in columns.

    start (E+1,): the rows of epoch i are start[i]:start[i+1]; columns (n,) or (n, 2) as in
    `Observations`.
    """

    start: NDArray[np.int64]
    targets: NDArray[np.int64]
    points: Array
    sigmas: Array
    covariances: Array | None
    quality: dict[str, Array]

    def observations(self, epoch: int) -> Observations:
        """What epoch number `epoch` of the table (from 0) shows; views, no copies."""
        rows = slice(int(self.start[epoch]), int(self.start[epoch + 1]))
        return Observations(
            self.targets[rows],
            self.points[rows],
            self.sigmas[rows],
            None if self.covariances is None else self.covariances[rows],
            {name: values[rows] for name, values in self.quality.items()},
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """Consecutive rows: row number of the first, epoch index per row, and the values (n, k)."""

    first: int
    epochs: NDArray[np.int64]
    targets: NDArray[np.int64]
    values: Array

    def rows(self, rows: slice) -> _Block:
        shift = rows.start or 0
        return _Block(self.first + shift, self.epochs[rows], self.targets[rows], self.values[rows])


def _join(blocks: list[_Block]) -> _Block:
    return _Block(
        blocks[0].first,
        np.concatenate([b.epochs for b in blocks]),
        np.concatenate([b.targets for b in blocks]),
        np.concatenate([b.values for b in blocks]),
    )


class ObservationFile:
    """The file of a recording; numbers: the (E,) epoch numbers of epochs.csv, increasing."""

    def __init__(
        self, path: Path, field: TestField, numbers: NDArray[np.int64], sensor: Sensor
    ) -> None:
        self._table: Table | ParquetTable
        if path.suffix == ".parquet":
            self._table = ParquetTable(path, _REQUIRED)
        else:
            table = Table(path, _REQUIRED)
            long = path.stat().st_size >= LONG_FROM_BYTES
            self._table = parse_once(table, _REQUIRED) if long else table
        self._field, self._numbers, self._sensor = field, numbers, sensor
        self._quality = self._numeric_extras()
        self._has_covariances = "sxy" in self._table.columns

    def load(self) -> ObservationTable:
        """All observations; the rows may stand in any order. 40 bytes per row and a little."""
        blocks = [self._block(chunk) for chunk in self._table.chunks()]
        if not blocks:
            return self._columns(self._empty(), 0, len(self._numbers))
        whole = _join(blocks)
        del blocks
        if np.any(np.diff(whole.epochs) < 0):
            order = np.argsort(whole.epochs, kind="stable")
            self._refuse_duplicates(whole)
            whole = _Block(0, whole.epochs[order], whole.targets[order], whole.values[order])
        else:
            self._refuse_duplicates(whole)
        return self._columns(whole, 0, len(self._numbers))

    def stream(self) -> Iterator[Observations]:
        """The observations of one epoch of epochs.csv after the other, in constant memory.

        Raises RecordingError where the rows are not in the order of their epochs.
        """
        for block, first, stop in self._whole_epochs(self._table.chunks()):
            yield from self._emit(block, first, stop)

    def some(self, window: slice) -> Iterator[Observations]:
        """The observations of some consecutive epochs; of a Parquet file only they are read."""
        low, high = self._numbers[window][[0, -1]]
        chunks: Iterator[Chunk] = (
            self._table.chunks(epochs=(int(low), int(high)))
            if isinstance(self._table, ParquetTable)
            else self._table.chunks()
        )
        for block, first, stop in self._whole_epochs(chunks):
            yield from self._emit(block, max(first, window.start), min(stop, window.stop))
            if stop >= window.stop:
                break

    def grids(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """The same as grids of consecutive epochs, each with its first epoch (from 0).

        windows: only epochs of these slices, ascending; of a Parquet file only they are read.
        """
        wanted = [slice(0, len(self._numbers))] if windows is None else list(windows)
        columns = [*_REQUIRED, *(["sxy"] if self._has_covariances else [])]
        if windows is None or not isinstance(self._table, ParquetTable):
            chunks: Iterator[Chunk] = self._table.chunks()
            if isinstance(self._table, ParquetTable):
                chunks = self._table.chunks(columns=columns)
            yield from self._within(wanted, chunks)
            return
        for window in wanted:
            low, high = self._numbers[window][[0, -1]]
            chunks = self._table.chunks(columns=columns, epochs=(int(low), int(high)))
            yield from self._within([window], chunks)

    def _within(
        self, windows: Sequence[slice], chunks: Iterator[Chunk]
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """The grids of some windows from the chunks that hold them."""
        for block, first, stop in self._whole_epochs(chunks, False):
            for window in windows:
                if stop > window.start and first < window.stop:
                    yield from self._grids(block, max(first, window.start), min(stop, window.stop))
            if stop >= windows[-1].stop:
                break

    def _grids(self, block: _Block, first: int, stop: int) -> Iterator[tuple[int, ObservationGrid]]:
        size = max(min(_GRID_POINTS // len(self._field), _GRID_EPOCHS), 1)
        for begin in range(first, stop, size):
            end = min(begin + size, stop)
            low, high = np.searchsorted(block.epochs, [begin, end])
            part = block.rows(slice(int(low), int(high)))
            grid = ObservationGrid.from_rows(
                (end - begin, len(self._field)), part.epochs - begin, part.targets,
                part.values[:, 0:2], part.values[:, 2:4],
                part.values[:, 4] if self._has_covariances else None,
            )  # fmt: skip
            if np.count_nonzero(grid.observed) < len(part.epochs):
                self._refuse_duplicates(part)
            yield begin, grid

    def _whole_epochs(
        self, chunks: Iterator[Chunk], quality: bool = True
    ) -> Iterator[tuple[_Block, int, int]]:
        """Blocks of whole epochs, in order, with the first epoch of each and the one after it."""
        done = 0
        pending: _Block | None = None
        for chunk in chunks:
            block = self._block(chunk, quality)
            if pending is not None:
                block = _join([pending, block])
            back = np.diff(block.epochs) < 0
            if back.any() or block.epochs[0] < done:
                row = block.first + (int(np.argmax(back)) + 1 if back.any() else 0)
                self._table.fail(
                    row, "epoch", "stands after a later epoch; sort the rows of so long a file"
                )
            last = int(block.epochs[-1])
            whole = block.rows(slice(0, int(np.searchsorted(block.epochs, last))))
            pending = block.rows(slice(len(whole.epochs), len(block.epochs)))
            yield whole, done, last
            done = last
        yield pending or self._empty(), done, len(self._numbers)

    def _emit(self, block: _Block, first: int, stop: int) -> Iterator[Observations]:
        if stop > first:
            self._refuse_duplicates(block)
            table = self._columns(block, first, stop)
            for i in range(stop - first):
                yield table.observations(i)

    def _columns(self, block: _Block, first: int, stop: int) -> ObservationTable:
        start = np.searchsorted(block.epochs, np.arange(first, stop + 1))
        values = block.values
        shift = 5 if self._has_covariances else 4
        return ObservationTable(
            start.astype(np.int64),
            block.targets,
            np.ascontiguousarray(values[:, 0:2]),
            np.ascontiguousarray(values[:, 2:4]),
            np.ascontiguousarray(values[:, 4]) if self._has_covariances else None,
            {name: values[:, shift + i].copy() for i, name in enumerate(self._quality)},
        )

    def _empty(self) -> _Block:
        width = 4 + self._has_covariances + len(self._quality)
        none = np.empty(0, dtype=np.int64)
        return _Block(0, none, none, np.empty((0, width)))

    def _block(self, chunk: Chunk, quality: bool = True) -> _Block:
        numbers = chunk.integers("epoch")
        # rows of one epoch follow one another: look each run of them up once
        runs = np.flatnonzero(np.diff(numbers, prepend=-1))
        found = np.searchsorted(self._numbers, numbers[runs])
        epochs = np.repeat(found, np.diff(runs, append=len(numbers)))
        near = np.minimum(epochs, len(self._numbers) - 1)
        chunk.check(
            "epoch",
            self._numbers[near] != numbers,
            lambda row: f"epoch {numbers[row]} does not stand in epochs.csv",
        )
        names = self._quality if quality else []
        values = np.empty((len(chunk), 4 + self._has_covariances + len(names)))
        for column, name in enumerate(("x", "y", "sx", "sy")):
            values[:, column] = chunk.numbers(name)
            if column >= 2:
                chunk.check(name, values[:, column] <= 0, "a standard deviation must be above 0 px")
        if fault := point_fault(values):
            chunk.fail(*fault)
        if outside := frame_fault(values[:, :2], self._sensor):
            chunk.fail(outside[0], "x", outside[1])
        if self._has_covariances:
            values[:, 4] = chunk.numbers("sxy")
            too_large = np.abs(values[:, 4]) >= values[:, 2] * values[:, 3]
            chunk.check("sxy", too_large, "a covariance must be below sx·sy")
        for i, name in enumerate(names, start=4 + self._has_covariances):
            values[:, i] = chunk.numbers(name, empty_is_nan=True)
        return _Block(chunk.first, epochs, self._targets(chunk), values)

    def _targets(self, chunk: Chunk) -> NDArray[np.int64]:
        targets = chunk.places("target", self._field.index)
        chunk.check(
            "target",
            targets < 0,
            lambda row: f"target {chunk.text('target')[row]!r} does not stand in testfield.csv",
        )
        return targets

    def _refuse_duplicates(self, block: _Block) -> None:
        keys = block.epochs * len(self._field) + block.targets
        order = np.argsort(keys, kind="stable")
        twice = np.diff(keys[order]) == 0
        if twice.any():
            row = int(np.min(order[1:][twice]))
            name = self._field.names[block.targets[row]]
            number = self._numbers[block.epochs[row]]
            self._table.fail(
                block.first + row, "target", f"target {name!r} is duplicated in epoch {number}"
            )

    def _numeric_extras(self) -> list[str]:
        known = {*_REQUIRED, "sxy", ""}
        extras = [name for name in self._table.columns if name not in known]
        if not extras:
            return []
        first = next(self._table.chunks(1), None)
        return [] if first is None else [name for name in extras if first.is_number(name)]
