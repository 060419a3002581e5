"""What the user has given about a log, and what follows from the log itself.

The columns that hold times and temperatures are those that options name, or guessed. The order of
day and month follows from the dates, or from the times of the photographs. Otherwise the file is
refused, and the message names the option that decides.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from datetime import date, datetime
from itertools import pairwise
from typing import TYPE_CHECKING

from thermocald.errors import DataError, UsageError
from thermocald.names import channel_fault
from thermocald.numbers import column_label, without_unit
from thermocald.store.logger.clock import (
    ORDERS,
    ZONES_H,
    DeviceClock,
    are_serials,
    date_orders,
    day_begin,
    device_clock,
    lacks_zone,
    parse_moment,
)
from thermocald.store.logger.dialect import (
    OTHER_NAME,
    OUR_TIMES,
    TEMPERATURE_NAME,
    TIME_NAME,
    UNITS,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from thermocald.store.logger.dialect import LoggerFile


_MEAN = re.compile(r"(?<![^\W_])(?:avg|mean)(?![^\W_])", re.IGNORECASE)
_SENSOR = re.compile(
    r"(?:sensor|probe|device|logger|station|location|channel|name|series|topic|place|kanal)"
    r"[ _.-]?(id|name|no|nr|number)?\.?",
    re.IGNORECASE,
)
"""Heads of columns that name the sensor of a row."""
_SHIFT = re.compile(r"(?:UTC|GMT)?[+-]\d\d:\d\d")
_SHORT_DATE = re.compile(r"\d\d\.\d\d\.\d\d")
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


def require_columns(
    path: Path, columns: Sequence[str], given: Sequence[str], option: str
) -> tuple[str, ...]:
    """Return those of a file's columns that are given by the head or as the notes call them.

    Raises DataError for one that the file does not have.
    """
    known = {channel_name(column): column for column in columns[::-1]}
    known |= {column: column for column in columns}
    for name in given:
        if name not in known:
            raise DataError(
                f"{path}: there is no column {name!r} ({option}); the columns are {quoted(columns)}"
            )
    return tuple(dict.fromkeys(known[name] for name in given))


def channel_name(name: str) -> str:
    """Return a recording's name for a column, without the unit, which is °C there."""
    quantity = without_unit(column_label(name))
    plain = (re.sub(r"[^\w .°+-]", "", quantity).strip() or "temperature")[:48]
    return f"{plain} of the log" if channel_fault(plain) else plain


def find_time_columns(file: LoggerFile, options: LogOptions) -> tuple[str, ...]:
    """Return the columns that make up a time: it, or a date and a time, and perhaps the zone."""
    if options.times:
        return require_columns(file.path, file.names, options.times, "--time-column")
    found = _guess_time_columns(file)
    words = {name: set(filter(None, file.column(name))) for name in file.names}
    zones = [
        name
        for name, said in words.items()
        if said and (said <= ZONES_H.keys() or all(map(_SHIFT.fullmatch, said)))
    ]
    return (*found, *zones[:1]) if lacks_zone(file.column(found[-1])[0]) else found


def label_columns(file: LoggerFile) -> list[str]:
    """Return the columns that name the sensor of a row, if one table has all sensors.

    That is `entity_id` of Home Assistant; of InfluxDB, the words that differ between the rows; else
    a column called so whose words alternate.
    """
    if "_value" in file.names:
        return [n for n in file.of_kind("text", "empty") if len(set(file.column(n))) > 1]
    if "entity_id" in file.names:
        return ["entity_id"]
    labels = {name: file.column(name) for name in file.names if _is_label(file, name)}
    return [
        name
        for name, words in labels.items()
        if sum(a != b for a, b in pairwise(words)) > 2 * len(set(words)) > 2
    ]


def _is_label(file: LoggerFile, name: str) -> bool:
    """Return whether a column is called as a sensor and has no readings, but words or numbers."""
    found = _SENSOR.fullmatch(name)
    is_word = name in file.of_kind("text", "empty") or all(map(str.isdigit, file.column(name)))
    return found is not None and bool(found[1] or is_word)


def _guess_time_columns(file: LoggerFile) -> tuple[str, ...]:
    numeric, seconds = file.of_kind("number", "seconds"), file.of_kind("seconds")
    serial = [n for n in numeric if TIME_NAME.search(n) and are_serials(file.column(n))]
    # a column of one time is the start of a query or a mission
    moments = sorted(
        file.of_kind("moment"), key=lambda n: (n != "_time", len(set(file.column(n))) < 2)
    )
    found = serial or [n for n in OUR_TIMES if n in numeric] or moments
    if found := found or list(filter(TIME_NAME.search, seconds)):
        return (found[0],)
    dates, clocks = file.of_kind("date"), file.of_kind("time")
    if not dates:  # 14.06.26, which could also be a time
        dates = [n for n in clocks if all(map(_SHORT_DATE.fullmatch, file.column(n)))][:1]
        clocks = [n for n in clocks if n not in dates]
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
        day = row[places[0]][:10]
        if day in dates:
            continue
        dates.add(day)
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
            try:
                moment = parse_moment(text, order)
            except ValueError as cause:
                raise DataError(f"{file.path}, column {names[0]!r}: {cause}") from cause
            assert isinstance(moment, date)  # `date_orders` knows no others
            moments.append(day_begin(moment))
    every = list(found.values())
    return first, {
        order: [moments[0], moments[-1]]
        for i, (order, moments) in enumerate(found.items())
        if moments not in every[:i]
    }


def find_temperature_columns(
    file: LoggerFile, times: tuple[str, ...], options: LogOptions
) -> tuple[str, ...]:
    # else they are sensors, which may share a column
    given = set(options.temperatures)
    if given and (given & {*file.names} or not label_columns(file)):
        return require_columns(file.path, file.names, options.temperatures, "--temperature-column")
    wanted = tuple(name for name in options.wanted if name in file.names)
    numeric = [
        n for n in file.of_kind("number", "seconds") if n not in times and not _is_label(file, n)
    ]
    of_name = [n for n in numeric if TEMPERATURE_NAME.search(n)]
    plain = [n for n in of_name if not OTHER_NAME.search(n)]
    # a mean is a reading unless it is one of another column
    readings = tuple(n.lower() for n in plain)
    of = {n: _MEAN.sub("", n).lower().lstrip(" _.-") for n in of_name if _MEAN.search(n)}
    means = {n for n, o in of.items() if not OTHER_NAME.search(o) and not o.startswith(readings)}
    named = [n for n in of_name if n in {*plain, *means} and n not in wanted]
    if wanted or named:
        return (*wanted, *named)
    others = [
        n
        for n in numeric
        if not OTHER_NAME.search(n) and n not in OUR_TIMES and not _counts(file.column(n))
    ]
    if len(others) == 1:
        return (others[0],)
    shown = "; ".join(f"{n!r}: {file.column(n)[0]}" for n in numeric) or "none with numbers"
    raise DataError(
        f"{file.path}: which column is the temperature? Give --temperature-column NAME. "
        f"{shown[:400]}"
    )


def _counts(texts: Sequence[str]) -> bool:
    """Return whether texts are the numbers of the rows."""
    numbers = [int(text) for text in texts if text.isdecimal()]
    rise = sum(b - a == 1 for a, b in pairwise(numbers))
    return len(numbers) == len(texts) > 2 and rise >= len(texts) - 2  # the sample has a gap


def quoted(names: Iterable[str]) -> str:
    """Return names of columns for a message."""
    return ", ".join(repr(n) for n in names)
