"""From a recording to the arrays that a reduction reads."""

from __future__ import annotations

from typing import TYPE_CHECKING

from thermocald.acquisition.calibrator import Calibrator
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.reduction.series import SeriesInput

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.epoch import Epoch
    from thermocald.store.recording.reader import Recording

__all__ = ["measured_epochs", "series_input"]


def measured_epochs(
    recording: Recording, advance: Callable[[int], None] | None = None
) -> list[Epoch]:
    """A recording's epochs with their observations; frames are measured where they are not."""
    if recording.has_observations:
        return list(recording.epochs)
    camera = recording.camera
    calibrator = Calibrator(
        camera.sensor,
        recording.testfield,
        nominal_c=camera.principal_distance,
        interior=camera.interior,
    )
    epochs = []
    for epoch in recording.iter_epochs():
        epochs.append(calibrator.calibrate(epoch).epoch)
        if advance is not None:
            advance(1)
    return epochs


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
