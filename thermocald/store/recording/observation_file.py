"""`observations.csv` (CONVENTIONS §3) or `.parquet`: image points by epoch, read whole or in parts.

An optional column `sxy` (px²) is the covariance of x and y. Further numeric columns become the
observations' quality; other columns are ignored.

Apache Parquet is read ten times as fast as CSV and has a third of its size; the numbers are the
same to the bit. It needs pyarrow (`pip install 'thermocald[parquet]'`). A chunk of it has the
interface of a CSV table's chunk, so both pass the same checks.

A CSV file that is too long for memory is read several times by an analysis. Its text is parsed only
once, into a Parquet copy in the user's cache, found by the text's path, inode, size and times.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import time
import uuid
from bisect import bisect_left, bisect_right
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from thermocald.errors import RecordingError, UsageError
from thermocald.files import new_file, write_parts
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.series.normals import ObservationGrid, runs
from thermocald.result import csv_text
from thermocald.store.recording.sense import frame_fault, point_fault
from thermocald.store.recording.table import Chunk, Table

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.result import Columns


REQUIRED = ("epoch", "target", "x", "y", "sx", "sy")
_GRID_POINTS, _GRID_EPOCHS = 300_000, 4_000  # limits of a grid: 12 MB
# A file of text or Parquet of this size (a day of 150 targets every 10 s) is read in parts.
LONG_FROM_BYTES = 100_000_000
_ROWS = 1 << 18
_TEXT_BLOCK = 1 << 23  # bytes of text that pyarrow parses at a time
_KEPT_DAYS = 14.0  # since a copy was last read

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class ObservationRows:
    """Observations of many epochs, one per row.

    epochs (n,): from 0, or epoch numbers; seen: n observations, without covariances if none of them
    is given; first: row of the first observation in its file.
    """

    epochs: NDArray[np.int64]
    seen: Observations
    first: int = 0

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Return parts of one file, which have the same columns, one after another."""
        seen = [part.seen for part in parts]
        given = "covariances" if seen[0].covariances is not None else None
        columns = {
            name: np.concatenate([getattr(one, name) for one in seen])
            for name in filter(None, ("targets", "points", "sigmas", given))
        }
        quality = {n: np.concatenate([one.quality[n] for one in seen]) for n in seen[0].quality}
        joined = Observations(**columns, quality=quality)
        return cls(np.concatenate([part.epochs for part in parts]), joined, parts[0].first)

    def rows(self, rows: slice | NDArray[np.int64] | NDArray[np.bool_]) -> Self:
        """Return some of the rows; `first` is only right for a slice."""
        first = self.first + (rows.start or 0 if isinstance(rows, slice) else 0)
        return type(self)(self.epochs[rows], self.seen.select(rows), first)

    def between(self, begin: int, end: int) -> Self:
        """Return the rows of epochs `begin` to `end` (exclusive) of sorted rows, as views."""
        low, high = np.searchsorted(self.epochs, [begin, end])
        return self.rows(slice(int(low), int(high)))


