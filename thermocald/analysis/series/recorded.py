"""The table of a recording: its epochs one by one, then the series; a long one in blocks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from thermocald.acquisition.calibrator import Calibrator
from thermocald.analysis.series.adjusted import table_of_series
from thermocald.analysis.series.epochs import Epochs, calibrate_epochs, frame_temperatures
from thermocald.errors import DataError
from thermocald.photogrammetry.series.long_series import together_at_most
from thermocald.photogrammetry.series.result import SeriesSettings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from thermocald.arrays import Array
    from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.photogrammetry.series.normals import ObservationGrid
    from thermocald.store.recording.reader import Recording

__all__ = ["recorded_table"]

_STARTS = 25  # epochs of a long series that are calibrated by themselves, for a start


def recorded_table(
    recording: Recording,
    settings: AdjustmentSettings,
    exterior: str,
    advance: Callable[[int], None] | None = None,
    jobs: int = 1,
) -> tuple[Epochs, Callable[[int], Observations | None]]:
    """The table of a recording adjusted as one series, and what shows an epoch's observations.

    Frames are measured where they are not. Of a series with observations that is too long to be
    adjusted at once, only some epochs are calibrated by themselves. advance: receives how many
    epochs are done; jobs: processes, with the same bits for any number. Raises DataError where no
    epoch has a result.
    """
    recording.head.require_calibrated(str(recording.path))
    adjusted = SeriesSettings.of(settings, exterior)
    calibrator = Calibrator.of_recording(recording, settings)
    head, targets = recording.head, recording.testfield
    if recording.has_observations and len(recording) > together_at_most(len(targets)):
        start = _start(recording, calibrator)
        source = _Watched(recording, advance)
        apart = _not_calibrated(recording)
        table = table_of_series(head, targets, apart, source, adjusted, start, jobs)
        return table, recording.observations
    columns = recording.columns
    temperature = {}
    if recording.channels:
        readings = columns.readings_of(next(iter(recording.channels)))
        temperature = frame_temperatures(columns.numbers, columns.frame_time, *readings)
    apart, observations = calibrate_epochs(
        recording.iter_epochs(), calibrator, temperature, advance, jobs
    )
    return (
        table_of_series(head, targets, apart, observations, adjusted, jobs=jobs),
        lambda row: observations[row],
    )


def _start(recording: Recording, calibrator: Calibrator) -> Array:
    """Parameters (16,) to start from: medians over some epochs from first to last."""
    found, reasons = [], []
    for row in np.unique(np.linspace(0, len(recording) - 1, _STARTS).astype(np.int64)).tolist():
        seen = recording.observations(row)
        if seen is None or not len(seen):
            continue
        result = calibrator.adjust(seen)
        if result.ok:
            found.append(result.values)
        else:
            reasons.append(result.reason)
    if not found:
        why = max(reasons, key=reasons.count) if reasons else "no target was measured"
        raise DataError(f"{recording.name}: no epoch has a result; most often: {why}")
    start: Array = np.median(found, axis=0)
    return start


def _not_calibrated(recording: Recording) -> Epochs:
    """The table of a recording's epochs that nobody has calibrated one by one."""
    columns, E = recording.columns, len(recording)
    nothing, none = np.broadcast_to(np.nan, (E, 16)), np.broadcast_to(np.int64(0), (E,))
    channel = next(iter(recording.channels), None)
    temperature = np.full(E, np.nan) if channel is None else columns.at_frame(channel)
    return Epochs(
        columns.numbers, columns.frame_time, temperature, nothing, nothing, nothing[:, 0],
        none, none, ("ok",) * E, ("",) * E,
        "per_epoch",
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Watched:
    """A recording whose first reading is counted."""

    recording: Recording
    advance: Callable[[int], None] | None
    begun: list[bool] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.recording)

    def blocks(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        first_time = windows is None and not self.begun
        if first_time:
            self.begun.append(True)
        for first, grid in self.recording.blocks(windows):
            yield first, grid
            if first_time and self.advance is not None:
                self.advance(len(grid))
