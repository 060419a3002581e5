"""`observations.parquet`: the columns of observations.csv as Apache Parquet, read in chunks.

It is read ten times as fast as CSV and has a third of its size; the numbers are the same to the
bit. It needs pyarrow (`pip install 'thermocald[parquet]'`). A chunk has the interface of a CSV
table's chunk, so both pass the same checks.

A CSV file that is too long for memory is read several times by an analysis. Its text is parsed only
once, into a Parquet copy in the user's cache, found by the text's path, inode, size and time.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import tempfile
import time
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import RecordingError, UsageError
from thermocald.files import new_file, write_parts
from thermocald.result import csv_text
from thermocald.store.recording.table import Chunk, Table

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from typing import NoReturn

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.result import Columns


REQUIRED = ("epoch", "target", "x", "y", "sx", "sy")
_ROWS = 1 << 18

log = logging.getLogger(__name__)

_TEXT_BLOCK = 1 << 24  # bytes of text that are parsed at a time
_KEPT_DAYS = 14.0  # since a copy was last read


class ParquetTable(Table):
    """A Parquet file with the columns of a CSV table; RecordingError if a column is missing.

    original: the table of which the file is a copy; errors then name the line of that table.
    """

    seeks = True
    _head, _most_columns = "", 200

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
        self,
        rows: int = _ROWS,
        columns: Sequence[str] | None = None,
        epochs: tuple[int, int] | None = None,
    ) -> Iterator[ColumnChunk]:
        """Yield at most `rows` rows at a time of `columns` and, if groups allow, of `epochs`."""
        pyarrow = _pyarrow()
        first = 0
        try:
            # not memory-mapped: what was read of a long file would stay resident
            with pyarrow.parquet.ParquetFile(self.path, pre_buffer=False) as file:
                groups = range(file.num_row_groups)
                if epochs is not None:
                    groups, first = _select_groups(
                        file.metadata, self.columns.index("epoch"), epochs
                    )
                for group in groups:  # one call for all groups would hold them all in memory
                    for batch in file.iter_batches(rows, [group], columns):
                        if len(batch):
                            yield ColumnChunk(self, first, batch)
                            first += len(batch)
        except (OSError, ValueError) as cause:  # pyarrow raises both
            if isinstance(cause, RecordingError):
                raise
            raise RecordingError(f"{self.path}: is damaged: {cause}") from cause
        finally:
            pyarrow.default_memory_pool().release_unused()

    def fail(self, row: int, column: str | None, message: str) -> NoReturn:
        """Raise RecordingError for one row (from 0) and column."""
        if self._original is not None:
            self._original.fail(row, column, message)
        where = f"{self.path}, row {row + 1}"
        raise RecordingError(f"{where}{f', column {column}' if column else ''}: {message}")


class ColumnChunk(Chunk):
    """Some consecutive rows of a Parquet table."""

    def __init__(self, table: ParquetTable, first: int, batch: Any) -> None:
        self.table = table
        self.first = first
        self._batch = batch
        self._size = len(batch)

    def text(self, name: str) -> tuple[str, ...]:
        return tuple("" if v is None else str(v) for v in self._batch.column(name).to_pylist())

    def numbers(self, name: str, *, empty_is_nan: bool = False) -> Array:
        column = self._batch.column(name)
        if not self.is_number(name):
            self.fail(0, name, f"holds {column.type}; numbers are required")
        empty = np.asarray(column.is_null())
        values: Array = column.cast(_pyarrow().float64(), safe=False).to_numpy(zero_copy_only=False)
        wrong = ~np.isfinite(values) & ~(empty & empty_is_nan)
        self.check(name, wrong, lambda row: "is empty; a number is required" if empty[row]
                   else f"{values[row]} is not a finite number")  # fmt: skip
        return values

    def is_number(self, name: str) -> bool:
        types = _pyarrow().types
        kind = self._batch.column(name).type
        return bool(types.is_floating(kind) or types.is_integer(kind))

    def places(self, name: str, index: Mapping[str, int]) -> NDArray[np.int64]:
        encoded = self._batch.column(name)
        if not hasattr(encoded, "dictionary"):
            encoded = encoded.dictionary_encode()
        if encoded.null_count:
            return np.where(np.asarray(encoded.is_null()), -1, super().places(name, index))
        known = [index.get(str(word), -1) for word in encoded.dictionary.to_pylist()]
        found: NDArray[np.int64] = np.array([*known, -1], dtype=np.int64)[
            encoded.indices.to_numpy(zero_copy_only=False)
        ]
        return found


def parse_once(table: Table) -> Table:
    """Return the binary copy of a text table from the user's cache; write it if there is none.

    Without pyarrow or space on the disk, or if pyarrow's parser refuses the text, the table itself
    is returned: reading it then reports what is wrong.
    """
    try:
        found = table.path.stat()
        key = f"2 {table.path.resolve()} {found.st_ino} {found.st_size} {found.st_mtime_ns}"
        folder = _cache()
        copy = folder / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.parquet"
        if copy.exists():
            os.utime(copy)
        else:
            for old in folder.glob("*.parquet"):
                with suppress(OSError):
                    if old.stat().st_mtime < time.time() - 86_400 * _KEPT_DAYS:
                        old.unlink()
            if shutil.disk_usage(folder).free < 2 * found.st_size:
                return table
            partial = copy.with_name(f"{copy.stem}-{os.getpid()}.parquet")
            try:
                _parse(table, partial)
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
    """Return the folder of copies, which must be this user's own; OSError if it is not."""
    with suppress(OSError, RuntimeError):
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(base) / "thermocald"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    folder = Path(tempfile.gettempdir()) / f"thermocald-{os.geteuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    owner = folder.lstat()
    if folder.is_symlink() or owner.st_uid != os.geteuid() or owner.st_mode & 0o077:
        raise OSError(f"{folder} is not this user's own")
    return folder


