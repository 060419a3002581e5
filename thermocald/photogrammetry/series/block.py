"""One block of a long series adjusted, as its rows and what it adds to the sums of the series.

A block needs nothing of the others, so that blocks may be adjusted on several processes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.series.common_sums import CommonSums
from thermocald.photogrammetry.series.covariances import stillness
from thermocald.photogrammetry.series.normals import ObservationGrid, normal_matrices

if TYPE_CHECKING:
    from thermocald.arrays import Array, Index
    from thermocald.photogrammetry.series.known import AdjustedBlock, KnownSeries

__all__ = ["Block", "Blocks", "adjusted_block"]


@dataclass(frozen=True, eq=False)
class Block:
    """Consecutive epochs of a long series from epoch `first` on, as adjusted.

    values, variance (n, 16): NaN and 0 where there is no result; status, reasons: of each epoch;
    sigma0, redundancy, stillness (n,): NaN where there is none; observed, rejected (n,): how many
    targets; sums: what the block adds to those of the series.
    """

    first: int
    values: Array
    variance: Array
    status: list[str]
    reasons: list[str]
    sigma0: Array
    redundancy: Array
    stillness: Array
    observed: Index
    rejected: Index
    sums: CommonSums


@dataclass(frozen=True, eq=False)
class Blocks:
    """What adjusts the blocks of a series of so many epochs: known, and slow (16, 16), covariance
    of a straight line over the series from slow errors of targets.
    """

    known: KnownSeries
    epochs: int
    slow: Array

    def adjusted(self, first: int, grid: ObservationGrid) -> Block:
        """The block of epochs from `first` on."""
        known = self.known
        block = known.adjusted(grid, self.epochs)
        estimate, use, system = block.estimate, block.use, block.estimate.system
        sums = CommonSums(known.design)
        sums.add(first, system, estimate.residuals, block.right)
        relative = known.covariance(block, known.shared.mean)
        # Slow errors: a line through zero in the middle of the series, uncertain at its ends.
        if self.slow.any():
            line = (first + np.arange(len(grid))) / max(self.epochs - 1, 1) - 0.5
            relative += (line * system.good)[:, None, None] ** 2 * self.slow
        status, reasons = known.judged(block, relative)
        ok = np.array([word == "ok" for word in status], dtype=bool)
        return Block(
            first, np.where(ok[:, None], estimate.values, np.nan),
            np.where(ok[:, None], np.diagonal(relative, axis1=1, axis2=2), 0.0), status, reasons,
            np.where(ok, block.sigma0, np.nan), block.redundancy, self._stillness(block),
            use.sum(axis=1), (grid.observed & ~use).sum(axis=1), sums,
        )  # fmt: skip

    def _stillness(self, block: AdjustedBlock) -> Array:
        """Chi-square (n,) of each epoch's pose being the series', NaN where epochs have poses."""
        if self.known.s.exterior != "series":
            return np.full(len(block.grid), np.nan)
        system = block.estimate.system
        N = normal_matrices(system.used(), system.design.at.A)
        score = stillness(replace(system, N=N), block.estimate.residuals)
        still: Array = score / np.where(block.redundancy > 0, block.unit, 1.0)
        return still


def adjusted_block(blocks: Blocks, block: tuple[int, ObservationGrid]) -> Block:
    """A block from its first epoch and its observations, for `parallel.in_order`."""
    return blocks.adjusted(*block)
