"""A logger's temperatures: which columns are times and temperatures, in which unit.

Columns are taken by name, or guessed and shown. Whatever is not certain is refused with the option
that says it: units, the order of day and month, the time zone.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from datetime import date, datetime, time
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import DataError
from thermocald.store.logger.clock import DeviceClock, time_zone
from thermocald.store.logger.dialect import LoggerTable, read_table
from thermocald.store.logger.moments import MomentFormat, order_of_dates, parse_moment

if TYPE_CHECKING:
    from pathlib import Path

    from thermocald.arrays import Array

__all__ = ["UNITS", "LogOptions", "LoggedTemperatures", "read_log"]

UNITS = ("degC", "K", "degF")
_TIME_NAME = re.compile(r"time|date|zeit|datum|uhr|stamp|tijd|heure|fecha|hora|utc", re.IGNORECASE)
_TEMPERATURE_NAME = re.compile(
    r"temp|°\s*c|deg\s*c|celsius|kelvin|thermo|ds18|pt100|housing|geh[äa]use|\bt\d*\b|\[c\]|\bsensor",
    re.IGNORECASE,
)
_OTHER_NAME = re.compile(
    r"hum|feucht|\brh\b|%|press|druck|hpa|mbar|volt|batt|\bnr\b|index|count|record|lux|light|dew|taupunkt"
    r"|^epoch$|pixel|^(?:c|x0|y0|sigma0)$|^sd_|^#$|^no\.?$",
    re.IGNORECASE,
)
_FAHRENHEIT = re.compile(r"°\s*f|deg\s*f|fahrenheit|\[f\]|_f$", re.IGNORECASE)
_KELVIN = re.compile(r"kelvin|\[k\]|\(k\)|_k$", re.IGNORECASE)
_HEADER_ZONE = re.compile(r"(?:GMT|UTC)\s*[+-]\s*\d{1,2}(?::?\d{2})?", re.IGNORECASE)
_NO_READING = {-127.0, -999.0, -9999.0, -99.0, 9999.0}
_PLAUSIBLE_C = (-90.0, 180.0)
_GOOD_SHARE = 0.8


@dataclass(frozen=True, slots=True)
class LogOptions:
    """What is said about a log: names of time and temperature columns (empty: guess), separator and
    decimal mark, order of dates, unit, and the logger's clock.
    """

    times: tuple[str, ...] = ()
    temperatures: tuple[str, ...] = ()
    separator: str | None = None
    decimal: str | None = None
    date_order: str | None = None
    unit: str | None = None
    clock: DeviceClock = field(default_factory=DeviceClock)


@dataclass(frozen=True, slots=True, eq=False)
class LoggedTemperatures:
    """times (n,) s UTC, increasing; channels {name: (n,) °C}, NaN where there is none; notes: what
    was found and guessed, for people.
    """

    times: Array
    channels: dict[str, Array]
    notes: tuple[str, ...]


def read_log(path: Path, options: LogOptions | None = None) -> LoggedTemperatures:
    """Read a logger's file; DataError or UsageError says what is not certain and how to say it."""
    options = options or LogOptions()
    table = read_table(path, options.separator, options.decimal)
    notes = [f"log: {len(table)} rows, {table.description}"]
    time_names = _time_columns(table, options)
    moments = _moments(table, time_names, options)
    clock = options.clock
    header = " ".join(time_names)
    if said := _HEADER_ZONE.search(header):
        if clock.forced:
            notes.append(f"log: the header says {said[0]}; the logger's own zone was given instead")
        else:  # it is no time without a zone: what is said of such times is not meant for it
            clock = replace(clock, zone=time_zone(said[0]))
            notes.append(f"log: the header says the time zone: {said[0]}")

    def where(i: int) -> str:
        return f"{path}, line {table.lines[i]}"

    times = clock.utc(moments, where)
    names = _temperature_columns(table, time_names, options)
    notes.append(
        f"log: time from {_quoted(time_names)}; temperatures from {_quoted(names)}"
        + ("" if options.temperatures else " (guessed: --temperature-column says otherwise)")
    )
    channels = {}
    for name in names:
        values, lost = _values(table, name, options)
        channels[_channel(name)] = values
        if lost:
            notes.append(f"log: {lost} readings of {name!r} are none (-127, -999): left empty")
    order = np.argsort(times, kind="stable")
    times = times[order]
    if np.any(np.diff(times) < 0) or len(times) < 2:
        raise DataError(f"{path}: holds {len(times)} readings; two at least are needed")
    keep = np.concatenate([[True], np.diff(times) > 0])
    if not keep.all():
        notes.append(f"log: {int((~keep).sum())} rows with the time of the row before: left out")
    return LoggedTemperatures(
        times[keep], {n: v[order][keep] for n, v in channels.items()}, tuple(notes)
    )


