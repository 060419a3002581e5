"""Series of one camera: M1 to discover on, others to prove it on; recordings or in stores."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import DataError, UsageError
from thermocald.reduction.source import load_series, series_input
from thermocald.store.recording.reader import open_recording
from thermocald.store.server.address import is_server
from thermocald.store.sources import require_source, source_name

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from thermocald.reduction.series import SeriesInput

__all__ = ["load_together"]


def load_together(
    first: Path, others: Sequence[Path], say: Callable[[str], None], jobs: int = 1
) -> list[SeriesInput]:
    """Read M1 and the recordings to prove it on; refuses those of another camera or thermometer.

    jobs: processes that measure frames.
    """
    places = [_place(p) for p in (first, *others)]
    for k, path in enumerate(others, start=1):
        if places[k] == places[0]:
            raise UsageError(
                f"{path} is the recording to explain itself; --verify needs another recording of "
                "the same camera, made at another time"
            )
        if places[k] in places[1:k]:
            raise UsageError(f"{path} is given to --verify twice; one time is enough")
    out = []
    for path in (first, *others):
        say(f"reading {source_name(path)}")
        out.append(_read(path, say, jobs))
    for other in out[1:]:
        _same_camera(out[0], other)
    for k, (path, other) in enumerate(zip(others, out[1:], strict=True), start=1):
        for before, same in zip((first, *others)[:k], out[:k], strict=True):
            if np.array_equal(same.grid.points, other.grid.points, equal_nan=True):
                raise DataError(
                    f"{source_name(path)} holds the same observations as {source_name(before)}; "
                    "--verify needs measurements of their own (simulated ones another --seed)"
                )
    return out


def _read(path: Path, say: Callable[[str], None], jobs: int) -> SeriesInput:
    """One series: a recording's, or the only one of a store or of what an address selects."""
    if path.is_dir():
        return series_input(open_recording(path), say, jobs=jobs)
    found = load_series(require_source(path))
    if len(found) > 1:
        there = ", ".join(f"{s.camera}/{s.series}" for s in found)
        remedy = (
            "select one with ?station=…&camera=…&series=… in the address"
            if is_server(path)
            else "make recordings of them with `thermocald archive`"
        )
        raise DataError(f"{source_name(path)}: holds several series ({there}); {remedy}")
    return found[0]


def _place(source: Path) -> str:
    return str(source) if is_server(source) else str(source.resolve())


def _same_camera(a: SeriesInput, b: SeriesInput) -> None:
    if a.camera != b.camera or a.sensor != b.sensor:
        raise DataError(
            f"{b.name} is of another camera ({b.camera}, {b.sensor.width}×{b.sensor.height} px) "
            f"than {a.name} ({a.camera}, {a.sensor.width}×{a.sensor.height} px); constants of one "
            "camera cannot be verified on another"
        )
    reference = next(iter(a.readings), None)
    if reference is not None and reference != next(iter(b.readings), None):
        raise DataError(
            f"{b.name}: the reference temperature is {next(iter(b.readings), 'missing')!r}, in "
            f"{a.name} it is {reference!r}; both series need the same thermometer"
        )
