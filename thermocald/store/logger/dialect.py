"""Read a table of any program: detect its encoding, separator, decimal mark, head and columns.

Lines above the table (a logger's name, its serial number) are skipped; a second line of the head
with units is joined to the names. Rows are read one by one, so that a year of them fits into
memory. What was detected is kept for the user to see.

Units of temperatures are detected in heads of columns and in readings. The columns that hold times
and temperatures are those that options name, or guessed. The order of day and month follows from
the dates, or from the times of the photographs. Otherwise the file is refused, and the message
names the option that decides.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter, deque
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, time
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from thermocald.errors import DataError, UsageError
from thermocald.names import channel_fault
from thermocald.store.logger.clock import (
    ORDERS,
    DeviceClock,
    are_serials,
    date_orders,
    device_clock,
    is_date_like,
    parse_moment,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from thermocald.arrays import Array


UNITS = ("degC", "K", "degF")

_LETTERS = {
    "c": "degC",
    "℃": "degC",
    "k": "K",
    "f": "degF",
    "℉": "degF",
    "华": "degF",
    "華": "degF",
}
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
UNIT_BEHIND = re.compile(r"\s*(?:[°º]\s*[CFK]?|'C|℃|℉|deg\s?[CF]|(?<=[\d\s])[CFK])$")
"""The unit behind a reading."""


def stated_unit(text: str) -> str | None:
    """Return the unit, one of `UNITS`, that a column's head or a reading states, or None.

    `(F)`, `[F]`, `°F`, `ºF`, `℉`, `degF`, `deg. F`, `TempF`, `temp_f`, `Temperature, F` and
    `Fahrenheit` are equivalent.
    """
    found = _STATED.search(text)
    if found is None:
        return None
    return _LETTERS[next(filter(None, found.groups()))[0].lower()]


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
"""Names of columns of seconds in this program's files, which may count from any day."""
TIME_NAME = re.compile(
    r"time|date|zeit|datum|uhr|stamp|tijd|heure|fecha|hora|utc|changed|\btid|时间|日期|時間|日時|時刻|日付"
    r"|시간|날짜|일시|дата|врем|čas|ώρα",
    re.IGNORECASE,
)
"""Words in the head of a column of times."""
SEPARATORS = {";": "semicolon", "\t": "tab", "|": "bar", ",": "comma"}
_LARGEST_BYTES = 2_000_000_000
_CHUNK = 1 << 20
_MOST_COLUMNS = 1000
_SAMPLE = 400
_CONSISTENT = 0.8
_PREAMBLE = 12
_ENDS = ("\n", "\r")
_FOREIGN = 50  # lines by which an encoding is detected
_ENCODINGS = (
    "utf-8", "cp932", "euc_jp", "big5", "cp949", "cp1251", "koi8_r", "cp866", "cp1250", "cp1253",
    "cp1254", "cp850", "mac_roman",
)  # fmt: skip
"""Encodings that are tried after those of Western Europe and China."""
_LETTERS_ALONE = "\u03a9\u2126\u0394"  # ohm and delta, which are part of Greek words too
_COMMA_NUMBER = re.compile(r"[+-]?\d+,\d+\s*[^\d\s.,:]{0,4}")
_POINT_NUMBER = re.compile(r"[+-]?\d+\.\d+\s*[^\d\s.,:]{0,4}")
_CUT = re.compile(r"[+-]?\d+;\d+")  # one number, cut at its decimal comma
_BARE_UNIT = re.compile(r"[°º]?\s*[CFK]|℃|℉|deg\s?[CFK]|%", re.IGNORECASE)
_READING = re.compile(
    r"(?:[+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?\s*(?:[°º']?\s*[CFK]|℃|℉|deg\s?[CF]|%)?)?"
    r"|unavailable|unknown|none|null|n/?an?|-+|err(?:or)?",
    re.IGNORECASE,
)


