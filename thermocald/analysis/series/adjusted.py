"""A series adjusted together, as a table: at once, or in blocks where it is long.

The test field is then as if it had stood still: its movements are looked for in the residuals of a
first adjustment, which a second one does without.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import (
    EOP,
    IOP,
    ExteriorOrientation,
    InteriorOrientation,
)
from thermocald.photogrammetry.field.testfield import field_sheets, find_misplaced
from thermocald.photogrammetry.series.adjustment import adjust_series
from thermocald.photogrammetry.series.field_motion import (
    FEWEST_EPOCHS,
    FieldMovement,
    FieldSeries,
    board_movements,
    put_back,
    taken_off,
    wandering_targets,
)
from thermocald.photogrammetry.series.long_series import adjust_long_series, together_at_most
from thermocald.photogrammetry.series.mount import drift_period
from thermocald.photogrammetry.series.normals import (
    WithoutTargets,
    gathered,
    linearise,
    misplaced_targets,
    spread_windows,
)
from thermocald.thermal.reduce import find_spikes

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from thermocald.analysis.series.epochs import Epochs
    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.series.long_series import LongAdjustment
    from thermocald.photogrammetry.series.normals import ObservationBlocks, ObservationGrid
    from thermocald.photogrammetry.series.result import SeriesAdjustment, SeriesSettings
    from thermocald.store.recording.head import Head


def still_field(
    sensor: Sensor, testfield: TestField, grid: ObservationGrid, result: SeriesAdjustment,
    camera: Array, numbers: NDArray[np.int64], time_s: Array,
) -> tuple[tuple[FieldMovement, ...], ObservationGrid]:  # fmt: skip
    """What moved in a series, and its observations without that.

    result: of a first adjustment; camera (16,): where it is linearised; numbers, time_s (E,): the
    epochs'.
    """
    if len(numbers) < FEWEST_EPOCHS:
        return (), grid
    at = linearise(sensor, testfield, camera[IOP], camera[EOP])
    # what data snooping rejects after a knock is the board; single leaps are not
    good = grid.observed & ~find_spikes(result.residuals, grid.observed)
    residuals = np.where(good[..., None], result.residuals, np.nan)
    ratio = result.noise_ratio if np.isfinite(result.noise_ratio) else 1.0
    weights = grid.weights / max(ratio, 1e-6) ** 2
    series = FieldSeries(
        time_s - time_s[0], residuals, weights, at.A, at.B, testfield.points,
        field_sheets(testfield), testfield.names, numbers,
    )  # fmt: skip
    single = wandering_targets(series)
    boards = board_movements(series, single)
    for m in boards:
        series = put_back(series, m)
    if boards:
        single = wandering_targets(series)
    moved = (*boards, *single)
    return moved, taken_off(grid, moved) if moved else grid


_SOME = 20_000  # epochs that tell the start values
_LOOKED_AT = 60  # that tell where the targets are
_AS_READ = ("number", "frame_time", "temperature")


def table_of_series(
    head: Head,
    testfield: TestField,
    apart: Epochs,
    source: ObservationBlocks,
    settings: SeriesSettings,
    start: Array | None = None,
    jobs: int = 1,
    advance: Callable[[int], None] | None = None,
) -> Epochs:
    """Return the series adjusted together, from the table of its epochs one by one.

    start (16,): where the adjustment begins, by default the medians of the epochs one by one, of
    which some must have a result. A series of more epochs than are adjusted at once goes in blocks,
    on `jobs` processes, and tells `advance` how many epochs are done.
    """
    if start is None:
        rows = np.flatnonzero(apart.ok)
        start = np.median(apart.values[rows[:: max(len(rows) // _SOME, 1)]], axis=0)
    few = spread_windows(len(source), _LOOKED_AT)
    own = np.where(apart.ok[:, None], apart.values, np.nan)[np.r_[few]]
    if not np.isfinite(own).any():  # epochs of a long series are not calibrated one by one
        own = np.tile(start, (len(own), 1))
    far = misplaced_targets(head.camera.sensor, testfield, gathered(source, few), own)
    wrong = np.flatnonzero(far)

    def left_out() -> Epochs:
        """The table without targets that are wrong, which count as rejected."""
        fewer = WithoutTargets(source, wrong)
        table = table_of_series(head, testfield, apart, fewer, settings, start, jobs, advance)
        counts = [grid.observed[:, wrong].sum(axis=1) for _, grid in source.blocks()]
        return replace(table, n_rejected=table.n_rejected + np.concatenate(counts))

    if len(wrong):
        return left_out()
    apart = replace(apart, head=head)
    settings = replace(settings, drift_period=drift_period(apart.frame_time, apart.temperature))
    in_blocks = len(source) > together_at_most(len(testfield))
    if not in_blocks:
        source = grid = gathered(source, [slice(0, len(source))])
    found = _adjusted(testfield, apart, start, source, settings, in_blocks, jobs, advance)
    assert found.adjustment is not None
    c_px = start[0] / head.camera.sensor.pixel_pitch
    wrong = np.flatnonzero(find_misplaced(found.adjustment.offsets, c_px))
    if len(wrong):  # they had drawn the start to themselves
        return left_out()
    if in_blocks:
        return found
    moved, still = still_field(
        head.camera.sensor, testfield, grid, found.adjustment, start, apart.number,
        apart.frame_time,
    )  # fmt: skip
    if not moved:
        return found
    return replace(_adjusted(testfield, apart, start, still, settings), field_movements=moved)


def _adjusted(
    testfield: TestField, apart: Epochs, start: Array, source: ObservationBlocks,
    settings: SeriesSettings, in_blocks: bool = False, jobs: int = 1,
    advance: Callable[[int], None] | None = None,
) -> Epochs:  # fmt: skip
    """Return the table of one adjustment of all epochs, which are one grid, or of a long series."""
    assert apart.head is not None
    sensor, whole_series = apart.head.camera.sensor, [slice(0, len(source))]
    camera = (
        InteriorOrientation.from_array(start[IOP]), ExteriorOrientation.from_array(start[EOP])
    )  # fmt: skip
    whole: SeriesAdjustment | LongAdjustment
    if in_blocks:
        whole = adjust_long_series(
            sensor, testfield, source, *camera, settings, jobs=jobs, advance=advance
        )
        # the epochs that are known in full
        sample, sampled = whole.sample, whole.sampled
    else:
        grid = gathered(source, whole_series)
        whole = sample = adjust_series(sensor, testfield, grid, *camera, settings)
        sampled = None

    def without(targets: NDArray[np.int64], quick: bool) -> Epochs:
        rough, fewer = replace(settings, exterior=sample.exterior), WithoutTargets(source, targets)
        if not quick:
            return _adjusted(testfield, apart, start, fewer, rough, in_blocks, jobs)
        rough = replace(rough, snooping_alpha=0.0, target_noise=False)
        windows, some = whole_series, apart
        if sampled is not None:
            windows = list(spread_windows(len(source), len(sampled)))
            some = replace(
                apart.part(slice(0, 0)),
                **{n: getattr(apart, n)[sampled] for n in _AS_READ},
                status=tuple(apart.status[i] for i in sampled),
                reasons=tuple(apart.reasons[i] for i in sampled),
            )
        kept = gathered(fewer, windows).reject(~sample.observed)
        return _adjusted(testfield, some, start, kept, rough)

    rows, groups = whole.rows, {}
    # what the epoch itself said of a frame without a result says more than "no observations"
    for row in np.flatnonzero(~apart.ok).tolist():
        if rows.status[row] == "no_observations":
            rows.status[row], rows.reasons[row] = apart.status[row], apart.reasons[row]
    seen = np.flatnonzero(sample.observed.any(axis=0))
    for label in dict.fromkeys(testfield.groups[seen].tolist()):
        members = seen[testfield.groups[seen] == label]
        groups[testfield.names[members[0]]] = members
    return replace(
        apart,
        **vars(rows) | {"status": tuple(rows.status), "reasons": tuple(rows.reasons)},
        exterior=sample.exterior,
        level_sd=whole.level_sd,
        adjustment=sample,
        groups=groups,
        trend_sd=whole.trend_sd,
        perspective_sd=sample.perspective_sd,
        without=without,
        sampled=sampled,
    )
