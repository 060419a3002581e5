"""Adjustment of a series of any length, in blocks of epochs or epoch by epoch.

A sample of the epochs, evenly spread runs of neighbours, is adjusted as a whole series
(`adjustment`). It gives the camera's pose, the mount's movement, and the noise and offsets of the
targets. With these held (`KnownSeries`) all epochs are adjusted, in blocks or one by one. A block
gives its epochs' own parameters, and contributes to the sums of the common unknowns (`CommonSums`)
its normal equations with its own parameters reduced. At the epochs' solution the reduced right-hand
side is the plain gradient, which is summed epoch by epoch. The matrix is that of the mean weights
of all epochs that see the same targets: it differs from the sum by the square of the weights'
variation, and costs one reduction per kind of epoch. The sums correct the common unknowns. The mean
effect is added to the epochs if single epochs differ from it by less than a twentieth of their
standard deviation; otherwise there is another pass.

Blocks are independent, so that several processes can adjust them. The result is one row per epoch,
and the sample in full.

Source: Helmert blocking, Wolf, H. (1978): The Helmert block method.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from thermocald.parallel import in_order
from thermocald.photogrammetry.camera.camera_model import EOP
from thermocald.photogrammetry.linalg import inverse_of_determined, root_of
from thermocald.photogrammetry.series.adjustment import (
    adjusted,
    epoch_variance,
    judge_epochs,
    result,
)
from thermocald.photogrammetry.series.covariances import (
    correlated_error_cofactors,
    level_errors,
    line_weights,
    scaled_covariances,
    with_excess,
)
from thermocald.photogrammetry.series.normals import (
    ObservationBlocks,
    ObservationGrid,
    among_all,
    gathered,
    spread_windows,
)
from thermocald.photogrammetry.series.result import (
    EpochRows,
    SeriesAdjustment,
    SeriesSettings,
    enough_targets,
)
from thermocald.photogrammetry.series.system import Design, SeriesSystem, State

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.camera.camera_model import (
        ExteriorOrientation,
        InteriorOrientation,
        Sensor,
    )
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.series.estimator import Estimate, SeriesEstimator
    from thermocald.photogrammetry.series.mount import Movement
    from thermocald.photogrammetry.series.target_noise import CorrelatedPairs


_FEW = 0.02  # share of a block's epochs from which a kind gets its own matrix
_MOST = 12  # kinds of epochs in a block
_MOST_PATTERNS = 300  # of targets seen, over the series; epochs with others are summed together


@dataclass(eq=False)
class CommonSums:
    """Sums over blocks for the common unknowns.

    design: the unknowns; gradient (q + 2T,); ends: the first and the last epoch; patterns: for the
    epochs that see the same targets, one after the other: their count, the sums of their numbers
    and of the squares of these, of the gradients (p,) of their own parameters, and of their weights
    (T, 3).
    """

    design: Design
    gradient: Array | float = 0.0
    ends: tuple[int, int] | None = None
    patterns: dict[bytes, Array] = field(default_factory=dict)

    def add(self, first: int, system: SeriesSystem, left: Array, right: Array) -> None:
        """Add a block that begins at epoch `first`.

        system: of the block, with the common unknowns held; left (E, T, 2) px: residuals; right
        (E, p): gradient of the own parameters, 0 at their solution.
        """
        good = np.flatnonzero(system.good)
        if not len(good) or not self.design.width:
            return
        t = (first + good).astype(np.float64)
        self.ends = int(t[0]), int(t[-1])
        w = system.used(good)
        self.gradient += self.design.gradient(w, left[good])
        for bits, at in _patterns(system.use[good]):
            counts = [len(at), t[at].sum(), t[at] @ t[at]]
            pull, weights = right[good[at]].sum(axis=0), w[at].sum(axis=0)
            self._count(bits, np.concatenate([counts, pull, weights.ravel()]))

    def merge(self, later: CommonSums) -> None:
        """Add the sums over later blocks."""
        if later.ends is None:
            return
        self.ends = (self.ends or later.ends)[0], later.ends[1]
        self.gradient += later.gradient
        for bits, part in later.patterns.items():
            self._count(bits, part)

    def _count(self, bits: bytes, part: Array) -> None:
        """Add the sums of epochs that see the same targets; rare patterns are added together."""
        if bits not in self.patterns and len(self.patterns) >= _MOST_PATTERNS:
            bits = b""
        self.patterns[bits] = self.patterns.get(bits, 0.0) + part

    def solved(self, known: KnownSeries) -> tuple[KnownSeries, Array, Array, float]:
        """Estimate the common unknowns from the sums; return the new series and the changes.

        These are the mean change (p,) of the own parameters; the change (p, q + 2T) of a straight
        line from the first to the last epoch by the common unknowns; and the largest deviation of a
        kind of epochs from the mean change, in standard deviations.
        """
        design, p, T = self.design, len(self.design.own), len(self.design.at.A)
        q, width = len(design.common), design.width
        sums = np.array(list(self.patterns.values())).reshape(-1, 3 + p + 3 * T)
        (count, times, squares), right = sums[:, :3].T, sums[:, 3 : 3 + p]
        weights = sums[:, 3 + p :].reshape(-1, T, 3) / count[:, None, None]
        kinds = SeriesSystem.formed(design, weights, weights[..., 0] > 0)
        gradient = self.gradient + design.common_pull(known.pose, known.offsets)
        mean, tilt = np.zeros((2, p, width))
        for part, C in kinds.couplings():
            G = kinds.Q[part] @ C
            gradient -= np.einsum("kpi,kp->i", G, right[part])
            mean += np.tensordot(count[part], G, axes=1)
            tilt += np.tensordot(times[part], G, axes=1)
        n = max(count.sum(), 1.0)
        mean /= n
        cofactors = inverse_of_determined(kinds.common_normals(count))
        change = cofactors @ gradient
        offsets = known.offsets.copy()
        offsets[: len(design.offset_prior)] += change[q:].reshape(2, -1).T
        rest = 0.0
        for part, C in kinds.couplings():
            sd = np.sqrt(np.diagonal(kinds.Q[part], axis1=1, axis2=2))
            other = (kinds.Q[part] @ C - mean) @ change
            rest = max(rest, float(np.max(np.abs(other) / sd)))
        middle = times.sum() / n
        spread = squares.sum() - n * middle**2
        line = np.zeros((p, width))
        if spread > 0 and self.ends is not None:
            line = (tilt - middle * n * mean) / spread * (self.ends[1] - self.ends[0])
        later = replace(
            known,
            offsets=offsets,
            pose=known.pose + change[:q] if q else known.pose,
            cofactors=cofactors,
            mean=mean,
            used=float(width - np.einsum("ij,ji->", cofactors, design.prior_matrix())),
        )
        return later, -mean @ change, line, rest


def _patterns(use: Mask) -> list[tuple[bytes, Index]]:
    """Return the patterns of targets in use (E, T), each with the rows of its epochs."""
    seen, of = np.unique(np.packbits(use, axis=1), axis=0, return_inverse=True)
    return [(bits.tobytes(), np.flatnonzero(of.ravel() == k)) for k, bits in enumerate(seen)]


def _kinds_of(design: Design, system: SeriesSystem) -> Iterator[tuple[Index, SeriesSystem, Array]]:
    """Group the epochs of a block by the targets that they see, with rare patterns in one group.

    design: of the series; system: of the block, with the common unknowns held. Yields each kind's
    epochs, a system (1,) of their mean weights, and the derivatives G (p, q + 2T).
    """
    good = np.flatnonzero(system.good)
    groups = sorted((good[at] for _, at in _patterns(system.use[good])), key=len, reverse=True)
    often = [rows for rows in groups[:_MOST] if len(rows) >= max(_FEW * len(good), 2)]
    rare = groups[len(often) :]
    for rows in [*often, np.sort(np.concatenate(rare))] if rare else often:
        weights = system.used(rows).mean(axis=0, keepdims=True)
        one = SeriesSystem.formed(design, weights, weights[..., 0] > 0)
        if one.good[0]:
            G = np.zeros((len(design.own), design.width))
            for _, C in one.couplings():
                G = one.Q[0] @ C[0]
            yield rows, one, G


@dataclass(frozen=True, eq=False)
class KnownSeries:
    """A series as known from epochs adjusted together, to adjust further ones.

    estimator: for further epochs, with the common unknowns held; design: the unknowns of the
    series; offsets (T, 2) px, pose (6,): the common ones; cofactors (q + 2T, q + 2T): theirs; mean
    (p, q + 2T): mean G by which own parameters depend on the common ones; used: number of
    observations that these use up; excess (16,): variance of the epochs' excess scatter; middle
    (16,): start values of epochs; pairs: correlated errors of targets; movement: of the mount; slow
    (16, 16): covariance of a straight line over the series from slow errors; combination (16,),
    at, turned (16, 16): from `level_errors`.
    """

    estimator: SeriesEstimator
    design: Design
    offsets: Array
    pose: Array
    cofactors: Array
    mean: Array
    used: float
    excess: Array
    middle: Array
    pairs: CorrelatedPairs | None
    movement: Movement
    slow: Array
    combination: Array
    at: float
    turned: Array

    @classmethod
    def of(
        cls, series: SeriesEstimator, estimate: Estimate, sample: SeriesAdjustment
    ) -> KnownSeries:
        """Collect the series from a sample of adjusted epochs."""
        system, unit = estimate.system, series.variance(estimate)
        at = system.design.at
        design = series.design(at, unit)
        slow = sum(
            ((2.0 * course[-1]) ** 2 * changes for course, changes in sample.slow[1:]),
            np.zeros((16, 16)),
        )
        good = sample.ok
        middle = np.median(sample.values[good] if good.any() else estimate.values, axis=0)
        held = replace(series, grid=series.grid[:0], held=at, unit=unit, windows=())
        mean = np.zeros((len(design.own), design.width))
        for part, C in system.couplings():
            mean += (system.Q[part] @ C).sum(axis=0) / system.good.sum()
        return cls(
            held, design, estimate.offsets, estimate.pose, system.Q_common, mean,
            system.common_share, sample.excess_sd**2, middle, sample.pairs, sample.movement, slow,
            *level_errors(
                series.sensor, series.testfield, system, estimate.values, sample.level_covariance
            ),
        )  # fmt: skip

    def adjusted(
        self, grid: ObservationGrid, epochs: int, line: Array
    ) -> tuple[Estimate, SeriesAdjustment]:
        """Adjust epochs with the common unknowns held.

        epochs: number of epochs that determined the common unknowns; line (E,): position of each
        epoch in the series, from -0.5 for the first to 0.5 for the last. The result is without the
        level and the series' own figures.
        """
        s, pooled = self.estimator.s, self.estimator.unit
        weighted = ObservationGrid(grid.points, grid.weights / self.estimator.ratios)
        values = np.tile(self.middle, (len(grid), 1))
        if len(self.design.common):
            values[:, EOP] = self.pose
        held, estimate = replace(self.estimator, grid=weighted).adjusted(
            State(values, self.offsets, self.pose),
            grid.observed & enough_targets(grid, s)[:, None],
        )
        system = estimate.system
        unit, sigma0, redundancy = held.noise(estimate, self.used / epochs)
        covariance = self._covariance(system, epoch_variance(unit, redundancy, pooled))
        if self.slow.any():
            # Slow errors: a line through zero in the middle of the series, uncertain at its ends.
            covariance += (line * system.good)[:, None, None] ** 2 * self.slow
        course = estimate.values @ self.combination - self.at
        covariance += (np.where(system.good, course, 0.0) ** 2)[:, None, None] * self.turned
        judged = judge_epochs(held, estimate, covariance, unit, pooled, sigma0, redundancy)
        return estimate, judged

    def _covariance(self, system: SeriesSystem, unit: Array) -> Array:
        """Return the covariances (E, 16, 16) of epochs relative to the series.

        unit (E,): variance of unit weight that scales each.
        """
        own, pooled = self.design.own, self.estimator.unit
        swayed = self.movement.covariance * (self.estimator.s.exterior == "series")
        mine, added = system.Q.copy(), np.zeros_like(system.Q)
        for rows, one, G in _kinds_of(self.design, system):
            away = G - self.mean
            mine[rows] += away @ self.cofactors @ away.T
            if self.pairs:
                mine[rows] += correlated_error_cofactors(one, self.pairs, pooled)[0]
            if swayed.any():
                added[rows] = G[:, :6] @ swayed @ G[:, :6].T
        mine = scaled_covariances(mine, system, unit, pooled) + added
        mine = with_excess(mine, self.excess[own])
        mine[~system.good] = 0.0
        return among_all(mine, own)


@dataclass(frozen=True, eq=False)
class LongAdjustment:
    """An adjusted long series; parameters in the order of `PARAMETER_NAMES`.

    rows: the epochs; level_sd, trend_sd (16,): as in `SeriesAdjustment`; sample: the adjustment of
    the epochs `sampled` (P,) together, with covariances, residuals and offsets.
    """

    rows: EpochRows
    level_sd: Array
    trend_sd: Array
    sample: SeriesAdjustment
    sampled: Index


_TOGETHER_POINTS = 1_300_000  # a day of 150 targets: 200 MB
_FEWEST_TOGETHER, _MOST_TOGETHER = 2_000, 10_000  # epochs
_PASSES = 3
_SAME = 0.05  # standard deviations of an epoch by which the last pass may be wrong


def together_at_most(targets: int) -> int:
    """Return the number of epochs with so many targets that are adjusted at once."""
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
    advance: Callable[[int], None] | None = None,
) -> LongAdjustment:
    """Adjust a series of any length, from start values good to a few per cent.

    together: epochs of the sample, by default `together_at_most`; jobs: processes that adjust
    blocks, with the same bits for any number; advance: called with the number of epochs that the
    first pass has just adjusted. Never raises because of the data: an epoch without a result has a
    status and a reason.
    """
    epochs = len(source)
    windows = spread_windows(epochs, together or together_at_most(len(testfield)))
    start = np.concatenate([interior.as_array(), exterior.as_array()])
    ends = np.cumsum([0, *(w.stop - w.start for w in windows)]).tolist()
    inside = tuple(slice(a, b) for a, b in pairwise(ends)) if len(windows) > 1 else ()
    found = adjusted(sensor, testfield, gathered(source, windows), start, settings, inside)
    sample = result(*found)
    known = KnownSeries.of(*found, sample)
    rows = EpochRows.empty(epochs)
    for passes in range(1, _PASSES + 1):
        sums = CommonSums(known.design)
        for first, block, part in in_order(_adjust_block, (known, epochs), source.blocks(), jobs):
            rows.put(first, block)
            sums.merge(part)
            if advance is not None and passes == 1:
                advance(len(block.values))
        later, own, line, rest = sums.solved(known)
        if rest <= _SAME or passes == _PASSES:
            break
        known = later
    level, trend = _carry(known, later, own, line, rows)
    sampled = np.concatenate([np.arange(w.start, w.stop) for w in windows])
    return LongAdjustment(rows, level, trend, sample, sampled)


def _adjust_block(
    state: tuple[KnownSeries, int], item: tuple[int, ObservationGrid]
) -> tuple[int, EpochRows, CommonSums]:
    """Adjust the block of epochs from `first` on; return `first`, its rows and its sums."""
    (known, epochs), (first, grid) = state, item
    line = (first + np.arange(len(grid))) / max(epochs - 1, 1) - 0.5
    estimate, block = known.adjusted(grid, epochs, line)
    sums, system = CommonSums(known.design), estimate.system
    right = system.own_gradient(estimate.residuals, estimate)
    sums.add(first, system, estimate.residuals, right)
    return first, block.rows, sums


def _carry(
    known: KnownSeries, later: KnownSeries, d_own: Array, line: Array, rows: EpochRows
) -> tuple[Array, Array]:
    """Apply the last change of the common unknowns to all epochs, in place.

    later: with the common unknowns from all sums; d_own, line: from `CommonSums.solved`. Returns
    the standard deviations (16,) of the level and of a straight line.
    """
    unit, design = known.estimator.unit, known.design
    own, common, q = design.own, design.common, len(design.common)
    whole = np.zeros((16, design.width))
    whole[common, np.arange(q)] = 1.0
    whole[own] -= later.mean
    level = np.diag(whole @ later.cofactors @ whole.T) * unit
    change = np.zeros(16)
    change[own] += d_own
    change[common] += (later.pose - known.pose)[:q]
    ok = np.array([word == "ok" for word in rows.status], dtype=bool)
    for column in np.flatnonzero(change):
        rows.values[:, column] += change[column]
    for column in common:
        old = np.nan_to_num(rows.sd[:, column])
        rows.sd[:, column] = np.where(ok, np.sqrt(old**2 + level[column]), np.nan)
    course = line_weights(ok) @ np.nan_to_num(rows.values @ known.combination)
    trend, block = known.slow + course**2 * known.turned, np.ix_(own, own)
    if len(later.cofactors):
        tilt = line @ root_of(later.cofactors)
        trend[block] += tilt @ tilt.T * unit
    if known.movement.covariance.any() and q:
        G = later.mean[:, :6]
        trend[block] += G @ known.movement.tilt(line_weights(ok)) @ G.T
    return np.sqrt(np.clip(level, 0.0, None)), np.sqrt(np.diag(trend))
