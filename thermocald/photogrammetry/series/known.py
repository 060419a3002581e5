"""What is known of a series, and epochs adjusted with it: in blocks, or one by one as they come.

Some epochs of the series are adjusted together (`adjustment`): they say how the camera stands, how
far its mount moves, what single targets are measured to and where they are off. Any other epoch is
then adjusted with that known, and adds to the sums of what all have in common (`CommonSums`): its
normal equations with its own parameters reduced. At the epochs' own solution the reduced right-hand
side is the plain gradient, which is summed epoch by epoch. The matrix is that of the mean weights
of all epochs that see the same targets; it differs from the sum by the square of how much their
weights vary, and costs one reduction per kind of epoch.

Source: Helmert blocking, Wolf, H. (1978): The Helmert block method.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP
from thermocald.photogrammetry.linalg import inverse_of_determined
from thermocald.photogrammetry.series.adjustment import Adjusted, epoch_variance
from thermocald.photogrammetry.series.covariances import of_correlated, of_priors
from thermocald.photogrammetry.series.estimator import ENOUGH_FOR_NOISE, Estimate, SeriesEstimator
from thermocald.photogrammetry.series.normals import (
    ObservationGrid,
    among_all,
    planes,
    sums_of_squares,
)
from thermocald.photogrammetry.series.result import (
    SeriesAdjustment,
    SeriesSettings,
    enough_targets,
    judge,
)
from thermocald.photogrammetry.series.system import Design, SeriesSystem, State

if TYPE_CHECKING:
    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.series.movement import Movement
    from thermocald.photogrammetry.series.target_noise import CorrelatedPairs


_FEW = 0.02  # share of a block's epochs that is worth a matrix of its own
_MOST = 12  # kinds of epochs in a block
_MOST_PATTERNS = 300  # of targets seen, over the series; the epochs of others count together


@dataclass(frozen=True, eq=False)
class Shared:
    """What is known of the common unknowns: offsets (T, 2) px, pose (6,), their cofactors (q + 2T,
    q + 2T), the mean G (p, q + 2T) by which own parameters follow an error of theirs; used: how
    many observations they use up.
    """

    offsets: Array
    pose: Array
    cofactors: Array
    mean: Array
    used: float


@dataclass(frozen=True, eq=False)
class Alike:
    """Epochs of a block that see nearly the same targets: rows (n,), system of one epoch with their
    mean weights, G (p, q + 2T): by how much own parameters follow the common unknowns.
    """

    rows: Index
    system: SeriesSystem
    G: Array


@dataclass(eq=False)
class _Pattern:
    """Epochs that see the same targets: how many, sums of their weights (T, 3), of their numbers,
    and of the gradients (p,) of their own parameters.
    """

    epochs: int
    weights: Array
    times: float
    right: Array


@dataclass(eq=False)
class CommonSums:
    """The sums over the blocks so far.

    design: the unknowns; gradient (q + 2T,); epochs, times, squares: how many, sums of their
    numbers and of the squares; ends: the first and the last.
    """

    design: Design
    gradient: Array = field(init=False)
    epochs: int = 0
    times: float = 0.0
    squares: float = 0.0
    ends: tuple[int, int] | None = None
    patterns: dict[bytes, _Pattern] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.gradient = np.zeros(self.design.width)

    def add(self, first: int, system: SeriesSystem, left: Array, right: Array) -> None:
        """Add a block that begins at epoch `first`.

        system: of the block, its common unknowns held; left (E, T, 2) px: residuals; right (E, p):
        gradient of the own parameters, which is 0 at their solution.
        """
        good = np.flatnonzero(system.good)
        if not len(good):
            return
        t = (first + good).astype(np.float64)
        self.ends = (self.ends[0] if self.ends else int(t[0]), int(t[-1]))
        self.epochs += len(good)
        self.times += float(t.sum())
        self.squares += float(t @ t)
        if not self.design.width:
            return
        w = system.used(good)
        self.gradient += self.design.gradient(w, left[good])
        seen, of = np.unique(np.packbits(system.use[good], axis=1), axis=0, return_inverse=True)
        for k, bits in enumerate(seen):
            rows = np.flatnonzero(of.ravel() == k)
            part = _Pattern(
                len(rows), w[rows].sum(axis=0), float(t[rows].sum()), right[good[rows]].sum(axis=0)
            )
            self._count(bits.tobytes(), part)

    def merge(self, later: CommonSums) -> None:
        """Add the sums over later blocks."""
        if later.ends is None:
            return
        self.ends = (self.ends[0] if self.ends else later.ends[0], later.ends[1])
        self.epochs += later.epochs
        self.times += later.times
        self.squares += later.squares
        self.gradient += later.gradient
        for key, part in later.patterns.items():
            self._count(key, part)

    def _count(self, key: bytes, part: _Pattern) -> None:
        """Add epochs that see the same targets; those of rare patterns together."""
        if key not in self.patterns and len(self.patterns) >= _MOST_PATTERNS:
            key = b""
        if key not in self.patterns:
            self.patterns[key] = part
            return
        found = self.patterns[key]
        found.epochs += part.epochs
        found.weights = found.weights + part.weights
        found.times += part.times
        found.right = found.right + part.right

    def solved(self, known: Shared) -> Solved:
        """What is known with these sums."""
        design, n = self.design, max(self.epochs, 1)
        p, q, width = len(design.own), len(design.common), design.width
        patterns = list(self.patterns.values())
        count = np.array([float(found.epochs) for found in patterns])
        times = np.array([found.times for found in patterns])
        right = np.array([found.right for found in patterns]).reshape(len(patterns), p)
        weights = np.array([found.weights / found.epochs for found in patterns])
        kinds = _typical(design, weights.reshape(len(patterns), len(design.at.A), 3))
        prior = design.prior_matrix()
        gradient = self.gradient + design.common_pull(known.pose, known.offsets)
        mean, tilt = np.zeros((2, p, width))
        for part, C in kinds.couplings():
            G = kinds.Q[part] @ C
            gradient -= np.einsum("kpi,kp->i", G, right[part])
            mean += np.tensordot(count[part], G, axes=1)
            tilt += np.tensordot(times[part], G, axes=1)
        mean /= n
        cofactors = inverse_of_determined(prior + kinds.common_normals(count))
        change = cofactors @ gradient
        offsets = known.offsets
        if design.offset_prior is not None:
            offsets = offsets + change[q:].reshape(2, -1).T
        rest = 0.0
        for part, C in kinds.couplings():
            sd = np.sqrt(np.diagonal(kinds.Q[part], axis1=1, axis2=2))
            other = (kinds.Q[part] @ C - mean) @ change
            rest = max(rest, float(np.max(np.abs(other) / sd)))
        middle = self.times / n
        spread = self.squares - n * middle**2
        line = np.zeros((p, width))
        if spread > 0 and self.ends is not None:
            line = (tilt - middle * n * mean) / spread * (self.ends[1] - self.ends[0])
        pose = known.pose + change[:q] if q else known.pose
        used = float(width - np.einsum("ij,ji->", cofactors, prior))
        return Solved(Shared(offsets, pose, cofactors, mean, used), -mean @ change, line, rest)

    def settle(self, shared: Shared) -> None:
        """Carry the sums to the common unknowns that they were solved for, in place.

        There only the priors' pull is left of the gradients.
        """
        self.gradient = -self.design.common_pull(shared.pose, shared.offsets)
        for pattern in self.patterns.values():
            pattern.right[:] = 0.0


@dataclass(frozen=True, eq=False)
class Solved:
    """The common unknowns from all sums: shared; own (p,): the mean change of own parameters that
    goes with them; line (p, q + 2T): what they do to a straight line from the first to the last
    epoch; rest: by how many of their standard deviations single kinds of epochs change otherwise.
    """

    shared: Shared
    own: Array
    line: Array
    rest: float


def _typical(design: Design, weights: Array) -> SeriesSystem:
    """The system of epochs with some weights (K, T, 3), without the priors of what is common."""
    return SeriesSystem.formed(design.without_common_priors(), weights, weights[..., 0] > 0)


def kinds_of(design: Design, system: SeriesSystem) -> list[Alike]:
    """The kinds of epochs of a block: the frequent ones by what they see, the others together.

    design: of the series; system: of the block, its common unknowns held.
    """
    good = np.flatnonzero(system.good)
    if not len(good):
        return []
    seen = np.packbits(system.use[good], axis=1)
    _, of, count = np.unique(seen, axis=0, return_inverse=True, return_counts=True)
    of = of.ravel()
    often = np.argsort(-count, kind="stable")[:_MOST]
    often = often[count[often] >= max(_FEW * len(good), 2)]
    groups = [good[of == label] for label in often]
    rest = good[~np.isin(of, often)]
    if len(rest):
        groups.append(rest)
    out = []
    for rows in groups:
        one = _typical(design, system.used(rows).mean(axis=0, keepdims=True))
        if one.good[0]:
            G = np.zeros((len(design.own), design.width))
            for _, C in one.couplings():
                G = one.Q[0] @ C[0]
            out.append(Alike(rows, one, G))
    return out


def level_of(known: Shared, design: Design, G: Array) -> Array:
    """Cofactors (16, 16) of what the common unknowns do to parameters that follow them by G."""
    whole = np.zeros((16, design.width))
    whole[design.common, np.arange(len(design.common))] = 1.0
    whole[design.own] -= G
    level: Array = whole @ known.cofactors @ whole.T
    return level


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
