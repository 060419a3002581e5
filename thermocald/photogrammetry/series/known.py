"""What is known of a series, and epochs adjusted with it: in blocks, or one by one as they come.

Some epochs of the series are adjusted together (`adjustment`): they say how the camera stands, how
far its mount moves, what single targets are measured to and where they are off. Any other epoch is
then adjusted with that known, and adds to the sums of what all have in common (`common_sums`).

Source: Helmert blocking, Wolf, H. (1978): The Helmert block method.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP
from thermocald.photogrammetry.series.adjustment import epoch_variance
from thermocald.photogrammetry.series.cofactors import among_all
from thermocald.photogrammetry.series.common_sums import CommonSums, Shared, kinds_of
from thermocald.photogrammetry.series.covariances import of_correlated, of_priors
from thermocald.photogrammetry.series.design import State
from thermocald.photogrammetry.series.estimator import ENOUGH_FOR_NOISE
from thermocald.photogrammetry.series.normals import ObservationGrid, planes, sums_of_squares
from thermocald.photogrammetry.series.status import enough_targets, judge

if TYPE_CHECKING:
    from thermocald.arrays import Array, Mask
    from thermocald.photogrammetry.series.adjustment import Adjusted
    from thermocald.photogrammetry.series.common_sums import Alike
    from thermocald.photogrammetry.series.design import Design
    from thermocald.photogrammetry.series.estimator import Estimate, SeriesEstimator
    from thermocald.photogrammetry.series.movement import Movement
    from thermocald.photogrammetry.series.result import SeriesAdjustment, SeriesSettings
    from thermocald.photogrammetry.series.target_noise import CorrelatedPairs


__all__ = ["AdjustedBlock", "KnownSeries"]


@dataclass(frozen=True, eq=False)
class AdjustedBlock:
    """Epochs adjusted with what is known of their series.

    use (E, T): which points took part; kinds: the epochs by what they see; unit, redundancy,
    sigma0 (E,): variance of unit weight by the weights in use, its degrees of freedom, and the
    noise against the stated sigmas.
    """

    grid: ObservationGrid
    estimate: Estimate
    use: Mask
    kinds: list[Alike]
    unit: Array
    redundancy: Array
    sigma0: Array

    @property
    def right(self) -> Array:
        """Gradient (E, p) of the own parameters, about 0."""
        return self.estimate.system.own_gradient(self.estimate.residuals, self.estimate)


@dataclass(frozen=True, eq=False)
class KnownSeries:
    """What epochs adjusted together say of their series.

    estimator: as it adjusts further epochs, the common unknowns held; design: the unknowns of the
    series; shared: the common ones; excess (16,): variance by which epochs scatter beyond theirs;
    ratios (T, 3): by what weights are multiplied; middle (16,): where epochs start; pairs,
    movement: errors that targets share, and the mount's.
    """

    estimator: SeriesEstimator
    design: Design
    shared: Shared
    excess: Array
    ratios: Array
    middle: Array
    pairs: CorrelatedPairs | None
    movement: Movement

    @classmethod
    def of(cls, found: Adjusted, sample: SeriesAdjustment) -> tuple[KnownSeries, CommonSums]:
        """What adjusted epochs say of a series, and their sums."""
        series, estimate = found.series, found.estimate
        system, unit = estimate.system, series.variance(estimate)
        at = system.design.at
        design = series.design(at, unit)
        sums = CommonSums(design)
        sums.add(0, system, estimate.residuals, np.zeros((len(found.use), len(design.own))))
        shared = Shared(
            estimate.offsets, estimate.pose, system.Q_common, np.zeros((0, 0)),
            system.common_share(),
        )  # fmt: skip
        shared = replace(shared, mean=sums.solved(shared).shared.mean)
        pairs = None
        if series.s.target_noise and len(found.use) >= ENOUGH_FOR_NOISE:
            pairs = series.pairs(estimate, found.use)
        good = sample.ok
        middle = np.median(sample.values[good] if good.any() else estimate.values, axis=0)
        T = series.grid.points.shape[1]
        none = ObservationGrid(planes(2, 0, T), planes(3, 0, T))
        held = replace(
            series, grid=none, stated=none.weights, held=at, unit=unit, windows=(), typical=unit
        )
        known = cls(
            held, design, shared, sample.excess_sd**2, _ratios(series), middle,
            pairs if pairs is not None and len(pairs) else None, sample.movement,
        )  # fmt: skip
        return known, sums

    @property
    def s(self) -> SeriesSettings:
        """How the series is adjusted."""
        return self.estimator.s

    @property
    def unit(self) -> float:
        """Variance of unit weight."""
        return self.estimator.unit

    def adjusted(self, grid: ObservationGrid, epochs: int) -> AdjustedBlock:
        """Adjust epochs; epochs: how many there are, which the common unknowns rest on."""
        s, shared = self.s, self.shared
        weighted = ObservationGrid(grid.points, grid.weights * self.ratios)
        values = np.tile(self.middle, (len(grid), 1))
        if len(self.design.common):
            values[:, EOP] = shared.pose
        held, estimate, use = replace(self.estimator, grid=weighted, stated=grid.weights).adjusted(
            State(values, shared.offsets, shared.pose),
            grid.observed & enough_targets(grid, s)[:, None],
        )
        vPv, redundancy = held.sums(estimate)
        redundancy = redundancy - shared.used / epochs
        positive = redundancy > 0
        stated = sums_of_squares(grid.weights, estimate.residuals, estimate.system.use)
        return AdjustedBlock(
            grid, estimate, use, kinds_of(self.design, estimate.system),
            vPv / np.where(positive, redundancy, 1.0), redundancy,
            np.sqrt(stated / np.where(positive, redundancy, np.nan)),
        )  # fmt: skip

    def covariance(self, block: AdjustedBlock, mean: Array | None) -> Array:
        """Covariances (E, 16, 16) of a block's epochs without what all epochs have in common.

        mean (p, q + 2T): by how much own parameters follow the common unknowns in all epochs; None
        counts the epoch's own part of that in what is common too.
        """
        s, own, system = self.s, self.design.own, block.estimate.system
        mine = system.Q.copy()
        if mean is not None:
            for kind in block.kinds:
                away = kind.G - mean
                mine[kind.rows] += away @ self.shared.cofactors @ away.T
        if s.scale == "posterior":
            # What priors contribute is known as well as they are, not as the epoch.
            bound = of_priors(system) if system.design.own_prior.any() else 0.0
            mine -= bound
            mine *= epoch_variance(block.unit, block.redundancy, self.unit)[:, None, None]
            mine += self.unit * bound
        for kind in block.kinds:
            if s.exterior == "series" and self.movement.covariance.any():
                G = kind.G[:, :6]
                mine[kind.rows] += G @ self.movement.covariance @ G.T
            if self.pairs is not None:
                mine[kind.rows] += of_correlated(kind.system, self.pairs)[0][np.ix_(own, own)]
        mine += np.diag(self.excess[own])
        mine[~system.good] = 0.0
        return among_all(mine, own)

    def judged(self, block: AdjustedBlock, covariance: Array) -> tuple[list[str], list[str]]:
        """Status and reason of a block's epochs with covariances (E, 16, 16)."""
        return judge(
            self.estimator.sensor, self.estimator.testfield, block.grid, self.s,
            block.estimate.values, block.use, block.estimate.system.good, covariance,
            block.unit / self.unit, block.redundancy,
        )  # fmt: skip


def _ratios(series: SeriesEstimator) -> Array:
    """By what the weights of each target (T, 3) are multiplied, from its own noise."""
    seen = series.stated[..., 0] > 0
    ratios = np.ones((seen.shape[1], 3))
    for k in (0, 1):
        ratio = series.grid.weights[..., k] / np.where(seen, series.stated[..., k], 1.0)
        ratio = np.where(seen, ratio, 0.0).max(axis=0, initial=0.0)
        ratios[:, k] = np.where(ratio > 0, ratio, 1.0)
    ratios[:, 2] = np.sqrt(ratios[:, 0] * ratios[:, 1])
    return ratios
