"""Adjustment of a series of any length, in blocks of epochs and constant memory.

A sample of the epochs, runs of neighbours from the first to the last, is adjusted as a whole series
(`adjustment`). The blocks then follow one after the other with what it says (`known`). Each gives
its epochs' own parameters, and adds to the normal equations of what is common (`common_sums`). What
these change of the common unknowns is put on the epochs by its mean where single epochs differ by
less than a twentieth of their standard deviation; else there is another pass.

Source: Helmert blocking, Wolf, H. (1978): The Helmert block method.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.parallel import in_order
from thermocald.photogrammetry.linalg import root_of
from thermocald.photogrammetry.series.adjustment import adjusted, result
from thermocald.photogrammetry.series.block import Blocks, adjusted_block
from thermocald.photogrammetry.series.blocks import gathered, spread_windows
from thermocald.photogrammetry.series.common_sums import CommonSums, level_of
from thermocald.photogrammetry.series.covariances import line_weights, of_slow_targets
from thermocald.photogrammetry.series.estimator import ENOUGH_FOR_NOISE
from thermocald.photogrammetry.series.known import KnownSeries
from thermocald.photogrammetry.series.long_result import LongAdjustment, RowWriter
from thermocald.photogrammetry.series.spool import give_back
from thermocald.photogrammetry.series.target_noise import slow_errors

if TYPE_CHECKING:
    from thermocald.arrays import Index
    from thermocald.photogrammetry.camera.camera_model import (
        ExteriorOrientation,
        InteriorOrientation,
        Sensor,
    )
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.series.adjustment import Adjusted
    from thermocald.photogrammetry.series.blocks import ObservationBlocks
    from thermocald.photogrammetry.series.common_sums import Solved
    from thermocald.photogrammetry.series.result import SeriesAdjustment, SeriesSettings


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