def _quoted(names: tuple[str, ...]) -> str:
    return ", ".join(repr(n) for n in names)


def _channel(name: str) -> str:
    """A name that a recording can have for a column."""
    plain = re.sub(r"[^\w .°+-]", "", name).strip() or "temperature"
    return (
        f"{plain} of the log"
        if plain in {"epoch", "frame_time", "temperature_time", "frame"}
        else plain
    )


def _given(table: LoggerTable, names: tuple[str, ...], option: str) -> tuple[str, ...]:
    for name in names:
        if name not in table.columns:
            raise DataError(
                f"{table.path}: there is no column {name!r} ({option}); there are "
                f"{', '.join(repr(n) for n in table.columns)}"
            )
    return names


def _kind(values: list[str]) -> str:
    """What most of a column's first values are: moment, date, time, number, text."""
    kinds: dict[str, int] = {}
    sample = [v for v in values[:200] if v]
    for value in sample:
        try:
            found = parse_moment(value)
        except ValueError:
            kind = "moment?" if re.match(r"\d{1,2}[/-]\d{1,2}[/-]\d{2,4}", value) else "text"
            if kind == "moment?":
                kind = "moment" if ":" in value else "date"
            elif re.fullmatch(r"[+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?", value):
                kind = "number"
        else:
            number = re.fullmatch(r"\d+(?:[.,]\d+)?", value)
            kind = (
                "seconds" if number and isinstance(found, datetime)
                else "number" if number
                else "moment" if isinstance(found, datetime)
                else "date" if isinstance(found, date)
                else "time"
            )  # fmt: skip
        kinds[kind] = kinds.get(kind, 0) + 1
    if not kinds:
        return "empty"
    kind = max(kinds, key=lambda k: kinds[k])
    return kind if kinds[kind] >= _GOOD_SHARE * len(sample) else "text"


def _time_columns(table: LoggerTable, options: LogOptions) -> tuple[str, ...]:
    if options.times:
        return _given(table, options.times, "--time-column")
    kinds = {name: _kind(values) for name, values in table.columns.items()}
    moments = [n for n, kind in kinds.items() if kind == "moment"]
    moments += [n for n, kind in kinds.items() if kind == "seconds" and _TIME_NAME.search(n)]
    if moments:
        return (moments[0],)
    dates = [n for n, kind in kinds.items() if kind == "date"]
    clocks = [n for n, kind in kinds.items() if kind == "time"]
    if dates and clocks:
        return (dates[0], clocks[0])
    seconds = [n for n, kind in kinds.items() if kind == "seconds"]
    if len(seconds) == 1:
        return (seconds[0],)
    raise DataError(
        f"{table.path}: no column holds dates with times; say --time-column NAME (twice for a date "
        f"and a time). Columns: {', '.join(repr(n) for n in table.columns)}"
    )


