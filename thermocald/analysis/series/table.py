"""The table of a series: one row per epoch with its parameters, as exports and summaries need it.

Comes from a recording or a store: epochs one by one as they were calibrated or stored, or all
adjusted together from their observations (`adjusted`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np

from thermocald.acquisition.calibrated_blocks import calibrated_epochs
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.photogrammetry.series.spool import released
from thermocald.photogrammetry.series.words import Words
from thermocald.store.recording.reader import interpolate_readings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from thermocald.acquisition.calibrator import Calibrator
    from thermocald.arrays import Array
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.photogrammetry.series.adjustment import SeriesAdjustment
    from thermocald.photogrammetry.series.field_motion import FieldMovement

__all__ = ["BY_EPOCH", "CSV_COLUMNS", "SeriesTable", "calibrate_epochs", "csv_text"]

CSV_COLUMNS = (
    "epoch",
    "frame_time",
    "temperature",
    *PARAMETER_NAMES,
    "sigma0",
    "n_observations",
    "n_rejected",
    "status",
    *(f"sd_{name}" for name in PARAMETER_NAMES),
)

_ROWS = 20_000  # of a table that are worked on at a time


BY_EPOCH = (
    "number", "frame_time", "temperature", "values", "sd", "sigma0", "n_observations",
    "n_rejected", "status", "reasons", "redundancy", "stillness",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class SeriesTable:
    """Rows are epochs.

    number, frame_time (E,); temperature (E,) °C of the reference at the frame's time; values,
    sd (E, 16), NaN where there is none; sigma0, n_observations, n_rejected (E,); status, reasons:
    E words and sentences; exterior: `series` or `per_epoch`; level_sd (16,): what all epochs have
    in common, NaN where it cannot be separated; adjustment: the series', None epoch by epoch;
    groups: {name: rows of the test field} of what belongs together; without: the table without some
    targets (rows), quickly or with all care; left_out: targets found to move by themselves;
    field_movements: boards and targets that moved, taken off the observations.
    """

    number: NDArray[np.int64]
    frame_time: Array
    temperature: Array
    values: Array
    sd: Array
    sigma0: Array
    n_observations: NDArray[np.integer]
    n_rejected: NDArray[np.integer]
    status: Sequence[str]
    reasons: Sequence[str]
    exterior: str
    level_sd: Array = field(default_factory=lambda: np.full(16, np.nan))
    adjustment: SeriesAdjustment | None = None
    groups: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    without: Callable[[NDArray[np.int64], bool], SeriesTable] | None = None
    left_out: tuple[str, ...] = ()
    trend_sd: Array = field(default_factory=lambda: np.zeros(16))
    redundancy: Array = field(default_factory=lambda: np.zeros(0))
    stillness: Array = field(default_factory=lambda: np.zeros(0))
    sampled: NDArray[np.int64] | None = None
    field_movements: tuple[FieldMovement, ...] = ()

    def part(self, rows: slice) -> SeriesTable:
        """Some rows, without what belongs to the series as a whole."""
        return replace(
            self,
            **{name: getattr(self, name)[rows] for name in BY_EPOCH},
            adjustment=None, sampled=None, without=None,
        )  # fmt: skip

    def parts(self) -> Iterator[SeriesTable]:
        """All rows, some thousand at a time; what was used of a long series leaves memory."""
        for first in range(0, len(self.number), _ROWS):
            yield self.part(slice(first, first + _ROWS))
            released(self.values)
            released(self.sd)

    @property
    def ok(self) -> NDArray[np.bool_]:
        """(E,): epochs with a result."""
        return Words.of(self.status).are("ok")


def calibrate_epochs(
    epochs: Iterable[Epoch],
    calibrator: Calibrator,
    temperature: Mapping[int, float],
    advance: Callable[[int], None] | None = None,
    jobs: int = 1,
) -> tuple[SeriesTable, list[Observations | None]]:
    """Adjust epochs one by one; their table, and the observations for a series adjustment.

    temperature: {epoch number: °C at the frame's time}; jobs: processes.
    """
    rows, observations = [], []
    for done in calibrated_epochs(calibrator, epochs, jobs):
        a = done.adjustment
        rows.append((done.epoch.number, done.epoch.frame_time, a))
        observations.append(done.epoch.observations)
        if advance is not None:
            advance(1)
    table = SeriesTable(
        np.array([n for n, _, _ in rows], dtype=np.int64),
        np.array([t for _, t, _ in rows]),
        np.array([temperature.get(n, np.nan) for n, _, _ in rows]),
        np.array([a.values if a.ok else np.full(16, np.nan) for _, _, a in rows]).reshape(-1, 16),
        np.array([a.sd if a.ok else np.full(16, np.nan) for _, _, a in rows]).reshape(-1, 16),
        np.array([a.sigma0 if a.ok else np.nan for _, _, a in rows]),
        np.array([a.n_observations for _, _, a in rows], dtype=np.int64),
        np.array([len(a.rejected) for _, _, a in rows], dtype=np.int64),
        tuple(a.status for _, _, a in rows),
        tuple(a.reason for _, _, a in rows),
        "per_epoch",
    )
    return table, observations


def frame_temperatures(
    number: NDArray[np.int64], frame_time: Array, reading_time: Array, readings: Array
) -> dict[int, float]:
    """{epoch number: °C at the frame's time}, from readings at their own times."""
    values = interpolate_readings(frame_time, reading_time, readings)
    return dict(zip(number.tolist(), values.tolist(), strict=True))


def csv_text(table: SeriesTable) -> Iterable[str]:
    """The table as lines of CSV (CONVENTIONS §4): a result's figures with all their digits."""
    yield ",".join(CSV_COLUMNS) + "\n"

    for part in table.parts():
        columns = [
            [str(n) for n in part.number.tolist()],
            [f"{t:.6f}" for t in part.frame_time.tolist()],
            _cells(part.temperature),
            *(_cells(column) for column in part.values.T),
            _cells(part.sigma0),
            [str(n) for n in part.n_observations.tolist()],
            [str(n) for n in part.n_rejected.tolist()],
            part.status,
            *(_cells(column) for column in part.sd.T),
        ]
        yield from (",".join(row) + "\n" for row in zip(*columns, strict=True))


def _cells(column: Array) -> list[str]:
    """Numbers with all their digits, nothing where there is none."""
    return [repr(v) if isfinite(v) else "" for v in column.tolist()]
