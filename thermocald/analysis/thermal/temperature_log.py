"""A log of temperatures, and tables of times: any logger's CSV, epochs.csv, or a store."""

from __future__ import annotations

import csv
from array import array
from dataclasses import dataclass
from datetime import datetime
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import DataError
from thermocald.store.logger.clock import DeviceClock
from thermocald.store.logger.moments import parse_moment
from thermocald.store.logger.temperatures import LogOptions, read_log

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from thermocald.arrays import Array

__all__ = ["TemperatureLog", "read_rows", "read_temperature_log", "row_blocks"]

_TIME_NAMES = ("time", "temperature_time", "frame_time", "timestamp")
_OTHER_UNITS = ("fahrenheit", "degf", "°f", "_f", "kelvin", "degk", "_k")
_NOT_TEMPERATURES = ("epoch", "frame")
_KELVIN_FROM = 220.0  # °C that no camera survives, and K of a winter
_LONGEST_HEADER = 100_000


@dataclass(frozen=True, slots=True, eq=False)
class TemperatureLog:
    """times (R,) s UTC, ascending; channels {name: (R,) °C}, NaN where empty, the first is T."""

    times: Array
    channels: dict[str, Array]


class _Times:
    """A column of times while it is read: numbers, or dates with times; of a year of rows too."""

    def __init__(self, path: Path, column: str) -> None:
        self._path, self._column = path, column
        self._seconds, self._lines = array("d"), array("q")
        self._dated: dict[int, datetime] = {}

    def __len__(self) -> int:
        return len(self._seconds)

    def where(self, row: int) -> str:
        """A row's place in the file, as errors name it."""
        return f"{self._path}, line {self._lines[row]}, column {self._column}"

    def add(self, line: int, text: str) -> None:
        """One more. Raises DataError for what is no time."""
        self._lines.append(line)
        self._seconds.append(np.nan)
        try:
            seconds = float(text)
        except ValueError:
            try:
                moment = parse_moment(text)
            except ValueError:
                moment = None
            if not isinstance(moment, datetime):
                raise DataError(f"{self.where(-1)}: {text!r} is not a time") from None
            self._dated[len(self) - 1] = moment
            return
        if not np.isfinite(seconds):
            raise DataError(f"{self.where(-1)}: {text!r} is not a time")
        self._seconds[-1] = seconds

    def utc(self, clock: DeviceClock) -> Array:
        """Seconds since 1970 UTC (n,). Raises DataError for a time whose zone nobody says."""
        seconds = np.array(self._seconds)
        places = list(self._dated)
        seconds[places] = clock.utc(list(self._dated.values()), lambda k: self.where(places[k]))
        return seconds


def read_temperature_log(
    path: Path, reference: str | None = None, clock: DeviceClock | None = None
) -> TemperatureLog:
    """Read a CSV of times and temperatures °C; an `epochs.csv` of a recording is one.

    A log without a column of our names for times is read as any logger's (`store.logger`).
    reference: the column that is T, by default the first; clock: of times without a zone, which are
    refused without. DataError names file, line and column; other units than °C are refused.
    """
    clock = clock or DeviceClock()
    if not _is_ours(path):
        wanted = (reference,) if reference else ()
        found = read_log(path, LogOptions(temperatures=wanted, clock=clock))
        return TemperatureLog(found.times, found.channels)
    header, rows = _table(path)
    time_column = next(n for n in _TIME_NAMES if n in header)
    names = [n for n in header if n not in (*_TIME_NAMES, *_NOT_TEMPERATURES)]
    for name in names:
        if name.lower().endswith(_OTHER_UNITS) or "fahrenheit" in name.lower():
            raise DataError(f"{path}, column {name}: temperatures must be °C; convert them")
    if reference is not None and reference not in names:
        raise DataError(f"{path}: there is no column {reference!r}; there are: {', '.join(names)}")
    if not names:
        raise DataError(f"{path}: there is no temperature column")
    ordered = [reference, *(n for n in names if n != reference)] if reference else names
    known = _Times(path, time_column)
    values = [array("d") for _ in ordered]
    for line, row in rows:
        if not row[time_column]:
            continue
        known.add(line, row[time_column])
        for column, name in zip(values, ordered, strict=True):
            column.append(_number(path, line, name, row[name]) if row[name] else np.nan)
    if not len(known):
        raise DataError(f"{path}: holds no rows")
    times = known.utc(clock)
    back = np.nonzero(np.diff(times) < 0)[0]
    if len(back):
        raise DataError(f"{known.where(int(back[0]) + 1)}: time runs backwards")
    columns = np.array(values).T
    for i, name in enumerate(ordered):
        if np.nanmin(columns[:, i], initial=np.inf) > _KELVIN_FROM:
            raise DataError(
                f"{path}, column {name}: reads as kelvin ({columns[0, i]:g}); temperatures must be "
                "°C: subtract 273.15"
            )
    return TemperatureLog(times, {n: columns[:, i] for i, n in enumerate(ordered)})


