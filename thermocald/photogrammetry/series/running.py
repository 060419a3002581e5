"""A series that goes on: every epoch adjusted with what all epochs so far have in common.

The epochs are a long series (`long_series`) whose sample is the last of them and whose blocks are
single epochs. The first 40 epochs are adjusted together again and again; from then on the sums
carry the common unknowns, and the last epochs say how far the mount moves and what targets are
measured to. An epoch costs the same and the memory stays the same however long the series is.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.series.adjustment import adjusted, result
from thermocald.photogrammetry.series.common_sums import level_of
from thermocald.photogrammetry.series.known import KnownSeries
from thermocald.photogrammetry.series.mount import FEWEST_EPOCHS
from thermocald.photogrammetry.series.normals import ObservationGrid

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array, Mask
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.photogrammetry.series.common_sums import CommonSums
    from thermocald.photogrammetry.series.result import SeriesSettings


__all__ = ["RunningEpoch", "RunningSeries"]

_WINDOW = 240  # epochs that are kept: they show how far the mount moves
_WINDOW_POINTS = 60_000  # image points of them: 2.4 MB
_AGAIN = 40  # epochs until which all are adjusted together again
_SOLVED_AFTER = 0.05  # share of new epochs from which the common unknowns are solved for again


@dataclass(frozen=True, eq=False)
class RunningEpoch:
    """An epoch of a running series.

    status, reason: as of an `Adjustment`; values (16,); covariance (16, 16), with what all epochs
    have in common; sigma0; redundancy; rejected (T,): targets that contradict; residuals (T, 2) px.
    """

    status: str
    reason: str
    values: Array
    covariance: Array
    sigma0: float
    redundancy: int
    rejected: Mask
    residuals: Array


class RunningSeries:
    """The epochs of one series as they come.

    epochs: how many were taken in. `mount` and `auto` are the same here: where no movement is found
    the mount is held; before 20 epochs every one has its own exterior orientation.
    """

    def __init__(self, sensor: Sensor, testfield: TestField, settings: SeriesSettings) -> None:
        self.epochs = 0
        self._sensor = sensor
        self._field = testfield
        self._settings = settings
        size = min(_WINDOW, max(_WINDOW_POINTS // max(len(testfield), 1), FEWEST_EPOCHS))
        self._recent: deque[ObservationGrid] = deque(maxlen=size)
        self._look_at = 1
        self._solved = 0
        self._known: KnownSeries | None = None
        self._sums: CommonSums | None = None

    def add(
        self, observations: Observations, values: Array, rejected: Sequence[int] = ()
    ) -> RunningEpoch:
        """Take an epoch in, and adjust it.

        values (16,): where the first one starts; rejected: targets that the epoch's own adjustment
        found to be wrong, which stay so.
        """
        grid = ObservationGrid.from_observations(self._field, [observations])
        observed = grid.observed[0]
        grid.weights[0, list(rejected)] = 0.0
        self._recent.append(grid)
        self.epochs += 1
        known, sums, counted = self._current(values)
        block = known.adjusted(grid, max(sums.epochs, 1))
        if not counted:
            estimate = block.estimate
            sums.add(self.epochs - 1, estimate.system, estimate.residuals, block.right)
        self._known, self._sums = known, sums
        if sums.epochs > (1 + _SOLVED_AFTER) * self._solved:
            shared = sums.solved(known.shared).shared
            sums.settle(shared)
            self._known, self._solved = replace(known, shared=shared), sums.epochs
        covariance = known.covariance(block, None)
        for kind in block.kinds:
            covariance += known.unit * level_of(known.shared, known.design, kind.G)
        status, reasons = known.judged(block, covariance)
        return RunningEpoch(
            status[0], reasons[0], block.estimate.values[0], covariance[0], float(block.sigma0[0]),
            int(block.redundancy[0]), observed & ~block.use[0], block.estimate.residuals[0],
        )  # fmt: skip

    def pose(self) -> tuple[Array, Array] | None:
        """The common exterior orientation (6,), and the covariance (6, 6) of an epoch's about it;
        None where the epochs have none in common.
        """
        known = self._known
        if known is None or not len(known.design.common):
            return None
        covariance = known.shared.cofactors[:6, :6] * known.unit + known.movement.covariance
        return known.shared.pose, covariance

    def _current(self, values: Array) -> tuple[KnownSeries, CommonSums, bool]:
        """What is known, the sums, and whether they hold the last epoch already."""
        before, sums = self._known, self._sums
        if before is None or sums is None:
            return *self._look(values, None), True
        if self.epochs < self._look_at:
            return before, sums, False
        if self.epochs <= min(_AGAIN, len(self._recent)):
            return *self._look(before.middle, None), True
        # What earlier epochs say of the common unknowns is in the sums, at their linearisation.
        known, _ = self._look(before.middle, before)
        estimator = replace(known.estimator, held=before.design.at, s=before.s)
        sums.design = estimator.design(before.design.at, known.unit)
        known = replace(known, estimator=estimator, design=sums.design, shared=before.shared)
        return known, sums, False

    def _look(self, values: Array, before: KnownSeries | None) -> tuple[KnownSeries, CommonSums]:
        """Adjust the epochs that are kept together, and set when to do so again.

        before: what is known of the targets' offsets, None to estimate them.
        """
        few = self.epochs < FEWEST_EPOCHS
        again = min(2 * self.epochs, self.epochs + _WINDOW)
        self._look_at = min(again, FEWEST_EPOCHS) if few else again
        s = self._settings
        if s.exterior in ("mount", "auto"):
            s = replace(s, exterior="per_epoch" if few else "mount")
        points = np.concatenate([g.points for g in self._recent])
        if before is not None:
            s, points = replace(s, target_offsets=False), points - before.shared.offsets
        grid = ObservationGrid(points, np.concatenate([g.weights for g in self._recent]))
        found = adjusted(self._sensor, self._field, grid, values, s)
        known, sums = KnownSeries.of(found, result(found))
        self._solved = sums.epochs if before is None else self._solved
        return known, sums
