"""`observations.csv` (CONVENTIONS §3) or `.parquet`: image points by epoch, read whole or in parts.

An optional column `sxy` (px²) is the covariance of x and y. Further numeric columns become the
observations' quality; other columns are ignored.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Self

import numpy as np

from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.series.normals import ObservationGrid, runs
from thermocald.store.recording.parquet_table import REQUIRED, ParquetTable, parse_once
from thermocald.store.recording.sense import frame_fault, point_fault
from thermocald.store.recording.table import Table

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.store.recording.table import Chunk


_GRID_POINTS, _GRID_EPOCHS = 300_000, 4_000  # limits of a grid: 12 MB
# A file of text or Parquet of this size (a day of 150 targets every 10 s) is read in parts.
LONG_FROM_BYTES = 100_000_000


@dataclass(frozen=True, slots=True, eq=False)
class ObservationRows:
    """Observations of many epochs, one per row.

    epochs (n,): from 0, or epoch numbers; targets (n,): rows of the test field; points, sigmas
    (n, 2) px; covariances (n,) px² of x and y, 0 if not given, None if given for none; first: row
    of the first observation in its file.
    """

    epochs: NDArray[np.int64]
    targets: NDArray[np.int64]
    points: Array
    sigmas: Array
    covariances: Array | None
    quality: Mapping[str, Array] = field(default_factory=dict)
    first: int = 0

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Return parts one after another; all have the quality columns of the first."""
        covariances = None
        if any(part.covariances is not None for part in parts):
            covariances = np.concatenate(
                [np.zeros(len(p.epochs)) if p.covariances is None else p.covariances for p in parts]
            )
        epochs, targets, points, sigmas = (
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("epochs", "targets", "points", "sigmas")
        )
        quality = {n: np.concatenate([part.quality[n] for part in parts]) for n in parts[0].quality}
        return cls(epochs, targets, points, sigmas, covariances, quality, parts[0].first)

    def rows(self, rows: slice | NDArray[np.int64] | NDArray[np.bool_]) -> Self:
        """Return some of the rows; `first` is only right for a slice."""
        first = self.first + (rows.start or 0 if isinstance(rows, slice) else 0)
        covariances = None if self.covariances is None else self.covariances[rows]
        quality = {name: values[rows] for name, values in self.quality.items()}
        kept = self.epochs[rows], self.targets[rows], self.points[rows], self.sigmas[rows]
        return type(self)(*kept, covariances, quality, first)

    def between(self, begin: int, end: int) -> Self:
        """Return the rows of epochs `begin` to `end` (exclusive) of sorted rows, as views."""
        low, high = np.searchsorted(self.epochs, [begin, end])
        return self.rows(slice(int(low), int(high)))

    def of_epoch(self, epoch: int) -> Observations:
        """Return the observations of an epoch, as views; rows must be sorted by epoch."""
        found = self.between(epoch, epoch + 1)
        return Observations(
            found.targets, found.points, found.sigmas, found.covariances, dict(found.quality)
        )

    def grid(self, begin: int, end: int, targets: int) -> ObservationGrid:
        """Return the grid of epochs `begin` to `end` (exclusive), to which all rows belong."""
        return ObservationGrid.from_rows(
            (end - begin, targets), self.epochs - begin, self.targets, self.points, self.sigmas,
            self.covariances,
        )  # fmt: skip


