"""A table as any program writes it: encoding, separator, decimal mark and header found out.

Lines above the table (a logger's name, its serial number) are passed over; a second line of the
header with units is joined to the names. What was found is kept, to be shown.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

from thermocald.errors import DataError
from thermocald.store.logger.moments import parse_moment

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["SEPARATORS", "LoggerTable", "read_table"]

SEPARATORS = {";": "semicolon", "\t": "tab", "|": "bar", ",": "comma"}
_LARGEST_BYTES = 500_000_000
_MOST_COLUMNS = 1000
_SAMPLE = 400
_CONSISTENT = 0.8
_PREAMBLE = 12
_COMMA_NUMBER = re.compile(r"[+-]?\d+,\d+")
_POINT_NUMBER = re.compile(r"[+-]?\d+\.\d+")


@dataclass(frozen=True, slots=True)
class LoggerTable:
    """Columns of text by name; lines: of each row in the file; what was found out about it."""

    path: Path
    columns: dict[str, list[str]]
    lines: list[int]
    encoding: str
    separator: str
    decimal: str

    def __len__(self) -> int:
        return len(self.lines)

    @property
    def description(self) -> str:
        """What was found, for people."""
        mark = "a comma" if self.decimal == "," else "a point"
        return (
            f"{self.encoding}, columns separated by "
            f"{SEPARATORS.get(self.separator, self.separator)}, decimals with {mark}"
        )


def read_table(path: Path, separator: str | None = None, decimal: str | None = None) -> LoggerTable:
    """Read a logger's table; separator and decimal mark are found out where they are not given.

    Raises DataError where the file cannot be read or holds no table with times.
    """
    text, encoding = _text(path)
    lines = text.splitlines()
    mark = separator or _separator(path, lines)
    rows: list[list[str]] = []
    numbers: list[int] = []
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=mark)
    try:
        for row in reader:
            if any(field.strip() for field in row):
                rows.append([field.strip() for field in row])
                numbers.append(reader.line_num)
    except csv.Error as cause:
        raise DataError(f"{path}, line {reader.line_num}: is not readable: {cause}") from cause
    width = Counter(len(row) for row in rows[-_SAMPLE:]).most_common(1)[0][0]
    if width > _MOST_COLUMNS:
        raise DataError(f"{path}: has {width} columns; at most {_MOST_COLUMNS} are read")
    first = next((i for i, row in enumerate(rows) if len(row) == width and _is_data(row)), None)
    if first is None or width < 2:
        raise DataError(
            f"{path}: no row holds a time and a number; is it a log of temperatures? Separator and "
            "decimal mark can be given (--separator ';' --decimal ',')"
        )
    names = _names([row for row in rows[:first] if len(row) == width], width)
    body = [
        (n, row) for n, row in zip(numbers[first:], rows[first:], strict=True) if len(row) == width
    ]
    columns = {name: [row[i] for _, row in body] for i, name in enumerate(names)}
    return LoggerTable(
        path, columns, [n for n, _ in body], encoding, mark, decimal or _decimal(columns, mark)
    )


def _text(path: Path) -> tuple[str, str]:
    if not path.is_file():
        raise DataError(f"{path}: is not a file")
    if path.stat().st_size > _LARGEST_BYTES:
        raise DataError(f"{path}: is larger than {_LARGEST_BYTES // 1_000_000} MB; cut it")
    try:
        data = path.read_bytes()
    except OSError as cause:
        raise DataError(f"{path}: cannot be read: {cause.strerror}") from cause
    if not data.strip():
        raise DataError(f"{path}: is empty")
    for bom, name in ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"),
                      (codecs.BOM_UTF16_BE, "utf-16")):  # fmt: skip
        if data.startswith(bom):
            return data.decode(name, errors="replace"), name
    if b"\0" in data[:4096]:
        raise DataError(f"{path}: is not text")
    for name in ("utf-8", "cp1252", "latin-1"):
        try:
            return data.decode(name), name
        except UnicodeDecodeError:
            continue
    raise DataError(f"{path}: is not text in UTF-8, UTF-16 or Latin-1")


def _separator(path: Path, lines: list[str]) -> str:
    """The first separator that cuts the last lines into rows of one width with a time in each."""
    sample = [line for line in lines[-_SAMPLE:] if line.strip()]
    for mark in SEPARATORS:
        rows = [[f.strip() for f in row] for row in csv.reader(sample, delimiter=mark) if row]
        width = Counter(len(row) for row in rows).most_common(1)[0][0]
        data = sum(len(row) == width and _is_data(row) for row in rows)
        if width > 1 and data >= max(1, _CONSISTENT * (len(rows) - _PREAMBLE)):
            return mark
    raise DataError(
        f"{path}: no separator ({', '.join(SEPARATORS.values())}) cuts it into rows with a time "
        "and a number each; say --separator"
    )


def _is_data(row: list[str]) -> bool:
    """Whether a row holds a time and something with digits besides."""
    times = sum(_is_time(field) for field in row)
    return times > 0 and any(_is_number(field) for field in row)


def _is_time(field: str) -> bool:
    try:
        parse_moment(field)
    except ValueError:
        # month before day, which is not decided yet
        return bool(re.fullmatch(r"\d{1,2}[/-]\d{1,2}[/-]\d{2,4}.*", field))
    return True


def _is_number(field: str) -> bool:
    return bool(re.fullmatch(r"[+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?", field)) or field == ""


def _names(header: list[list[str]], width: int) -> list[str]:
    """Names of the columns, those of a second line (units) joined to them; unique."""
    if not header:
        return [f"column {i + 1}" for i in range(width)]
    names = []
    for i in range(width):
        parts = [row[i] for row in header[:2] if row[i]]
        name = " ".join(dict.fromkeys(parts)) or f"column {i + 1}"
        while name in names:
            name += "'"
        names.append(name)
    return names


def _decimal(columns: dict[str, list[str]], separator: str) -> str:
    if separator == ",":
        quoted = any(_COMMA_NUMBER.fullmatch(v) for c in columns.values() for v in c[:_SAMPLE])
        return "," if quoted else "."
    values = [v for column in columns.values() for v in column[:_SAMPLE]]
    comma = sum(bool(_COMMA_NUMBER.fullmatch(v)) for v in values)
    return "," if comma > sum(bool(_POINT_NUMBER.fullmatch(v)) for v in values) else "."
