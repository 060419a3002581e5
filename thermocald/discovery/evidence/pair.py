"""Two recordings of one camera: M1 to discover on, M2 to prove it on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from thermocald.errors import DataError, UsageError
from thermocald.reduction.source import series_input

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from thermocald.reduction.series import SeriesInput

__all__ = ["load_pair"]


def load_pair(first: Path, second: Path | None, say: Callable[[str], None]) -> list[SeriesInput]:
    """Read M1, and M2 where it is given; refuses an M2 of another camera or thermometer."""
    from thermocald.store.recording.reader import read_recording

    if second is not None and first.resolve() == second.resolve():
        raise UsageError(
            f"{second} is the recording to explain itself; --verify needs another recording of the "
            "same camera, made at another time"
        )
    out = []
    for path in (first, second):
        if path is None:
            continue
        say(f"reading {path}")
        out.append(series_input(read_recording(path), say))
    if len(out) == 2:
        _same_camera(*out)
    return out


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
