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
from thermocald.photogrammetry.epoch.gauss_markov import Rejections
from thermocald.photogrammetry.series.normals import (
    ObservationGrid,
    linearise,
    planes,
    series_residuals,
    sums_of_squares,
)
from thermocald.photogrammetry.series.result import (
    EOP_COLUMNS,
    SeriesAdjustment,
    SeriesSettings,
)
from thermocald.photogrammetry.series.snooping import point_tests, snoop_series
from thermocald.photogrammetry.series.status import enough_targets, judge
from thermocald.photogrammetry.series.system import SeriesSystem
from thermocald.photogrammetry.series.target_noise import (
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


@dataclass(frozen=True, eq=False)
class _Estimate:
    """values (E, 16) and offsets (T, 2) px, the residuals (E, T, 2) px they leave, the system."""

    values: Array
    offsets: Array
    residuals: Array
    system: SeriesSystem


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
    series = _Series(sensor, testfield.subset(seen), epochs.targets(seen), s)
    start = np.concatenate([interior.as_array(), exterior.as_array()])
    use = series.grid.observed & enough_targets(series.grid, s)[:, None]
    values = np.tile(start, (len(use), 1))
    estimate = series.solve(values, np.zeros((len(seen), 2)), use, 1.0)
    if s.snooping_alpha > 0:
        estimate, use = series.snoop(estimate, use)
        if s.target_noise and len(use) >= _ENOUGH_FOR_NOISE:
            series = series.with_target_noise(estimate, use)
            estimate = series.solve(estimate.values, estimate.offsets, use, 1.0)
            estimate, use = series.snoop(estimate, use)
    return series.result(estimate, use).spread(seen, len(testfield))


@dataclass(frozen=True, eq=False)
class _Series:
    sensor: Sensor
    testfield: TestField
    grid: ObservationGrid
    s: SeriesSettings

    @property
    def has_offsets(self) -> bool:
        """Whether the targets' offsets are unknowns: only where the field has sigmas."""
        return self.s.target_offsets and bool((self.testfield.sigmas > 0).any())

    def solve(
        self, values: Array, offsets: Array, use: NDArray[np.bool_], variance: float
    ) -> _Estimate:
        """Gauss-Newton with one linearisation at the series' mean, renewed while that moves.

        variance: of unit weight, by which the offsets' prior is weighted against image points.
        """
        system = self._linearised(values, use, variance)
        residuals = self._residuals(values, offsets, planes(2, *use.shape))
        for _ in range(_ITERATIONS):
            step = system.step(residuals, offsets)
            values = values.copy()
            values[:, system.own] += step.d_own
            values[:, system.common] += step.d_common
            offsets = offsets + step.d_offsets
            if step.size < _SMALL:
                system.move(residuals, step)
                return _Estimate(values, offsets, residuals, system)
            residuals = self._residuals(values, offsets, residuals)
            moved = np.zeros(16)
            moved[system.common] = step.d_common
            if system.good.any():
                moved[system.own] = np.median(step.d_own[system.good], axis=0)
            if np.abs(system.at.A @ moved).max(initial=0.0) > _RELINEARISE_PX:
                system = self._linearised(values, use, variance)
        return _Estimate(values, offsets, residuals, system)

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
        for _ in range(_ROUNDS):
            tests = point_tests(estimate.system, estimate.residuals)
            keep = snoop_series(tests, offered, use, len(self.s.per_epoch), self.s.snooping_alpha)
            keep = rejections.settle(use, keep)
            previous, variance = variance, self.variance(estimate)
            settled = not self.has_offsets or abs(variance / previous - 1) < 0.02
            if settled and np.array_equal(keep, use):
                break
            use = keep
            estimate = self.solve(estimate.values, estimate.offsets, use, variance)
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
        for _ in range(_ROUNDS):
            tests = point_tests(system, residuals[part])
            keep = snoop_series(
                tests, offered[part], use[part], len(self.s.per_epoch), self.s.snooping_alpha
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
        return _Estimate(values, estimate.offsets, residuals, whole), use

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
        at = linearise(self.sensor, self.testfield, mean[:10], mean[10:])
        prior = self._offset_prior(at) * variance if self.has_offsets else None
        return SeriesSystem.build(
            at, self.grid.weights, use, self.s.per_epoch, self.s.common, prior
        )

    def _residuals(self, values: Array, offsets: Array, out: Array) -> Array:
        if (values == values[:1]).all():
            first = project(self.sensor, values[0, :10], values[0, 10:], self.testfield.points)
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
        return vPv, 2 * n - len(self.s.per_epoch) - share

    def variance(self, estimate: _Estimate) -> float:
        """Variance of unit weight of the series, the median over its epochs."""
        return _pooled(*self._sums(estimate), estimate.system.good)

    def result(self, estimate: _Estimate, use: NDArray[np.bool_]) -> SeriesAdjustment:
        """Judge the epochs and scale the covariances."""
        system, s = estimate.system, self.s
        vPv, redundancy = self._sums(estimate)
        positive = redundancy > 0
        sigma0 = np.sqrt(vPv / np.where(positive, redundancy, 1.0))
        sigma0[~positive] = np.nan
        relative, level, trend = system.covariances()
        pooled = _pooled(vPv, redundancy, system.good)
        if s.scale == "posterior":
            relative *= np.nan_to_num(sigma0, nan=1.0)[:, None, None] ** 2
            level *= pooled
        trend *= pooled
        slow = np.zeros((16, 16))
        if s.target_noise and len(use) >= _ENOUGH_FOR_NOISE:
            group = self.testfield.groups
            pairs = correlated_pairs(estimate.residuals, use, group, self._redundancy_share(use))
            if len(pairs):
                relative += system.correlated(pairs)
            slow = system.slow(slow_errors(estimate.residuals, use), group)
            trend += slow
        excess, own, sound = np.zeros(16), system.own, system.good
        if s.target_noise:
            variances = np.diagonal(relative, axis1=1, axis2=2)[:, own]
            excess[own] = excess_scatter(
                estimate.values[sound][:, own], variances[sound], kinks=s.exterior == "series"
            )
            relative[:, own, own] += excess[own] * sound[:, None]
        # Slow errors: a line through zero in the middle of the series, uncertain at its ends.
        if slow.any():
            relative += np.linspace(-0.5, 0.5, len(use))[:, None, None] ** 2 * slow
        relative[~sound] = 0.0
        stillness = np.full(len(sigma0), np.nan)
        if s.exterior == "series":
            stillness = system.score(estimate.residuals, EOP_COLUMNS) / np.where(
                positive, sigma0**2, 1.0
            )
        values = estimate.values.copy()
        observed = self.grid.observed
        status, reasons = judge(
            self.sensor, self.testfield, self.grid, s, values, use, sound, relative
        )
        values[[word != "ok" for word in status]] = np.nan
        return SeriesAdjustment(
            s, values, relative, level, sigma0, redundancy, use, observed & ~use,
            estimate.residuals, estimate.offsets if self.has_offsets else estimate.offsets * np.nan,
            np.sqrt(system.offset_cofactors() * pooled), tuple(status), tuple(reasons), stillness,
            np.sqrt(excess), np.sqrt(np.diag(trend)),
        )  # fmt: skip


def _pooled(vPv: Array, redundancy: Array, good: NDArray[np.bool_]) -> float:
    good = good & (redundancy > 0)
    return float(np.median(vPv[good] / redundancy[good])) if good.any() else 1.0
