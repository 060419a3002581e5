"""Tables of what was measured at known times, of a file or as it comes in on standard input."""

from __future__ import annotations

import csv
import sys
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from thermocald.errors import DataError
from thermocald.store.logger.clock import DeviceClock, parse_moment

if TYPE_CHECKING:
    import io
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from thermocald.arrays import Array

STANDARD_INPUT = Path("-")
_CHUNK = 1 << 22  # bytes at once: a year of rows has to fit into memory


@dataclass(frozen=True, slots=True, eq=False)
class RowBlock:
    """Some rows: header; lines (n,) in the file, the header's is 1; rows as text; times (n,) s UTC;
    values (n, k) of the further columns that were asked for; refused: (line, reason) of others.
    """

    header: list[str]
    lines: list[int]
    rows: list[dict[str, str]]
    times: Array
    values: Array
    refused: list[tuple[int, str]]

    def kept(self, wanted: NDArray[np.bool_], reason: str) -> RowBlock:
        """The rows that are wanted (n,), the others refused for a reason."""
        where = np.flatnonzero(wanted).tolist()
        refused = [(line, reason) for line, ok in zip(self.lines, wanted, strict=True) if not ok]
        return RowBlock(
            self.header, [self.lines[i] for i in where], [self.rows[i] for i in where],
            self.times[wanted], self.values[wanted], sorted([*self.refused, *refused]),
        )  # fmt: skip


def row_blocks(
    path: Path, columns: tuple[str, ...], clock: DeviceClock | None = None
) -> Iterator[RowBlock]:
    """Read a CSV with a column `time` and others, a block at a time; `-` is standard input.

    Of standard input a block is what has come in. clock: of times without a zone. Raises DataError
    for a column that is missing and for times whose zone nobody says; rows that cannot be read are
    refused by themselves.
    """
    header: list[str] = []
    line = empty = 0
    for lines in _lines(path):
        if not header:
            header = [name.strip() for name in next(csv.reader(lines[:1]), [])]
            lines, line = lines[1:], 1
            for name in ("time", *columns):
                if name not in header:
                    raise DataError(
                        f"{path}: there is no column {name!r}; there are {', '.join(header)}"
                    )
        if lines:
            yield _block(path, header, columns, lines, line, clock or DeviceClock())
        line, empty = line + len(lines), empty + len(lines)
    if not empty:
        raise DataError(f"{path}: holds no rows")


def first_times(
    path: Path, clock: DeviceClock | None = None
) -> tuple[list[str], tuple[float, float] | None]:
    """Return the columns of a CSV and the span s UTC of its first rows.

    Of standard input, which is read once, nothing is known beforehand.
    """
    if path == STANDARD_INPUT:
        return [], None
    block = next(row_blocks(path, (), clock))
    times = block.times
    return block.header, (float(times.min()), float(times.max())) if len(times) else None


def seconds_of(text: str, clock: DeviceClock) -> float:
    """Return a time that a user wrote, s UTC; DataError where it is none."""
    try:
        moment = _moment(text)
    except ValueError:
        raise DataError(f"{text!r} is not a time: write 2026-05-04T09:00:00Z, or seconds") from None
    if isinstance(moment, datetime):
        return float(clock.utc([moment], lambda _: f"the time {text!r}")[0])
    return moment


def _lines(path: Path) -> Iterator[list[str]]:
    """Lists of whole lines: what has come in, of a file some megabytes."""
    standard = path == STANDARD_INPUT
    rest = b""
    try:
        with nullcontext(sys.stdin.buffer) if standard else path.open("rb") as file:
            stream = cast("io.BufferedReader", file)
            while chunk := stream.read1(_CHUNK):
                whole, mark, rest = (rest + chunk).rpartition(b"\n")
                if mark:
                    yield _text(whole, standard).splitlines()
            if rest:
                yield [_text(rest, standard)]
    except (OSError, UnicodeDecodeError) as cause:
        what = cause.strerror if isinstance(cause, OSError) else "is not UTF-8 text"
        raise DataError(f"{path}: cannot be read: {what}") from cause


def _text(data: bytes, standard: bool) -> str:
    return data.decode("utf-8-sig", errors="replace" if standard else "strict")


def _block(
    path: Path, header: list[str], columns: tuple[str, ...], lines: list[str], line: int,
    clock: DeviceClock,
) -> RowBlock:  # fmt: skip
    kept: list[tuple[int, dict[str, str], float | datetime, list[float]]] = []
    refused: list[tuple[int, str]] = []
    reader = csv.reader(lines)
    for row in reader:
        number = line + reader.line_num
        if not row:
            continue
        if len(row) != len(header):
            refused.append((number, f"has {len(row)} fields, the header {len(header)}"))
            continue
        fields = dict(zip(header, map(str.strip, row), strict=True))
        try:
            values = [_number(name, fields[name]) for name in columns]
            kept.append((number, fields, _moment(fields["time"]), values))
        except ValueError as cause:
            refused.append((number, str(cause)))
    dated = [(i, m) for i, (_, _, m, _) in enumerate(kept) if isinstance(m, datetime)]
    times = np.array([np.nan if isinstance(m, datetime) else m for _, _, m, _ in kept])
    times[[i for i, _ in dated]] = clock.utc(
        [m for _, m in dated], lambda k: f"{path}, line {kept[dated[k][0]][0]}, column time"
    )
    found = np.array([values for *_, values in kept], dtype=float)
    return RowBlock(
        header, [n for n, *_ in kept], [fields for _, fields, _, _ in kept], times,
        found.reshape(len(kept), len(columns)), refused,
    )  # fmt: skip


def _moment(text: str) -> float | datetime:
    try:
        seconds = float(text)
    except ValueError:
        try:
            moment = parse_moment(text)
        except ValueError:
            moment = None
        if isinstance(moment, datetime):
            return moment
        seconds = np.nan
    if not np.isfinite(seconds):
        raise ValueError(f"column time: {text!r} is not a time")
    return seconds


def _number(column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ValueError(f"column {column}: {text!r} is not a number")
    if column in ("sx", "sy") and value <= 0:
        raise ValueError(f"column {column}: a standard deviation must be above 0")
    return value
