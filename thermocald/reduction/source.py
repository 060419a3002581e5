"""From a recording to the arrays that a reduction reads."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.acquisition.calibrated_blocks import calibrated_epochs
from thermocald.acquisition.calibrator import Calibrator
from thermocald.errors import DataError
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.reduction.condense import condensed, rows_at_most
from thermocald.reduction.series import SeriesInput
from thermocald.store.sources import open_source, source_name
from thermocald.store.stored_blocks import StoredBlocks

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.store.database.row import StoredSeries
    from thermocald.store.database.series_reader import SeriesReader
    from thermocald.store.recording.head import Head
    from thermocald.store.recording.reader import Recording

__all__ = ["epochs_input", "load_series", "measured_epochs", "series_input"]


def measured_epochs(
    recording: Recording, advance: Callable[[int], None] | None = None, jobs: int = 1
) -> list[Epoch]:
    """A recording's epochs with their observations; frames are measured where they are not.

    jobs: processes that measure, with the same bits for any number.
    """
    if recording.has_observations:
        return list(recording.epochs)
    calibrator = Calibrator.of_recording(recording)
    epochs = []
    for done in calibrated_epochs(calibrator, recording.iter_epochs(), jobs):
        epochs.append(done.epoch)
        if advance is not None:
            advance(1)
    return epochs


def epochs_input(head: Head, field: TestField, epochs: Sequence[Epoch], name: str) -> SeriesInput:
    """The arrays of some epochs; name: of their recording or store, for messages."""
    readings = {
        channel: np.array([e.temperatures.get(channel, np.nan) for e in epochs], dtype=float)
        for channel in head.channels
    }
    whole = _without_points(
        head, field, name,
        np.array([e.number for e in epochs], dtype=np.int64),
        np.array([e.frame_time for e in epochs], dtype=float),
        np.array([e.temperature_time for e in epochs], dtype=float),
        readings,
    )  # fmt: skip
    grid = ObservationGrid.from_observations(field, [e.observations for e in epochs])
    return replace(whole, grid=grid)


def series_input(
    recording: Recording,
    say: Callable[[str], None] | None = None,
    advance: Callable[[int], None] | None = None,
    jobs: int = 1,
) -> SeriesInput:
    """The arrays of one recording; its frames are measured where they have not been, on `jobs`
    processes.

    A long one with observations is condensed while it is read.
    """
    if recording.has_observations and len(recording) > rows_at_most(len(recording.testfield)):
        whole = replace(_all_epochs(recording), columns=_columns(recording))
        return condensed(whole, recording)
    if not recording.has_observations and say is not None:
        say(f"measuring the {len(recording.columns)} frames of {recording.path}")
    epochs = measured_epochs(recording, advance, jobs)
    source = epochs_input(recording.head, recording.testfield, epochs, f"{recording.path}")
    return replace(source, columns=_columns(recording))


def _columns(recording: Recording) -> dict[str, NDArray[np.float64]]:
    """The further columns of epochs.csv that hold numbers, such as a humidity."""
    out = {}
    for name, texts in recording.columns.extra.items():
        try:
            values = np.array([float(t) if t.strip() else np.nan for t in texts])
        except ValueError:
            continue  # text: a note
        out[name] = np.where(np.isfinite(values), values, np.nan)
    return out


def _all_epochs(recording: Recording) -> SeriesInput:
    """A recording's epochs without their image points."""
    columns = recording.columns
    return _without_points(
        recording.head, recording.testfield, f"{recording.path}", columns.numbers,
        columns.frame_time, columns.temperature_time, columns.temperatures,
    )  # fmt: skip


def _stored(store: SeriesReader, series: StoredSeries, name: str) -> SeriesInput:
    """The arrays of a series in a store; a long one is condensed while it is read."""
    numbers = store.series_columns(series, ["epoch"])["epoch"].astype(np.int64)
    if len(numbers) <= rows_at_most(len(series.testfield)):
        epochs = [e.epoch for e in store.epochs(series)]
        return epochs_input(series.head, series.testfield, epochs, name)
    names = ["frame_time", "temperature_time", *series.head.channels]
    columns = store.series_columns(series, names)
    whole = _without_points(
        series.head, series.testfield, name, numbers, columns["frame_time"],
        columns["temperature_time"], {n: columns[n] for n in series.head.channels},
    )  # fmt: skip
    return condensed(whole, StoredBlocks(store, series, numbers))


def _without_points(
    head: Head, field: TestField, name: str, numbers: NDArray[np.int64], frame_times: Array,
    reading_times: Array, readings: Mapping[str, Array],
) -> SeriesInput:  # fmt: skip
    camera = head.camera
    nothing = np.empty((0, len(field), 3))
    return SeriesInput(
        name=name,
        camera=camera.name,
        sensor=camera.sensor,
        field=field,
        principal_distance=camera.principal_distance,
        frame_times=frame_times,
        reading_times=reading_times,
        readings=readings,
        resolutions={channel: c.resolution for channel, c in head.channels.items()},
        grid=ObservationGrid(nothing[..., :2], nothing),
        numbers=numbers,
        series=head.series,
        interior=camera.interior,
    )


def load_series(
    path: Path, advance: Callable[[int], None] | None = None, jobs: int = 1
) -> list[SeriesInput]:
    """The series of a recording (a folder) or of a store (a file).

    advance: receives how many frames were measured; jobs: processes that measure.
    """
    if path.is_dir():
        from thermocald.store.recording.reader import open_recording

        return [series_input(open_recording(path), advance=advance, jobs=jobs)]
    with open_source(path) as store:
        found = [_stored(store, s, f"{store.path}: {s.name}") for s in store.all_series()]
    if not found:
        raise DataError(f"{source_name(path)}: the store holds no series")
    return found
