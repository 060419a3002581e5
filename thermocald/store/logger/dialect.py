"""A table as any program writes it: encoding, separator, decimal mark and header found out.

Lines above the table (a logger's name, its serial number) are passed over; a second line of the
header with units is joined to the names. The rows are read one by one: a year of them has to fit
into memory. What was found is kept, to be shown.

Units of temperatures are those that heads of columns and the readings of any device state.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter, deque
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from thermocald.errors import DataError
from thermocald.store.logger.clock import is_date_like, parse_moment

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from thermocald.arrays import Array


UNITS = ("degC", "K", "degF")

_LETTERS = {"c": "degC", "k": "K", "f": "degF"}
_STATED = re.compile(
    r"(?:°|º|˚|(?<![^\W\d_])deg(?:rees?|\.)?|(?<![^\W\d_])grad)[\s_-]*(?P<degree>[CFK])(?![^\W\d_])"
    r"|(?<![^\W\d_])(?P<before>[CFK])\s?[°º˚]"
    r"|[(\[{<]\s*[o*]?(?P<bracket>[CFK])\.?\s*[)\]}>,]"
    r"|(?P<word>celsius|f\w?[ah]r?h?r?[ae]n?h?ei[td]|fahr(?![^\W\d_])|kelvin)"
    r"|(?P<sign>[℃℉])|(?P<chinese>[华華]氏)"
    r"|temp(?:eratur[ae]?)?[\s_./:-]*(?P<temp>[CFK])(?![^\W\d_])"
    r"|[_,/]\s*(?P<tail>[CFK])$",
    re.IGNORECASE,
)


def stated_unit(text: str) -> str | None:
    """Return the unit, one of `UNITS`, that a column's head or a reading states, or None.

    `(F)`, `[F]`, `°F`, `ºF`, `℉`, `degF`, `deg. F`, `TempF`, `temp_f`, `Temperature, F` and
    `Fahrenheit` state the same.
    """
    found = _STATED.search(text)
    if found is None:
        return None
    kind, value = next((k, v.lower()) for k, v in found.groupdict().items() if v)
    if kind == "sign":
        return "degC" if value == "℃" else "degF"
    if kind == "chinese":
        return "degF"
    return _LETTERS[value[0]]


def without_unit(text: str) -> str:
    """Return a column's head without the unit that it states: `Temp` of `Temp (°F)`, `temp_f`."""
    while found := _STATED.search(text):
        begin = found.start("temp") if found["temp"] else found.start()
        text = f"{text[:begin]} {text[found.end() :]}"
    return " ".join(text.split()).strip(" _.,/-()[]{}")


def to_celsius(values: Array, unit: str) -> Array:
    """Convert temperatures (n,) in one of `UNITS` to °C."""
    if unit == "K":
        return values - 273.15
    return (values - 32.0) / 1.8 if unit == "degF" else values


OUR_TIMES = ("time", "temperature_time", "frame_time", "timestamp")
"""Names of a column of seconds in files of ours, which may count from any day."""
TIME_NAME = re.compile(
    r"time|date|zeit|datum|uhr|stamp|tijd|heure|fecha|hora|utc|时间|日期|changed", re.IGNORECASE
)
"""In the head of a column of times."""
SEPARATORS = {";": "semicolon", "\t": "tab", "|": "bar", ",": "comma"}
_LARGEST_BYTES = 2_000_000_000
_CHUNK = 1 << 20
_MOST_COLUMNS = 1000
_SAMPLE = 400
_CONSISTENT = 0.8
_PREAMBLE = 12
_COMMA_NUMBER = re.compile(r"[+-]?\d+,\d+\s*[^\d\s.,:]{0,4}")
_POINT_NUMBER = re.compile(r"[+-]?\d+\.\d+\s*[^\d\s.,:]{0,4}")
_CUT = re.compile(r"[+-]?\d+;\d+")  # one number, cut at its decimal comma
_BARE_UNIT = re.compile(r"[°º]?\s*[CFK]|℃|℉|deg\s?[CFK]|%", re.IGNORECASE)
_READING = re.compile(
    r"(?:[+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?\s*(?:[°º]?\s*[CFK]|℃|℉|deg\s?[CF]|%)?)?"
    r"|unavailable|unknown|none|null|n/?an?|-+|err(?:or)?",
    re.IGNORECASE,
)


