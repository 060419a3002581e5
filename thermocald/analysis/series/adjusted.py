"""Joint adjustment of a series' epochs, at once or, if it is long, in blocks.

Movements of the test field are detected in the residuals of a first adjustment. A second one uses
observations that are corrected for them.
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
from thermocald.photogrammetry.field.planes import field_sheets
from thermocald.photogrammetry.field.testfield import find_misplaced
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
from thermocald.photogrammetry.series.mount import drift_gaps, drift_period
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


def correct_field(
    sensor: Sensor, testfield: TestField, grid: ObservationGrid, result: SeriesAdjustment,
    camera: Array, numbers: NDArray[np.int64], time_s: Array,
) -> tuple[tuple[FieldMovement, ...], ObservationGrid]:  # fmt: skip
    """Return the movements of the test field in a series, and observations corrected for them.

    result: of a first adjustment; camera (16,): where it is linearised; numbers, time_s (E,): of
    the epochs.
    """
    if len(numbers) < FEWEST_EPOCHS:
        return (), grid
    at = linearise(sensor, testfield, camera[IOP], camera[EOP])
    # points that snooping rejects after a knock show the board's movement; single spikes do not
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


_SOME = 20_000  # epochs for the initial values
_LOOKED_AT = 60  # epochs in which misplaced targets are searched
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
    """Adjust a series together, given its epochs calibrated one by one (`apart`).

    start (16,): initial values, by default the medians of `apart`, which must then have results. A
    series too long to be adjusted at once is adjusted in blocks on `jobs` processes, and `advance`
    receives the number of epochs done.
    """
    if start is None:
        rows = np.flatnonzero(apart.ok)
        start = np.median(apart.values[rows[:: max(len(rows) // _SOME, 1)]], axis=0)
    few = spread_windows(len(source), _LOOKED_AT)
    own = np.where(apart.ok[:, None], apart.values, np.nan)[np.r_[few]]
    if not np.isfinite(own).any():  # epochs of a long series are not calibrated one by one
        own = np.tile(start, (len(own), 1))
    far = misplaced_targets(head.camera.sensor, testfield, gathered(source, few), own)
    apart = replace(apart, head=head)
    in_blocks = len(source) > together_at_most(len(testfield))
    settings = replace(
        settings,
        drift_period=drift_period(apart.frame_time, apart.temperature),
        gaps=() if in_blocks else drift_gaps(apart.frame_time),
    )
    c_px = start[0] / head.camera.sensor.pixel_pitch
    while True:  # a single pass, unless misplaced targets biased the initial values
        used = WithoutTargets(source, np.flatnonzero(far)) if far.any() else source
        grid = used if in_blocks else gathered(used)
        found = _adjust(testfield, apart, start, grid, settings, jobs, advance)
        assert found.adjustment is not None
        drawn = find_misplaced(found.adjustment.offsets, c_px)
        if not drawn.any():
            break
        far = far | drawn
    if not in_blocks:
        moved, still = correct_field(
            head.camera.sensor, testfield, gathered(grid), found.adjustment, start, apart.number,
            apart.frame_time,
        )  # fmt: skip
        if moved:
            found = _adjust(testfield, apart, start, still, settings)
            found = replace(found, field_movements=moved)
    if far.any():  # the misplaced targets count as rejected
        counts = [part.observed[:, far].sum(axis=1) for _, part in source.blocks()]
        found = replace(found, n_rejected=found.n_rejected + np.concatenate(counts))
    return found


def _adjust(
    testfield: TestField, apart: Epochs, start: Array, source: ObservationBlocks,
    settings: SeriesSettings, jobs: int = 1, advance: Callable[[int], None] | None = None,
) -> Epochs:  # fmt: skip
    """Adjust all epochs once, in a single grid or in blocks."""
    assert apart.head is not None
    sensor = apart.head.camera.sensor
    camera = (
        InteriorOrientation.from_array(start[IOP]), ExteriorOrientation.from_array(start[EOP])
    )  # fmt: skip
    whole: SeriesAdjustment | LongAdjustment
    if len(source) > together_at_most(len(testfield)):
        whole = adjust_long_series(
            sensor, testfield, source, *camera, settings, jobs=jobs, advance=advance
        )
        # only a sample of the epochs has its covariances and residuals
        sample, sampled = whole.sample, whole.sampled
    else:
        whole = sample = adjust_series(sensor, testfield, gathered(source), *camera, settings)
        sampled = None

    def without(targets: NDArray[np.int64], quick: bool) -> Epochs:
        rough, fewer = replace(settings, exterior=sample.exterior), WithoutTargets(source, targets)
        if not quick:
            return _adjust(testfield, apart, start, fewer, rough, jobs)
        rough = replace(rough, snooping_alpha=0.0, target_noise=False)
        windows, some = None, apart
        if sampled is not None:
            windows = spread_windows(len(source), len(sampled))
            some = replace(
                apart,
                **{n: getattr(apart, n)[sampled] for n in _AS_READ},
                status=tuple(apart.status[i] for i in sampled),
                reasons=tuple(apart.reasons[i] for i in sampled),
            )
        kept = gathered(fewer, windows).reject(~sample.observed)
        return _adjust(testfield, some, start, kept, rough)

    rows, groups = whole.rows, {}
    # the epoch's own reason is more specific than "no observations"
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
