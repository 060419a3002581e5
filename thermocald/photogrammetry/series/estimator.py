"""The estimator of a series: Gauss-Newton with reduced common unknowns, and data snooping.

The arrays are those of a whole series, or of one block of a long series. The common unknowns of a
block are held at their known values.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP, IOP, PARAMETER_NAMES, Sensor, project
from thermocald.photogrammetry.epoch.gauss_markov import TRUSTED_REDUNDANCY, settle
from thermocald.photogrammetry.linalg import MEDIAN_CHI2, inverse_of_determined, median_known
from thermocald.photogrammetry.series.mount import STILL, Movement
from thermocald.photogrammetry.series.normals import (
    ObservationGrid,
    Partials,
    chunks,
    linearise,
    normal_matrices,
    planes,
    sums_of_squares,
)
from thermocald.photogrammetry.series.system import (
    Design,
    SeriesSystem,
    State,
    Step,
    offset_weights,
    point_tests,
    snoop_series,
    typical_variance,
)
from thermocald.photogrammetry.series.target_noise import (
    FEW_EPOCHS,
    MEDIAN_WORTH,
    CorrelatedPairs,
    correlated_pairs,
    noise_ratios,
)

if TYPE_CHECKING:
    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.series.result import SeriesSettings

NOISE_SHOWN = 0.5
"""Share of an epoch's redundancy below which residuals show the priors rather than the noise."""

_ENOUGH_FOR_NOISE = 4  # epochs needed to estimate the noise of single targets
_GUESSED = 10.0  # degrees of freedom of a single target's noise as stated
_MANY = 10.0  # observations per common unknown beyond which priors hardly matter
_ITERATIONS = 15
_HALVINGS = 6  # of a step at most
_SMALL = 0.1  # standard deviations; the partials apply a last step below it to 1e-3
_SMALLER = 1e-4  # the same for a block, as the result must not depend on the blocks
_NEAR = 10.0  # standard deviations up to which the partials predict the residuals after a step
_FAR = 20.0  # times an epoch's median residual or px: gross beyond doubt, whatever the camera
_ROUNDS = 8  # of data snooping
_FIELD_ROUNDS = 4  # of the field's own variance component
_SAME_FIELD = 0.1  # relative change of that component at convergence
_LEAST_SHARE = 0.1  # of an offset that image points must determine, for the offset to count
_FEWEST_OFFSETS = 8
_BEYOND_CHANCE = 3.1  # standard deviations
_LEAST_NUMBER = 0.05  # redundancy number of a coordinate that hardly anything else checks
_RELINEARISE_PX = 1.0  # movement of the mean that changes the partials by more than about 1e-3


@dataclass(frozen=True, eq=False)
class Estimate(State):
    """An estimated state with its residuals (E, T, 2) px, its system, and a mask (E,) of the epochs
    that converged.
    """

    residuals: Array
    system: SeriesSystem
    converged: Mask

    @property
    def solved(self) -> Mask:
        """Mask (E,) of the epochs that determine their parameters and converged."""
        return self.converged & self.system.good

    @property
    def settled(self) -> bool:
        """Whether most epochs in use are solved."""
        return bool(2 * self.solved.sum() >= self.system.use.any(axis=1).sum())


