"""The columns of a log that hold its times and temperatures: as options name them, or guessed.

The order of day and month follows from the dates, or from the times of the photographs. Otherwise
the file is refused, and the message names the option that decides.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime, time
from typing import TYPE_CHECKING

from thermocald.errors import DataError, UsageError
from thermocald.names import channel_fault
from thermocald.store.logger.clock import (
    DeviceClock,
    day_and_month,
    device_clock,
    is_date_like,
    parse_moment,
)
from thermocald.store.logger.dialect import OUR_TIMES, TIME_NAME, UNIT_BEHIND, UNITS, LoggerFile

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

_TEMPERATURE_NAME = re.compile(
    r"temp|°\s*[cf]|deg\s*[cf]|celsius|fahrenheit|kelvin|thermo|ds18|pt100|housing|geh[äa]use"
    r"|\bt\d*\b|[\[(][cf][\])]|\bsensor|温度|[℃℉]",
    re.IGNORECASE,
)
OTHER_NAME = re.compile(
    r"hum|feucht|\brh\b|%|press|druck|hpa|mbar|volt|batt|w/m|radiation|strahlung|\bm[va]\b|ohms?\b|[ΩΩ]"
    r"|delta|Δ|(?<![a-z])diff(?:eren[cz]e?)?(?![a-z])|\bd_?t\b|\bnr\b|index|count|record|lux|light|dew|taupunkt|ros[ée]e|roc[ií]o|rugiada"
    r"|\bdpt\b|vpd|alarm|limit|threshold|serial|trusted|湿度|露点|序号"
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
_WORDS = {"dmy": "day/month", "mdy": "month/day"}
_LONGER = 10.0  # ratio of spans: with day and month exchanged, a log spans months


@dataclass(frozen=True, slots=True)
class LogOptions:
    """What the user has given about a log.

    times, temperatures: names of columns, empty to guess; separator, decimal, date_order, unit:
    None to detect; clock: the logger's; wanted: names of temperature columns to use if they occur,
    such as a model's thermometers; names: new names of columns by those in the file.
    """

    times: tuple[str, ...] = ()
    temperatures: tuple[str, ...] = ()
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
    separator: str | None = None,
    decimal: str | None = None,
    date_order: str | None = None,
    unit: str | None = None,
    name: Sequence[str] | None = None,
) -> LogOptions:
    """Return the options of a log from the text of a command. Raises UsageError."""
    for option, value, allowed in (
        ("--unit", unit, UNITS),
        ("--date-order", date_order, ("dmy", "mdy")),
        ("--decimal", decimal, (",", ".")),
    ):
        if value is not None and value not in allowed:
            raise UsageError(f"{option} {value}: must be one of {', '.join(allowed)}")
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
        tuple(time_column or ()), tuple(temperature_column or ()), mark, decimal, date_order, unit,
        clock, names=names,
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
    kinds = {name: _kind(file.column(name)) for name in file.names}
    ours = [n for n in OUR_TIMES if kinds.get(n) in ("number", "seconds")]
    moments = [n for n, kind in kinds.items() if kind == "moment"]
    moments += [n for n, kind in kinds.items() if kind == "seconds" and TIME_NAME.search(n)]
    if ours or moments:
        return ((ours or moments)[0],)
    dates = [n for n, kind in kinds.items() if kind == "date"]
    clocks = [n for n, kind in kinds.items() if kind == "time"]
    if dates and clocks:
        return (dates[0], clocks[0])
    seconds = [n for n, kind in kinds.items() if kind == "seconds"]
    if len(seconds) == 1:
        return (seconds[0],)
    shown = "; ".join(f"{n!r}: {file.column(n)[0]}" for n in file.names)
    raise DataError(
        f"{file.path}: no column holds dates with times, as in 2026-06-14 12:00:00; change their "
        f"form, or give --time-column NAME (twice for a date and a time). First row: {shown}"
    )


def find_date_order(
    file: LoggerFile,
    names: tuple[str, ...],
    options: LogOptions,
    clock: DeviceClock,
    near: tuple[float, float] | None,
) -> tuple[str | None, list[str]]:
    """Return the order of day and month, None if dates need none, and notes.

    It follows from a number above 12; else from the photographs, if only one order puts the log
    near them; else from the rows, as a log of some days would span months in the other order.
    """
    if options.date_order is not None:
        return options.date_order, []
    if not any(day_and_month(text) for text in file.column(names[0])):
        return None, []
    places = [file.names.index(name) for name in names]
    first = last = ""
    orders: set[str] = set()
    same = True
    for _, row in file.rows():
        found = day_and_month(row[places[0]])
        if found is None:
            continue
        last = " ".join(row[place] for place in places)
        first = first or last
        same &= found[0] == found[1]
        if max(found) > 12:
            orders.add("dmy" if found[0] > 12 else "mdy")
    if len(orders) == 1:
        return orders.pop(), []
    if same:
        return "dmy", []
    if not orders:
        spans = {o: [_moment(file, names, text, o) for text in (first, last)] for o in _WORDS}
        if near is not None:
            far = {}
            for order, span in spans.items():
                utc = clock.utc(span, lambda _: f"{file.path}")
                far[order] = float(max(utc.min() - near[1], near[0] - utc.max(), 0.0))
            if abs(far["dmy"] - far["mdy"]) > 86400.0:
                order = min(far, key=lambda o: far[o])
                return order, [
                    f"log: {first!r} is {_WORDS[order]}: this puts the log near the photographs"
                ]
        ends = {o: [moment.replace(tzinfo=None) for moment in span] for o, span in spans.items()}
        lengths = {o: abs((b - a).total_seconds()) + 1.0 for o, (a, b) in ends.items()}
        order = min(lengths, key=lambda o: lengths[o])
        if max(lengths.values()) > _LONGER * lengths[order]:
            return order, [f"log: {first!r} is {_WORDS[order]}: this makes the rows consecutive"]
    raise DataError(
        f"{file.path}, column {names[0]!r}: {first!r} may be day/month or month/day: give "
        "--date-order dmy or mdy"
    )


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
    numeric = [
        name
        for name in file.names
        if name not in times and _kind(file.column(name)) in ("number", "seconds")
    ]
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
