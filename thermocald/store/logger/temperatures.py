"""Read temperatures from the file of a logger, for every command that reads a log.

Units and the time zone are taken from the file. Otherwise the file is refused, and the message
names the option that gives them.
"""

from __future__ import annotations

import math
import re
from array import array
from collections import Counter
from dataclasses import replace
from datetime import date, datetime
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import DataError
from thermocald.numbers import counted, stated_unit
from thermocald.store.logger.clock import (
    DeviceClock,
    are_serials,
    day_begin,
    parse_moment,
    parse_serial,
    stated_zones,
    whole_seconds,
)
from thermocald.store.logger.dialect import (
    OTHER_NAME,
    OUR_TIMES,
    TIME_NAME,
    UNIT_BEHIND,
    LoggerFile,
    open_log,
    to_celsius,
)
from thermocald.store.logger.options import (
    LogOptions,
    channel_name,
    find_date_order,
    find_temperature_columns,
    find_time_columns,
    label_columns,
    quoted,
    require_columns,
)
from thermocald.store.recording.reader import TemperatureLog as TemperatureLog
from thermocald.store.recording.sense import (
    PAUSE,
    TOO_HOT_C,
    find_spikes,
    find_unit_change,
    stuck_doubts,
    time_fault,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from thermocald.arrays import Array

_ZONE_LINE = re.compile(r"(?:time|zeit)\s*zone\W*([a-z]{3,4}[^a-z]*|[a-z]+/[\w/]+)$", re.IGNORECASE)
"""A line above the table that states the time zone; cities behind it may have summer time."""
_UNCLEAR = re.compile(r"(?<![^\W_])(?:[A-Z]{1,2}[SD]T|MSK|МСК|HKT|SGT)(?![^\W_])")
"""Letters that several time zones share, or that this program does not know."""
_UNIT_NAME = re.compile(r"unit|einheit|^scale$|unidad|eenheid", re.IGNORECASE)
_ABOVE = re.compile(r"(?:unit|einheit)\w*\W+(?:°\s*)?F\b|fahrenheit|°\s*F\b|℉", re.IGNORECASE)
"""Lines above a table that state °F."""
_CHANGES = "last_changed"
"""Home Assistant's column of times: it writes a row when the value changes, and only then."""
_LONGEST_PAUSE_S = 86400.0
_NO_READING = {
    -127.0, -196.6, -99.0, -99.9, -999.0, -999.9, -9999.0, 999.0, 999.9, 3276.7, 9999.0, 9999.99,
    -6999.0, 6999.0, -7999.0, 7999.0,
}  # fmt: skip
"""Numbers that stand for none: -196.6 is the -127 of the DS18B20 in °F, 3276.7 a full register."""
_TENTHS = re.compile(r"([+-]\d{3})(\d),\d")
"""A temperature of NOAA's integrated surface data: tenths, and a code of quality."""
_PLAUSIBLE_C = (-90.0, 180.0)
_KELVIN = (220.0, 450.0)
_LATEST_S = 1e11
_HOURS = re.compile(r"(?:19|20)\d\d(?:0[1-9]|1[0-2])[0-3]\d[0-2]\d")
_SECONDS = re.compile(r"(.*?):([0-5]\d(?:\.\d+)?)(\D*(?:[+-]\d\d:?\d\d)?)", re.ASCII)
"""A time with its last two digits before a zone, probably the seconds."""
_MOST_REPEATED = 0.1  # of the rows


def read_log(
    path: Path, options: LogOptions, near: tuple[float, float] | None = None
) -> TemperatureLog:
    """Read a logger's file; near: first and last time, s UTC, that the log should cover.

    Raises DataError or UsageError if something cannot be determined, naming the option to set.
    """
    file = open_log(path, options.encoding, options.separator, options.decimal)
    time_names = find_time_columns(file, options)
    lines = [zone[1] for line in file.above if (zone := _ZONE_LINE.search(line))]
    clock, notes = _apply_header_zone(options.clock, " ".join([*time_names, *lines]))
    names = find_temperature_columns(file, time_names, options)
    order, order_notes = find_date_order(file, time_names, options, clock, near)
    table = _Table(file, time_names, names, order, clock)
    if table.are_serials:
        notes.append(f"log: {time_names[0]!r} holds days since 1899-12-30, as of a spreadsheet")
    times = table.times
    if (different := len(np.unique(times))) < 2:
        raise DataError(f"{path}: has readings at {counted(different, 'time')}; two are needed")
    steps = np.diff(times)
    if not table.labels and steps.max() > 0 and (back := np.flatnonzero(steps < 0) + 1).size:
        row = int(back[0])
        notes.append(
            f"doubtful: the times run back {counted(len(back), 'time')}, the first by "
            f"{-steps[row - 1]:.0f} s ({table.where(row)}): was the clock set, or are hours of a "
            "12-hour clock without AM and PM? The rows are put in the order of their times"
        )
    channels, found = _read_channels(table, options)
    notes += found
    if _CHANGES in time_names:
        labels = np.array(table.labels or [""] * len(times))
        times, channels, held = _hold_readings(times, channels, labels)
        notes += held
    notes = [
        f"log: {counted(len(times), 'row')}, {file.description}",
        f"log: time from {quoted(time_names)}; temperatures from {quoted(channels)}"
        + ("" if options.temperatures else " (guessed; set --temperature-column to change)"),
        *order_notes, *notes, *table.left_out(),
    ]  # fmt: skip
    times, channels, repeated, others = _sort_by_time(times, channels)
    if repeated:
        text = f"{counted(repeated, 'row')} with the time of the row before: left out"
        without = "; the times have no seconds: take the logger's own file, not a spreadsheet's"
        rough = (
            repeated > _MOST_REPEATED * len(steps) and not (times % 60).any() and steps.min() >= 0
        )
        several = "; its reading is another: are sensors below one another? Make a file of each"
        end = several if others > 0.5 * repeated else without if rough else ""
        notes.append(f"{'doubtful' if end else 'log'}: {text}{end}")
    return TemperatureLog(times, channels, tuple(notes))


def _read_channels(table: _Table, options: LogOptions) -> tuple[dict[str, Array], list[str]]:
    """Return the channels {name: (n,) °C} of a table, and notes on their units and readings."""
    path, sensors = table.file.path, list(dict.fromkeys(table.labels))
    given = {
        column: new
        for old, new in options.names.items()
        for column in require_columns(path, [*table.file.names, *sensors], [old], "--name")
    }
    if sensors:
        _separate_sensors(table, sensors, options)
    channels: dict[str, Array] = {}
    notes: list[str] = []
    for name in table.values:
        values, found = _to_celsius_column(table, name, options)
        channel = given.get(name) or (name if name in options.wanted else channel_name(name))
        while channel in channels:  # `T (1)` and `T [1]` are two columns
            channel += "_"
        channels[channel] = values
        notes += found
    if not options.temperatures:  # a sensor that was never read is no reference
        channels = dict(sorted(channels.items(), key=lambda c: not np.isfinite(c[1]).any()))
    return channels, notes


def _separate_sensors(table: _Table, sensors: Sequence[str], options: LogOptions) -> None:
    """Make a column of each sensor with temperatures in a table that has all below one another."""
    path = table.file.path
    asked = [name for name in options.temperatures if name not in table.file.names]
    names = require_columns(path, sensors, asked, "--temperature-column")
    names = names or tuple(filter(options.wanted.__contains__, sensors))
    if len(table.values) > 1:
        raise DataError(
            f"{path}: has rows of {counted(len(sensors), 'sensor')} with several temperatures each "
            f"(column {quoted(label_columns(table.file))}): make a file of each sensor"
        )
    ((column, values),) = table.values.items()
    labels = np.array(table.labels)
    every = {n: np.where(labels == n, values, np.nan) for n in names or sensors}
    table.values = {
        name: readings
        for name, readings in every.items()
        if names or (np.isfinite(readings).any() and not OTHER_NAME.search(name))
    }
    table.units = dict.fromkeys(table.values, table.units[column])
    if not table.values:
        raise DataError(
            f"{path}: no sensor in column {quoted(label_columns(table.file))} has temperatures: "
            f"{quoted(sensors[:6])}; export one that has"
        )


def _hold_readings(
    times: Array, channels: dict[str, Array], labels: Array
) -> tuple[Array, dict[str, Array], list[str]]:
    """Repeat the readings in the pauses of a log of changes, in which the value stayed the same.

    labels: the sensor of each row. A sensor that was unavailable has a row without a reading, after
    which nothing is known.
    """
    more, notes = [times], []
    repeated = {name: [values] for name, values in channels.items()}
    for name, values in channels.items():
        sensor = labels == labels[np.isfinite(values).argmax()]
        order = np.argsort(times[sensor], kind="stable")
        t, v = times[sensor][order], values[sensor][order]
        steps = np.diff(t)
        usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else np.inf
        long = (steps > PAUSE * usual) & (steps <= _LONGEST_PAUSE_S) & np.isfinite(v[:-1])
        for k in np.flatnonzero(long).tolist():
            held = np.arange(t[k] + usual, t[k + 1] - 0.5 * usual, usual)
            more.append(held)
            for other, columns in repeated.items():
                columns.append(np.full(len(held), v[k] if other == name else np.nan))
        if long.any():
            notes.append(
                f"log: {name!r} has a row for each change only: its value is held in "
                f"{counted(int(long.sum()), 'pause')} of up to {steps[long].max():.0f} s"
            )
    return np.concatenate(more), {n: np.concatenate(c) for n, c in repeated.items()}, notes


def _sort_by_time(
    times: Array, channels: dict[str, Array]
) -> tuple[Array, dict[str, Array], int, int]:
    """Sort rows by time and join those of one time; return also how many are left out.

    The last number is that of rows left out whose readings are others, by more than 1 K.
    """
    unique, place = np.unique(times, return_inverse=True)
    kept, taken, others = {}, *np.zeros((2, len(times)), dtype=bool)
    for name, values in channels.items():
        known = np.flatnonzero(np.isfinite(values))
        _, first = np.unique(place[known], return_index=True)
        kept[name] = np.full(len(unique), np.nan)
        kept[name][place[known[first]]] = values[known[first]]
        taken[known[first]] = True
        others |= np.abs(values - kept[name][place]) > 1.0
    lost = int((~taken & np.any([np.isfinite(v) for v in channels.values()], axis=0)).sum())
    return unique, kept, lost, int(others.sum())


class _Table:
    """The rows of a log as arrays of numbers, compact enough for a year of them.

    Rows without a time (a footer) and words that are no reading are counted.
    """

    def __init__(
        self,
        file: LoggerFile,
        times: tuple[str, ...],
        names: tuple[str, ...],
        order: str | None,
        clock: DeviceClock,
    ) -> None:
        self.file, self._order = file, order
        self._time_names = times
        self._places = [file.names.index(name) for name in times]
        self._lines, self._seconds = array("i"), array("d")
        # of each row: the moment from which its seconds count, -1 for 1970
        self._of, self._moments = array("i"), list[datetime]()
        self._minute = cache(self._find_minute)
        self.values: dict[str, Any] = {name: array("d") for name in names}
        self.units: dict[str, Counter[str]] = {name: Counter() for name in names}
        self._untimed: list[tuple[int, str]] = []
        self._words: dict[str, Counter[str]] = {name: Counter() for name in names}
        self.labels: list[str] = []
        columns = [(name, file.names.index(name)) for name in names]
        labels = list(map(file.names.index, label_columns(file)))
        self.are_serials = len(times) == 1 and are_serials(file.column(times[0]))
        bare = set(self._time_names) <= set(OUR_TIMES) and not self.are_serials
        # 2026061412, the hours of a weather service
        tail = "00" if all(map(_HOURS.fullmatch, file.column(times[0]))) else ""
        self._has_times = times[0] in file.of_kind("moment")
        head = 0
        for line, row in file.rows():
            text = " ".join(row[place] for place in self._places) + tail
            seconds = _as_seconds(text) if bare else None
            at = (-1, seconds) if seconds is not None else self._find_moment(line, text)
            if at is None:
                self._untimed.append((line, text))
                head = line if self._is_other_head(row) else head
                continue
            if head:
                raise DataError(
                    f"{file.path}, line {head}: another head begins here, and columns may differ "
                    "from it on: make a file of each part"
                )
            self._of.append(at[0])
            self._seconds.append(at[1])
            self._lines.append(line)
            for name, place in columns:
                self.values[name].append(self._value(line, name, row[place]))
            if labels:
                self.labels.append(" ".join(row[place] for place in labels))
        self.times = self._utc(clock)

    def _is_other_head(self, row: list[str]) -> bool:
        """Return whether a row without a time names columns, but not those of the head."""
        text = " ".join(row).strip()
        named = any(TIME_NAME.search(row[place]) for place in self._places)
        above = any(line.startswith(text) for line in self.file.above)
        several = sum(map(bool, row)) > 1  # a remark fills one
        return named and several and not above and not re.search(r"\d:\d\d", text)

    def where(self, row: int) -> str:
        """Return a row's place in the file for messages."""
        return f"{self.file.path}, line {self._lines[row]}"

    def _utc(self, clock: DeviceClock) -> Array:
        """Return the time of each row, s since 1970 UTC. Raises DataError for impossible ones."""
        of, seconds = np.array(self._of, dtype=np.int64), np.array(self._seconds)
        rows = np.flatnonzero(of >= 0)
        seconds[rows] = clock.utc(
            self._moments, lambda k: self.where(rows[k]), of[rows], seconds[rows]
        )
        if fault := time_fault(seconds):
            raise DataError(f"{self.where(fault[0])}, column {self._time_names[0]!r}: {fault[1]}")
        return seconds

    def left_out(self) -> list[str]:
        """Return notes for the user on rows and readings that were left out."""
        notes = []
        if self._untimed:
            line, text = self._untimed[0]
            notes.append(
                f"log: {counted(len(self._untimed), 'row')} without a time: left out (line {line}: "
                f"{text[:30]!r})"
            )
        if self.file.is_cut:
            notes.append("log: the last row is cut off (no line end, fewer digits): left out")
        for name, words in self._words.items():
            if words:
                shown = ", ".join(repr(word) for word, _ in words.most_common(3))
                what = f"{counted(words.total(), 'value')} of {name!r} without a reading ({shown})"
                notes.append(f"log: {what}: left empty")
        return notes

    def _find_moment(self, line: int, text: str) -> tuple[int, float] | None:
        """Return a moment's row and the seconds after it; None for a row that has no readings."""
        found = _SECONDS.fullmatch(text)
        if found and (begin := self._minute(found[1], found[3])) >= 0:
            return begin, float(found[2])
        try:
            moment = parse_serial(text) if self.are_serials else parse_moment(text, self._order)
        except ValueError as cause:
            # a footer may be `60 records`
            if not text[:1].isdigit() or re.fullmatch(r"\d{1,5} \D*", text):
                return None
            raise DataError(
                f"{self.file.path}, line {line}, column {self._time_names[0]!r}: {text[:40]!r} is "
                f"not a date with a time ({cause})"
            ) from cause
        if self._has_times and isinstance(moment, date):
            moment = day_begin(moment)  # some programs leave out the time of midnight
        if not isinstance(moment, datetime):
            raise DataError(
                f"{self.file.path}, line {line}: {text[:40]!r} is only a date or a time; name "
                "both columns (--time-column twice)"
            )
        self._moments.append(moment)
        return len(self._moments) - 1, 0.0

    def _find_minute(self, before: str, after: str) -> int:
        """Return the row of a minute's first moment, given the text around the seconds; else -1.

        Parsing the time of each reading would take longer than all else.
        """
        try:
            whole, half = (parse_moment(f"{before}:{s}{after}", self._order) for s in ("00", "30"))
        except ValueError:
            return -1
        # in some forms the last digits are minutes, a fraction, or those of a zone
        if not (isinstance(whole, datetime) and isinstance(half, datetime)):
            return -1
        if (half - whole).total_seconds() != 30.0:
            return -1
        self._moments.append(whole)
        return len(self._moments) - 1

    def _value(self, line: int, name: str, text: str) -> float:
        """Return a reading in the unit of the file, NaN for none."""
        if not text:
            return np.nan
        if found := _TENTHS.fullmatch(text):
            text = f"{found[1]}.{found[2]}"
        plain = text.replace(",", ".") if self.file.decimal == "," else text
        if not plain[-1].isdigit() and (unit := UNIT_BEHIND.search(plain)):
            plain = plain[: unit.start()]
            self.units[name][stated_unit(f"({unit[0].strip()[-1:]})") or ""] += 1
        try:
            value = float(plain) if "_" not in plain else np.nan
        except ValueError:
            value = np.nan
        if math.isfinite(value) and value not in _NO_READING:
            return value
        if re.match(r"(?!-?1\.#)[^#]*\d", text) and value not in _NO_READING:
            raise DataError(
                f"{self.file.path}, line {line}, column {name!r}: {text[:40]!r} is not a number"
            )
        self._words[name][text[:20]] += 1
        return np.nan


def _as_seconds(text: str) -> float | None:
    """Return a number of s, ms, µs or ns since 1970 in s; None for other text."""
    try:
        seconds = whole_seconds(float(text))
    except ValueError:
        return None
    # of 12 and 14 digits is a date with a time
    return seconds if seconds < _LATEST_S and len(text.split(".")[0]) not in (12, 14) else None


def _apply_header_zone(clock: DeviceClock, header: str) -> tuple[DeviceClock, list[str]]:
    """Return the logger's clock with the zone in the head of its times, and notes."""
    stated = stated_zones(header)
    if not stated and (unclear := _UNCLEAR.search(header)) and not clock.forced:
        where = f"doubtful: {unclear[0]!r} in the head of the times may be one of several zones"
        return clock, [f"{where}: {clock.zone} is used, if --log-timezone does not give it"]
    if not stated:
        return clock, []
    note = f"log: the header gives the time zone {'/'.join(stated)}"
    if clock.forced:
        return clock, [f"{note}; the one given for the logger is used instead"]
    offsets = {zone.utcoffset(None) for zone in stated.values()}
    if len(offsets) == 1:
        # takes precedence over --timezone, which is for times without a zone
        return replace(clock, zone=next(iter(stated.values()))), [note]
    seasons = [datetime(2026, month, 1, tzinfo=clock.zone) for month in (1, 7)]
    if clock.zone is not None and {moment.utcoffset() for moment in seasons} != offsets:
        raise DataError(
            f"{'/'.join(stated)} in the head of the log's times is not the time zone {clock.zone}: "
            "give --log-timezone, such as --log-timezone America/New_York"
        )
    return clock, [note]


def _to_celsius_column(table: _Table, name: str, options: LogOptions) -> tuple[Array, list[str]]:
    """Return a column (n,) in °C, and notes on its unit and readings."""
    path = table.file.path
    values = np.array(table.values[name])
    known = values[np.isfinite(values)]
    unit, source = (options.unit, "") if options.unit else _find_unit(table, name)
    notes = []
    if unit is None:
        if len(known) and known.min() > _KELVIN[0] and known.max() < _KELVIN[1]:
            raise DataError(
                f"{path}, column {name!r}: {known[0]:g} looks like kelvin: give --unit K to convert"
            )
        if len(known) and known.min() > TOO_HOT_C:
            notes.append(
                f"doubtful: {name!r} names no unit: {known[0]:g} is taken as °C; if it is °F, it "
                f"is {(known[0] - 32) / 1.8:.1f} °C: give --unit degF, or degC"
            )
        unit = "degC"
    elif unit != "degC" and options.unit is None:
        notes.append(f"log: {name!r} is converted from {unit}, the unit in {source}")
    celsius, doubts = _drop_unmeasured(table, name, to_celsius(values, unit), options)
    wrong = (celsius < _PLAUSIBLE_C[0]) | (celsius > _PLAUSIBLE_C[1])
    if wrong.any():
        i = int(np.argmax(wrong))
        raise DataError(
            f"{table.where(i)}, column {name!r}: {values[i]:g} {unit} is {celsius[i]:.4g} °C; "
            f"temperatures of cameras lie between {_PLAUSIBLE_C[0]:g} and {_PLAUSIBLE_C[1]:g} °C. "
            "Another unit (--unit), or another column (--temperature-column)? Leave a field "
            "empty that is no reading"
        )
    return celsius, [*notes, *doubts]


def _drop_unmeasured(
    table: _Table, name: str, celsius: Array, options: LogOptions
) -> tuple[Array, list[str]]:
    """Return readings (n,) °C, NaN for values given without a measurement, and notes.

    Raises DataError if the unit changes midway and was not given.
    """
    if changed := find_unit_change(table.times, celsius):
        row, words = changed
        last = celsius[:row][np.isfinite(celsius[:row])][-1]
        where = f"{table.where(row)}, column {name!r}: the unit seems to change {words} here"
        if options.unit is None:
            raise DataError(
                f"{where} ({celsius[row]:.4g} after {last:.4g} °C): import the parts "
                "separately, or give --unit if the unit is the same"
            )
        return celsius, [f"doubtful: {where}"]
    spikes = find_spikes(celsius)
    measured = celsius.copy()
    notes = [f"doubtful: {text}" for text in stuck_doubts(celsius, repr(name))]
    for treated, sort in (("left empty", False), ("kept", True)):
        found = [s for s in spikes if s.measured is sort]
        if not found:
            continue
        first = found[0].first
        why = "leaping away and back" if sort else "given without a measurement"
        notes.append(
            f"doubtful: {counted(sum(s.stop - s.first for s in found), 'reading')} of {name!r} "
            f"{why} (the first {celsius[first]:.4g} °C, {table.where(first)}): {treated}"
        )
    for spike in spikes:
        if not spike.measured:
            measured[spike.first : spike.stop] = np.nan
    return measured, notes


def _find_unit(table: _Table, name: str) -> tuple[str | None, str]:
    """Return the unit of a column and where the file states it. Raises DataError if it has two."""
    file = table.file
    found: dict[str, str] = {}
    if unit := stated_unit(name):
        found[unit] = "its head"
    readings = int(np.isfinite(table.values[name]).sum())
    for unit, count in table.units[name].items():
        if unit not in ("", "degC", *found) and count < readings:
            raise DataError(
                f"{file.path}, column {name!r}: only {count} of {counted(readings, 'reading')} "
                f"are in {unit}; give --unit, or correct them"
            )
        if unit:
            found.setdefault(unit, "each reading")
    for column in file.names:
        if _UNIT_NAME.search(column):
            for text in set(file.column(column)):
                if unit := stated_unit(f"({text})") or stated_unit(text):
                    found.setdefault(unit, f"the column {column!r}")
    if not found and any(map(_ABOVE.search, file.above)):
        return "degF", "a line above the table"
    if len(found) > 1:
        raise DataError(
            f"{file.path}, column {name!r}: is in {' and '.join(found)} at once; give --unit"
        )
    return next(iter(found.items()), (None, ""))
