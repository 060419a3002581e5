"""Adjustment of a series of any length, in blocks of epochs and constant memory.

A sample of the epochs, runs of neighbours from the first to the last, is adjusted as a whole series
(`adjustment`). The blocks then follow one after the other with what it says (`known`). Each gives
its epochs' own parameters, and adds to the normal equations of what is common (`CommonSums`). What
these change of the common unknowns is put on the epochs by its mean where single epochs differ by
less than a twentieth of their standard deviation; else there is another pass.

A block needs nothing of the others, so that blocks may be adjusted on several processes. The result
is one row per epoch on disk, and a sample in full.

Source: Helmert blocking, Wolf, H. (1978): The Helmert block method.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.parallel import in_order
from thermocald.photogrammetry.linalg import root_of
from thermocald.photogrammetry.series.adjustment import Adjusted, adjusted, result
from thermocald.photogrammetry.series.blocks import (
    ColumnSpool,
    ObservationBlocks,
    gathered,
    give_back,
    spread_windows,
)
from thermocald.photogrammetry.series.covariances import line_weights, of_slow_targets, stillness
from thermocald.photogrammetry.series.estimator import ENOUGH_FOR_NOISE
from thermocald.photogrammetry.series.known import (
    AdjustedBlock,
    CommonSums,
    KnownSeries,
    Solved,
    level_of,
)
from thermocald.photogrammetry.series.normals import ObservationGrid, normal_matrices
from thermocald.photogrammetry.series.target_noise import slow_errors

if TYPE_CHECKING:
    from thermocald.arrays import Array, Index
    from thermocald.photogrammetry.camera.camera_model import (
        ExteriorOrientation,
        InteriorOrientation,
        Sensor,
    )
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.series.result import SeriesAdjustment, SeriesSettings


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


@dataclass(frozen=True, eq=False)
class LongAdjustment:
    """A long series as adjusted; parameters in the order of `PARAMETER_NAMES`.

    rows: the epochs one by one; level_sd, trend_sd (16,), as in `SeriesAdjustment`; sample: some
    epochs, those of `sampled` (P,), as adjusted together: their covariances, residuals and offsets;
    passes: how often the observations were read.
    """

    rows: RowWriter
    level_sd: Array
    trend_sd: Array
    sample: SeriesAdjustment
    sampled: Index
    passes: int


class RowWriter:
    """The rows of a long series.

    values, sd (E, 16): NaN where an epoch has no result or a parameter was held, on disk (`release`
    takes what was used of them out of memory); sigma0, redundancy, stillness (E,); observed,
    rejected (E,): how many targets; ok (E,): epochs with a result; status, reasons: E words and
    sentences, "" where it has one.
    """

    def __init__(self, epochs: int) -> None:
        self._spools = ColumnSpool(epochs, 16), ColumnSpool(epochs, 16)
        self.values, self.sd = (spool.array for spool in self._spools)
        self.sigma0, self.redundancy, self.stillness = np.full((3, epochs), np.nan)
        self.observed, self.rejected = np.zeros((2, epochs), dtype=np.int32)
        self.ok = np.zeros(epochs, dtype=bool)
        self.status, self.reasons = [""] * epochs, [""] * epochs

    def put(self, block: Block) -> None:
        """The epochs of a block."""
        here = slice(block.first, block.first + len(block.values))
        self.values[here] = block.values
        self.sd[here] = np.sqrt(np.where(block.variance > 0, block.variance, np.nan))
        self.ok[here] = [word == "ok" for word in block.status]
        # each text once, however many epochs have it
        self.status[here] = map(sys.intern, block.status)
        self.reasons[here] = map(sys.intern, block.reasons)
        self.sigma0[here], self.redundancy[here] = block.sigma0, block.redundancy
        self.stillness[here] = block.stillness
        self.observed[here], self.rejected[here] = block.observed, block.rejected

    def shift(self, columns: Index, change: Array) -> None:
        """Add a change (k,) to some parameters of all epochs."""
        for column, size in zip(columns, change, strict=True):
            self.values[:, column] += size
            self.release()

    def widen(self, columns: Index, variance: Array) -> None:
        """Add variances (k,) to some parameters of all epochs with a result."""
        for column, size in zip(columns, variance, strict=True):
            old = np.nan_to_num(self.sd[:, column])
            self.sd[:, column] = np.where(self.ok, np.sqrt(old**2 + size), np.nan)
            self.release()

    def release(self) -> None:
        """Take the values on disk out of memory."""
        for spool in self._spools:
            spool.release()


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
    jobs: int = 1,
) -> LongAdjustment:
    """Adjust a series of any length, from start values good to a few per cent.

    together: epochs of the sample, by default as many as a day of 150 targets has; jobs: processes
    that adjust blocks, with the same bits for any number. Never raises for data: an epoch without a
    result has a status and a reason.
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
    blocks, out = _known(found, whole, len(source)), RowWriter(len(source))
    for turn in range(1, _PASSES + 1):
        solved = _walk(blocks, source, out, jobs).solved(blocks.known.shared)
        if solved.rest <= _SAME or turn == _PASSES:
            break
        blocks = replace(blocks, known=replace(blocks.known, shared=solved.shared))
    give_back()
    return _finished(blocks, solved, out, whole, rows, turn)


def _known(found: Adjusted, sample: SeriesAdjustment, epochs: int) -> Blocks:
    """What a sample of a series of so many epochs says."""
    series, estimate, slow = found.series, found.estimate, np.zeros((16, 16))
    if series.s.target_noise and len(found.use) >= ENOUGH_FOR_NOISE:
        errors = slow_errors(estimate.residuals, found.use)
        slow = of_slow_targets(estimate.system, errors, series.testfield.groups)
    return Blocks(KnownSeries.of(found, sample)[0], epochs, slow)


def _walk(blocks: Blocks, source: ObservationBlocks, out: RowWriter, jobs: int) -> CommonSums:
    """One pass: every block's epochs into `out`, and the sums."""
    sums = CommonSums(blocks.known.design)
    for block in in_order(adjusted_block, blocks, source.blocks(), jobs):
        out.put(block)
        sums.merge(block.sums)
        out.release()
    return sums


def _finished(
    blocks: Blocks, solved: Solved, out: RowWriter, sample: SeriesAdjustment,
    sampled: Index, passes: int,
) -> LongAdjustment:  # fmt: skip
    """The last change of the common unknowns on all epochs, and what is of the whole series."""
    known, shared, design = blocks.known, solved.shared, blocks.known.design
    own, common = design.own, design.common
    level = level_of(shared, design, shared.mean) * known.unit
    total = np.zeros(16)
    total[own] += solved.own
    total[common] += (shared.pose - known.shared.pose)[: len(common)]
    moved = np.flatnonzero(total)
    out.shift(moved, total[moved])
    out.widen(common, np.diag(level)[common])
    trend = np.zeros((16, 16))
    if len(shared.cofactors):
        tilt = solved.line @ root_of(shared.cofactors)
        trend[own[:, None], own] = tilt @ tilt.T * known.unit
    trend += blocks.slow
    if known.movement.covariance.any() and len(common):
        G = shared.mean[:, :6]
        swayed = G @ known.movement.tilt(line_weights(out.ok)) @ G.T
        trend[own[:, None], own] += swayed
    return LongAdjustment(
        out, np.sqrt(np.clip(np.diag(level), 0.0, None)), np.sqrt(np.diag(trend)), sample,
        sampled, passes,
    )  # fmt: skip