def _moments(table: LoggerTable, names: tuple[str, ...], options: LogOptions) -> list[datetime]:
    where = f"{table.path}, column {names[0]!r}"
    order = options.date_order or order_of_dates(table.columns[names[0]], where)
    form = MomentFormat(order)
    columns = [table.columns[name] for name in names]
    found: list[datetime] = []
    for i, parts in enumerate(zip(*columns, strict=True)):
        text = " ".join(parts)
        try:
            moment = parse_moment(text, form)
        except ValueError as cause:
            raise DataError(
                f"{table.path}, line {table.lines[i]}, column {names[0]!r}: {text[:40]!r} is not a "
                f"date with a time ({cause})"
            ) from cause
        if isinstance(moment, time) or not isinstance(moment, datetime):
            raise DataError(
                f"{table.path}, line {table.lines[i]}: {text[:40]!r} is a date or a time alone; "
                "name both columns (--time-column twice)"
            )
        found.append(moment)
    return found


def _temperature_columns(
    table: LoggerTable, times: tuple[str, ...], options: LogOptions
) -> tuple[str, ...]:
    if options.temperatures:
        return _given(table, options.temperatures, "--temperature-column")
    numeric = [
        name
        for name, values in table.columns.items()
        if name not in times and _kind(values) in ("number", "seconds")
    ]
    named = [n for n in numeric if _TEMPERATURE_NAME.search(n) and not _OTHER_NAME.search(n)]
    if named:
        return tuple(named)
    others = [n for n in numeric if not _OTHER_NAME.search(n)]
    if len(others) == 1:
        return (others[0],)
    shown = "; ".join(f"{n!r}: {table.columns[n][0]}" for n in numeric) or "none with numbers"
    raise DataError(
        f"{table.path}: which column is the temperature? Say --temperature-column NAME. {shown}"
    )


def _values(table: LoggerTable, name: str, options: LogOptions) -> tuple[Array, int]:
    """A column (n,) in °C, and how many readings were none."""
    values = np.full(len(table), np.nan)
    lost = 0
    for i, text in enumerate(table.columns[name]):
        plain = text.replace(",", ".") if table.decimal == "," else text
        plain = re.sub(r"\s*(°\s*[CFK]?|deg[CF]|K)$", "", plain)
        if plain.lower() in ("", "nan", "na", "n/a", "-", "--", "null", "none", "err", "error"):
            continue
        if "_" in plain:
            plain = "?"
        try:
            values[i] = float(plain)
        except ValueError:
            raise DataError(
                f"{table.path}, line {table.lines[i]}, column {name!r}: {text[:40]!r} is not a "
                "number"
            ) from None
        if values[i] in _NO_READING:
            values[i], lost = np.nan, lost + 1
    unit = options.unit or _unit(table, name, values)
    values = values - 273.15 if unit == "K" else (values - 32) / 1.8 if unit == "degF" else values
    wrong = (values < _PLAUSIBLE_C[0]) | (values > _PLAUSIBLE_C[1])
    if wrong.any():
        i = int(np.argmax(wrong))
        raise DataError(
            f"{table.path}, line {table.lines[i]}, column {name!r}: {table.columns[name][i]} is "
            f"{values[i]:.4g} °C; temperatures of cameras lie between {_PLAUSIBLE_C[0]:g} and "
            f"{_PLAUSIBLE_C[1]:g} °C. Another unit (--unit), or another column "
            "(--temperature-column)?"
        )
    return values, lost


def _unit(table: LoggerTable, name: str, values: Array) -> str:
    """degC; DataError where name or values give another unit away."""
    known = values[np.isfinite(values)]
    if _FAHRENHEIT.search(name):
        raise DataError(f"{table.path}, column {name!r}: looks like °F: say --unit degF to convert")
    if _KELVIN.search(name) or (len(known) and known.min() > 220 and known.max() < 450):
        raise DataError(
            f"{table.path}, column {name!r}: looks like kelvin: say --unit K to convert"
        )
    return "degC"
