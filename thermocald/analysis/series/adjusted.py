"""A series adjusted together, as a table: at once, or in blocks where it is long."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.series.still_field import still_field
from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import (
    EOP,
    IOP,
    ExteriorOrientation,
    InteriorOrientation,
)
from thermocald.photogrammetry.series.adjustment import adjust_series
from thermocald.photogrammetry.series.blocks import (
    ObservedBlocks,
    WithoutTargets,
    gathered,
    released,
    spread_windows,
)
from thermocald.photogrammetry.series.long_series import adjust_long_series, together_at_most
from thermocald.photogrammetry.series.mount import drift_period

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.analysis.series.epochs import Epochs
    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.photogrammetry.series.blocks import ObservationBlocks
    from thermocald.photogrammetry.series.long_series import LongAdjustment, RowWriter
    from thermocald.photogrammetry.series.normals import ObservationGrid
    from thermocald.photogrammetry.series.result import SeriesAdjustment, SeriesSettings
    from thermocald.store.recording.head import Head

__all__ = ["table_of_series"]

_SOME = 20_000  # epochs that tell the start values
_AS_READ = ("number", "frame_time", "temperature")


def table_of_series(
    head: Head,
    testfield: TestField,
    apart: Epochs,
    observations: Sequence[Observations | None] | ObservationBlocks,
    settings: SeriesSettings,
    start: Array | None = None,
    jobs: int = 1,
) -> Epochs:
    """The series adjusted together, from the table of its epochs one by one.

    start (16,): where the adjustment begins, by default the medians of the epochs one by one. A
    series of more epochs than are adjusted at once goes in blocks, on `jobs` processes. Raises
    DataError where no epoch has a result to start from.
    """
    ok = apart.ok
    if start is None and not ok.any():
        counts = Counter(reason for reason in apart.reasons if reason)
        why = max(counts, key=lambda reason: counts[reason], default="-")
        raise DataError(f"{head.name}: no epoch has a result; most often: {why}")
    if start is None:
        start = _middle(apart.values, ok)
    apart = replace(apart, head=head)
    settings = replace(settings, drift_period=drift_period(apart.frame_time, apart.temperature))
    source = (
        observations if hasattr(observations, "blocks") else ObservedBlocks(testfield, observations)
    )
    if len(source) <= together_at_most(len(testfield)):
        return _together(head, testfield, apart, start, source, settings)
    return _in_blocks(head, testfield, apart, start, source, settings, jobs)


def _middle(values: Array, ok: NDArray[np.bool_]) -> Array:
    """Medians (16,) over the epochs with a result, of many epochs over some thousand."""
    rows = np.flatnonzero(ok)
    rows = rows[:: max(len(rows) // _SOME, 1)]
    middle: Array = np.median(values[rows], axis=0)
    released(values)
    return middle


def _together(
    head: Head, testfield: TestField, apart: Epochs, start: Array,
    source: ObservationBlocks, settings: SeriesSettings,
) -> Epochs:  # fmt: skip
    """The table of a series that is adjusted as one, its field put back where it moved."""
    grid = gathered(source, [slice(0, len(source))])
    found = _as_one(head, testfield, apart, start, grid, settings)
    assert found.adjustment is not None
    moved, still = still_field(
        head.camera.sensor,
        testfield,
        grid,
        found.adjustment,
        start,
        apart.number,
        apart.frame_time,
    )
    if not moved:
        return found
    return replace(_as_one(head, testfield, apart, start, still, settings), field_movements=moved)


def _as_one(
    head: Head, testfield: TestField, apart: Epochs, start: Array,
    grid: ObservationGrid, settings: SeriesSettings,
) -> Epochs:  # fmt: skip
    """The table of one adjustment of all epochs."""
    result = adjust_series(
        head.camera.sensor, testfield, grid, InteriorOrientation.from_array(start[IOP]),
        ExteriorOrientation.from_array(start[EOP]), settings,
    )  # fmt: skip

    def without(rows: NDArray[np.int64], quick: bool) -> Epochs:
        rough = replace(settings, exterior=result.exterior)
        mask = np.zeros(result.observed.shape, dtype=bool)
        if quick:
            mask = ~result.observed
            rough = replace(rough, snooping_alpha=0.0, target_noise=False)
        mask[:, rows] = True
        return _as_one(head, testfield, apart, start, grid.reject(mask), rough)

    return replace(_table(apart, testfield, result, result, result), without=without)


def _in_blocks(
    head: Head, testfield: TestField, apart: Epochs, start: Array,
    source: ObservationBlocks, settings: SeriesSettings, jobs: int,
) -> Epochs:  # fmt: skip
    """The table of a long series."""
    found = adjust_long_series(
        head.camera.sensor, testfield, source, InteriorOrientation.from_array(start[IOP]),
        ExteriorOrientation.from_array(start[EOP]), settings, jobs=jobs,
    )  # fmt: skip
    rows, sample = found.rows, found.sample

    def without(targets: NDArray[np.int64], quick: bool) -> Epochs:
        rough = replace(settings, exterior=sample.exterior)
        fewer = WithoutTargets(source, targets)
        if not quick:
            return _in_blocks(head, testfield, apart, start, fewer, rough, jobs)
        rough = replace(rough, snooping_alpha=0.0, target_noise=False)
        grid = gathered(fewer, spread_windows(len(source), len(found.sampled)))
        used = grid.reject(~sample.observed)
        some = replace(
            apart.part(slice(0, 0)),
            **{n: getattr(apart, n)[found.sampled] for n in _AS_READ},
            status=tuple(apart.status[i] for i in found.sampled),
            reasons=tuple(apart.reasons[i] for i in found.sampled),
        )
        return _as_one(head, testfield, some, start, used, rough)

    table = _table(apart, testfield, rows, found, sample)
    return replace(table, without=without, sampled=found.sampled)


def _table(
    apart: Epochs, testfield: TestField, rows: SeriesAdjustment | RowWriter,
    whole: SeriesAdjustment | LongAdjustment, sample: SeriesAdjustment,
) -> Epochs:  # fmt: skip
    """The table of adjusted epochs (`rows`), of the series as a whole, and of epochs in full."""
    rejected = _count(rows.rejected)
    status, reasons = _said(rows, apart)
    return replace(
        apart,
        values=rows.values,
        sd=rows.sd,
        sigma0=np.where(rows.ok, rows.sigma0, np.nan),
        n_observations=_count(rows.observed) + rejected,
        n_rejected=rejected,
        status=status,
        reasons=reasons,
        exterior=sample.exterior,
        level_sd=whole.level_sd,
        adjustment=sample,
        groups=_groups(testfield, sample),
        trend_sd=whole.trend_sd,
        perspective_sd=sample.perspective_sd,
        redundancy=rows.redundancy,
        stillness=rows.stillness,
    )


def _count(targets: NDArray[Any]) -> NDArray[np.int64]:
    """How many targets (E,), from their numbers or a mask (E, T)."""
    count: NDArray[np.int64] = targets if targets.ndim == 1 else targets.sum(axis=1)
    return count


def _said(
    rows: SeriesAdjustment | RowWriter, apart: Epochs
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Words and sentences of the epochs; what the epoch itself said of a frame without a result
    says more than "no observations".
    """
    status, reasons = list(rows.status), list(rows.reasons)
    for row in np.flatnonzero(~rows.ok & ~apart.ok).tolist():
        if status[row] == "no_observations":
            status[row], reasons[row] = apart.status[row], apart.reasons[row]
    return tuple(status), tuple(reasons)


def _groups(testfield: TestField, result: SeriesAdjustment) -> dict[str, NDArray[np.int64]]:
    """The groups of targets that take part, by the name of their first."""
    seen = result.observed.any(axis=0)
    rows: dict[int, list[int]] = {}
    for row in np.flatnonzero(seen):
        rows.setdefault(int(testfield.groups[row]), []).append(int(row))
    return {testfield.names[members[0]]: np.array(members) for members in rows.values()}
