"""CSV tables read in chunks of columns, with errors that name file, line and column.

A row passes Python's csv reader once and is never made an object of its own: a day of 1.3 million
observations is read in one to two seconds, in the memory of one chunk.
"""

from __future__ import annotations

import csv
import io
import os
import re
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import RecordingError, ThermocaldError
from thermocald.numbers import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from typing import NoReturn, TextIO

    from numpy.typing import NDArray

    from thermocald.arrays import Array


_MAX_EXACT_INTEGER = 2**53
_LONGEST_HEADER = 200_000
_MOST_COLUMNS = 1000
_ROWS = 8192  # of a chunk
_LEFT_EMPTY = "; leave the field empty if there is none"


class Table:
    """A CSV file with a header; raises `error` if the file or a required column is missing.

    text: the table's text if it is not read from `path`, which then is only for the messages.
    columns: the names in the header, in their order.
    """

    _head = ", line 1"

    def __init__(
        self,
        path: Path | str,
        required: Sequence[str],
        error: type[ThermocaldError] = RecordingError,
        text: str | None = None,
    ) -> None:
        self.path, self.title = Path(path), str(path)  # as a path, an address loses a slash
        self._text = text
        self._error = error
        self.columns = self._header()
        if (count := len(self.columns)) > _MOST_COLUMNS:
            raise error(
                f"{self.title}{self._head}: has {count} columns; at most {_MOST_COLUMNS} are read"
            )
        for name in self.columns:
            if name and self.columns.count(name) > 1:
                raise error(f"{self.title}{self._head}: column {name!r} is duplicated")
        for name in required:
            if name not in self.columns:
                raise error(self._missing(name))

    def chunks(
        self, columns: Sequence[str] | None = None, epochs: tuple[int, int] | None = None
    ) -> Iterator[Chunk]:
        """Yield the rows below the header, at most _ROWS at a time; empty lines are skipped.

        columns, epochs (first, last): what is needed; a Parquet file leaves out the rest.
        """
        del columns, epochs
        first = 0
        with self._open() as file:
            reader = csv.reader(file, strict=True)
            # the garbage collector stops tracking tuples of text, but not lists
            content = map(tuple, filter(None, reader))
            try:
                next(content, None)
                while block := list(islice(content, _ROWS)):
                    yield Chunk(self, first, block)
                    first += len(block)
            except (csv.Error, UnicodeDecodeError, OSError) as cause:
                raise self._unreadable(reader.line_num, cause) from cause

    def read(
        self,
        integers: Sequence[str] = (),
        numbers: Sequence[str] = (),
        optional: Sequence[str] = (),
        texts: Sequence[str] = (),
    ) -> dict[str, Any]:
        """Return whole columns by name; optional: numbers that may be empty, which become NaN."""
        parts: dict[str, list[Any]] = {n: [] for n in (*integers, *numbers, *optional, *texts)}
        for chunk in self.chunks():
            for name in integers:
                parts[name].append(chunk.integers(name))
            for name in (*numbers, *optional):
                parts[name].append(chunk.numbers(name, empty_is_nan=name in optional))
            # chunk by chunk: the garbage collector would traverse a list of a year's texts
            for name in texts:
                parts[name].append(chunk.text(name))
        return {
            name: tuple(chain.from_iterable(found)) if name in texts
            else np.concatenate(found or [np.empty(0)])
            for name, found in parts.items()
        }  # fmt: skip

    def numeric(self, names: Sequence[str]) -> list[str]:
        """Return the columns that begin with numbers or are empty; they are read until it shows."""
        kinds: dict[str, bool | None] = dict.fromkeys(names)
        for chunk in self.chunks(columns=names) if names else ():
            kinds |= {n: chunk.is_number(n) for n, kind in kinds.items() if kind is None}
            if None not in kinds.values():
                break
        return [n for n, kind in kinds.items() if kind is not False]

    def check(
        self,
        name: str,
        wrong: NDArray[np.bool_],
        message: Callable[[int], str] | str,
        first: int = 0,
    ) -> None:
        """Raise for the first row marked wrong, after `first` others; message may take the row."""
        if wrong.any():
            row = int(np.argmax(wrong))
            self.fail(first + row, name, message if isinstance(message, str) else message(row))

    def fail(self, row: int, column: str | None, message: str) -> NoReturn:
        """Raise the error for one row (counted from 0 below the header) and column."""
        of = "" if column is None else f", column {column}"
        raise self._error(f"{self._where(row)}{of}: {message}")

    def _where(self, row: int) -> str:
        return f"{self.title}, line {self._line(row)}"

    def _open(self) -> TextIO:
        if self._text is not None:
            return io.StringIO(self._text, newline="")
        # reading a link to a device might never end
        if os.path.exists(self.path) and not os.path.isfile(self.path):
            raise self._error(f"{self.title}: is not a file")
        try:
            return self.path.open(newline="", encoding="utf-8-sig")
        except (OSError, ValueError) as cause:  # ValueError: a NUL character in the path
            why = getattr(cause, "strerror", cause)
            raise self._error(f"{self.title}: cannot be read: {why}") from cause

    def _header(self) -> list[str]:
        with self._open() as file:
            try:
                if len(file.readline(_LONGEST_HEADER)) >= _LONGEST_HEADER:
                    raise self._error(
                        f"{self.title}, line 1: is longer than {_LONGEST_HEADER} characters"
                    )
                file.seek(0)
                header = next(filter(None, csv.reader(file, strict=True)), None)
            except (csv.Error, UnicodeDecodeError, OSError) as cause:
                raise self._unreadable(1, cause) from cause
        if header is None:
            raise self._error(f"{self.title}: is empty; the first line must name the columns")
        return [name.strip() for name in header]

    def _unreadable(self, line: int, cause: Exception) -> ThermocaldError:
        if isinstance(cause, UnicodeDecodeError):
            return self._error(f"{self.title}: is not text in UTF-8; save it as CSV in UTF-8")
        return self._error(f"{self.title}, line {line}: is not readable as CSV: {cause}")

    def _missing(self, name: str) -> str:
        found = ", ".join(n if n.isprintable() else repr(n) for n in self.columns)
        hint = ""
        if len(self.columns) == 1 and name in self.columns[0]:
            hint = "; separate the columns with commas and write decimals with a point"
        elif near := [c for c in self.columns if re.split(r"\W", c.lower())[0] == name.lower()]:
            hint = f"; is {near[0]!r} meant? Write {name}, without a unit, in these letters"
        return f"{self.title}{self._head}: column {name} is missing; found: {found[:200]}{hint}"

    def _line(self, row: int) -> int:
        """Count the lines of the file up to a row: quoted fields may span several."""
        with self._open() as file:
            reader = csv.reader(file)
            for _ in islice(filter(None, reader), row + 2):
                pass
            return reader.line_num


