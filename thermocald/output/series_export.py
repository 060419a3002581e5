"""A series as people want it: units, times, separators, all thermometers; CSV or Parquet.

The columns of CONVENTIONS §4 with other units have them in their names (`c_px`, `X0_um`,
`omega_deg`), so that nobody reads one for the other. The temperatures of all thermometers follow.
"""

from __future__ import annotations

import importlib.util
import json
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.series.epochs import csv_text
from thermocald.errors import DriverMissing, UsageError
from thermocald.files import make_folder, new_file
from thermocald.result import jsonable
from thermocald.store.recording.reader import open_recording
from thermocald.store.sources import open_source

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.analysis.series.epochs import Columns, Epochs
    from thermocald.arrays import Array
    from thermocald.store.series import StoredEpoch


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


@dataclass(frozen=True, slots=True)
class Besides:
    """What a source knows of its epochs besides the adjustment.

    pixel_pitch mm; thermometers {channel: (E,) °C at the frames}; extra {name: (E,) numbers, or E
    texts}: what the camera reported, light, blur, the filter's state, unknown columns of a file.
    """

    pixel_pitch: float | None = None
    thermometers: dict[str, Array] = field(default_factory=dict)
    extra: Columns = field(default_factory=dict)


def besides(
    source: Path, series: str | None, numbers: NDArray[np.int64], *, extra: bool = False
) -> Besides:
    """What is known besides of epochs `numbers` (E,).

    source: a recording (folder) or a store; series: `CAMERA/SERIES` or `SERIES` of a store; extra:
    False leaves the extra columns unread.
    """
    texts: dict[str, tuple[str, ...]] = {}
    values: dict[str, Array] = {}
    if source.is_dir():
        recording = open_recording(source)
        known = recording.columns.numbers
        readings = {name: recording.columns.at_frame(name) for name in recording.channels}
        pitch = recording.camera.sensor.pixel_pitch
        texts = dict(recording.columns.extra) if extra else {}
    else:
        with open_source(source) as store:
            camera, _, name = (series or "").rpartition("/")
            stored = store.find_series(camera or None, name or None)
            known = store.series_columns(stored, ["epoch"])["epoch"].astype(np.int64)
            readings = store.temperatures_at_frame(stored)
            pitch = stored.head.camera.sensor.pixel_pitch
            if extra:
                values = _extra_of(store.epochs(stored, details=False), known)
    rows = np.searchsorted(known, numbers)
    there = np.append(known, -1)[rows] == numbers
    rows = np.where(there, rows, -1)

    def placed(columns: dict[str, Array]) -> dict[str, Array]:
        return {name: np.append(column, np.nan)[rows] for name, column in columns.items()}

    others: Columns = {**placed(values)}
    for name, column in texts.items():
        others[name] = tuple("" if i < 0 else column[i] for i in rows)
    return Besides(pitch, placed(readings), others)


def column_parts(
    table: Epochs, style: ExportStyle, others: Besides | None = None
) -> Iterator[Columns]:
    """The columns of `columns_of`, some thousand rows at a time: a year has to fit into memory."""
    others, done = others or Besides(), 0
    for part in table.parts():
        rows = slice(done, done + len(part.number))
        extra: Columns = {name: values[rows] for name, values in others.extra.items()}
        readings = {name: values[rows] for name, values in others.thermometers.items()}
        yield columns_of(part, style, Besides(others.pixel_pitch, readings, extra))
        done = rows.stop


def _extra_of(epochs: Iterable[StoredEpoch], known: NDArray[np.int64]) -> dict[str, Array]:
    """The extra columns of stored epochs by name, in the order of `known` (E,)."""
    place = {int(n): i for i, n in enumerate(known)}
    found: dict[str, Array] = {}
    for stored in epochs:
        row = place.get(stored.epoch.number)
        if row is None:
            continue
        for name, value in stored.extra.items():
            found.setdefault(name, np.full(len(known), np.nan))[row] = value
    return {name: found[name] for name in sorted(found)}


def columns_of(
    table: Epochs,
    style: ExportStyle,
    others: Besides | None = None,
) -> Columns:
    """The columns of a series in some style, then thermometers and extra columns, as they are.

    UsageError where px are wanted and the pixel's size is not known.
    """
    others = others or Besides()
    pixel_pitch = others.pixel_pitch
    if "px" in style.units and pixel_pitch is None:
        raise UsageError("--units px: the size of the pixels is not known here")
    columns: Columns = {}
    for name, values in table.columns().items():
        suffix, factor = _unit(name.removeprefix("sd_"), style, pixel_pitch)
        columns[name + suffix] = values if not suffix else np.asarray(values) * factor
    if style.time == "iso":
        columns["frame_time"] = tuple(_iso(t) for t in table.frame_time.tolist())
    for name, readings in others.thermometers.items():
        columns[f"temperature {name}"] = readings
    for name, column in others.extra.items():
        columns[name if name not in columns else f"extra {name}"] = column
    return columns


def _unit(name: str, style: ExportStyle, pixel_pitch: float | None) -> tuple[str, float]:
    """The ending of a parameter's name, and the factor from mm or rad."""
    if name in _IN_IMAGE and "px" in style.units and pixel_pitch is not None:
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
    """The columns as text; numbers keep every digit, what is not known stays empty."""
    return csv_text(parts, style.separator, style.decimal)


def as_json(parts: Iterable[Columns]) -> Iterator[str]:
    """The columns as one JSON list with a row per epoch; what is not known is null."""
    start = "[\n"
    for columns in parts:
        lists = [c.tolist() if isinstance(c, np.ndarray) else c for c in columns.values()]
        for row in zip(*lists, strict=True):
            said = json.dumps(jsonable(dict(zip(columns, row, strict=True))), indent=1)
            yield start + " " + said.replace("\n", "\n ")
            start = ",\n"
    yield "\n]\n" if start != "[\n" else "[]\n"


def write_parquet(parts: Iterable[Columns], path: Path) -> None:
    """The columns as a Parquet file, whole or not at all; numbers bit for bit."""
    if importlib.util.find_spec("pyarrow") is None:
        raise DriverMissing("writing Parquet needs pyarrow: pip install 'thermocald[parquet]'")
    import pyarrow as pa
    from pyarrow import parquet

    make_folder(path.absolute().parent)
    with new_file(path) as partial:
        writer = None
        for columns in parts:
            table = pa.table({name: pa.array(v if isinstance(v, np.ndarray) else list(v))
                              for name, v in columns.items()})  # fmt: skip
            writer = writer or parquet.ParquetWriter(partial, table.schema)
            writer.write_table(table)
        if writer is not None:
            writer.close()