@dataclass(frozen=True, eq=False)
class SeriesEstimator:
    """A series with the settings of its adjustment.

    grid: the observations with the weights in use; bound (6, 6): inverse covariance of the mount's
    movements; movement: its variance components; choice: why the exterior orientation is estimated
    as it is; held: the linearisation of held common unknowns, None if they are estimated; unit:
    initial variance of unit weight for the priors, and with held unknowns that of epochs too poor
    to estimate theirs; windows: runs of consecutive epochs, if the series is a sample of a longer
    one; field_variance: factor of the field's stated covariance; freedom (T,), ratios (T, 3):
    degrees of freedom of each target's estimated noise and its variances over the stated ones, None
    and 1 if the noise is as stated.
    """

    sensor: Sensor
    testfield: TestField
    grid: ObservationGrid
    s: SeriesSettings
    bound: Array | None = None
    movement: Movement = STILL
    choice: str = "as asked for"
    held: Partials | None = None
    unit: float = 1.0
    windows: tuple[slice, ...] = ()
    field_variance: float = 1.0
    freedom: Array | None = None
    ratios: Array | float = 1.0

    def adjusted(self, start: State, use: Mask) -> tuple[SeriesEstimator, Estimate]:
        """Estimate the series, its gross errors and the targets' noise.

        use (E, T): the image points offered. Returns the series with that noise and the estimate.
        """
        series, s, offered = self, self.s, use
        estimate = series.solve(start, use, self.unit)
        solved = estimate.solved | ~use.any(axis=1)
        if not solved.all():
            # Gross errors among few targets of an epoch must not spoil the common unknowns.
            few = 2 * solved.sum() < len(solved)
            if few:
                use = series._screen(start, use)
            else:
                middle = np.median(estimate.values[estimate.solved], axis=0)
                use = use & (estimate.converged[:, None] | series._near(middle, use))
                use = use & series.solve(start, use, self.unit).converged[:, None]
            offered = offered & use.any(axis=1, keepdims=True)
            estimate = series.solve(start, use, self.unit)
        if s.snooping_alpha > 0:
            estimate = series.snoop(estimate, offered)
            as_stated = self.freedom is None and self.held is None
            if s.target_noise and len(use) >= _ENOUGH_FOR_NOISE and as_stated:
                known = series._with_target_noise(estimate)
                again = known.solve(estimate, estimate.system.use, 1.0)
                if again.settled or not estimate.settled:
                    series, estimate = known, known.snoop(again, offered)
            for _ in range(_FIELD_ROUNDS):
                variance = series.estimate_field_variance(estimate)
                if variance is None or abs(variance / series.field_variance - 1.0) < _SAME_FIELD:
                    break
                wider = replace(series, field_variance=variance)
                use = estimate.system.use
                again = wider.solve(estimate, use, wider.variance(estimate))
                if not again.settled:
                    break  # a field of this accuracy does not determine the parameters
                series, estimate = wider, wider.snoop(again, offered)
        return series, estimate

    def estimate_field_variance(self, estimate: Estimate) -> float | None:
        """Estimate the factor, at least 1, of the field's stated covariance.

        From the targets' offsets: the median of their weighted squares over the share of each that
        the image points determine; moved targets do not affect it. None if not significant.
        """
        design, q = estimate.system.design, len(estimate.system.design.common)
        Q = estimate.system.Q_common
        alone = self.s.exterior == "per_epoch"  # the EOP absorb what offsets have in common
        if alone or not len(design.offset_prior) or self.held is not None or len(Q) <= q:
            return None
        (wx, wy, wxy), (x, y) = design.offset_prior.T, estimate.offsets.T
        T = len(wx)
        at, to = q + np.arange(T), q + T + np.arange(T)
        held = wx * Q[at, at] + wy * Q[to, to] + 2.0 * wxy * Q[at, to]
        share = 1.0 - held / 2.0  # of an offset's two coordinates
        shown = share > _LEAST_SHARE
        if shown.sum() < _FEWEST_OFFSETS:
            return None
        squares = (wx * x * x + wy * y * y + 2.0 * wxy * x * y) / self.variance(estimate)
        ratio = float(np.median(squares[shown] / share[shown])) / MEDIAN_CHI2
        ratio *= self.field_variance
        chance = 1.0 + _BEYOND_CHANCE * np.sqrt(2.0 / (MEDIAN_WORTH * 2.0 * share[shown].sum()))
        return ratio if ratio > chance or self.field_variance > 1.0 else None

    def _screen(self, start: State, use: Mask) -> Mask:
        """Select points (E, T) for a series of which most epochs do not converge.

        The selected points fit a pose per epoch with the initial interior orientation. An epoch
        whose pose does not converge keeps none.
        """
        middle = np.median(start.values, axis=0)
        use = use & self._near(middle, use)
        s = replace(self.s, exterior="per_epoch", free=(), target_offsets=False, priors={})
        alone = replace(self, s=s, bound=None, windows=())
        first = State(np.tile(middle, (len(use), 1)), np.zeros_like(start.offsets), middle[EOP])
        own = alone.solve(first, use, self.unit)
        return alone.snoop(own, use).system.use & own.converged[:, None]

    def _near(self, values: Array, use: Mask) -> Mask:
        """Select the points (E, T) that are not far off the image of a camera, values (16,)."""
        predicted = project(self.sensor, values[IOP], values[EOP], self.testfield.points)
        size = np.linalg.norm(self.grid.points - predicted, axis=2)
        usual = median_known(np.where(use, size, np.nan).T)
        return np.asarray(size < _FAR * np.fmax(usual, 1.0)[:, None])

    @property
    def has_offsets(self) -> bool:
        """Whether the targets have offsets, for which the field needs sigmas."""
        return self.s.target_offsets and bool((self.testfield.sigmas > 0).any())

    def solve(self, start: State, use: Mask, variance: float) -> Estimate:
        """Solve by Gauss-Newton, with one linearisation at the series' mean, renewed if that moves.

        variance: of unit weight, by which priors are weighted against image points. If most epochs
        of a series do not converge, its geometry is so weak that whole steps go too far, and
        shorter ones are tried.
        """
        whole = self._iterate(start, use, variance)
        if not whole.system.design.width or whole.settled:
            return whole
        shorter = self._iterate(start, use, variance, _HALVINGS)
        return max(shorter, whole, key=lambda estimate: estimate.solved.sum())

    def _iterate(self, start: State, use: Mask, variance: float, halvings: int = 0) -> Estimate:
        """Iterate, with every step halved up to `halvings` times until it helps."""
        state = start
        system = self._linearised(state.values, use, variance)
        own, common = system.design.own, system.design.common
        residuals = self._residuals(state, planes(2, *use.shape))
        for _ in range(_ITERATIONS * (1 + halvings)):
            step = system.step(residuals, state)
            sizes = step.sizes
            if halvings and step.size >= _SMALL:
                shorter = self._shorten(system, state, step, halvings)
                if shorter is None:
                    break
                step = shorter
            state = system.design.apply(state, step)
            if step.size < (_SMALL if self.held is None else _SMALLER):
                system.move(residuals, step)
                break
            residuals = self._residuals(state, residuals)
            moved = np.zeros(16)
            moved[common] = step.d_common
            if system.good.any():
                moved[own] += np.median(step.d_own[system.good], axis=0)
            far = self.held is None and np.abs(system.design.at.A @ moved).max(initial=0.0)
            if not far < self.sensor.width:  # start values are good to a few per cent
                sizes = np.full(len(use), np.inf)
                break
            if far > _RELINEARISE_PX:
                system = self._linearised(state.values, use, variance)
        return Estimate(state.values, state.offsets, state.pose, residuals, system, sizes < _NEAR)

    def _shorten(
        self, system: SeriesSystem, state: State, step: Step, halvings: int
    ) -> Step | None:
        """Halve a step until the next one is shorter; return None if it never is.

        Source: the natural monotonicity test, Deuflhard (2004), Newton methods, section 3.3.
        """
        for _ in range(halvings):
            there = system.design.apply(state, step)
            left = self._residuals(there, planes(2, *system.use.shape))
            if system.step(left, there).size < step.size:
                return step
            step = replace(
                step, d_own=step.d_own / 2, d_common=step.d_common / 2,
                d_offsets=step.d_offsets / 2,
            )  # fmt: skip
        return None

    def snoop(self, estimate: Estimate, offered: Mask) -> Estimate:
        """Estimate without gross errors; offered (E, T): points that may be taken back."""
        if estimate.system.design.width:
            return self._snoop_together(estimate, offered)
        return self._snoop_apart(estimate, offered)

    def _with_target_noise(self, estimate: Estimate) -> SeriesEstimator:
        """Return the series with each target's weights from the scatter of its own residuals."""
        # in few epochs the share of the residuals that offsets absorb is not negligible
        use = estimate.system.use
        lost = int(self.has_offsets and len(use) < FEW_EPOCHS)
        numbers = self._redundancy_numbers(estimate.system)
        ratios, freedom = noise_ratios(estimate.residuals, self.grid.weights, use, numbers, lost)
        ratios = np.column_stack([ratios, np.sqrt(ratios.prod(axis=1))])
        grid = ObservationGrid(self.grid.points, self.grid.weights / ratios)
        return replace(self, grid=grid, ratios=ratios, freedom=freedom)

    def pairs(self, estimate: Estimate) -> CorrelatedPairs:
        """Find the pairs of image coordinates with correlated errors."""
        use = estimate.system.use
        n, epochs = 2 * int(use.sum()), int(use.any(axis=1).sum())
        redundant = max((n - len(self.s.per_epoch) * epochs) / max(n, 1), 0.05)
        return correlated_pairs(estimate.residuals, use, self.testfield.groups, redundant)

    @property
    def _noise_freedom(self) -> Array | None:
        """Degrees of freedom (T,) of each target's noise; None if the noise is as stated."""
        if self.freedom is None and self.s.target_noise:
            return np.full(len(self.testfield), _GUESSED)
        return self.freedom

    def _redundancy_numbers(self, system: SeriesSystem) -> Array:
        """Return the redundancy numbers (T, 2) of the coordinates in a typical epoch.

        Of few targets the outer ones determine an epoch, and their residuals are small.
        """
        use = system.use & system.good[:, None]
        A = system.design.at.A[..., system.design.own]
        sums = np.stack([(self.grid.weights[..., k] * use).sum(axis=0) for k in range(3)], axis=1)
        N = normal_matrices(sums[None] / max(int(system.good.sum()), 1), A)[0]
        Q = inverse_of_determined(N + system.design.own_prior)
        weights = sums[:, :2] / np.maximum(use.sum(axis=0), 1)[:, None]
        numbers: Array = 1.0 - weights * np.einsum("tkp,pq,tkq->tk", A, Q, A)
        return numbers.clip(_LEAST_NUMBER)

    def _snoop_together(self, estimate: Estimate, offered: Mask) -> Estimate:
        """Snoop epochs that share unknowns, solving the whole series again after every round.

        An estimate that has not settled shows no gross errors: the last settled one is returned.
        """
        if not estimate.settled:
            return estimate
        variance, typical = 1.0, None
        history = np.zeros(offered.shape, dtype=np.int8)
        for _ in range(_ROUNDS):
            use = estimate.system.use
            tests = point_tests(estimate.system, estimate.residuals)
            if typical is None:
                typical = typical_variance(tests, use)
            alpha = self.s.snooping_alpha
            if self.shown_share(estimate) < NOISE_SHOWN:
                alpha **= 2  # errors of the field look like gross ones: reject only certain ones
            keep = snoop_series(
                tests, offered, use, self.s.carried, alpha, typical, self._noise_freedom
            )
            keep = settle(history, use, keep)
            previous, variance = variance, self.variance(estimate)
            steady = not self.has_offsets or abs(variance / previous - 1) < 0.02
            if steady and np.array_equal(keep, use):
                break
            again = self.solve(estimate, keep, variance)
            if not again.settled:
                break
            estimate = again
        return estimate

    def _snoop_apart(self, estimate: Estimate, offered: Mask) -> Estimate:
        """Snoop epochs that share no unknowns, solving only changed ones again."""
        system = replace(estimate.system, use=estimate.system.use.copy())
        whole = replace(estimate, system=system, converged=estimate.converged.copy())
        rows, history = np.arange(len(system.use)), np.zeros(system.use.shape, dtype=np.int8)
        part: slice | Index = slice(None)  # all epochs, without a copy
        typical, last = None if self.held is None else self.unit, estimate
        for _ in range(_ROUNDS):
            use = last.system.use
            tests = point_tests(last.system, last.residuals)
            if typical is None:  # in the first round, which has all epochs
                typical = typical_variance(tests, use)
            keep = snoop_series(
                tests, offered[part], use, self.s.carried, self.s.snooping_alpha, typical,
                self._noise_freedom,
            )  # fmt: skip
            seen = history[part]
            keep = settle(seen, use, keep)
            history[part] = seen
            changed = (keep != use).any(axis=1)
            part = rows = rows[changed]
            if len(rows) == 0:
                break
            some = replace(self, grid=self.grid[rows], held=system.design.at)
            state = State(whole.values[rows], estimate.offsets, estimate.pose)
            last = some._iterate(state, keep[changed], self.unit)
            for name in ("values", "residuals", "converged"):
                getattr(whole, name)[rows] = getattr(last, name)
            for name in ("use", "Q", "good"):
                getattr(system, name)[rows] = getattr(last.system, name)
        return whole

    def _linearised(self, values: Array, use: Mask, variance: float) -> SeriesSystem:
        at = self.held
        if at is None:
            used = use.any(axis=1)
            mean = np.median(values[used] if used.any() else values, axis=0)
            at = linearise(self.sensor, self.testfield, mean[IOP], mean[EOP])
        design = self.design(at, variance, with_common=self.held is None)
        system = SeriesSystem.formed(design, self.grid.weights, use)
        return system.solved() if design.width else system

    def design(self, at: Partials, variance: float, *, with_common: bool = True) -> Design:
        """Return the unknowns at a linearisation.

        variance: of unit weight, by which priors are weighted against image points; with_common:
        whether to include the common unknowns.
        """
        s, own = self.s, self.s.per_epoch
        common = s.common if with_common else s.common[:0]
        known, weight = np.zeros(16), np.zeros(16)
        for name, (value, sd) in s.priors.items():
            k = PARAMETER_NAMES.index(name)
            known[k], weight[k] = value, variance / sd**2
        own_prior, shifts = np.diag(weight[own]), None
        if self.bound is not None:
            own_prior[-6:, -6:] = self.bound * variance
            shifts = self.movement.shifts
            if self.held is not None:  # epochs after those that showed the mount
                shifts = shifts[-1:]
        offsets = self.has_offsets and with_common
        return Design(
            at, own, common, known, own_prior, weight[common], shifts,
            offset_weights(self.testfield, at) * (variance / self.field_variance)
            if offsets else np.empty((0, 3)),
        )  # fmt: skip

    def _residuals(self, state: State, out: Array) -> Array:
        """Write measured minus predicted points (E, T, 2) px, at each epoch's values, to `out`."""
        values = state.values
        if (values == values[:1]).all():
            first = project(self.sensor, values[0, IOP], values[0, EOP], self.testfield.points)
            np.subtract(self.grid.points, first, out=out)
        else:
            for part in chunks(*out.shape[:2]):
                iop, eop = values[part, IOP], values[part, EOP]
                predicted = project(self.sensor, iop, eop, self.testfield.points)
                np.subtract(self.grid.points[part], predicted, out=out[part])
        if state.offsets.any():
            out -= state.offsets
        return out

    def sums(self, estimate: Estimate) -> tuple[Array, Array]:
        """Return the weighted sum of squares (E,) and the redundancy (E,) of every epoch."""
        use = estimate.system.use
        vPv = sums_of_squares(self.grid.weights, estimate.residuals, use)
        system = estimate.system
        n = use.sum(axis=1) * system.good
        share = system.common_share * n / max(int(n.sum()), 1)
        # with priors an epoch's parameters use up less than p observations
        held = np.einsum("epq,qp->e", system.Q, system.design.own_prior)
        return vPv, 2 * n - (len(system.design.own) - held) - share

    def noise(self, estimate: Estimate, used: float = 0.0) -> tuple[Array, Array, Array]:
        """Return three arrays (E,): the variance of unit weight by the weights in use, sigma0 by
        the stated weights (NaN without redundancy), and the redundancy.

        used: observations per epoch that held common unknowns have used up.
        """
        vPv, redundancy = self.sums(estimate)
        redundancy = redundancy - used
        positive = redundancy > 0
        stated = sums_of_squares(
            self.grid.weights * self.ratios, estimate.residuals, estimate.system.use
        )
        return (
            vPv / np.where(positive, redundancy, 1.0),
            np.sqrt(stated / np.where(positive, redundancy, np.nan)),
            redundancy,
        )

    def variance(self, estimate: Estimate) -> float:
        """Return the variance of unit weight of the series: the median over its epochs, drawn to
        the stated one if their redundancy is small.
        """
        vPv, redundancy = self.sums(estimate)
        good = estimate.system.good
        shown = max(float(redundancy[good].sum()) * self.shown_share(estimate), 0.0)
        good = good & (redundancy > 0)
        median = float(np.median(vPv[good] / redundancy[good])) or 1.0 if good.any() else 1.0
        return (shown * median + TRUSTED_REDUNDANCY) / (shown + TRUSTED_REDUNDANCY)

    def shown_share(self, estimate: Estimate) -> float:
        """Return the share of the redundancy that shows the noise even if the priors are wrong."""
        system = estimate.system
        whole = float(self.sums(estimate)[1][system.good].sum())
        if whole > _MANY * system.design.width:
            return 1.0  # an unknown's prior takes up at most a quarter of an observation
        held, twice = system.held
        return 1.0 - (held - twice) / whole if whole > 0 else 0.0