@dataclass(frozen=True, slots=True)
class LoggerFile:
    """A table in a file: the names of its columns, and what was found out about it.

    first_line: that of the first row; sample: some rows, from its beginning and its end; above: the
    lines above the head.
    """

    path: Path
    names: tuple[str, ...]
    first_line: int
    encoding: str
    separator: str
    decimal: str
    sample: tuple[tuple[str, ...], ...]
    above: tuple[str, ...] = ()

    @property
    def description(self) -> str:
        """What was found, for people."""
        mark = "a comma" if self.decimal == "," else "a point"
        return (
            f"{self.encoding}, columns separated by "
            f"{SEPARATORS.get(self.separator, self.separator)}, decimals with {mark}"
        )

    def column(self, name: str) -> list[str]:
        """Values of a column in the sample."""
        place = self.names.index(name)
        return [row[place] for row in self.sample]

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Every row with its line: as many fields as there are names, missing ones empty."""
        width = len(self.names)
        with self.path.open(encoding=self.encoding, errors="replace", newline="") as file:
            for line, row in _parsed(self.path, file, self.separator):
                if line >= self.first_line:
                    yield line, _fitted(row, width)


def open_log(path: Path, separator: str | None = None, decimal: str | None = None) -> LoggerFile:
    """Find out how a logger's table is written; separator and decimal mark where not given.

    Raises DataError where the file cannot be read or holds no table with times.
    """
    encoding = _encoding(path)
    with path.open(encoding=encoding, errors="replace", newline="") as file:
        begin = list(islice(file, _SAMPLE))
        end = list(deque(file, _SAMPLE))
    ours = any(name.strip() in OUR_TIMES for name in begin[0].split(","))
    try:
        mark = separator or _separator(path, end if len(end) == _SAMPLE else begin + end)
    except DataError:
        if not ours:
            raise
        mark = ","
    start, last = _cut(begin, mark), _cut(end, mark)
    width = Counter(len(row) for _, row in (start + last)[-_SAMPLE:]).most_common(1)[0][0]
    if width > _MOST_COLUMNS:
        raise DataError(f"{path}: has {width} columns; at most {_MOST_COLUMNS} are read")
    first = next((i for i, (_, row) in enumerate(start) if len(row) >= width and _is_data(row)), -1)
    if first < 0 and ours and len(start) > 1:
        first = 1
    if first < 0 or width < 2:
        raise DataError(
            f"{path}: no row holds a time and a number; is it a log of temperatures? Separator and "
            "decimal mark can be given (--separator ';' --decimal ',')"
        )
    head = [row for _, row in start[:first]]
    above = tuple(" ".join(row) for row in head)
    # what stood there were statistics, where another head follows
    for i in range(first + 1, min(first + _PREAMBLE, len(start) - 1)):
        row, next_row = start[i][1], start[i + 1][1]
        named = row not in head and not _is_data(row) and any(map(TIME_NAME.search, row))
        if named and _is_data(next_row):
            head, first = [row], i + 1
    names = _names(head, width)
    rows = tuple(tuple(_fitted(row, len(names))) for _, row in start[first:] + last)
    found = decimal or _decimal(rows, mark)
    ends = [";".join(row[-2:]) for row in rows if row[-1]]
    if mark == "," and head and len(head[-1]) < width and ends and all(map(_CUT.fullmatch, ends)):
        raise DataError(
            f"{path}, line {start[first][0]}: the rows hold more fields than the head: do commas "
            "stand in the numbers and between the columns? Write either another way"
        )
    return LoggerFile(path, names, start[first][0], encoding, mark, found, rows, above)


def _parsed(path: Path, lines: Iterable[str], mark: str) -> Iterator[tuple[int, list[str]]]:
    """Rows that are not empty, with their lines."""
    reader = csv.reader(lines, delimiter=mark)
    try:
        for row in reader:
            fields = [field.strip() for field in row]
            if any(fields):
                yield reader.line_num, fields
    except csv.Error as cause:
        raise DataError(f"{path}, line {reader.line_num}: is not readable: {cause}") from cause


def _cut(lines: list[str], mark: str) -> list[tuple[int, list[str]]]:
    try:
        return list(_parsed(Path(), lines, mark))
    except DataError:
        return []  # said with its line where all rows are read


def _fitted(row: list[str], width: int) -> list[str]:
    return row[:width] + [""] * (width - len(row))


def _encoding(path: Path) -> str:
    """The first encoding in which the whole file is text."""
    if not path.is_file():
        raise DataError(f"{path}: is not a file")
    if path.stat().st_size > _LARGEST_BYTES:
        raise DataError(f"{path}: is larger than {_LARGEST_BYTES // 1_000_000} MB; cut it")
    try:
        with path.open("rb") as file:
            head = file.read(4096)
            if not head.strip():
                raise DataError(f"{path}: is empty")
            if head.startswith(codecs.BOM_UTF8):
                return "utf-8-sig"
            if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
                return "utf-16"
            if b"\0" in head:
                raise DataError(f"{path}: is not text")
            for name in ("utf-8", "gb18030", "cp1252"):
                file.seek(0)
                if _is_text(iter(lambda: file.read(_CHUNK), b""), name):
                    return name
    except OSError as cause:
        raise DataError(f"{path}: cannot be read: {cause.strerror}") from cause
    return "latin-1"


def _is_text(chunks: Iterator[bytes], encoding: str) -> bool:
    decoder = codecs.getincrementaldecoder(encoding)()
    try:
        for number, chunk in enumerate(chunks):
            # GB 18030 writes 温度 in pairs of high bytes; °C and ä of Latin-1 stand alone
            if encoding == "gb18030" and number == 0:
                runs = re.findall(rb"[\x80-\xff]+(?=[\0-\x7f])", chunk)
                if any(len(run) % 2 for run in runs):
                    return False
            decoder.decode(chunk)
        decoder.decode(b"", final=True)
    except UnicodeDecodeError:
        return False
    return True


def _separator(path: Path, lines: list[str]) -> str:
    """The first separator that cuts the last lines into rows of one width with a time in each."""
    sample = [line for line in lines[-_SAMPLE:] if line.strip()]
    for mark in SEPARATORS:
        rows = [row for _, row in _cut(sample, mark)]
        if not rows:
            continue
        width = Counter(len(row) for row in rows).most_common(1)[0][0]
        data = sum(len(row) >= width and _is_data(row) for row in rows)
        if width > 1 and data >= max(1, _CONSISTENT * (len(rows) - _PREAMBLE)):
            return mark
    raise DataError(
        f"{path}: no separator ({', '.join(SEPARATORS.values())}) cuts it into rows with a time "
        f"and a number each, as in {sample[-1].strip()[:60]!r}; say --separator, or write times "
        "and numbers another way"
    )


def _is_data(row: list[str]) -> bool:
    """Whether a row holds a time and something that can stand for a reading besides."""
    times = sum(_is_time(field) for field in row)
    return times > 0 and sum(bool(_READING.fullmatch(field)) for field in row) > 0


def _is_time(field: str) -> bool:
    try:
        parse_moment(field)
    except ValueError:
        return is_date_like(field)  # month before day, which is not decided yet
    return True


def _names(above: list[list[str]], width: int) -> tuple[str, ...]:
    """Names of the columns, those of a second line (units) joined to them; unique.

    above: the rows above the data. The first row of the data's width has the names; where none has
    it, one that is wider (a serial number stands in the first row alone) or one field narrower (the
    rows end with a separator).
    """
    wide = [_with_units(row, width) for row in above if len(row) > width][-1:]
    narrow = [row for row in above if len(row) == width - 1 and width > 2][-1:]
    rows = [row for row in above if len(row) == width]
    # a logger's serial number may stand above in as many fields
    named = next((i for i, row in enumerate(rows) if any(map(TIME_NAME.search, row))), None)
    if named is None and any(TIME_NAME.search(name) for row in wide for name in row):
        rows = wide
    header = rows[named or 0 :][:2] or wide or narrow
    names: list[str] = []
    for i in range(max(width, *(len(row) for row in header)) if header else width):
        parts = [row[i] for row in header if i < len(row) and row[i]]
        name = " ".join(dict.fromkeys(parts)) or f"column {i + 1}"
        while name in names:
            name += "'"
        names.append(name)
    return tuple(names)


def _with_units(row: list[str], width: int) -> list[str]:
    """A head of more fields than the data has: `Temperature, F` without quotes is one of them."""
    joined: list[str] = []
    for i, name in enumerate(row):
        if joined and len(joined) + len(row) - i > width and _BARE_UNIT.fullmatch(name):
            joined[-1] += f", {name}"
        else:
            joined.append(name)
    return joined


def _decimal(rows: tuple[tuple[str, ...], ...], separator: str) -> str:
    values = [value for row in rows for value in row]
    comma = sum(bool(_COMMA_NUMBER.fullmatch(v)) for v in values)
    if separator == ",":
        return "," if any(_COMMA_NUMBER.fullmatch(v) for v in values) else "."
    return "," if comma > sum(bool(_POINT_NUMBER.fullmatch(v)) for v in values) else "."
