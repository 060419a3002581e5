"""From a recording to what discovery reads; two recordings of one camera, checked."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.thermal.reduction import measured_epochs
from thermocald.discovery.evidence import Evidence, SeriesInput
from thermocald.discovery.reduction import gather
from thermocald.errors import DataError
from thermocald.photogrammetry.series.normals import ObservationGrid

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from thermocald.store.recording.reader import Recording

__all__ = ["gather_pair", "load_pair", "series_input"]


def series_input(recording: Recording, say: Callable[[str], None] | None = None) -> SeriesInput:
    """The arrays of one recording; its frames are measured where they have not been."""
    if not recording.has_observations and say is not None:
        say(f"measuring the {len(recording.columns)} frames of {recording.path}")
    observations = [e.observations for e in measured_epochs(recording)]
    columns = recording.columns
    camera = recording.camera
    readings = {
        name: values for name, values in columns.temperatures.items() if name in recording.channels
    }
    return SeriesInput(
        name=f"{recording.path}",
        camera=camera.name,
        sensor=camera.sensor,
        field=recording.testfield,
        principal_distance=camera.principal_distance,
        frame_times=columns.frame_time,
        reading_times=columns.temperature_time,
        readings=readings,
        resolutions={name: c.resolution for name, c in recording.channels.items()},
        grid=ObservationGrid.from_observations(recording.testfield, observations),
        numbers=columns.numbers,
    )


def load_pair(first: Path, second: Path | None, say: Callable[[str], None]) -> list[SeriesInput]:
    """Read M1, and M2 where it is given; refuses an M2 of another camera or thermometer."""
    from thermocald.store.recording.reader import read_recording

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


def gather_pair(inputs: Sequence[SeriesInput], T0: float | None = None) -> list[Evidence]:
    """Evidence of one or two series in common units; T0 is M1's mean unless a model has one."""
    first = gather(inputs[0], T0)
    out = [first, *(gather(i, first.T0, first.scale) for i in inputs[1:])]
    for e in out[1:]:
        low = float(np.min(e.at.iop[0] / first.at.iop[0]))
        if not 0.9 < low < 1.1:
            raise DataError(
                f"{e.source.name}: the principal distance is {e.at.iop[0]:.3f} mm, in "
                f"{first.source.name} {first.at.iop[0]:.3f} mm: another camera, or refocused"
            )
    return out
