"""Recordings of any length for benchmarks: drawn, not rendered, a million epochs in minutes.

A camera with linear rates, optionally with a lag, looks at a corner of targets; the temperature has
daily and annual cycles, and noise. The Parquet file is written in blocks, so memory does not grow.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.adjustment import EXTERIOR, INTERIOR, SENSOR, SIGMA_PX
from benchmarks.adjustment import corner_field as whole_field
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.physics.model import follow_angle
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.photogrammetry.field.testfield import TestField

    Array = NDArray[np.float64]

__all__ = ["INTERVAL_S", "field_of", "outdoor_temperature", "write_long_recording"]

INTERVAL_S = 10.0
RATES = {0: 2.0e-4, 1: 3.0e-4, 2: -2.0e-4}  # mm/K of c, x0, y0
_BLOCK = 20_000
_START = 1.7e9


def field_of(targets: int) -> TestField:
    """Return some targets of the benchmarks' corner, spread over its planes."""
    field = whole_field()
    return field.subset(np.unique(np.linspace(0, len(field) - 1, targets).astype(np.int64)))


def outdoor_temperature(seconds: Array) -> Array:
    """Return temperatures, °C, with an annual cycle, daily cycles, and weather of several days."""
    day, year = 86_400.0, 365.25 * 86_400.0
    weather = np.sin(seconds / (5.3 * day)) + np.sin(seconds / (2.1 * day) + 1.0)
    cycle = 5.0 * np.sin(2 * np.pi * seconds / day)
    return 15.0 + 10.0 * np.sin(2 * np.pi * seconds / year) + cycle + weather


def write_long_recording(
    path: Path,
    epochs: int,
    targets: int = 27,
    lag_s: float = 0.0,
    temperature: Callable[[Array], Array] = outdoor_temperature,
    seed: int = 1,
) -> None:
    """Write a recording."""
    import pyarrow as pa  # tests import this module
    from pyarrow import parquet

    rng = np.random.default_rng(seed)
    field = field_of(targets)
    camera = CameraSpec("rpi", SENSOR, INTERIOR.c)
    head = Head("long", "long", INTERVAL_S, camera, {"temperature": Channel()}, {})
    with RecordingWriter(path, head, field):
        pass
    names = pa.array(list(field.names))
    writer = None
    state: float | None = None
    with (path / "epochs.csv").open("a", encoding="utf-8") as rows:
        for first in range(0, epochs, _BLOCK):
            number = np.arange(first, min(first + _BLOCK, epochs))
            time = INTERVAL_S * number
            T = temperature(time)
            driven, state = _lagged(T, lag_s, state)
            points = _points(field, driven, rng)
            read = T + rng.normal(0, 0.02, len(T))
            lines = zip(number.tolist(), (time + _START).tolist(), read.tolist(), strict=True)
            rows.writelines(f"{n},{t:.6f},{t:.6f},{v:.4f},\n" for n, t, v in lines)
            n, m = points.shape[:2]
            target = np.tile(np.arange(m, dtype=np.int32), n)
            sigma = np.full(n * m, SIGMA_PX)
            table = pa.table({
                "epoch": np.repeat(number, m),
                "target": pa.DictionaryArray.from_arrays(pa.array(target), names),
                "x": np.round(points[..., 0].ravel(), 5), "y": np.round(points[..., 1].ravel(), 5),
                "sx": sigma, "sy": sigma,
            })  # fmt: skip
            if writer is None:
                writer = parquet.ParquetWriter(
                    path / "observations.parquet", table.schema, compression="zstd"
                )
            writer.write_table(table)
    if writer is not None:
        writer.close()


def _lagged(T: Array, lag_s: float, state: float | None) -> tuple[Array, float]:
    """Return the temperature after a first-order lag, and its last value."""
    if lag_s <= 0:
        return T, float(T[-1])
    from scipy.signal import lfilter

    a = float(np.exp(-INTERVAL_S / lag_s))
    begin = float(T[0]) if state is None else state
    out, _ = lfilter([1 - a], [1, -a], T, zi=[a * begin])
    return np.asarray(out), float(out[-1])


def _points(field: TestField, T: Array, rng: np.random.Generator) -> Array:
    values = np.tile(INTERIOR.as_array(), (len(T), 1))
    for column, rate in RATES.items():
        values[:, column] += rate * (T - 15.0)
    values = follow_angle(values, INTERIOR.c)
    seen = project(SENSOR, values, np.tile(EXTERIOR.as_array(), (len(T), 1)), field.points)
    out: Array = seen + rng.normal(0, SIGMA_PX, seen.shape)
    return out
