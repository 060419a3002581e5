"""The table of a series: one row per epoch with its parameters, as exports and summaries need it.

Comes from a recording or a store. With `exterior="per_epoch"` a store's rows are taken as they
were stored; with `exterior="series"` all epochs are adjusted together from their observations.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, cast

import numpy as np

from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import (
    PARAMETER_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
)
from thermocald.photogrammetry.parameters import EOP, IOP
from thermocald.photogrammetry.series.adjustment import (
    SeriesAdjustment,
    SeriesSettings,
    adjust_series,
)
from thermocald.photogrammetry.series.mount import drift_period
from thermocald.store.recording.reader import interpolate_readings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from thermocald.acquisition.calibrator import Calibrator
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.photogrammetry.series.result import Exterior
    from thermocald.store.recording.head import Head

    Array = NDArray[np.float64]

__all__ = ["CSV_COLUMNS", "SeriesTable", "calibrate_epochs", "csv_text", "table_of_series"]

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

_MOST_TOGETHER = 50_000  # epochs: beyond, a series is adjusted epoch by epoch


@dataclass(frozen=True, eq=False)
class SeriesTable:
    """Rows are epochs.

    number, frame_time (E,); temperature (E,) °C of the reference at the frame's time; values,
    sd (E, 16), NaN where there is none; sigma0, n_observations, n_rejected (E,); status, reasons:
    E words and sentences; exterior: `series` or `per_epoch`; level_sd (16,): what all epochs have
    in common, NaN where it cannot be separated; adjustment: the series', None epoch by epoch;
    groups: {name: rows of the test field} of what belongs together; without: the table without some
    targets (rows), quickly or with all care; left_out: targets found to move by themselves.
    """

    number: NDArray[np.int64]
    frame_time: Array
    temperature: Array
    values: Array
    sd: Array
    sigma0: Array
    n_observations: NDArray[np.int64]
    n_rejected: NDArray[np.int64]
    status: tuple[str, ...]
    reasons: tuple[str, ...]
    exterior: str
    level_sd: Array = field(default_factory=lambda: np.full(16, np.nan))
    adjustment: SeriesAdjustment | None = None
    groups: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    without: Callable[[NDArray[np.int64], bool], SeriesTable] | None = None
    left_out: tuple[str, ...] = ()

    @property
    def ok(self) -> NDArray[np.bool_]:
        """(E,): epochs with a result."""
        return np.array([s == "ok" for s in self.status], dtype=bool)


def calibrate_epochs(
    epochs: Iterable[Epoch],
    calibrator: Calibrator,
    temperature: Mapping[int, float],
    advance: Callable[[int], None] | None = None,
) -> tuple[SeriesTable, list[Observations | None]]:
    """Adjust epochs one by one; their table, and the observations for a series adjustment.

    temperature: {epoch number: °C at the frame's time}.
    """
    rows, observations = [], []
    for epoch in epochs:
        done = calibrator.calibrate(epoch)
        a = done.adjustment
        rows.append((epoch.number, epoch.frame_time, a))
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


def table_of_series(
    head: Head,
    testfield: TestField,
    apart: SeriesTable,
    observations: Sequence[Observations | None],
    settings: SeriesSettings,
) -> SeriesTable:
    """The series adjusted together, from the table of its epochs one by one.

    Raises DataError where no epoch has a result to start from.
    """
    ok = apart.ok
    if not ok.any():
        reasons = sorted({r for r in apart.reasons if r}, key=apart.reasons.count)
        raise DataError(
            f"{head.name}: no epoch has a result; most often: {reasons[-1] if reasons else '-'}"
        )
    if len(observations) > _MOST_TOGETHER:
        raise DataError(
            f"{head.name}: {len(observations)} epochs are too many to be adjusted together (at "
            f"most {_MOST_TOGETHER}); use --exterior per_epoch"
        )
    start = np.median(apart.values[ok], axis=0)
    settings = replace(settings, drift_period=drift_period(apart.frame_time, apart.temperature))

    def without(rows: NDArray[np.int64], quick: bool) -> SeriesTable:
        left = [None if o is None else o.select(~np.isin(o.targets, rows)) for o in observations]
        if quick:
            used = result.observed
            left = [None if o is None else o.select(used[e, o.targets]) for e, o in enumerate(left)]
        rough = replace(settings, exterior=result.exterior)
        if quick:
            rough = replace(rough, snooping_alpha=0.0, target_noise=False)
        return table_of_series(head, testfield, apart, left, rough)

    result = adjust_series(
        head.camera.sensor,
        testfield,
        observations,
        InteriorOrientation.from_array(start[IOP]),
        ExteriorOrientation.from_array(start[EOP]),
        settings,
    )
    observed, rejected = result.observed.sum(axis=1), result.rejected.sum(axis=1)
    # What the epoch itself said of a frame without a result says more than "no observations".
    pairs = [
        (mine, why) if word == "no_observations" and mine != "ok" else (word, reason)
        for word, reason, mine, why in zip(
            result.status, result.reasons, apart.status, apart.reasons, strict=True
        )
    ]
    good = result.ok
    return SeriesTable(
        apart.number,
        apart.frame_time,
        apart.temperature,
        result.values,
        result.sd,
        np.where(good, result.sigma0, np.nan),
        observed + rejected,
        rejected,
        tuple(word for word, _ in pairs),
        tuple(reason for _, reason in pairs),
        result.exterior,
        result.level_sd,
        result,
        _groups(testfield, result),
        without,
    )


def _groups(testfield: TestField, result: SeriesAdjustment) -> dict[str, NDArray[np.int64]]:
    """The groups of targets that take part, by the name of their first."""
    seen = result.observed.any(axis=0)
    rows: dict[int, list[int]] = {}
    for row in np.flatnonzero(seen):
        rows.setdefault(int(testfield.groups[row]), []).append(int(row))
    return {testfield.names[members[0]]: np.array(members) for members in rows.values()}


def settings_for_series(settings: AdjustmentSettings, exterior: str) -> SeriesSettings:
    """The series' settings that go with those of single epochs."""
    return SeriesSettings(
        exterior=cast("Exterior", exterior),
        free=settings.free,
        scale=settings.scale,
        bounds=settings.bounds,
        max_rejected=settings.max_rejected,
    )


def frame_temperatures(
    number: NDArray[np.int64], frame_time: Array, reading_time: Array, readings: Array
) -> dict[int, float]:
    """{epoch number: °C at the frame's time}, from readings at their own times."""
    values = interpolate_readings(frame_time, reading_time, readings)
    return dict(zip(number.tolist(), values.tolist(), strict=True))


def csv_text(table: SeriesTable) -> Iterable[str]:
    """The table as lines of CSV (CONVENTIONS §4): a result's figures with all their digits."""
    yield ",".join(CSV_COLUMNS) + "\n"

    def cell(value: float) -> str:
        return repr(float(value)) if np.isfinite(value) else ""

    for i, number in enumerate(table.number):
        row = [str(int(number)), f"{table.frame_time[i]:.6f}", cell(table.temperature[i])]
        row += [cell(v) for v in table.values[i]]
        row += [cell(table.sigma0[i]), str(table.n_observations[i]), str(table.n_rejected[i])]
        row += [table.status[i], *(cell(v) for v in table.sd[i])]
        yield ",".join(row) + "\n"
