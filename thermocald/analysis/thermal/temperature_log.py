"""A log of temperatures, and tables of times: any logger's CSV, epochs.csv, or a store."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from datetime import datetime
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

__all__ = ["TemperatureLog", "read_rows", "read_temperature_log", "read_times"]

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


def read_times(path: Path, texts: list[tuple[int, str]], column: str, clock: DeviceClock) -> Array:
    """Seconds since 1970 UTC (n,) from (line, text) of a column: numbers, or dates with times.

    Raises DataError for what is neither, and for a time whose zone nobody says.
    """
    seconds = np.full(len(texts), np.nan)
    dated: dict[int, datetime] = {}
    for i, (line, text) in enumerate(texts):
        try:
            seconds[i] = float(text)
        except ValueError:
            try:
                moment = parse_moment(text)
            except ValueError:
                moment = None
            if not isinstance(moment, datetime):
                raise DataError(
                    f"{path}, line {line}, column {column}: {text!r} is not a time"
                ) from None
            dated[i] = moment
        if i not in dated and not np.isfinite(seconds[i]):
            raise DataError(f"{path}, line {line}, column {column}: {text!r} is not a time")
    places = list(dated)
    seconds[places] = clock.utc(
        list(dated.values()), lambda k: f"{path}, line {texts[places[k]][0]}, column {column}"
    )
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
    texts: list[tuple[int, str]] = []
    values: list[list[float]] = []
    for line, row in rows:
        if not row[time_column]:
            continue
        texts.append((line, row[time_column]))
        values.append([_number(path, line, n, row[n]) if row[n] else np.nan for n in ordered])
    if not texts:
        raise DataError(f"{path}: holds no rows")
    times = read_times(path, texts, time_column, clock)
    back = np.nonzero(np.diff(times) < 0)[0]
    if len(back):
        line = texts[int(back[0]) + 1][0]
        raise DataError(f"{path}, line {line}, column {time_column}: time runs backwards")
    columns = np.array(values)
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
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as cause:
        what = cause.strerror if isinstance(cause, OSError) else "is not UTF-8 text"
        raise DataError(f"{path}: cannot be read: {what}") from cause
    reader = csv.DictReader(text.splitlines())
    header = [n.strip() for n in reader.fieldnames or ()]
    reader.fieldnames = header

    def rows() -> Iterator[tuple[int, dict[str, str]]]:
        for row in reader:
            if None in row or any(v is None for v in row.values()):
                raise DataError(f"{path}, line {reader.line_num}: has not {len(header)} columns")
            yield reader.line_num, {k: (v or "").strip() for k, v in row.items()}

    return header, rows()


def read_rows(
    path: Path, needed: tuple[str, ...], clock: DeviceClock | None = None
) -> tuple[list[str], list[dict[str, str]], Array]:
    """A CSV with a time column and others: header, rows, numbers (n, len(needed)), time first.

    clock: of times without a zone, which are refused without.
    """
    header, rows = _table(path)
    missing = [n for n in needed if n not in header]
    if missing:
        raise DataError(f"{path}: there is no column {missing[0]!r}; there are {', '.join(header)}")
    kept, numbers, texts = [], [], []
    for line, row in rows:
        kept.append(row)
        texts.append((line, row["time"]))
        numbers.append([_number(path, line, n, row[n]) for n in needed if n != "time"])
    if not kept:
        raise DataError(f"{path}: holds no rows")
    times = read_times(path, texts, "time", clock or DeviceClock())
    return header, kept, np.column_stack([times, np.array(numbers).reshape(len(kept), -1)])


def _number(path: Path, line: int, column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise DataError(f"{path}, line {line}, column {column}: {text!r} is not a number")
    return value