def grid_runs(epochs: int, targets: int, windows: Sequence[slice] | None) -> Iterator[slice]:
    """Yield the slices of epochs that make the grids of a series, or of some windows of it."""
    return runs(epochs, max(min(_GRID_POINTS // targets, _GRID_EPOCHS), 1), windows)


class ObservationFile:
    """The observations' file of a recording; numbers (E,): those of epochs.csv, increasing.

    is_long: whether it is read in parts, as its observations are too many for memory.
    """

    def __init__(
        self, path: Path, field: TestField, numbers: NDArray[np.int64], sensor: Sensor
    ) -> None:
        is_text = path.suffix != ".parquet"
        table = (Table if is_text else ParquetTable)(path, REQUIRED)
        self.is_long = path.stat().st_size >= LONG_FROM_BYTES
        self._table = _parse_once(table) if is_text and self.is_long else table
        self._field, self._numbers, self._sensor = field, numbers, sensor
        self._has_covariances = "sxy" in self._table.columns
        extras = [n for n in self._table.columns if n not in {*REQUIRED, "sxy", ""}]
        self._quality = self._table.numeric(extras)

    @cached_property
    def _whole(self) -> ObservationRows:
        """All observations sorted by epoch; the file may have them in any order."""
        parts = [self._read(chunk, self._quality) for chunk in self._table.chunks()]
        whole = self._single(ObservationRows.join(parts) if parts else self._no_rows())
        del parts
        if np.any(np.diff(whole.epochs) < 0):
            whole = whole.rows(np.argsort(whole.epochs, kind="stable"))
        return whole

    def stream(self, window: slice) -> Iterator[Observations]:
        """Yield the observations of the epochs in a window of epochs.csv.

        A long file is read in constant memory. Raises RecordingError if its rows are not in the
        order of their epochs.
        """
        for rows, first, stop in self._blocks([window], self._quality):
            for epoch in range(first, stop):
                yield rows.between(epoch, epoch + 1).seen

    def grids(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """Yield observations as grids of consecutive epochs, each with its first epoch (from 0).

        windows: only the epochs of these slices, ascending; of a long Parquet file only they are
        read. Raises the error of `stream`.
        """
        targets = len(self._field)
        for rows, first, stop in self._blocks(windows, []):
            for run in grid_runs(stop, targets, [slice(first, stop)]):
                part = rows.between(run.start, run.stop)
                seen = part.seen
                yield run.start, ObservationGrid.from_rows(
                    (run.stop - run.start, targets), part.epochs - run.start, seen.targets,
                    seen.points, seen.sigmas, seen.covariances,
                )  # fmt: skip

    def _blocks(
        self, windows: Sequence[slice] | None, quality: list[str]
    ) -> Iterator[tuple[ObservationRows, int, int]]:
        """Yield rows of whole epochs, in order, with the first wanted one and the end."""
        every = windows or [slice(0, len(self._numbers))]
        if not self.is_long:
            yield from ((self._whole, window.start, window.stop) for window in every)
            return
        columns = [*REQUIRED, *(["sxy"] if self._has_covariances else []), *quality]
        # text is read once for all windows
        seeks = isinstance(self._table, ParquetTable)
        parts = [[window] for window in every] if seeks else [every]
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
            yield self._single(rows.rows(slice(0, cut))), done, last
            done = last
        yield self._single(pending), done, len(self._numbers)

    def _no_rows(self) -> ObservationRows:
        quality = {name: np.empty(0) for name in self._quality}
        none = replace(Observations.none(), quality=quality)
        return ObservationRows(none.targets, none)

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
        seen = Observations(targets, points, sigmas, covariances, extras)
        return ObservationRows(epochs, seen, chunk.first)

    def _single(self, rows: ObservationRows) -> ObservationRows:
        """Return rows as they are. Raises RecordingError for a target twice in one epoch."""
        targets = rows.seen.targets
        keys = rows.epochs * len(self._field) + targets
        order = np.argsort(keys, kind="stable")
        twice = np.diff(keys[order]) == 0
        if twice.any():
            row = int(np.min(order[1:][twice]))
            name = self._field.names[targets[row]]
            number = self._numbers[rows.epochs[row]]
            self._table.fail(
                rows.first + row, "target", f"target {name!r} is duplicated in epoch {number}"
            )
        return rows


class ParquetTable(Table):
    """A Parquet file with the columns of a CSV table; RecordingError if a column is missing.

    original: the table of which the file is a copy; errors then name the line of that table.
    """

    _head = ""

    def __init__(self, path: Path, required: Sequence[str], original: Table | None = None) -> None:
        super().__init__(path, required)
        self._original = original

    def _header(self) -> list[str]:
        parquet = _pyarrow().parquet
        try:
            return list(parquet.read_schema(self.path).names)
        except (OSError, ValueError) as cause:
            raise RecordingError(f"{self.path}: is not readable as Parquet: {cause}") from cause

    def chunks(
        self, columns: Sequence[str] | None = None, epochs: tuple[int, int] | None = None
    ) -> Iterator[ColumnChunk]:
        """Yield at most _ROWS rows at a time of `columns` and, if groups allow, of `epochs`."""
        pyarrow = _pyarrow()
        first = 0
        try:
            # not memory-mapped: what was read of a long file would stay resident
            with pyarrow.parquet.ParquetFile(
                self.path, pre_buffer=False, page_checksum_verification=True
            ) as file:
                groups = range(file.num_row_groups)
                if epochs is not None:
                    groups, first = _select_groups(
                        file.metadata, self.columns.index("epoch"), epochs
                    )
                for group in groups:  # one call for all groups would hold them all in memory
                    for batch in file.iter_batches(_ROWS, [group], columns):
                        if len(batch):
                            yield ColumnChunk(self, first, batch)
                            first += len(batch)
        except (OSError, ValueError) as cause:  # pyarrow raises both
            removed = ""
            if self._original is not None:
                removed = "; this copy of the text is removed: run the command again"
                with suppress(OSError):
                    self.path.unlink()
            raise RecordingError(f"{self.path}: is damaged: {cause}{removed}") from cause
        finally:
            pyarrow.default_memory_pool().release_unused()

    def _where(self, row: int) -> str:
        return (
            f"{self.path}, row {row + 1}" if self._original is None else self._original._where(row)
        )


class ColumnChunk(Chunk):
    """Some consecutive rows of a table in Arrow's columns."""

    def __init__(self, table: Table, first: int, batch: Any) -> None:
        self.table = table
        self.first = first
        self._batch = batch
        self._size = len(batch)

    def text(self, name: str) -> tuple[str, ...]:
        words, rows = self._encoded(name)
        return tuple(map([*words, ""].__getitem__, rows.tolist()))

    def numbers(self, name: str, *, empty_is_nan: bool = False) -> Array:
        column = self._batch.column(name)
        if not self.is_number(name):
            self.fail(0, name, f"holds {column.type}; numbers are required")
        values: Array = _to_numpy(column.cast(_pyarrow().float64(), safe=False), np.nan)
        wrong = ~np.isfinite(values)
        if wrong.any():
            empty = np.asarray(column.is_null())
            wrong &= ~(empty & empty_is_nan)
            self.check(name, wrong, lambda row: "is empty; a number is required" if empty[row]
                       else f"{values[row]} is not a finite number")  # fmt: skip
        return values

    def is_number(self, name: str) -> bool:
        types = _pyarrow().types
        kind = self._batch.column(name).type
        return bool(types.is_floating(kind) or types.is_integer(kind))

    def places(self, name: str, index: Mapping[str, int]) -> NDArray[np.int64]:
        words, rows = self._encoded(name)
        known = [index.get(word, -1) for word in words]
        found: NDArray[np.int64] = np.array([*known, -1], dtype=np.int64)[rows]
        return found

    def _encoded(self, name: str) -> tuple[list[str], NDArray[np.int64]]:
        """Return the words of a column, and each row's place among them, -1 if it is empty."""
        encoded = self._batch.column(name).dictionary_encode()
        words = ["" if word is None else str(word) for word in encoded.dictionary.to_pylist()]
        # the indices of other programs may be unsigned
        return words, _to_numpy(encoded.indices.cast(_pyarrow().int64()), -1)


def _to_numpy(column: Any, missing: float) -> NDArray[Any]:
    """Return an Arrow column of numbers without importing pandas, as its `to_numpy` does."""
    return np.from_dlpack(column.fill_null(missing) if column.null_count else column)


def _parse_once(table: Table) -> Table:
    """Return the binary copy of a text table from the user's cache; write it if there is none.

    Without pyarrow or space on the disk, or if pyarrow's parser refuses the text, the table itself
    is returned: reading it then reports what is wrong.
    """
    try:
        found = table.path.stat()
        # a program that keeps the time of a file that it changes cannot keep `ctime`
        stamps = found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns
        key = f"3 {table.path.resolve()} {stamps}"
        folder = _cache()
        copy = folder / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.parquet"
        if copy.exists():
            with suppress(OSError):  # a cache that is read-only
                os.utime(copy)
            with suppress(RecordingError):  # a power cut may have left an empty one
                return ParquetTable(copy, REQUIRED, table)
        for old in folder.glob("*.parquet"):
            with suppress(OSError):
                if old.stat().st_mtime < time.time() - 86_400 * _KEPT_DAYS:
                    old.unlink()
        if shutil.disk_usage(folder).free < 2 * found.st_size:
            return table
        partial = folder / f"{uuid.uuid4().hex}.parquet"
        try:
            _write(partial, _typed(table, _parsed(table), lambda _: None))
            partial.replace(copy)
        finally:
            partial.unlink(missing_ok=True)
        return ParquetTable(copy, REQUIRED, table)
    except UsageError:
        log.info("%s is read from text each time; with pyarrow it would be parsed once", table.path)
    except (OSError, RuntimeError, ValueError, RecordingError) as cause:  # pyarrow, or no home
        log.debug("%s has no binary copy: %s", table.path, cause)
    return table


def _cache() -> Path:
    """Return the user's folder of copies. Raises OSError or RuntimeError if there is none."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "thermocald"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    return folder


class _ParsedChunk(ColumnChunk):
    """Some rows of a text table, whose text stays in Arrow's form, to be written again."""

    def text(self, name: str) -> Any:
        return self._batch.column(name)


def _parsed(table: Table) -> Iterator[ColumnChunk]:
    """Yield the rows of a CSV table by pyarrow's parser, six times as fast as ours.

    Its numbers are Python's to the bit. Raises ValueError where it refuses the text.
    """
    pyarrow = _pyarrow()
    from pyarrow import csv

    kinds = dict.fromkeys(filter(None, table.columns), pyarrow.string())
    kinds |= dict.fromkeys(_number_columns(table), pyarrow.float64())
    reader = csv.open_csv(
        table.path,
        csv.ReadOptions(
            block_size=_TEXT_BLOCK, column_names=table.columns, skip_rows=table._line(-1)
        ),
        csv.ParseOptions(newlines_in_values=True),
        csv.ConvertOptions(
            column_types=kinds, null_values=[""], include_columns=list(kinds), check_utf8=True
        ),
    )
    first = 0
    with reader:
        for batch in reader:
            yield _ParsedChunk(table, first, batch)
            first += len(batch)


def _number_columns(table: Table) -> list[str]:
    further = [name for name in table.columns if name not in ("", *REQUIRED)]
    return ["epoch", *REQUIRED[2:], *table.numeric(further)]


def _write(path: Path, parts: Iterable[Mapping[str, Any]]) -> None:
    """Write columns {name: (n,)}, given in parts, to a Parquet file; nothing if there are none."""
    pyarrow = _pyarrow()
    tables: Iterator[Any] = (
        pyarrow.table(
            {
                name: values
                if isinstance(values, pyarrow.Array)
                else pyarrow.array(values, from_pandas=isinstance(values, np.ndarray))
                for name, values in columns.items()
            }
        )
        for columns in parts
    )
    if (first := next(tables, None)) is None:
        return
    words = [f.name for f in first.schema if f.type == pyarrow.string()]
    tables = chain([first], tables)
    with pyarrow.parquet.ParquetWriter(
        path, first.schema, compression="zstd", use_dictionary=words, write_page_checksum=True
    ) as writer:
        # the parser's parts are long, those of our tables short
        while group := list(islice(tables, max(1, _ROWS // max(1, first.num_rows)))):
            writer.write_table(pyarrow.concat_tables(group))


def write_parquet(path: Path, parts: Iterable[Mapping[str, Any]]) -> None:
    """Write columns {name: (n,)}, given in parts, to a Parquet file, as a whole or not at all.

    Numbers are written bit for bit, NaN as null. Raises UsageError without pyarrow.
    """
    with new_file(path) as partial:
        _write(partial, parts)


def _typed(
    table: Table, chunks: Iterable[Chunk], advance: Callable[[int], object]
) -> Iterator[Columns]:
    """Yield the columns of a table in parts: epochs, numbers, and text. Raises RecordingError."""
    numbers, chunk = _number_columns(table), None
    for chunk in chunks:
        yield {
            name: chunk.integers(name) if name == "epoch"
            else chunk.numbers(name, empty_is_nan=name not in REQUIRED)
            if name in numbers
            else chunk.text(name)
            for name in table.columns
            if name
        }  # fmt: skip
        advance(len(chunk))
    if chunk is None:
        raise RecordingError(f"{table.path}: holds no observations")


def csv_to_parquet(source: Path, target: Path, advance: Callable[[int], object]) -> None:
    """Write observations.csv as Parquet; extra columns of text stay text.

    advance(n) is called after each n rows, and with -n where n rows are read again. Raises
    RecordingError; UsageError without pyarrow.
    """
    table = Table(source, REQUIRED)
    done = 0

    def advance_from_start(rows: int) -> None:
        nonlocal done
        done += rows
        advance(rows)

    with new_file(target) as partial:
        try:
            _write(partial, _typed(table, _parsed(table), advance_from_start))
        except ValueError:  # refused by pyarrow: our parser reads it, or names what is wrong
            advance(-done)
            _write(partial, _typed(table, table.chunks(), advance))


def parquet_to_csv(source: Path, target: Path, advance: Callable[[int], object]) -> None:
    """Write observations.parquet as CSV, so that every number reads back the same."""
    table = ParquetTable(source, REQUIRED)
    write_parts(target, csv_text(_typed(table, table.chunks(), advance)))


def _select_groups(metadata: Any, column: int, epochs: tuple[int, int]) -> tuple[range, int]:
    """Return the row groups that may hold a range of epochs, and the number of rows before them.

    A file whose groups have no statistics of their epochs, or are not in order, is read whole.
    """
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    known = [group.column(column).statistics for group in groups]
    if not all(one is not None and one.has_min_max for one in known):
        return range(len(groups)), 0
    low, high = [one.min for one in known], [one.max for one in known]
    if any(a > b for a, b in zip(high[:-1], low[1:], strict=True)):
        return range(len(groups)), 0
    first = bisect_left(high, epochs[0])
    return range(first, bisect_right(low, epochs[1])), sum(g.num_rows for g in groups[:first])


def _pyarrow() -> Any:
    try:
        import pyarrow as pa
        import pyarrow.parquet
    except ImportError as cause:
        raise UsageError(
            "Parquet needs pyarrow: pip install 'thermocald[parquet]', or convert the recording to "
            "CSV on a machine that has it"
        ) from cause
    return pa
