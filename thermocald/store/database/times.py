"""Times of a stored series with the clock's mistakes taken out.

A store holds times as they were stamped: on a machine whose clock was stepped or did not know the
time yet they run backwards, leap, or are wrong as a block. What is right is known afterwards, from
the epochs that follow and from the steps that the daemon noted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.store.database.row import StoredSeries
    from thermocald.store.database.series_reader import StampedReader

__all__ = ["SeriesTimes", "clock_corrections", "series_times"]

_TOLERANCE_S = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class SeriesTimes:
    """Corrected times of a series.

    numbers (E,): of its epochs; frame, reading (E,) s: of the frames and of the readings;
    corrections (E,) s: what was added to the times of the frames.
    """

    numbers: NDArray[np.int64]
    frame: Array
    reading: Array
    corrections: Array

    def of(self, number: int) -> tuple[float, float]:
        """(frame time, temperature time) of an epoch, s."""
        row = int(np.searchsorted(self.numbers, number))
        return float(self.frame[row]), float(self.reading[row])


def series_times(source: StampedReader, series: StoredSeries) -> SeriesTimes:
    """The corrected times of all epochs of a series. Raises StoreError."""
    names = ["epoch", "frame_time", "temperature_time", "clock_trusted"]
    columns = source.series_columns(series, names)
    steps = [
        float(event.data["seconds"])
        for event in source.clock_steps(series)
        if event.data.get("adopted") is True
    ]
    stamped, reading = columns["frame_time"], columns["temperature_time"]
    corrections = clock_corrections(stamped, series.head.interval, columns["clock_trusted"], steps)
    frame = stamped + corrections
    # a reading next to a step of the clock may be stamped by the other of the two
    nearest = reading.copy()
    for shift in np.unique(corrections):
        moved = reading + shift
        nearest = np.where(np.abs(moved - frame) < np.abs(nearest - frame), moved, nearest)
    return SeriesTimes(columns["epoch"].astype(np.int64), frame, nearest, corrections)


def clock_corrections(
    frame_time: Array, interval: float, trusted: Array | None = None, steps: Sequence[float] = ()
) -> Array:
    """Seconds (E,) to add to times (E,) so that they are right where that is known, and in order.

    trusted: (E,) 0 where the clock was not synchronised; steps: s, those that time stamps followed.
    In this order: what was taken before the machine learned the time moves by that step; what lies
    between a step forwards and the same step back was a glitch of the clock, and moves back; before
    any other step back all that came earlier is moved to end one interval before what follows, as
    the later setting is the better known one. Zero elsewhere.
    """
    corrections = np.zeros(len(frame_time))
    tolerance = max(_TOLERANCE_S, 3.0 * interval)
    for step in steps:
        _learned(frame_time + corrections, interval, trusted, step, tolerance, corrections)
    for j in np.flatnonzero(np.diff(frame_time + corrections) < 0) + 1:
        leaps = np.diff(frame_time + corrections) - interval
        back = -float(leaps[j - 1])
        same = np.flatnonzero((leaps[: j - 1] > 0) & (np.abs(leaps[: j - 1] - back) < tolerance))
        if same.size:
            corrections[same[-1] + 1 : j] -= back
    times = frame_time + corrections
    for last in np.flatnonzero(np.diff(times) < 0)[::-1]:
        corrections[: last + 1] += times[last + 1] - interval - times[last]
    return corrections


def _learned(
    times: Array,
    interval: float,
    trusted: Array | None,
    step: float,
    tolerance: float,
    corrections: Array,
) -> None:
    """Move the epochs before a step forwards that were taken without a synchronised clock."""
    if trusted is None or step < tolerance:
        return
    fits = np.abs(np.diff(times) - interval - step) < tolerance
    for i in np.flatnonzero(fits & (trusted[:-1] == 0)) + 1:
        known = np.flatnonzero(trusted[:i] != 0)
        first = int(known[-1]) + 1 if known.size else 0
        if times[i] - times[i - 1] > tolerance:
            corrections[first:i] += step