class Chunk:
    """Consecutive rows of a table, as columns; first: the number of the first row in the table."""

    def __init__(self, table: Table, first: int, rows: list[tuple[str, ...]]) -> None:
        self.table = table
        self.first = first
        self._size = len(rows)
        width = len(table.columns)
        if set(map(len, rows)) != {width}:
            short = next(i for i, row in enumerate(rows) if len(row) != width)
            self.fail(
                short,
                None,
                f"has {counted(len(rows[short]), 'field')} instead of {width}"
                + ("; is the file cut off?" if len(rows[short]) < width else ""),
            )
        self._columns = dict(zip(table.columns, zip(*rows, strict=True), strict=True))

    def __len__(self) -> int:
        return self._size

    def text(self, name: str) -> tuple[str, ...]:
        """Return a column as text."""
        column: tuple[str, ...] = self._columns[name]
        return column

    def numbers(self, name: str, *, empty_is_nan: bool = False) -> Array:
        """Return a column as (n,) finite numbers; with `empty_is_nan`, empty fields are NaN."""
        column = self._columns[name]
        joined = "".join(column)
        if "_" in joined or not joined.isascii():  # float() accepts 2_5.0 and digits of any script
            row = next(i for i, t in enumerate(column) if "_" in t or not t.isascii())
            self.fail(row, name, f"{column[row][:40]!r} is not a number")
        try:
            values = np.fromiter(map(float, column), dtype=np.float64, count=self._size)
        except ValueError:
            values = np.array(
                [self._number(i, name, text, empty_is_nan) for i, text in enumerate(column)]
            )
        wrong = ~np.isfinite(values)
        if empty_is_nan and wrong.any():
            wrong &= np.array([bool(text.strip()) for text in column])
        hint = _LEFT_EMPTY * empty_is_nan
        self.check(name, wrong, lambda row: f"{column[row]!r} is not a finite number{hint}")
        return values

    def integers(self, name: str) -> NDArray[np.int64]:
        """Return a column as (n,) integers that are not negative."""
        values = self.numbers(name)
        wrong = (values != np.floor(values)) | (values < 0) | (values >= _MAX_EXACT_INTEGER)
        text = self.text
        self.check(name, wrong, lambda row: f"{text(name)[row]!r} is not an integer of at least 0")
        return values.astype(np.int64)

    def places(self, name: str, index: Mapping[str, int]) -> NDArray[np.int64]:
        """Return the value (n,) in `index` of each word of a column, -1 for an unknown word."""
        words = self.text(name)
        try:
            return np.fromiter(map(index.__getitem__, words), dtype=np.int64, count=self._size)
        except KeyError:
            return np.array([index.get(word.strip(), -1) for word in words], dtype=np.int64)

    def is_number(self, name: str) -> bool | None:
        """Return whether the first 100 fields that are not empty are numbers; None without any."""
        fields = list(islice(filter(str.strip, self.text(name)), 100))
        try:
            list(map(float, fields))
        except ValueError:
            return False
        return True if fields else None

    def check(
        self, name: str, wrong: NDArray[np.bool_], message: Callable[[int], str] | str
    ) -> None:
        """Raise for the first row of this chunk marked wrong, see `Table.check`."""
        self.table.check(name, wrong, message, self.first)

    def fail(self, row: int, column: str | None, message: str) -> NoReturn:
        """Raise the table's error for a row of this chunk."""
        self.table.fail(self.first + row, column, message)

    def _number(self, row: int, name: str, text: str, empty_is_nan: bool) -> float:
        if not text.strip():
            if empty_is_nan:
                return float("nan")
            self.fail(row, name, "is empty; a number is required")
        try:
            return float(text)
        except ValueError:
            hint = _LEFT_EMPTY * empty_is_nan
            if re.match(r"\d{4}-\d\d-\d\d", text):
                hint = "; write seconds since 1970"
            elif re.fullmatch(r"[+-]?\d+,\d+", text.strip()):
                hint = "; write decimals with a point"
            self.fail(row, name, f"{text[:40]!r} is not a number{hint}")