@dataclass(frozen=True, slots=True)
class LoggerFile:
    """A table in a file: the names of its columns, and its detected form.

    first_line: line of the first row; sample: some rows from the beginning and the end; above: the
    lines above the first row; is_cut: whether the last row is incomplete; is_assumed: whether other
    encodings would do as well.
    """

    path: Path
    names: tuple[str, ...]
    first_line: int
    encoding: str
    separator: str
    decimal: str
    sample: tuple[tuple[str, ...], ...]
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
        """Return the names of the columns that hold one of some kinds of values, see `_kind`."""
        return [name for name in self.names if _kind(self.column(name)) in kinds]

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield each row with its line, with one field per name; missing ones are empty."""
        width = len(self.names)
        with self.path.open(encoding=self.encoding, errors="replace", newline="") as file:
            lines = (text for text in file if text.endswith(_ENDS) or not self.is_cut)
            for line, row in _parse_rows(self.path, lines, self.separator):
                if line >= self.first_line:
                    yield line, _fit_width(row, width)


def open_log(path: Path, options: LogOptions) -> LoggerFile:
    """Detect the form of a logger's table; encoding, separator, decimal mark only if not given.

    Raises DataError if the file cannot be read or holds no table with times.
    """
    detected = _detect_encoding(path)
    encoding = options.encoding or detected
    is_assumed = not options.encoding and not detected.startswith("utf")
    try:
        with path.open(encoding=encoding, errors="replace", newline="") as file:
            begin = list(islice(file, _SAMPLE))
            end = list(deque(filter(str.strip, file), _SAMPLE))
    except UnicodeError as cause:
        raise UsageError(f"--encoding {encoding}: {path} cannot be read so: {cause}") from cause
    if not any(map(str.strip, begin + end)):
        raise DataError(f"{path}: is empty")
    ours = any(name.strip() in OUR_TIMES for name in begin[0].split(","))
    try:
        mark = options.separator or _detect_separator(
            path, end if len(end) == _SAMPLE else begin + end
        )
    except DataError:
        if not ours:
            raise
        mark = ","
    start, last = list(_parse_rows(path, begin, mark)), _split_lines(end, mark)
    width = Counter(len(row) for _, row in (start + last)[-_SAMPLE:]).most_common(1)[0][0]
    if width > _MOST_COLUMNS:
        raise DataError(f"{path}: has {width} columns; at most {_MOST_COLUMNS} are read")
    first = next((i for i, (_, row) in enumerate(start) if len(row) >= width and _is_data(row)), -1)
    if first < 0 and ours and len(start) > 1:
        first = 1
    if first < 0 or width < 2:
        raise DataError(
            f"{path}: no row holds a time and a number; is it a log of temperatures? Give its "
            "separator and decimal mark (--separator ';' --decimal ',')"
        )
    head = [row for _, row in start[:first]]
    # if another head follows, the rows so far were statistics
    for i in range(first + 1, min(first + _PREAMBLE, len(start) - 1)):
        row, next_row = start[i][1], start[i + 1][1]
        named = row not in head and not _is_data(row) and any(map(TIME_NAME.search, row))
        # a remark (`# battery changed`) fills one field
        if named and sum(map(bool, row)) > 1 and _is_data(next_row):
            head, first = [row], i + 1
    names = _column_names(head, width)
    rows = tuple(tuple(_fit_width(row, len(names))) for _, row in start[first:] + last)
    found = options.decimal or _detect_decimal(rows, mark)
    ends = [";".join(row[-2:]) for row in rows if row[-1]]
    if mark == "," and head and len(head[-1]) < width and ends and all(map(_CUT.fullmatch, ends)):
        raise DataError(
            f"{path}, line {start[first][0]}: the rows hold more fields than the head: are commas "
            "used both in numbers and between columns? Change one of them"
        )
    above = tuple(" ".join(row) for _, row in start[:first])
    is_cut = not (begin + end)[-1].endswith(_ENDS) and _is_shorter(rows, found)
    return LoggerFile(
        path, names, start[first][0], encoding, mark, found, rows, above, is_cut, is_assumed
    )


def _is_shorter(rows: tuple[tuple[str, ...], ...], decimal: str) -> bool:
    """Return whether the last row has fewer fields, or its last number fewer decimals, than any."""
    *ends, column = (max((i for i, field in enumerate(row) if field), default=0) for row in rows)
    if column < min(ends, default=0):
        return True
    *others, last = (len(row[column].partition(decimal)[2]) for row in rows if row[column])
    return last < min(others, default=0)


def _parse_rows(path: Path, lines: Iterable[str], mark: str) -> Iterator[tuple[int, list[str]]]:
    """Yield rows that are not empty, with their lines."""
    plain = (line.replace("−", "-").replace("temp=", "") for line in lines)  # as vcgencmd writes it
    reader = csv.reader(plain, delimiter=mark)
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
    if not path.is_file():
        raise DataError(f"{path}: is not a file")
    if path.stat().st_size > _LARGEST_BYTES:
        raise DataError(f"{path}: is larger than {_LARGEST_BYTES // 1_000_000} MB; split it")
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
    except OSError as cause:
        raise DataError(f"{path}: cannot be read: {cause.strerror}") from cause
    some = b"\n".join(lines[:_FOREIGN])
    # GB 18030 writes Chinese in pairs of high bytes; ° and ä of Western Europe are single
    pairs = all(len(run) % 2 == 0 for run in re.findall(rb"[\x80-\xff]+(?=[\0-\x7f])", some))
    first = ("gb18030", "cp1252") if pairs else ("cp1252", "gb18030")
    return max((*first, *_ENCODINGS), key=lambda name: _count_words(some.decode(name, "replace")))


def _count_words(text: str) -> int:
    """Return how many words for times, temperatures and others a text has in letters beyond A-Z."""
    patterns = (TIME_NAME, _TEMPERATURE_NAME, OTHER_NAME)
    words = [found[0] for pattern in patterns for found in pattern.finditer(text)]
    return sum(not word.isascii() and word not in _LETTERS_ALONE for word in words)


def _detect_separator(path: Path, lines: list[str]) -> str:
    """Return the first separator that splits the last lines into equal rows with a time each."""
    sample = [line for line in lines[-_SAMPLE:] if line.strip()]
    for mark in SEPARATORS:
        rows = [row for _, row in _split_lines(sample, mark)]
        if not rows:
            continue
        width = Counter(len(row) for row in rows).most_common(1)[0][0]
        data = sum(len(row) >= width and _is_data(row) for row in rows)
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
        return is_date_like(field) or re.fullmatch(r"[45]\d{4}[.,]\d{5,}", field) is not None
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
    values = [value for row in rows for value in row]
    comma = sum(bool(_COMMA_NUMBER.fullmatch(v)) for v in values)
    point = sum(bool(_POINT_NUMBER.fullmatch(v)) for v in values if separator != ",")
    return "," if comma > point else "."


_TEMPERATURE_NAME = re.compile(
    r"temp|°\s*[cf]|deg\s*[cf]|celsius|fahrenheit|kelvin|thermo|ds18|pt100|housing|geh[äa]use"
    r"|\bt\d*\b|[\[(][cf][\])]|\bsensor|温度|溫度|気温|[℃℉]|온도|기온|темп|θερμ|hőm|sıcakl|teplot",
    re.IGNORECASE,
)
OTHER_NAME = re.compile(
    r"hum|feucht|\brh\b|%|press|druck|hpa|mbar|volt|batt|w/m|radiation|strahlung|\bm[va]\b|ohms?\b|[ΩΩ]"
    r"|delta|Δ|(?<![a-z])diff(?:eren[cz]e?)?(?![a-z])|\bd_?t\b|\bnr\b|index|count|record|lux|light|dew|taupunkt|ros[ée]e|roc[ií]o|rugiada"
    r"|^table$|entry_id|\bdpt\b|vpd|alarm|limit|threshold|serial|trusted|湿度|濕度|露点|序号|влажн|давлен|습도|気圧"
    # setpoints and statistics, not readings
    r"|(?<![^\W_])(?:set|sp|soll|goal|min|max|avg|mean|std)(?![^\W_])|set.?(?:point|temp|value|wert)"
    r"|temp\w*[ _]?set|soll|consigne|desired|target|wanted|nominal|reference value|forecast"
    r"|prognose|heat.?index|wind.?chill|feels|设定|目标"
    r"|^epoch$|pixel|^(?:c|x0|y0|sigma0)$|^sd_|^#$|^no\.?$",
    re.IGNORECASE,
)
_MEAN = re.compile(r"(?<![^\W_])(?:avg|mean)(?![^\W_])", re.IGNORECASE)
_NUMBER = re.compile(r"[+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?")
_GOOD_SHARE = 0.8
_ANNOTATIONS = ("#group", "#datatype", "#default")  # of InfluxDB
_LONGER = 10.0  # ratio of spans: in the wrong order, a log of days spans months or years


@dataclass(frozen=True, slots=True)
class LogOptions:
    """What the user has given about a log.

    times, temperatures: names of columns, empty to guess; encoding to unit: None to detect; clock:
    the logger's; wanted: names of temperature columns to use if they occur, such as a model's
    thermometers; names: new names of columns by those in the file.
    """

    times: tuple[str, ...] = ()
    temperatures: tuple[str, ...] = ()
    encoding: str | None = None
    separator: str | None = None
    decimal: str | None = None
    date_order: str | None = None
    unit: str | None = None
    clock: DeviceClock = field(default_factory=DeviceClock)
    wanted: tuple[str, ...] = ()
    names: Mapping[str, str] = field(default_factory=dict)


def log_options(
    *,
    timezone: str | None = None,
    log_timezone: str | None = None,
    log_clock: str = "0",
    ambiguous: str = "order",
    time_column: Sequence[str] | None = None,
    temperature_column: Sequence[str] | None = None,
    encoding: str | None = None,
    separator: str | None = None,
    decimal: str | None = None,
    date_order: str | None = None,
    unit: str | None = None,
    name: Sequence[str] | None = None,
) -> LogOptions:
    """Return the options of a log from the text of a command. Raises UsageError."""
    for option, value, allowed in (
        ("--unit", unit, UNITS),
        ("--date-order", date_order, ORDERS),
        ("--decimal", decimal, (",", ".")),
    ):
        if value is not None and value not in allowed:
            raise UsageError(f"{option} {value}: must be one of {', '.join(allowed)}")
    try:
        "".encode(encoding or "utf-8")
    except (LookupError, ValueError):
        raise UsageError(
            f"--encoding {encoding}: is unknown; give utf-8, cp1251, shift_jis, …"
        ) from None
    names = {}
    for text in name or ():
        column, _, label = text.rpartition("=")
        fault = channel_fault(label) if column and label else "must be COLUMN=LABEL"
        if fault:
            raise UsageError(f"--name {text}: {fault}")
        names[column] = label
    mark = {"tab": "\t", "\\t": "\t"}.get(separator or "", separator)
    if mark is not None and (len(mark) != 1 or mark.isalnum()):
        raise UsageError(f"--separator {separator}: must be one character, or the word tab")
    clock = device_clock(timezone, log_timezone, log_clock, ambiguous, "--log-timezone")
    return LogOptions(
        tuple(time_column or ()), tuple(temperature_column or ()), encoding, mark, decimal,
        date_order, unit, clock, names=names,
    )  # fmt: skip


def require_columns(file: LoggerFile, names: tuple[str, ...], option: str) -> tuple[str, ...]:
    for name in names:
        if name not in file.names:
            raise DataError(
                f"{file.path}: there is no column {name!r} ({option}); the columns are "
                f"{quoted(file.names)}"
            )
    return names


def find_time_columns(file: LoggerFile, options: LogOptions) -> tuple[str, ...]:
    if options.times:
        return require_columns(file, options.times, "--time-column")
    numeric, seconds = file.of_kind("number", "seconds"), file.of_kind("seconds")
    serial = [n for n in numeric if TIME_NAME.search(n) and are_serials(file.column(n))]
    found = serial or [n for n in OUR_TIMES if n in numeric] or file.of_kind("moment")
    if found := found or list(filter(TIME_NAME.search, seconds)):
        return (found[0],)
    dates, clocks = file.of_kind("date"), file.of_kind("time")
    if dates and clocks:
        return (dates[0], clocks[0])
    if len(seconds) == 1:
        return (seconds[0],)
    shown = "; ".join(f"{n!r}: {file.column(n)[0]}" for n in file.names)
    raise DataError(
        f"{file.path}: no column holds dates with times, as in 2026-06-14 12:00:00; change their "
        "form (in a spreadsheet, show 45992.5 as a date with a time before it is saved), or "
        f"give --time-column NAME (twice for a date and a time). First row: {shown}"
    )


def find_date_order(
    file: LoggerFile,
    names: tuple[str, ...],
    options: LogOptions,
    clock: DeviceClock,
    near: tuple[float, float] | None,
) -> tuple[str | None, list[str]]:
    """Return the order of day, month and year, None if dates need none, and notes.

    It follows from the numbers, such as a month above 12; else from the photographs, if only one
    order puts the log near them; else from the rows, as a log of some days would span months or
    years in another order. Where nothing decides, a year of two digits is taken to be last.
    """
    if options.date_order is not None:
        return options.date_order, []
    if not any(map(date_orders, file.column(names[0]))):
        return None, []
    first, spans = _read_in_orders(file, names)
    one, *others = spans
    costs: dict[str, dict[str, float]] = {}  # of each order, s, by what speaks for the least
    if others and near is not None:
        times = {o: clock.utc(span, lambda _: f"{file.path}") for o, span in spans.items()}
        costs["puts the log near the photographs"] = {
            o: float(max(t.min() - near[1], near[0] - t.max(), 0.0)) for o, t in times.items()
        }
    if others:
        costs["makes the rows consecutive"] = {
            o: abs((b.replace(tzinfo=None) - a.replace(tzinfo=None)).total_seconds())
            for o, (a, b) in spans.items()
        }
    for why, cost in costs.items():
        order, second, *_ = sorted(cost, key=cost.__getitem__)
        if cost[second] > _LONGER * cost[order] + 86400.0:
            return order, [f"log: {first!r} is {ORDERS[order]}: this {why}"]
    if "mdy" in others:
        raise DataError(
            f"{file.path}, column {names[0]!r}: {first!r} may be "
            f"{' or '.join(ORDERS[o] for o in spans)}: give --date-order {' or '.join(spans)}"
        )
    return one, [
        f"doubtful: {first!r} is taken as {ORDERS[one]}, {spans[one][0]:%Y-%m-%d}; if it is "
        f"{spans[other][0]:%Y-%m-%d}, give --date-order {other}"
        for other in others
    ]


def _read_in_orders(
    file: LoggerFile, names: tuple[str, ...]
) -> tuple[str, dict[str, list[datetime]]]:
    """Return the first date, and the first and last moment in every order that fits all dates."""
    places = [file.names.index(name) for name in names]
    first, dates = "", set[str]()
    found: dict[str, list[datetime]] = {order: [] for order in ORDERS}
    for line, row in file.rows():
        date = row[places[0]][:10]
        if date in dates:
            continue
        dates.add(date)
        if (possible := date_orders(row[places[0]])) is None:
            continue
        found = {order: moments for order, moments in found.items() if order in possible}
        if not found:
            raise DataError(
                f"{file.path}, line {line}, column {names[0]!r}: {row[places[0]]!r} is not in the "
                f"order of day and month of the rows above ({first!r})"
            )
        text = " ".join(row[place] for place in places)
        first = first or text
        for order, moments in found.items():
            moments.append(_moment(file, names, text, order))
    every = list(found.values())
    return first, {
        order: [moments[0], moments[-1]]
        for i, (order, moments) in enumerate(found.items())
        if moments not in every[:i]
    }


def _moment(file: LoggerFile, names: tuple[str, ...], text: str, order: str) -> datetime:
    try:
        found = parse_moment(text, order)
    except ValueError as cause:
        raise DataError(f"{file.path}, column {names[0]!r}: {cause}") from cause
    return found if isinstance(found, datetime) else datetime.now(UTC)


def find_temperature_columns(
    file: LoggerFile, times: tuple[str, ...], options: LogOptions
) -> tuple[str, ...]:
    if options.temperatures:
        return require_columns(file, options.temperatures, "--temperature-column")
    wanted = tuple(name for name in options.wanted if name in file.names)
    numeric = [n for n in file.of_kind("number", "seconds") if n not in times]
    of_name = [n for n in numeric if _TEMPERATURE_NAME.search(n)]
    plain = [n for n in of_name if not OTHER_NAME.search(n)]
    # a mean is a reading unless it is one of another column
    readings = tuple(n.lower() for n in plain)
    of = {n: _MEAN.sub("", n).lower().lstrip(" _.-") for n in of_name if _MEAN.search(n)}
    means = {n for n, o in of.items() if not OTHER_NAME.search(o) and not o.startswith(readings)}
    named = [n for n in of_name if n in {*plain, *means} and n not in wanted]
    if wanted or named:
        return (*wanted, *named)
    others = [n for n in numeric if not OTHER_NAME.search(n) and n not in OUR_TIMES]
    if len(others) == 1:
        return (others[0],)
    shown = "; ".join(f"{n!r}: {file.column(n)[0]}" for n in numeric) or "none with numbers"
    raise DataError(
        f"{file.path}: which column is the temperature? Give --temperature-column NAME. "
        f"{shown[:400]}"
    )


def _kind(values: list[str]) -> str:
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
        if is_date_like(value):
            return "moment" if ":" in value else "date"
        return "number" if number else "text"
    if isinstance(found, datetime):
        return "seconds" if number else "moment"
    if number and (isinstance(found, time) or not value.startswith("20")):  # 20260614 is a date
        return "number"
    return "time" if isinstance(found, time) else "date"


def quoted(names: Iterable[str]) -> str:
    """Return names of columns for a message."""
    return ", ".join(repr(n) for n in names)