def _is_ours(path: Path) -> bool:
    """Whether a log is a CSV with one of our names for its times."""
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            header = file.readline(_LONGEST_HEADER)
    except OSError as cause:
        raise DataError(f"{path}: cannot be read: {cause.strerror}") from cause
    return any(name.strip() in _TIME_NAMES for name in header.split(","))


def _table(path: Path) -> tuple[list[str], Iterator[tuple[int, dict[str, str]]]]:
    """The header, and the rows with their lines, which are read one by one."""

    def unreadable(cause: OSError | UnicodeDecodeError) -> DataError:
        what = cause.strerror if isinstance(cause, OSError) else "is not UTF-8 text"
        return DataError(f"{path}: cannot be read: {what}")

    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            header = [n.strip() for n in next(csv.reader(file), [])]
    except (OSError, UnicodeDecodeError) as cause:
        raise unreadable(cause) from cause

    def rows() -> Iterator[tuple[int, dict[str, str]]]:
        try:
            with path.open(encoding="utf-8-sig", newline="") as file:
                reader = csv.reader(file)
                next(reader, None)
                for row in reader:
                    if not row:
                        continue
                    if len(row) != len(header):
                        raise DataError(
                            f"{path}, line {reader.line_num}: has not {len(header)} columns"
                        )
                    yield reader.line_num, dict(zip(header, map(str.strip, row), strict=True))
        except (OSError, UnicodeDecodeError) as cause:
            raise unreadable(cause) from cause

    return header, rows()


Rows = tuple[list[str], list[dict[str, str]], "Array"]


def read_rows(path: Path, needed: tuple[str, ...], clock: DeviceClock | None = None) -> Rows:
    """A CSV with a time column and others: header, rows, numbers (n, len(needed)), time first.

    clock: of times without a zone, which are refused without.
    """
    parts = list(row_blocks(path, needed, clock))
    kept = [row for _, rows, _ in parts for row in rows]
    return parts[0][0], kept, np.concatenate([numbers for _, _, numbers in parts])


def row_blocks(
    path: Path, needed: tuple[str, ...], clock: DeviceClock | None = None, size: int = 100_000
) -> Iterator[Rows]:
    """What `read_rows` reads, at most `size` rows at a time."""
    header, rows = _table(path)
    missing = [n for n in needed if n not in header]
    if missing:
        raise DataError(f"{path}: there is no column {missing[0]!r}; there are {', '.join(header)}")
    others = [n for n in needed if n != "time"]
    first = True
    while part := list(islice(rows, size)):
        times = _Times(path, "time")
        for line, row in part:
            times.add(line, row["time"])
        numbers = np.array([[_number(path, line, n, row[n]) for n in others] for line, row in part])
        seconds = times.utc(clock or DeviceClock())
        yield (
            header,
            [row for _, row in part],
            np.column_stack([seconds, numbers.reshape(len(part), -1)]),
        )
        first = False
    if first:
        raise DataError(f"{path}: holds no rows")


def _number(path: Path, line: int, column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise DataError(f"{path}, line {line}, column {column}: {text!r} is not a number")
    return value
