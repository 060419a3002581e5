"""Courses in time: what a lamp, a processor or the air does, as straight pieces that may jump.

In a file a course is a number (always the same), a list of pieces without gaps,

    - {from: 0, to: 60, value: 0.0}
    - {from: 60, to: 900, begin: 0.0, end: 5.0}        # a ramp

or a log that is played in:

    {log: weather.csv, time: seconds, value: temperature, largest_gap: 900}
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from thermocald.errors import ConfigurationError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import ArrayLike

    from thermocald.arrays import Array
    from thermocald.simulation.quantities import QuantityReader

__all__ = ["Course", "read_course"]


@dataclass(frozen=True, eq=False)
class Course:
    """Straight pieces that follow each other without gaps.

    times (p+1,): s ascending, where pieces meet; begin, end (p,): values at the ends of each.
    Before the first and after the last piece the value is held.
    """

    times: Array
    begin: Array
    end: Array

    @classmethod
    def constant(cls, value: float) -> Self:
        """Always the same."""
        return cls(np.array([0.0, 0.0]), np.array([value]), np.array([value]))

    @classmethod
    def polygon(cls, times: ArrayLike, values: ArrayLike) -> Self:
        """Straight lines between points; of two points at one time it jumps."""
        t, v = np.asarray(times, dtype=float), np.asarray(values, dtype=float)
        if len(t) == 1:
            return cls.constant(float(v[0]))
        keep = np.append(np.diff(t) > 0, True)[:-1]
        return cls(np.append(t[:-1][keep], t[-1]), v[:-1][keep], v[1:][keep])

    @classmethod
    def steps(cls, times: ArrayLike, values: ArrayLike) -> Self:
        """Value i from times[i] to times[i+1]; one time more than values."""
        v = np.asarray(values, dtype=float)
        return cls(np.asarray(times, dtype=float), v, v.copy())

    @property
    def span(self) -> tuple[float, float]:
        """Where it begins and ends, s."""
        return float(self.times[0]), float(self.times[-1])

    def after(self, t: ArrayLike) -> Array:
        """The value right after each time (a jump there has happened)."""
        return self._at(np.asarray(t, dtype=float), "right")

    def before(self, t: ArrayLike) -> Array:
        """The value right before each time (a jump there has not happened)."""
        return self._at(np.asarray(t, dtype=float), "left")

    def _at(self, t: Array, side: Any) -> Array:
        piece = np.clip(np.searchsorted(self.times, t, side=side) - 1, 0, len(self.begin) - 1)
        length = self.times[piece + 1] - self.times[piece]
        share = np.clip((t - self.times[piece]) / np.where(length > 0, length, 1.0), 0.0, 1.0)
        result: Array = self.begin[piece] + share * (self.end[piece] - self.begin[piece])
        return result


def read_course(
    reader: QuantityReader, key: str, unit: str, duration: float, folder: Path
) -> Course:
    """The course at a key of a programme file; it must cover 0 to `duration` s without a gap."""
    raw = reader.mapping.get(key)
    if isinstance(raw, list):
        course = _pieces(reader, key, unit)
    elif isinstance(raw, dict) and "log" in raw:
        course = _log(reader.inner(key), unit, folder)
    else:
        return Course.constant(reader.number(key, unit))
    begin, end = course.span
    if begin > 0 or end < duration:
        raise reader.fail(
            key, f"covers {begin:g} to {end:g} s; the programme lasts from 0 to {duration:g} s"
        )
    return course


def _pieces(reader: QuantityReader, key: str, unit: str) -> Course:
    times: list[float] = []
    begin: list[float] = []
    end: list[float] = []
    for piece in reader.items(key):
        piece.only(("from", "to", "value", "begin", "end"))
        start, stop = piece.number("from", "s"), piece.number("to", "s")
        if stop <= start:
            raise piece.fail("to", f"is {stop:g} s, not after {start:g} s")
        if times and start != times[-1]:
            what = "a gap" if start > times[-1] else "an overlap"
            raise piece.fail(
                "from", f"is {start:g} s, but the piece before ends at {times[-1]:g} s: {what}"
            )
        if not times:
            times.append(start)
        times.append(stop)
        if "value" in piece.mapping:
            value = piece.number("value", unit)
            begin.append(value)
            end.append(value)
        else:
            begin.append(piece.number("begin", unit))
            end.append(piece.number("end", unit))
    if not times:
        raise reader.fail(key, "is an empty list")
    return Course(np.array(times), np.array(begin), np.array(end))


def _log(reader: QuantityReader, unit: str, folder: Path) -> Course:
    """A CSV file with a header, one time a row; time 0 is its first row."""
    import csv

    reader.only(("log", "time", "value", "largest_gap"))
    path = folder / reader.text("log")
    columns = reader.text("time", "time"), reader.text("value", "temperature")
    largest = reader.number("largest_gap", "s", 900.0, above=0.0)
    rows: list[tuple[float, float]] = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            table = csv.DictReader(file)
            for name in columns:
                if name not in (table.fieldnames or ()):
                    raise ConfigurationError(f"{path}: there is no column {name!r}")
            for line in table:
                try:
                    rows.append((float(line[columns[0]]), float(line[columns[1]])))
                except (TypeError, ValueError) as cause:
                    raise ConfigurationError(
                        f"{path}, line {table.line_num}: {columns[0]} or {columns[1]} is not "
                        "a number"
                    ) from cause
    except (OSError, UnicodeDecodeError) as cause:
        raise ConfigurationError(f"{path}: cannot be read: {cause}") from cause
    if len(rows) < 2:
        raise ConfigurationError(f"{path}: a log needs two rows at least")
    times, values = np.array(rows).T
    if not np.isfinite(times).all() or not np.isfinite(values).all():
        raise ConfigurationError(f"{path}: holds a value that is not finite (a gap in {unit})")
    steps = np.diff(times)
    if steps.min() <= 0:
        raise ConfigurationError(f"{path}, line {int(steps.argmin()) + 3}: time runs backwards")
    if steps.max() > largest:
        raise ConfigurationError(
            f"{path}, line {int(steps.argmax()) + 3}: a gap of {steps.max():g} s; the largest that "
            f"is bridged is {largest:g} s (largest_gap)"
        )
    return Course.polygon(times - times[0], values)
