"""Adjustment of a series of any length, in blocks of epochs and constant memory.

A sample of the epochs, runs of neighbours from the first to the last, is adjusted as a whole series
(`adjustment`): it says how the camera stands, how far its mount moves, what single targets are
measured to and where they are off. The blocks then follow one after the other with that known. Each
gives its epochs' own parameters, and adds to the normal equations of what is common
(`common_sums`). What these change of the common unknowns is put on the epochs by its mean where
single epochs differ by less than a twentieth of their standard deviation; else there is another
pass.

Source: Helmert blocking, Wolf, H. (1978): The Helmert block method.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import root_of
from thermocald.photogrammetry.parameters import EOP
from thermocald.photogrammetry.series.adjustment import (
    Adjusted,
    adjusted,
    epoch_variance,
    result,
)
from thermocald.photogrammetry.series.blocks import gathered, spread_windows
from thermocald.photogrammetry.series.cofactors import among_all
from thermocald.photogrammetry.series.common_sums import (
    CommonSums,
    Shared,
    Solved,
    kinds_of,
    level_of,
)
from thermocald.photogrammetry.series.covariances import (
    line_weights,
    of_correlated,
    of_priors,
    of_slow_targets,
    stillness,
)
from thermocald.photogrammetry.series.design import State
from thermocald.photogrammetry.series.estimator import ENOUGH_FOR_NOISE, SeriesEstimator
from thermocald.photogrammetry.series.long_result import LongAdjustment, RowWriter
from thermocald.photogrammetry.series.normals import (
    ObservationGrid,
    normal_matrices,
    sums_of_squares,
)
from thermocald.photogrammetry.series.status import enough_targets, judge
from thermocald.photogrammetry.series.target_noise import slow_errors

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.photogrammetry.camera.camera_model import (
        ExteriorOrientation,
        InteriorOrientation,
        Sensor,
    )
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.series.blocks import ObservationBlocks
    from thermocald.photogrammetry.series.common_sums import Alike
    from thermocald.photogrammetry.series.mount import Movement
    from thermocald.photogrammetry.series.result import SeriesAdjustment, SeriesSettings
    from thermocald.photogrammetry.series.system import SeriesSystem
    from thermocald.photogrammetry.series.target_noise import CorrelatedPairs

    Array = NDArray[np.float64]

__all__ = ["adjust_long_series", "together_at_most"]

_TOGETHER_POINTS = 1_300_000  # a day of 150 targets: 200 MB
_FEWEST_TOGETHER, _MOST_TOGETHER = 2_000, 10_000  # epochs
_PASSES = 3
_SAME = 0.05  # standard deviations that the last pass may leave an epoch without


def together_at_most(targets: int) -> int:
    """How many epochs of so many targets are adjusted at once."""
    wanted = _TOGETHER_POINTS // max(targets, 1)
    return min(max(wanted, _FEWEST_TOGETHER), _MOST_TOGETHER)


def adjust_long_series(
    sensor: Sensor,
    testfield: TestField,
    source: ObservationBlocks,
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    settings: SeriesSettings,
    together: int | None = None,
) -> LongAdjustment:
    """Adjust a series of any length, from start values good to a few per cent.

    together: epochs of the sample, by default as many as a day of 150 targets has. Never raises for
    data: an epoch without a result has a status and a reason.
    """
    windows = spread_windows(len(source), together or together_at_most(len(testfield)))
    sample = gathered(source, windows)
    lengths = [w.stop - w.start for w in windows]
    ends = np.cumsum(lengths)
    inside = tuple(slice(int(e) - n, int(e)) for e, n in zip(ends, lengths, strict=True))
    start = np.concatenate([interior.as_array(), exterior.as_array()])
    found = adjusted(sensor, testfield, sample, start, settings, inside if len(inside) > 1 else ())
    rows = np.concatenate([np.arange(w.start, w.stop) for w in windows])
    whole = result(found)
    return _Blocks.of(found, whole, len(source)).adjust(source, whole, rows)


@dataclass(frozen=True, eq=False)
class _Blocks:
    """What the sample says, as the blocks use it.

    shared: of the common unknowns; unit: variance of unit weight; excess (16,), slow (16, 16): what
    the sample's scatter adds to covariances; ratios (T, 3): by what weights are multiplied; middle
    (16,): where epochs start; pairs, movement: errors that targets share, and the mount's.
    """

    found: Adjusted
    epochs: int
    shared: Shared
    unit: float
    excess: Array
    slow: Array
    ratios: Array
    middle: Array
    pairs: CorrelatedPairs | None
    movement: Movement

    @classmethod
    def of(cls, found: Adjusted, sample: SeriesAdjustment, epochs: int) -> _Blocks:
        """What a sample of a series of so many epochs says."""
        series, estimate = found.series, found.estimate
        system = estimate.system
        sums = CommonSums(series.design(system.design.at, series.variance(estimate)))
        sums.add(0, system, estimate.residuals, np.zeros((len(found.use), len(system.design.own))))
        known = Shared(estimate.offsets, estimate.pose, system.Q_common, np.zeros((0, 0)))
        known = replace(known, mean=sums.solved(known).shared.mean)
        slow, pairs = np.zeros((16, 16)), None
        if series.s.target_noise and len(found.use) >= ENOUGH_FOR_NOISE:
            pairs = series.pairs(estimate, found.use)
            slow = of_slow_targets(
                system, slow_errors(estimate.residuals, found.use), series.testfield.groups
            )
        good = sample.ok
        middle = np.median(sample.values[good] if good.any() else estimate.values, axis=0)
        if len(series.s.common):
            middle[EOP] = estimate.pose
        return cls(
            found, epochs, known,
            series.variance(estimate), sample.excess_sd**2, slow, _ratios(series), middle,
            pairs if pairs is not None and len(pairs) else None, sample.movement,
        )  # fmt: skip

    def adjust(
        self, source: ObservationBlocks, sample: SeriesAdjustment, sampled: NDArray[np.int64]
    ) -> LongAdjustment:
        """All blocks, in as many passes as it takes."""
        out, blocks = RowWriter(self.epochs), self
        for turn in range(1, _PASSES + 1):
            sums = blocks.walk(source, out)
            solved = sums.solved(blocks.shared)
            if solved.rest <= _SAME or turn == _PASSES:
                break
            blocks = replace(blocks, shared=solved.shared)
        return blocks.finished(solved, out, sample, sampled, turn)

    def walk(self, source: ObservationBlocks, out: RowWriter) -> CommonSums:
        """One pass: every block's epochs into `out`, and the sums."""
        series, at = self.found.series, self.found.estimate.system.design.at
        sums = CommonSums(series.design(at, self.unit))
        for first, grid in source.blocks():
            self._block(first, grid, sums, out)
            out.release()
        return sums

    def _block(self, first: int, grid: ObservationGrid, sums: CommonSums, out: RowWriter) -> None:
        series, at = self.found.series, self.found.estimate.system.design.at
        s = series.s
        weighted = ObservationGrid(grid.points, grid.weights * self.ratios)
        held = replace(
            series, grid=weighted, stated=grid.weights, held=at, unit=self.unit, windows=(),
            typical=self.unit,
        )  # fmt: skip
        values = np.tile(self.middle, (len(grid), 1))
        start = State(values, self.shared.offsets, self.shared.pose)
        use = grid.observed & enough_targets(grid, s)[:, None]
        held, estimate, use = held.adjusted(start, use)
        system, values, residuals = estimate.system, estimate.values, estimate.residuals
        kinds = kinds_of(sums.design, system)
        sums.add(first, system, residuals, system.own_gradient(residuals, estimate))
        vPv, redundancy = held.sums(estimate)
        redundancy = redundancy - sums.design.width / self.epochs
        positive = redundancy > 0
        unit = vPv / np.where(positive, redundancy, 1.0)
        relative = self._covariance(first, system, kinds, unit, redundancy)
        status, reasons = judge(
            series.sensor, series.testfield, grid, s, values, use, system.good, relative,
            unit / self.unit, redundancy,
        )  # fmt: skip
        ok = out.put(first, values, relative, status, reasons)
        here = slice(first, first + len(grid))
        stated = sums_of_squares(grid.weights, residuals, system.use)
        noise = np.sqrt(stated / np.where(positive, redundancy, np.nan))
        out.sigma0[here] = np.where(ok, noise, np.nan)
        out.redundancy[here] = redundancy
        out.observed[here], out.rejected[here] = use.sum(axis=1), (grid.observed & ~use).sum(axis=1)
        if s.exterior == "series":
            score = stillness(replace(system, N=normal_matrices(system.used(), at.A)), residuals)
            out.stillness[here] = score / np.where(positive, unit, 1.0)

    def _covariance(
        self, first: int, system: SeriesSystem, kinds: list[Alike], unit: Array, redundancy: Array
    ) -> Array:
        """Covariances (n, 16, 16) of a block's epochs relative to the series."""
        s, own = self.found.series.s, system.design.own
        n = len(system.Q)
        mine = system.Q.copy()
        for kind in kinds:
            away = kind.G - self.shared.mean
            mine[kind.rows] += away @ self.shared.cofactors @ away.T
        if s.scale == "posterior":
            # What priors contribute is known as well as they are, not as the epoch.
            bound = of_priors(system) if system.design.own_prior.any() else 0.0
            mine -= bound
            mine *= epoch_variance(unit, redundancy, self.unit)[:, None, None]
            mine += self.unit * bound
        whole = np.ix_(own, own)
        for kind in kinds:
            if s.exterior == "series" and self.movement.covariance.any():
                G = kind.G[:, :6]
                mine[kind.rows] += G @ self.movement.covariance @ G.T
            if self.pairs is not None:
                mine[kind.rows] += of_correlated(kind.system, self.pairs)[0][whole]
        mine += np.diag(self.excess[own])
        # Slow errors: a line through zero in the middle of the series, uncertain at its ends.
        if self.slow.any():
            line = (first + np.arange(n)) / max(self.epochs - 1, 1) - 0.5
            mine += line[:, None, None] ** 2 * self.slow[whole]
        mine[~system.good] = 0.0
        return among_all(mine, own)

    def finished(
        self, solved: Solved, out: RowWriter, sample: SeriesAdjustment,
        sampled: NDArray[np.int64], passes: int,
    ) -> LongAdjustment:  # fmt: skip
        """The last change of the common unknowns on all epochs, and what is of the whole series."""
        series, shared = self.found.series, solved.shared
        design = series.design(self.found.estimate.system.design.at, self.unit)
        own, common = design.own, design.common
        level = level_of(shared, design) * self.unit
        total = np.zeros(16)
        total[own] += solved.own
        total[common] += (shared.pose - self.shared.pose)[: len(common)]
        moved = np.flatnonzero(total)
        out.shift(moved, total[moved])
        out.widen(common, np.diag(level)[common])
        trend = np.zeros((16, 16))
        if len(shared.cofactors):
            tilt = solved.line @ root_of(shared.cofactors)
            trend[own[:, None], own] = tilt @ tilt.T * self.unit
        trend += self.slow
        if self.movement.covariance.any() and len(common):
            G = shared.mean[:, :6]
            swayed = G @ self.movement.tilt(line_weights(out.ok)) @ G.T
            trend[own[:, None], own] += swayed
        return LongAdjustment(
            out, np.sqrt(np.clip(np.diag(level), 0.0, None)), np.sqrt(np.diag(trend)), sample,
            sampled, passes,
        )  # fmt: skip


def _ratios(series: SeriesEstimator) -> Array:
    """By what the weights of each target (T, 3) are multiplied, from its own noise."""
    seen = series.stated[..., 0] > 0
    ratios = np.ones((seen.shape[1], 3))
    for k in (0, 1):
        ratio = series.grid.weights[..., k] / np.where(seen, series.stated[..., k], 1.0)
        ratio = np.where(seen, ratio, 0.0).max(axis=0)
        ratios[:, k] = np.where(ratio > 0, ratio, 1.0)
    ratios[:, 2] = np.sqrt(ratios[:, 0] * ratios[:, 1])
    return ratios