def grid_runs(epochs: int, targets: int, windows: Sequence[slice] | None) -> Iterator[slice]:
    """Yield the slices of epochs that make the grids of a series, or of some windows of it."""
    return runs(epochs, max(min(_GRID_POINTS // targets, _GRID_EPOCHS), 1), windows)


class ObservationFile:
    """The observations' file of a recording; numbers (E,): those of epochs.csv, increasing."""

    def __init__(
        self, path: Path, field: TestField, numbers: NDArray[np.int64], sensor: Sensor
    ) -> None:
        if path.suffix == ".parquet":
            self._table: Table = ParquetTable(path, REQUIRED)
        else:
            self._table = Table(path, REQUIRED)
            if path.stat().st_size >= LONG_FROM_BYTES:
                self._table = parse_once(self._table)
        self._field, self._numbers, self._sensor = field, numbers, sensor
        self._has_covariances = "sxy" in self._table.columns
        extras = [n for n in self._table.columns if n not in {*REQUIRED, "sxy", ""}]
        self._quality = self._table.numeric(extras)

    def load(self) -> ObservationRows:
        """Return all observations sorted by epoch; the file may have them in any order."""
        parts = [self._read(chunk, self._quality) for chunk in self._table.chunks()]
        whole = ObservationRows.join(parts) if parts else self._no_rows()
        del parts
        self._refuse_duplicates(whole)
        if np.any(np.diff(whole.epochs) < 0):
            whole = whole.rows(np.argsort(whole.epochs, kind="stable"))
        return whole

    def stream(self, window: slice) -> Iterator[Observations]:
        """Yield the observations of the epochs in a window of epochs.csv, in constant memory.

        Raises RecordingError if the rows are not in the order of their epochs.
        """
        for rows, first, stop in self._blocks([window], self._quality):
            self._refuse_duplicates(rows)
            for epoch in range(first, stop):
                yield rows.of_epoch(epoch)

    def grids(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """Yield observations as grids of consecutive epochs, each with its first epoch (from 0).

        windows: only the epochs of these slices, ascending; of a Parquet file only they are read.
        """
        for rows, first, stop in self._blocks(windows, []):
            for run in grid_runs(stop, len(self._field), [slice(first, stop)]):
                part = rows.between(run.start, run.stop)
                grid = part.grid(run.start, run.stop, len(self._field))
                if np.count_nonzero(grid.observed) < len(part.epochs):
                    self._refuse_duplicates(part)
                yield run.start, grid

    def _blocks(
        self, windows: Sequence[slice] | None, quality: list[str]
    ) -> Iterator[tuple[ObservationRows, int, int]]:
        """Yield rows of whole epochs, in order, with the first wanted one and the end."""
        columns = [*REQUIRED, *(["sxy"] if self._has_covariances else []), *quality]
        every = [slice(0, len(self._numbers))]
        # text is read once for all windows
        parts = [[w] for w in windows or every] if self._table.seeks else [list(windows or every)]
        for part in parts:
            low, high = self._numbers[[part[0].start, part[-1].stop - 1]].tolist()
            chunks = self._table.chunks(
                columns=columns, epochs=None if windows is None else (low, high)
            )
            for rows, first, stop in self._whole_epochs(chunks, quality):
                for window in part:
                    begin, end = max(first, window.start), min(stop, window.stop)
                    if begin < end:
                        yield rows, begin, end
                if stop >= part[-1].stop:
                    break

    def _whole_epochs(
        self, chunks: Iterator[Chunk], quality: list[str]
    ) -> Iterator[tuple[ObservationRows, int, int]]:
        """Yield rows of whole epochs, in order, with their first epoch and the end (exclusive)."""
        done = 0
        pending = self._no_rows()
        for chunk in chunks:
            rows = self._read(chunk, quality)
            if len(pending.epochs):
                rows = ObservationRows.join([pending, rows])
            back = np.diff(rows.epochs) < 0
            if back.any() or rows.epochs[0] < done:
                row = rows.first + (int(np.argmax(back)) + 1 if back.any() else 0)
                self._table.fail(
                    row, "epoch", "comes after a later one; sort the rows of so large a file"
                )
            last = int(rows.epochs[-1])
            cut = int(np.searchsorted(rows.epochs, last))
            pending = rows.rows(slice(cut, len(rows.epochs)))
            yield rows.rows(slice(0, cut)), done, last
            done = last
        yield pending, done, len(self._numbers)

    def _no_rows(self) -> ObservationRows:
        none, points = np.empty(0, dtype=np.int64), np.empty((0, 2))
        quality = {name: np.empty(0) for name in self._quality}
        covariances = np.empty(0) if self._has_covariances else None
        return ObservationRows(none, none, points, points, covariances, quality)

    def _read(self, chunk: Chunk, quality: list[str]) -> ObservationRows:
        numbers = chunk.integers("epoch")
        # rows of one epoch follow one another: each run is looked up once
        starts = np.flatnonzero(np.diff(numbers, prepend=-1))
        found = np.searchsorted(self._numbers, numbers[starts])
        epochs = np.repeat(found, np.diff(starts, append=len(numbers)))
        near = np.minimum(epochs, len(self._numbers) - 1)
        chunk.check(
            "epoch",
            self._numbers[near] != numbers,
            lambda row: f"epoch {numbers[row]} is not in epochs.csv",
        )
        points = np.column_stack([chunk.numbers("x"), chunk.numbers("y")])
        sigmas = np.column_stack([chunk.numbers("sx"), chunk.numbers("sy")])
        for column, name in enumerate(("sx", "sy")):
            chunk.check(name, sigmas[:, column] <= 0, "a standard deviation must be above 0 px")
        if fault := point_fault(points, sigmas):
            chunk.fail(*fault)
        if outside := frame_fault(points, self._sensor):
            chunk.fail(outside[0], "x", outside[1])
        covariances = None
        if self._has_covariances:
            covariances = chunk.numbers("sxy")
            too_large = np.abs(covariances) >= sigmas[:, 0] * sigmas[:, 1]
            chunk.check("sxy", too_large, "a covariance must be below sx·sy")
        targets = chunk.places("target", self._field.index)
        chunk.check(
            "target",
            targets < 0,
            lambda row: f"target {chunk.text('target')[row]!r} is not in testfield.csv",
        )
        extras = {name: chunk.numbers(name, empty_is_nan=True) for name in quality}
        return ObservationRows(epochs, targets, points, sigmas, covariances, extras, chunk.first)

    def _refuse_duplicates(self, rows: ObservationRows) -> None:
        keys = rows.epochs * len(self._field) + rows.targets
        order = np.argsort(keys, kind="stable")
        twice = np.diff(keys[order]) == 0
        if twice.any():
            row = int(np.min(order[1:][twice]))
            name = self._field.names[rows.targets[row]]
            number = self._numbers[rows.epochs[row]]
            self._table.fail(
                rows.first + row, "target", f"target {name!r} is duplicated in epoch {number}"
            )
