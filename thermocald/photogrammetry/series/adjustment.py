"""Adjustment of a whole series: every epoch its own parameters, all epochs their common ones.

Parameters are per epoch (`free`, and the EOP with `exterior="per_epoch"`), common to the series
(the EOP with `exterior="series"`, and a constant offset per target), or held. Common unknowns are
reduced: each epoch contributes its normal equations with its own parameters eliminated.

What comes out of it is `series_result`'s. A target that is hidden now and then shifts single epochs
by its coordinate error; with `target_offsets` that error is an unknown with the test field's sigma
as its prior.

Source: DESIGN idea 3; the test for standing still is Rao's score test (1948).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.epoch.gauss_markov import TRUSTED_REDUNDANCY, Rejections
from thermocald.photogrammetry.parameters import EOP, EOP_COLUMNS, IOP, free_columns
from thermocald.photogrammetry.series.mount import (
    FEWEST_EPOCHS,
    STILL,
    Movement,
    estimate_movement,
)
from thermocald.photogrammetry.series.normals import (
    ObservationGrid,
    linearise,
    planes,
    series_residuals,
    sums_of_squares,
)
from thermocald.photogrammetry.series.result import (
    Exterior,
    SeriesAdjustment,
    SeriesSettings,
)
from thermocald.photogrammetry.series.snooping import (
    point_tests,
    snoop_series,
    typical_variance,
)
from thermocald.photogrammetry.series.status import enough_targets, judge
from thermocald.photogrammetry.series.system import SeriesSystem, line_weights
from thermocald.photogrammetry.series.target_noise import (
    CorrelatedPairs,
    correlated_pairs,
    excess_scatter,
    noise_ratios,
    slow_errors,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.photogrammetry.camera.camera_model import (
        ExteriorOrientation,
        InteriorOrientation,
        Sensor,
    )
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.photogrammetry.series.normals import Partials

    Array = NDArray[np.float64]

__all__ = ["SeriesAdjustment", "SeriesSettings", "adjust_series"]

_ITERATIONS = 15
_SMALL = 0.1  # standard deviations: a last step that the partials carry to 1e-3
_NEAR = 10.0  # standard deviations: by what the residuals follow a step by the partials
_ROUNDS = 8  # of data snooping
_RELINEARISE_PX = 1.0  # movement of the mean that changes the partials by more than about 1e-3
_ENOUGH_FOR_NOISE = 20  # epochs
_LOOSE_PX = 3.0  # far beyond what a mount trembles, and what one epoch knows of its perspective


@dataclass(frozen=True, eq=False)
class _Start:
    """values (E, 16), offsets (T, 2) px and the common pose (6,)."""

    values: Array
    offsets: Array
    pose: Array


@dataclass(frozen=True, eq=False)
class _Estimate(_Start):
    """The same estimated, the residuals (E, T, 2) px that they leave, the system, and which epochs
    converged (E,).
    """

    residuals: Array
    system: SeriesSystem
    converged: NDArray[np.bool_]


def adjust_series(
    sensor: Sensor,
    testfield: TestField,
    epochs: Sequence[Observations | None] | ObservationGrid,
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    settings: SeriesSettings | None = None,
) -> SeriesAdjustment:
    """Adjust all epochs of a camera, from start values good to a few per cent.

    epochs: the observations, None for an epoch without, or the grid of them. Never raises for data:
    an epoch without a result has a status and a reason.
    """
    s = settings or SeriesSettings()
    if not isinstance(epochs, ObservationGrid):
        epochs = ObservationGrid.from_observations(testfield, epochs)
    # Targets that are never seen would only be unknowns without observations.
    seen = np.flatnonzero(epochs.observed.any(axis=0))
    grid = epochs.targets(seen)
    start = np.concatenate([interior.as_array(), exterior.as_array()])
    use = grid.observed & enough_targets(grid, s)[:, None]
    first = _Start(np.tile(start, (len(use), 1)), np.zeros((len(seen), 2)), start[EOP])
    series = _Series(sensor, testfield.subset(seen), grid, grid.weights, s)
    if s.exterior in ("mount", "auto"):
        # Loosely bound at first, so that no movement is taken for gross errors.
        loose = replace(series, s=replace(s, exterior="mount"), bound=series.loose_bound(start))
        loose, estimate, use = loose.adjusted(first, use)
        series, why = loose.choose(s.exterior, estimate)
        first = estimate if series.s.exterior != "series" else first
    else:
        why = "as asked for"
    series, estimate, use = series.adjusted(first, use)
    return series.result(estimate, use, why).spread(seen, len(testfield))


@dataclass(frozen=True, eq=False)
class _Series:
    """A series as it is adjusted.

    grid: the observations with the weights in use; stated (E, T, 3): their weights as stated;
    bound (6, 6): inverse covariance of the movements of the mount; movement: what that rests on.
    """

    sensor: Sensor
    testfield: TestField
    grid: ObservationGrid
    stated: Array
    s: SeriesSettings
    bound: Array | None = None
    movement: Movement = STILL

    def adjusted(
        self, start: _Start, use: NDArray[np.bool_]
    ) -> tuple[_Series, _Estimate, NDArray[np.bool_]]:
        """Solve, find the gross errors and the targets' own noise; the series with that noise."""
        series, s = self, self.s
        estimate = series.solve(start, use, 1.0)
        if not estimate.converged.all():
            # A gross error among few targets: such an epoch must not spoil what all share.
            use = use & estimate.converged[:, None]
            estimate = series.solve(start, use, 1.0)
        if s.snooping_alpha > 0:
            estimate, use = series.snoop(estimate, use)
            first_look = self.grid.weights is self.stated
            if s.target_noise and len(use) >= _ENOUGH_FOR_NOISE and first_look:
                series = series.with_target_noise(estimate, use)
                estimate = series.solve(estimate, use, 1.0)
                estimate, use = series.snoop(estimate, use)
        return series, estimate, use

    def loose_bound(self, start: Array) -> Array:
        """A bound (6, 6) of the mount to some pixels in the image by each parameter."""
        A = linearise(self.sensor, self.testfield, start[IOP], start[EOP]).A[..., EOP]
        return np.diag((A**2).sum(axis=1).mean(axis=0)) / _LOOSE_PX**2

    def choose(self, asked: Exterior, estimate: _Estimate) -> tuple[_Series, str]:
        """The series with the exterior orientation that a first estimate allows, and why."""
        good = int(estimate.system.good.sum())
        if asked == "auto" and good < FEWEST_EPOCHS:
            own = replace(self, s=replace(self.s, exterior="per_epoch"), bound=None)
            return own, f"{good} epochs do not show how the mount moves ({FEWEST_EPOCHS} would)"
        movement = self.observed_movement(estimate)
        px = movement.image_px(estimate.system.at.A)
        noise = movement.noise_px(estimate.system.at.A)
        if movement.still and asked == "auto":
            still = replace(self, s=replace(self.s, exterior="series"), bound=None)
            return still, f"no movement of the mount beyond the noise of an epoch ({noise:.3f} px)"
        mount = replace(self, bound=movement.precision(), movement=movement)
        how = ""
        if movement.memory:
            part = movement.slow_fraction(estimate.system.at.A)
            slowly = f"over about {movement.memory:.0f} epochs"
            how = f", {part:.0%} of it {slowly if movement.memory < good / 3 else 'slowly'}"
        if movement.jumps:
            how += f", with jumps at row {', '.join(map(str, movement.jumps))}"
        return mount, f"the mount moves by {px:.3f} px about its mean pose{how}"

    def observed_movement(self, estimate: _Estimate) -> Movement:
        """The variance components of the mount's movements."""
        system = estimate.system
        variance = self.variance(estimate)
        before = np.concatenate([system.at.iop, system.at.eop])
        b = system.gradient(estimate.residuals)
        N = system.N
        b = b + np.einsum("eij,ej->ei", N, estimate.values - before)
        correlated = None
        if self.s.target_noise:
            pairs = self._pairs(estimate, system.use)
            if len(pairs):
                typical = (self.grid.weights * system.use[..., None])[system.good].mean(axis=0)
                extra = pairs.normal_matrices(typical[None], system.at.A[..., EOP])[0]
                correlated = extra / variance**2
        free = np.array(free_columns(self.s.free), dtype=np.int64)
        return estimate_movement(
            N / variance, b / variance, free, system.good, self.s.drift_period, correlated
        )

    def _pairs(self, estimate: _Estimate, use: NDArray[np.bool_]) -> CorrelatedPairs:
        return correlated_pairs(
            estimate.residuals, use, self.testfield.groups, self._redundancy_share(use)
        )

    @property
    def has_offsets(self) -> bool:
        """Whether the targets' offsets are unknowns: only where the field has sigmas."""
        return self.s.target_offsets and bool((self.testfield.sigmas > 0).any())

    def solve(self, start: _Start, use: NDArray[np.bool_], variance: float) -> _Estimate:
        """Gauss-Newton with one linearisation at the series' mean, renewed while that moves.

        variance: of unit weight, by which the offsets' prior is weighted against image points.
        """
        values, offsets, pose = start.values, start.offsets, start.pose
        system = self._linearised(values, use, variance)
        residuals = self._residuals(values, offsets, planes(2, *use.shape))
        for _ in range(_ITERATIONS):
            step = system.step(residuals, offsets, self._deviations(values, pose))
            values = values.copy()
            values[:, system.own] += step.d_own
            values[:, system.common] += step.d_common
            if len(system.common):
                pose = pose + step.d_common
            offsets = offsets + step.d_offsets
            if step.size < _SMALL:
                system.move(residuals, step)
                break
            residuals = self._residuals(values, offsets, residuals)
            moved = np.zeros(16)
            moved[system.common] = step.d_common
            if system.good.any():
                moved[system.own] += np.median(step.d_own[system.good], axis=0)
            if np.abs(system.at.A @ moved).max(initial=0.0) > _RELINEARISE_PX:
                system = self._linearised(values, use, variance)
        return _Estimate(values, offsets, pose, residuals, system, step.sizes < _NEAR)

    def _deviations(self, values: Array, pose: Array) -> Array | None:
        """How far the own parameters (E, p) are from what their prior draws them to."""
        if self.bound is None:
            return None
        deviations = np.zeros((len(values), len(self.s.per_epoch)))
        deviations[:, -len(pose) :] = values[:, EOP] - pose
        return deviations

    def snoop(
        self, estimate: _Estimate, use: NDArray[np.bool_]
    ) -> tuple[_Estimate, NDArray[np.bool_]]:
        """Find the gross errors; the estimate without them and what takes part."""
        shared = len(self.s.common) > 0 or self.has_offsets
        return (self._snoop_together if shared else self._snoop_apart)(estimate, use)

    def with_target_noise(self, estimate: _Estimate, use: NDArray[np.bool_]) -> _Series:
        """The series with every target's weights from the scatter of its own residuals."""
        ratios = noise_ratios(
            estimate.residuals, self.grid.weights, use, self._redundancy_share(use)
        )
        weights = self.grid.weights.copy(order="K")
        weights[..., :2] /= ratios
        weights[..., 2] /= np.sqrt(ratios.prod(axis=1))
        return replace(self, grid=ObservationGrid(self.grid.points, weights))

    def _redundancy_share(self, use: NDArray[np.bool_]) -> float:
        """Redundancy over observations: what the parameters have left of the residuals."""
        n = 2 * int(use.sum())
        own = len(self.s.per_epoch) * int(use.any(axis=1).sum())
        return max((n - own) / max(n, 1), 0.05)

    def _snoop_together(
        self, estimate: _Estimate, use: NDArray[np.bool_]
    ) -> tuple[_Estimate, NDArray[np.bool_]]:
        """Data snooping where all epochs share unknowns: every round solves the series again."""
        variance, offered = 1.0, use
        rejections = Rejections(use)
        typical = None
        for _ in range(_ROUNDS):
            tests = point_tests(estimate.system, estimate.residuals)
            typical = typical or typical_variance(tests, use)
            keep = snoop_series(
                tests, offered, use, self.s.unknowns, self.s.snooping_alpha, typical
            )
            keep = rejections.settle(use, keep)
            previous, variance = variance, self.variance(estimate)
            settled = not self.has_offsets or abs(variance / previous - 1) < 0.02
            if settled and np.array_equal(keep, use):
                break
            use = keep
            estimate = self.solve(estimate, use, variance)
        return estimate, use

    def _snoop_apart(
        self, estimate: _Estimate, use: NDArray[np.bool_]
    ) -> tuple[_Estimate, NDArray[np.bool_]]:
        """Data snooping where epochs share nothing: only those that changed are solved again."""
        values, residuals = estimate.values, estimate.residuals
        system = whole = replace(estimate.system, use=use.copy())
        offered, use, rows = use, whole.use, np.arange(len(use))
        rejections = Rejections(use)
        part: slice | NDArray[np.int64] = slice(None)  # without a copy
        typical = None
        for _ in range(_ROUNDS):
            tests = point_tests(system, residuals[part])
            typical = typical or typical_variance(tests, use)
            keep = snoop_series(
                tests, offered[part], use[part], self.s.unknowns, self.s.snooping_alpha, typical
            )
            keep = rejections.settle(use[part], keep, part)
            changed = (keep != use[part]).any(axis=1)
            part = rows = rows[changed]
            if len(rows) == 0:
                break
            system = SeriesSystem.build(
                whole.at, self.grid.weights[rows], keep[changed], whole.own, whole.common, None
            )
            some = replace(self, grid=ObservationGrid(self.grid.points[rows], system.weights))
            values[rows], residuals[rows] = some._without(system, values[rows], residuals[rows])
            whole.replace(rows, system)
        return replace(estimate, values=values, residuals=residuals, system=whole), use

    def _without(self, system: SeriesSystem, values: Array, left: Array) -> tuple[Array, Array]:
        """Values (E, 16) and residuals (E, T, 2) of epochs of which points were taken out."""
        offsets = np.zeros((left.shape[1], 2))
        for _ in range(_ITERATIONS):
            step = system.step(left, offsets)
            values[:, system.own] += step.d_own
            if step.size < _NEAR:
                system.move(left, step)
                break
            left = self._residuals(values, offsets, left)
        return values, left

    def _linearised(self, values: Array, use: NDArray[np.bool_], variance: float) -> SeriesSystem:
        used = use.any(axis=1)
        mean = np.median(values[used] if used.any() else values, axis=0)
        at = linearise(self.sensor, self.testfield, mean[IOP], mean[EOP])
        prior = self._offset_prior(at) * variance if self.has_offsets else None
        own = self.s.per_epoch
        bound = None
        if self.bound is not None:
            bound = np.zeros((len(own), len(own)))
            bound[-6:, -6:] = self.bound * variance
        return SeriesSystem.build(at, self.grid.weights, use, own, self.s.common, prior, bound)

    def _residuals(self, values: Array, offsets: Array, out: Array) -> Array:
        if (values == values[:1]).all():
            first = project(self.sensor, values[0, IOP], values[0, EOP], self.testfield.points)
            np.subtract(self.grid.points, first, out=out)
        else:
            series_residuals(self.sensor, self.grid, self.testfield.points, values, out)
        if self.has_offsets:
            out -= offsets
        return out

    def _offset_prior(self, at: Partials) -> Array:
        """Inverse covariance (T, 3) px⁻² of the offsets, from that of the object coordinates."""
        variance = self.testfield.sigmas**2
        tiny = 1e-12  # px²: a target without sigma has no offset
        xx = (at.B[:, 0] ** 2 * variance).sum(axis=1) + tiny
        yy = (at.B[:, 1] ** 2 * variance).sum(axis=1) + tiny
        xy = (at.B[:, 0] * at.B[:, 1] * variance).sum(axis=1)
        prior: Array = np.stack([yy, xx, -xy], axis=1) / (xx * yy - xy**2)[:, None]
        return prior

    def _sums(self, estimate: _Estimate) -> tuple[Array, Array]:
        """Weighted sum of squares (E,) and redundancy (E,) of every epoch."""
        use = estimate.system.use
        vPv = sums_of_squares(self.grid.weights, estimate.residuals, use)
        n = use.sum(axis=1) * estimate.system.good
        share = estimate.system.common_share() * n / max(int(n.sum()), 1)
        return vPv, 2 * n - estimate.system.own_count() - share

    def variance(self, estimate: _Estimate) -> float:
        """Variance of unit weight of the series, the median over its epochs."""
        return _pooled(*self._sums(estimate), estimate.system.good)

    def result(self, estimate: _Estimate, use: NDArray[np.bool_], choice: str) -> SeriesAdjustment:
        """Judge the epochs and scale the covariances."""
        system, s = estimate.system, self.s
        vPv, redundancy = self._sums(estimate)
        positive = redundancy > 0
        unit = vPv / np.where(positive, redundancy, 1.0)
        pooled = _pooled(vPv, redundancy, system.good)
        stated = sums_of_squares(self.stated, estimate.residuals, system.use)
        sigma0 = np.sqrt(stated / np.where(positive, redundancy, 1.0))
        sigma0[~positive] = np.nan
        cofactors = system.covariances()
        relative, level, trend = cofactors.relative, cofactors.level, cofactors.trend
        excess, own, sound = np.zeros(16), system.own, system.good
        block = (slice(None), own[:, None], own)
        if s.scale == "posterior":
            # What priors of the mount contribute is known as well as the mount, not as the epoch.
            bound = system.from_priors()
            relative[block] -= bound
            relative *= epoch_variance(unit, redundancy, pooled)[:, None, None]
            relative[block] += pooled * bound
            level *= pooled
        trend *= pooled
        movement = self.movement
        if s.exterior == "series" and len(use) >= FEWEST_EPOCHS:
            movement = self.observed_movement(estimate)
        mount_trend = np.zeros((16, 16))
        if movement.covariance.any() and sound.any():
            if s.exterior == "series":
                relative[block] += system.of_common(movement.covariance)
            G = system.typical_sensitivity()
            mount_trend[own[:, None], own] = G @ movement.tilt(line_weights(sound)) @ G.T
        slow = np.zeros((16, 16))
        if s.target_noise and len(use) >= _ENOUGH_FOR_NOISE:
            pairs = self._pairs(estimate, use)
            if len(pairs):
                relative += system.correlated(pairs)
            slow = system.slow(slow_errors(estimate.residuals, use), self.testfield.groups)
            trend += slow
        if s.target_noise:
            variances = np.diagonal(relative, axis1=1, axis2=2)[:, own]
            excess[own] = excess_scatter(
                estimate.values[sound][:, own], variances[sound],
                kinks=s.exterior != "per_epoch", drift=s.drift_period > 0,
            )  # fmt: skip
            relative[:, own, own] += excess[own] * sound[:, None]
        # Slow errors: a line through zero in the middle of the series, uncertain at its ends.
        if slow.any():
            relative += np.linspace(-0.5, 0.5, len(use))[:, None, None] ** 2 * slow
        relative[~sound] = 0.0
        stillness = np.full(len(sigma0), np.nan)
        if s.exterior == "series":
            score = system.score(estimate.residuals, EOP_COLUMNS)
            stillness = score / np.where(positive, unit, 1.0)
        values = estimate.values.copy()
        observed = self.grid.observed
        status, reasons = judge(
            self.sensor, self.testfield, self.grid, s, values, use, sound, relative,
            unit / pooled, redundancy,
        )  # fmt: skip
        values[[word != "ok" for word in status]] = np.nan
        return SeriesAdjustment(
            s, values, relative, level, sigma0, redundancy, use, observed & ~use,
            estimate.residuals, estimate.offsets if self.has_offsets else estimate.offsets * np.nan,
            np.sqrt(system.offset_cofactors() * pooled), tuple(status), tuple(reasons), stillness,
            np.sqrt(excess), np.sqrt(np.diag(trend + mount_trend)),
            self._noise_ratio(sigma0, sound), movement, choice,
        )  # fmt: skip

    def _noise_ratio(self, sigma0: Array, sound: NDArray[np.bool_]) -> float:
        """The noise found over the one stated."""
        found = sigma0[sound & np.isfinite(sigma0)]
        return float(np.median(found)) if len(found) else 1.0


def epoch_variance(unit: Array, redundancy: Array, pooled: float) -> Array:
    """Variance of unit weight (E,) that scales an epoch's covariance.

    The epoch's own, and never below the series' where a handful of residuals may be small by luck.
    """
    few = redundancy < TRUSTED_REDUNDANCY
    own: Array = np.where(few, np.maximum(unit, pooled), unit)
    return np.where(redundancy > 0, own, pooled)


def _pooled(vPv: Array, redundancy: Array, good: NDArray[np.bool_]) -> float:
    good = good & (redundancy > 0)
    return float(np.median(vPv[good] / redundancy[good])) if good.any() else 1.0
