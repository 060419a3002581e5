"""The test field of a series as if it had stood still: boards put back, wandering targets left out.

The movements are looked for in the residuals of a first adjustment of the series, which a second
one does without.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP, IOP
from thermocald.photogrammetry.field.planes import field_sheets
from thermocald.photogrammetry.series.field_motion import (
    FEWEST_EPOCHS,
    FieldMovement,
    FieldSeries,
    board_movements,
    put_back,
    wandering_targets,
)
from thermocald.photogrammetry.series.normals import ObservationGrid, linearise
from thermocald.thermal.reduce import find_spikes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.series.result import SeriesAdjustment

__all__ = ["still_field"]


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
    boards = board_movements(series)
    for m in boards:
        series = put_back(series, m)
    single = wandering_targets(series)
    if not boards and not single:
        return (), grid
    points = np.array(grid.points)
    for m in boards:
        points[:, m.rows] -= m.trajectory[:, None, None] * m.image
    wandering = np.zeros(grid.observed.shape, dtype=bool)
    for m in single:
        wandering[:, m.rows] = True
    still = ObservationGrid(points, grid.weights)
    return (*boards, *single), still.reject(wandering) if single else still
