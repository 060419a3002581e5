"""A series as people want it: units, times, separators, all thermometers; CSV or Parquet.

The columns of CONVENTIONS §4 with other units have them in their names (`c_px`, `X0_um`,
`omega_deg`), so that nobody reads one for the other. The temperatures of all thermometers follow.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.series.epochs import csv_text
from thermocald.errors import UsageError
from thermocald.result import jsonable

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from thermocald.analysis.series.epochs import Columns, Epochs


UNITS = ("px", "um", "deg")
_IN_IMAGE, _ANGLES = ("c", "x0", "y0"), ("omega", "phi", "kappa")
_PLACE = ("X0", "Y0", "Z0")


@dataclass(frozen=True, slots=True)
class ExportStyle:
    """units: of UNITS, others stay mm and rad; time: `seconds` or `iso`; separator and decimal."""

    units: frozenset[str] = frozenset()
    time: str = "seconds"
    separator: str = ","
    decimal: str = "."

    @property
    def is_plain(self) -> bool:
        """Whether it is the form that other programs of ours read."""
        return self == ExportStyle()


def style_of(units: str, time: str, separator: str, decimal: str) -> ExportStyle:
    """The style that options describe; UsageError for what there is not."""
    wanted = [u.strip() for u in units.split(",") if u.strip()]
    for unit in wanted:
        if unit not in UNITS:
            raise UsageError(f"--units {unit}: there are {', '.join(UNITS)}, separated by commas")
    if time not in ("seconds", "iso"):
        raise UsageError(f"--time {time}: must be seconds or iso")
    mark = {"tab": "\t", "\\t": "\t"}.get(separator, separator)
    if mark not in (",", ";", "\t", "|"):
        raise UsageError(f"--separator {separator}: must be one of , ; | tab")
    if decimal not in (".", ","):
        raise UsageError(f"--decimal {decimal}: must be . or ,")
    if decimal == mark:
        raise UsageError("--decimal , needs another --separator, such as ';'")
    return ExportStyle(frozenset(wanted), time, mark, decimal)


def column_parts(
    table: Epochs, style: ExportStyle, pixel_pitch: float, others: Columns | None = None
) -> Iterator[Columns]:
    """Yield the columns of `columns_of`, some thousand rows at a time: a year has to fit."""
    done = 0
    for part in table.parts():
        rows = slice(done, done + len(part.number))
        here = {name: values[rows] for name, values in (others or {}).items()}
        yield columns_of(part, style, pixel_pitch, here)
        done = rows.stop


def columns_of(table: Epochs, style: ExportStyle, pixel_pitch: float, others: Columns) -> Columns:
    """Return the columns of a series in some style, then the others, as they are.

    pixel_pitch: mm.
    """
    columns: Columns = {}
    for name, values in table.columns().items():
        suffix, factor = _unit(name.removeprefix("sd_"), style, pixel_pitch)
        columns[name + suffix] = values if not suffix else np.asarray(values) * factor
    if style.time == "iso":
        columns["frame_time"] = tuple(_iso(t) for t in table.frame_time.tolist())
    for name, column in others.items():
        columns[name if name not in columns else f"extra {name}"] = column
    return columns


def _unit(name: str, style: ExportStyle, pixel_pitch: float) -> tuple[str, float]:
    """The ending of a parameter's name, and the factor from mm or rad."""
    if name in _IN_IMAGE and "px" in style.units:
        return "_px", 1.0 / pixel_pitch
    if name in (*_IN_IMAGE, *_PLACE) and "um" in style.units:
        return "_um", 1000.0
    if name in _ANGLES and "deg" in style.units:
        return "_deg", 180.0 / np.pi
    return "", 1.0


def _iso(seconds: float) -> str:
    moment = datetime.fromtimestamp(seconds, UTC)
    return moment.isoformat(timespec="microseconds").replace("+00:00", "Z")


def as_csv(parts: Iterable[Columns], style: ExportStyle) -> Iterator[str]:
    """Yield the columns as text; numbers keep every digit, what is not known stays empty."""
    return csv_text(parts, style.separator, style.decimal)


def as_json(parts: Iterable[Columns]) -> Iterator[str]:
    """Yield the columns as one JSON list with a row per epoch; what is not known is null."""
    start = "[\n"
    for columns in parts:
        lists = [c.tolist() if isinstance(c, np.ndarray) else c for c in columns.values()]
        for row in zip(*lists, strict=True):
            said = json.dumps(jsonable(dict(zip(columns, row, strict=True))), indent=1)
            yield start + " " + said.replace("\n", "\n ")
            start = ",\n"
    yield "\n]\n" if start != "[\n" else "[]\n"
