"""Read a table of any program: detect its encoding, separator, decimal mark, head and columns.

Lines above the table (a logger's name, its serial number) are skipped; a second line of the head
with units is joined to the names. Rows are read one by one, so that a year of them fits into
memory. What was detected is kept for the user to see.

Units of temperatures are detected in heads of columns and in readings.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter, deque
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, time
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from thermocald.errors import DataError, UsageError
from thermocald.files import reading
from thermocald.store.logger.clock import date_orders, parse_moment

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from thermocald.arrays import Array


UNITS = ("degC", "K", "degF")

UNIT_BEHIND = re.compile(r"\s*(?:[°º]\s*[CFK]?|'C|℃|℉|deg\s?[CF]|(?<=[\d\s])[CFK])$")
"""The unit behind a reading."""


def to_celsius(values: Array, unit: str) -> Array:
    """Convert temperatures (n,) in one of `UNITS` to °C."""
    if unit == "K":
        return values - 273.15
    return (values - 32.0) / 1.8 if unit == "degF" else values


OUR_TIMES = ("time", "temperature_time", "frame_time", "timestamp")
"""Names of columns of seconds in this program's files, which may count from any day."""
TIME_NAME = re.compile(
    r"time|date|zeit|datum|uhr|stamp|tijd|heure|fecha|hora|utc|changed|czas|godzin|\btid|时间|日期|時間|日時|時刻|日付"
    r"|시간|날짜|일시|дата|врем|čas|ώρα",
    re.IGNORECASE,
)
"""Words in the head of a column of times."""
SEPARATORS = {";": "semicolon", "\t": "tab", "|": "bar", ",": "comma", " ": "space"}
_LARGEST_BYTES = 2_000_000_000
_CHUNK = 1 << 20
_MOST_COLUMNS = 1000
_SAMPLE = 400
_CONSISTENT = 0.8
_PREAMBLE = 12
_MOST_BREAKS = 5  # of the lines in a row, as in a quoted remark
_ENDS = ("\n", "\r")
_FOREIGN = 50  # lines by which an encoding is detected
_ENCODINGS = (
    "utf-8", "cp932", "euc_jp", "big5", "cp949", "cp1251", "koi8_r", "cp866", "cp1250", "cp1253",
    "cp1254", "cp850", "mac_roman",
)  # fmt: skip
"""Encodings that are tried after those of Western Europe and China."""
_LETTERS_ALONE = "\u03a9\u2126\u0394"  # ohm and delta, which are part of Greek words too
_DECIMAL = re.compile(r"[+-]?\d+([.,])\d+\s*[^\d\s.,:]{0,4}")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")
_CUT = re.compile(r"[+-]?\d+;\d+")  # one number, cut at its decimal comma
_BARE_UNIT = re.compile(r"[°º]?\s*[CFK]|℃|℉|deg\s?[CFK]|%", re.IGNORECASE)
_READING = re.compile(
    r"(?:[+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?\s*(?:[°º']?\s*[CFK]|[°º℃℉]|deg\s?[CF]|%)?)?"
    r"|unavailable|unknown|none|null|n/?an?|-+|err(?:or)?",
    re.IGNORECASE,
)