def _parse(table: Table, target: Path) -> None:
    """Write a CSV table as Parquet with pyarrow's parser; its numbers are Python's to the bit."""
    pyarrow = _pyarrow()
    from pyarrow import csv

    if next(table.chunks(1), None) is None:
        raise ValueError("no rows")
    names = [name for name in table.columns if name]
    kinds = dict.fromkeys(names, pyarrow.string())
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
    with reader:
        parts = ({name: batch.column(name) for name in kinds} for batch in reader)
        _write(target, (part | {"epoch": part["epoch"].cast(pyarrow.int64())} for part in parts))


def _number_columns(table: Table) -> list[str]:
    further = [name for name in table.columns if name not in ("", *REQUIRED)]
    return ["epoch", *REQUIRED[2:], *table.numeric(further)]


def _write(path: Path, batches: Iterable[Mapping[str, Any]]) -> None:
    """Write columns, given in parts, to a Parquet file."""
    pyarrow = _pyarrow()
    tables = (pyarrow.table(dict(columns)) for columns in batches)
    if (first := next(tables, None)) is None:
        return
    words = [f.name for f in first.schema if f.type == pyarrow.string()]
    with pyarrow.parquet.ParquetWriter(
        path, first.schema, compression="zstd", use_dictionary=words
    ) as writer:
        for table in chain([first], tables):
            writer.write_table(table)


def write_parquet(path: Path, parts: Iterable[Mapping[str, Any]]) -> None:
    """Write columns {name: (n,)}, given in parts, to a Parquet file, as a whole or not at all.

    Numbers are written bit for bit, NaN as null. Raises UsageError without pyarrow.
    """
    pyarrow = _pyarrow()
    arrays = (
        {
            name: pyarrow.array(values, from_pandas=isinstance(values, np.ndarray))
            for name, values in columns.items()
        }
        for columns in parts
    )
    with new_file(path) as partial:
        _write(partial, arrays)


def csv_to_parquet(source: Path, target: Path, advance: Any) -> None:
    """Write observations.csv as Parquet; extra columns of text stay text.

    advance(n) is called after each n rows. Raises RecordingError; UsageError without pyarrow.
    """
    table = Table(source, REQUIRED)
    names = _number_columns(table)

    def check(read: Table) -> None:
        for chunk in read.chunks():
            chunk.integers("epoch")
            for name in names:
                chunk.numbers(name, empty_is_nan=name not in REQUIRED)
            advance(len(chunk))

    with new_file(target) as partial:
        try:
            _parse(table, partial)
        except ValueError as cause:
            check(table)  # names the line of what is wrong
            raise RecordingError(f"{source}: cannot be converted: {cause}") from cause
        check(ParquetTable(partial, REQUIRED, table))


def parquet_to_csv(source: Path, target: Path, advance: Any) -> None:
    """Write observations.parquet as CSV, so that every number reads back the same."""
    table = ParquetTable(source, REQUIRED)

    def columns_of(chunk: ColumnChunk) -> Columns:
        advance(len(chunk))
        return {
            name: chunk.integers(name) if name == "epoch"
            else chunk.numbers(name, empty_is_nan=True) if chunk.is_number(name)
            else chunk.text(name)
            for name in table.columns
        }  # fmt: skip

    head: Columns = dict.fromkeys(table.columns, ())  # of a file without rows, too
    write_parts(target, csv_text(chain([head], map(columns_of, table.chunks()))))


def _select_groups(metadata: Any, column: int, epochs: tuple[int, int]) -> tuple[range, int]:
    """Return the row groups that may hold a range of epochs, and the number of rows before them.

    A file whose groups have no statistics of their epochs, or are not in order, is read whole.
    """
    whole = range(metadata.num_row_groups), 0
    low, high = [], []
    for group in range(metadata.num_row_groups):
        known = metadata.row_group(group).column(column).statistics
        if known is None or not known.has_min_max:
            return whole
        low.append(known.min)
        high.append(known.max)
    if any(a > b for a, b in zip(high[:-1], low[1:], strict=True)):
        return whole
    first = next((i for i, top in enumerate(high) if top >= epochs[0]), len(high))
    stop = next((i for i, bottom in enumerate(low) if bottom > epochs[1]), len(low))
    return range(first, stop), sum(metadata.row_group(i).num_rows for i in range(first))


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