@dataclass(frozen=True, slots=True)
class LoggerFile:
    """A table in a file: the names of its columns, and its detected form.

    first_line: line of the first row; sample: some rows from the beginning and the end; kinds: of
    each column's values, see `_kind`; above: the lines above the first row; is_cut: whether the
    last row is incomplete; is_assumed: whether other encodings would do as well.
    """

    path: Path
    names: tuple[str, ...]
    first_line: int
    encoding: str
    separator: str
    decimal: str
    sample: tuple[tuple[str, ...], ...]
    kinds: tuple[str, ...]
    above: tuple[str, ...] = ()
    is_cut: bool = False
    is_assumed: bool = False

    @property
    def description(self) -> str:
        """The detected form, for the user."""
        mark = "a comma" if self.decimal == "," else "a point"
        assumed = " (assumed; set --encoding to change)" if self.is_assumed else ""
        return (
            f"{self.encoding}{assumed}, columns separated by "
            f"{SEPARATORS.get(self.separator, self.separator)}, decimals with {mark}"
        )

    def column(self, name: str) -> list[str]:
        """Return the values of a column in the sample."""
        place = self.names.index(name)
        return [row[place] for row in self.sample]

    def of_kind(self, *kinds: str) -> list[str]:
        """Return the names of the columns that hold one of some kinds of values."""
        return [name for name, kind in zip(self.names, self.kinds, strict=True) if kind in kinds]

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield each row with its line, with one field per name; missing ones are empty."""
        width = len(self.names)
        with self.path.open(encoding=self.encoding, errors="replace", newline="") as file:
            lines = (text for text in file if text.endswith(_ENDS) or not self.is_cut)
            for line, row in _parse_rows(self.path, lines, self.separator):
                if line < self.first_line:
                    continue
                if (breaks := "".join(row).count("\n")) > _MOST_BREAKS:
                    raise DataError(f"{self.path}, line {line - breaks}: a quote is not closed")
                more = row[width:] if self.separator == "," else []
                if more and all(map(str.isdigit, more)):
                    raise _commas_twice(self.path, line)
                yield line, _fit_width(row, width)


def open_log(
    path: Path, encoding: str | None, separator: str | None, decimal: str | None
) -> LoggerFile:
    """Detect the form of a logger's table: encoding, separator, decimal mark only if not given.

    Raises DataError if the file cannot be read or holds no table with times.
    """
    detected = _detect_encoding(path)
    is_assumed = not encoding and not detected.startswith("utf")
    encoding = encoding or detected
    try:
        with path.open(encoding=encoding, errors="replace", newline="") as file:
            begin = list(islice(file, _SAMPLE))
            end = list(deque(filter(str.strip, file), _SAMPLE))
    except UnicodeError as cause:
        raise UsageError(f"--encoding {encoding}: {path} cannot be read so: {cause}") from cause
    if not any(map(str.strip, begin + end)):
        raise DataError(f"{path}: is empty")
    ours = any(name.strip() in OUR_TIMES for name in begin[0].split(","))
    mark = separator or ("," if ours else _detect_separator(path, begin + end))
    start, last = list(_parse_rows(path, begin, mark)), _split_lines(end, mark)
    width = Counter(len(row) for _, row in (start + last)[-_SAMPLE:]).most_common(1)[0][0]
    if width > _MOST_COLUMNS:
        raise DataError(f"{path}: has {width} columns; at most {_MOST_COLUMNS} are read")
    head, first = _find_head(start, width, ours)
    if first < 0 or width < 2:
        raise DataError(
            f"{path}: no row holds a time and a number; is it a log of temperatures? Give its "
            "separator and decimal mark (--separator ';' --decimal ',')"
        )
    names = _column_names(head, width)
    rows = tuple(tuple(_fit_width(row, len(names))) for _, row in start[first:] + last)
    found = decimal or _detect_decimal(rows, mark)
    ends = [";".join(row[-2:]) for row in rows if row[-1]]
    if mark == "," and head and len(head[-1]) < width and ends and all(map(_CUT.fullmatch, ends)):
        raise _commas_twice(path, start[first][0])
    above = tuple(" ".join(row) for _, row in start[:first])
    is_cut = not (begin + end)[-1].endswith(_ENDS) and _is_shorter(rows, found)
    rows = rows[: len(rows) - is_cut]
    kinds = tuple(_kind(column) for column in zip(*rows, strict=True))
    return LoggerFile(
        path, names, start[first][0], encoding, mark, found, rows, kinds, above, is_cut, is_assumed
    )


def _commas_twice(path: Path, line: int) -> DataError:
    return DataError(
        f"{path}, line {line}: the row holds more fields than the head: are commas used both in "
        "numbers and between columns? Change one of them"
    )


def _find_head(
    start: list[tuple[int, list[str]]], width: int, ours: bool
) -> tuple[list[list[str]], int]:
    """Return the rows above a table and the place of its first row, -1 if there is none."""
    first = next((i for i, (_, row) in enumerate(start) if len(row) >= width and _is_data(row)), -1)
    if first < 0 and ours and len(start) > 1:
        first = 1
    if first < 0:
        return [], first
    head = [row for _, row in start[:first]]
    titled = any(
        len(row) == width and any(map(TIME_NAME.search, row)) and not any(map(_is_time, row))
        for row in head
    )
    # if another head follows, the rows so far were statistics; several below a head are readings
    for i in range(first + 1, min(first + _PREAMBLE, len(start) - 1)):
        row, next_row = start[i][1], start[i + 1][1]
        named = row not in head and not _is_data(row) and any(map(TIME_NAME.search, row))
        # a remark (`# battery changed`) fills one field
        statistics = not titled or i - first < 2
        if named and statistics and sum(map(bool, row)) > 1 and _is_data(next_row):
            head, first = [row], i + 1
    return head, first


def _is_shorter(rows: tuple[tuple[str, ...], ...], decimal: str) -> bool:
    """Return whether the last row has fewer fields, or its last number fewer decimals, than any."""
    *ends, column = (max((i for i, field in enumerate(row) if field), default=0) for row in rows)
    if column < min(ends, default=0):
        return True
    *others, last = (len(row[column].partition(decimal)[2]) for row in rows if row[column])
    return last < min(others, default=0)


def _parse_rows(path: Path, lines: Iterable[str], mark: str) -> Iterator[tuple[int, list[str]]]:
    """Yield rows that are not empty, with their lines."""
    # `temp=` of vcgencmd, NULs in place of the end of a line before a power cut, a mark of UTF-16
    # written with each line
    plain = (
        line.rpartition("\0")[2].replace("−", "-").replace("temp=", "").replace("\ufeff", "")
        for line in lines
    )
    if mark == " ":  # a head of NumPy
        plain = (line.removeprefix("# ") for line in plain)
    reader = csv.reader(plain, delimiter=mark, skipinitialspace=True)
    try:
        for row in reader:
            fields = [field.strip() for field in row]
            if any(fields):
                yield reader.line_num, fields
    except csv.Error as cause:
        raise DataError(f"{path}, line {reader.line_num}: is not readable: {cause}") from cause


def _split_lines(lines: list[str], mark: str) -> list[tuple[int, list[str]]]:
    try:
        return list(_parse_rows(Path(), lines, mark))
    except DataError:
        return []  # reported with its line when all rows are read


def _fit_width(row: list[str], width: int) -> list[str]:
    return row if len(row) == width else row[:width] + [""] * (width - len(row))


def _detect_encoding(path: Path) -> str:
    """Return the encoding of a text file.

    Of a file without a byte order mark that is not UTF-8, it is the one in which its lines hold
    most words of a log that this program knows.
    """
    with reading(path, DataError):
        if not path.is_file():
            raise DataError(f"{path}: {'is not a file' if path.exists() else 'does not exist'}")
        if path.stat().st_size > _LARGEST_BYTES:
            raise DataError(f"{path}: is larger than {_LARGEST_BYTES // 1_000_000} MB; split it")
        with path.open("rb") as file:
            head = re.sub(rb"\0{8,}", b"", file.read(4096))  # a power cut may leave a block of them
            if not head.strip():
                raise DataError(f"{path}: is empty")
            if head.startswith(codecs.BOM_UTF8):
                return "utf-8-sig"
            if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
                return "utf-16"
            if b"\0" in head:
                odd = [head[k::2].count(0) for k in (0, 1)]
                # every second byte of Latin letters in UTF-16 is 0, and no other
                if min(odd) == 0 and max(odd) > len(head) / 4:
                    return "utf-16-be" if odd[0] else "utf-16-le"
                raise DataError(f"{path}: is not text; save it as CSV in UTF-8")
            file.seek(0)
            lines = [line for line in file.read(_CHUNK).splitlines() if not line.isascii()]
        with suppress(UnicodeDecodeError), path.open(encoding="utf-8", newline="") as text:
            while text.read(_CHUNK):
                pass
            return "utf-8"
    some = b"\n".join(lines[:_FOREIGN])
    # GB 18030 writes Chinese in pairs of high bytes; ° and ä of Western Europe are single
    pairs = all(len(run) % 2 == 0 for run in re.findall(rb"[\x80-\xff]+(?=[\0-\x7f])", some))
    first = ("gb18030", "cp1252") if pairs else ("cp1252", "gb18030")
    return max((*first, *_ENCODINGS), key=lambda name: _count_words(some.decode(name, "replace")))


def _count_words(text: str) -> int:
    """Return how many words for times, temperatures and others a text has in letters beyond A-Z."""
    patterns = (TIME_NAME, TEMPERATURE_NAME, OTHER_NAME)
    words = [found[0] for pattern in patterns for found in pattern.finditer(text)]
    return sum(not word.isascii() and word.upper() not in _LETTERS_ALONE for word in words)


def _detect_separator(path: Path, lines: list[str]) -> str:
    """Return the first separator that splits the last lines into equal rows with a time each."""
    sample = [line for line in lines[-_SAMPLE:] if line.strip()]
    for mark in SEPARATORS:
        rows = [row for _, row in _split_lines(sample, mark)]
        if not rows:
            continue
        width = Counter(len(row) for row in rows).most_common(1)[0][0]
        # between spaces may be a part of the time, such as PM or UTC
        data = sum(
            len(row) >= width
            and _is_data(row)
            and (mark != " " or all(_is_time(f) or _READING.fullmatch(f) for f in row))
            for row in rows
        )
        if width > 1 and data >= max(1, _CONSISTENT * (len(rows) - _PREAMBLE)):
            return mark
    raise DataError(
        f"{path}: no separator ({', '.join(SEPARATORS.values())}) splits it into rows with a time "
        f"and a number, as in {sample[-1].strip()[:60]!r}; give --separator, or change the form "
        "of times (in a spreadsheet, show 45992.5 as a date with a time) and numbers"
    )


def _is_data(row: list[str]) -> bool:
    """Return whether a row holds a time and a reading or a word for a missing one."""
    return any(map(_is_time, row)) and any(map(_READING.fullmatch, row))


def _is_time(field: str) -> bool:
    try:
        parse_moment(field)
    except ValueError:
        # month before day, not decided yet; or days of a spreadsheet
        return bool(date_orders(field)) or re.fullmatch(r"[45]\d{4}[.,]\d{5,}", field) is not None
    return True


def _column_names(above: list[list[str]], width: int) -> tuple[str, ...]:
    """Return unique names of the columns, joined with those of a second line (units).

    above: the rows above the data. The names are in the first row of the data's width; if there is
    none, in a wider one (a serial number is in the first data row only) or in one that is narrower
    by one field (the rows end with a separator).
    """
    wide = [_join_units(row, width) for row in above if len(row) > width][-1:]
    narrow = [row for row in above if len(row) == width - 1 and width > 2][-1:]
    rows = [row for row in above if len(row) == width and row[0] not in _ANNOTATIONS]
    # a line with a logger's serial number may have as many fields as the data
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


def _join_units(row: list[str], width: int) -> list[str]:
    """Join fields of a head that is wider than the data, as `Temperature, F` without quotes."""
    joined: list[str] = []
    for i, name in enumerate(row):
        if joined and len(joined) + len(row) - i > width and _BARE_UNIT.fullmatch(name):
            joined[-1] += f", {name}"
        else:
            joined.append(name)
    return joined


def _detect_decimal(rows: tuple[tuple[str, ...], ...], separator: str) -> str:
    found = [number for row in rows for value in row if (number := _DECIMAL.fullmatch(value))]
    clear = [number for number in found if not _THOUSANDS.fullmatch(number[0])]
    marks = Counter(number[1] for number in clear or found)
    return "," if marks[","] > (0 if separator == "," else marks["."]) else "."


TEMPERATURE_NAME = re.compile(
    r"temp|°\s*[cf]|deg\s*[cf]|celsius|fahrenheit|kelvin|thermo|ds18|pt100|housing|geh[äa]use"
    r"|\bt\d*\b|\btt_|\btmp|[\[(][cf][\])]|\bsensor|温度|溫度|気温|[℃℉]|온도|기온|темп|θερμ|hőm|sıcakl|teplot"
    r"|czujnik|wewn[ęe]trzn|zewn[ęe]trzn|płytk",
    re.IGNORECASE,
)
OTHER_NAME = re.compile(
    r"hum|feucht|wilgotno[śs]|ci[śs]nien|napi[ęe]ci|\brh\b|%|press|druck|hpa|mbar|volt|batt|w/m|radiation|strahlung|\bm[va]\b|ohms?\b|[ΩΩ]"
    r"|delta|Δ|(?<![a-z])diff(?:eren[cz]e?)?(?![a-z])|\bd_?t\b|\bnr\b|index|count|record|recn|lux|light|dew|taupunkt|ros[ée]e|roc[ií]o|rugiada"
    r"|^table$|entry_id|\bdpt\b|vpd|alarm|limit|threshold|serial|trusted|湿度|濕度|露点|序号|влажн|давлен|습도|気圧"
    # setpoints and statistics, not readings
    r"|(?<![^\W_])(?:set|sp|soll|goal|min|max|avg|mean|std)(?![^\W_])|set.?(?:point|temp|value|wert)"
    r"|temp\w*[ _]?set|soll|consigne|desired|target|wanted|nominal|reference value|forecast"
    r"|prognose|heat.?index|wind.?chill|feels|设定|目标"
    r"|^epoch$|pixel|^(?:c|x0|y0|sigma0)$|^sd_|^#$|^no\.?$",
    re.IGNORECASE,
)
_NUMBER = re.compile(r"[+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?")
_GOOD_SHARE = 0.8
_ANNOTATIONS = ("#group", "#datatype", "#default")  # of InfluxDB


def _kind(values: Iterable[str]) -> str:
    """Return the kind of most of a column's values: moment, seconds, date, time, number, text."""
    kinds: Counter[str] = Counter(_kind_of(value) for value in values if re.search(r"\d", value))
    if not kinds:
        return "empty"
    kind, count = kinds.most_common(1)[0]
    return kind if count >= _GOOD_SHARE * kinds.total() else "text"


def _kind_of(value: str) -> str:
    number = _NUMBER.fullmatch(UNIT_BEHIND.sub("", value))
    try:
        found = parse_moment(value)
    except ValueError:
        if date_orders(value):
            return "moment" if ":" in value else "date"
        return "number" if number else "text"
    if isinstance(found, datetime):
        return "seconds" if number else "moment"
    if number and (isinstance(found, time) or not value.startswith("20")):  # 20260614 is a date
        return "number"
    return "time" if isinstance(found, time) else "date"
