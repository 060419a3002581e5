"""A series in progress: the estimator of `replay`, given one epoch after the other.

Every epoch has a result of its own, with its own exterior orientation. It is corrected by what the
epochs so far show of the targets: their offsets, how precisely each is measured, which ones wander.
In addition the epoch has a result within its series, the same as `replay` of the epochs so far: one
orientation for all of them, or one and the movements of the mount.

The last epochs are stored and adjusted together again: after each of the first 120 if there is
time, and finally after half as many as are stored. From then on time per epoch and memory are
constant, however long the series. What all epochs share (the level) depends on which targets are
seen and rejected, and may be far less certain than the difference of two epochs. An epoch's own
result is therefore reduced to the level of the first one: the correction is the change of the
stored epochs' results since they were reported.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.photogrammetry.camera.camera_model import (
    EOP,
    IOP,
    PARAMETER_NAMES,
    PRINCIPAL,
    ExteriorOrientation,
    InteriorOrientation,
    project,
)
from thermocald.photogrammetry.epoch.gauss_markov import TRUSTED_REDUNDANCY
from thermocald.photogrammetry.field.testfield import find_misplaced
from thermocald.photogrammetry.series.adjustment import adjusted, result
from thermocald.photogrammetry.series.field_motion import taken_off
from thermocald.photogrammetry.series.long_series import KnownSeries
from thermocald.photogrammetry.series.mount import FEWEST_EPOCHS, drift_gaps, drift_period, image_px
from thermocald.photogrammetry.series.normals import ObservationGrid, joined, misplaced_targets
from thermocald.photogrammetry.series.result import SeriesSettings
from thermocald.photogrammetry.series.target_noise import FEW_EPOCHS

if TYPE_CHECKING:
    from thermocald.acquisition.calibrator import CalibratedEpoch
    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.epoch.adjustment import Adjustment, AdjustmentSettings
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.photogrammetry.series.estimator import Estimate, SeriesEstimator
    from thermocald.photogrammetry.series.field_motion import FieldMovement
    from thermocald.photogrammetry.series.result import Exterior, SeriesAdjustment

_WINDOW = 200  # epochs that are held in memory
_WINDOW_POINTS = 60_000  # image points of these epochs: 2.4 MB
_FEWEST = 101  # epochs that are held even with many targets
_EACH = 120  # first epochs, after each of which the series is adjusted again if there is time
_OFTEN, _SELDOM = 0.1, 0.5  # fraction of new epochs after which it is adjusted again otherwise
_SOON = 0.05  # the fraction for the series, whose level changes with it, if there is time
_MOST_TARGETS = 400  # with offsets: their normal matrix is full
_TURNED_PX, _STAYS = 30.0, 2  # beyond the linearisation, for so many epochs in a row
_USUAL_TREMBLE_PX = 0.08  # the largest of the real cameras' mounts that were examined
_LEFT = 0.01  # a second test of a point has this fraction of the series' error probability
_AGAINST = ("too_many_rejected", "global_test")  # statuses of an epoch that contradicts its series
_CARRIED = ("weak_geometry", "global_test")  # statuses of an epoch that its series may carry
# the same for few targets, which do not show whether some are wrong or all noisier than stated
_CARRIED_FEW = ("too_many_rejected", "too_few_targets", "no_convergence")
_MOST_SAID = 6  # targets that are named
_DOUBTED = 5  # epochs in a row with a result of their own and none in the series, or with neither

_ESTIMATED = PARAMETER_NAMES[PRINCIPAL]


@dataclass(eq=False)
class _Kept:
    """A stored epoch.

    grid: its observations; time s; temperature °C; alone (16,): its own values; reported (16,):
    those that were reported, None if the same.
    """

    grid: ObservationGrid
    number: int
    time: float
    temperature: float
    alone: Array
    reported: Array | None = None


@dataclass(eq=False)
class _Together:
    """The joint adjustment of the stored epochs.

    seen (t,): targets of the field that take part; moved: movements of the field.
    """

    seen: Index
    series: SeriesEstimator
    estimate: Estimate
    sample: SeriesAdjustment
    moved: tuple[FieldMovement, ...]

    @cached_property
    def known(self) -> KnownSeries:
        """The part of the adjustment that applies to later epochs."""
        return KnownSeries.of(self.series, self.estimate, self.sample)

    @property
    def image_px(self) -> float:
        """The size of the mount's movements in the image, px."""
        return image_px(self.sample.movement.covariance, self.estimate.system.design.at.A)

    def epoch(self, alone: Adjustment, row: int, s: SeriesAdjustment | None = None) -> Adjustment:
        """Return the result of one of the epochs, or of one of another series `s`.

        alone: its own calibration; the covariance is relative to the series.
        """
        s = s or self.sample
        return replace(
            _placed(alone, s.values[row]),
            status=s.status[row],
            reason=s.reasons[row],
            covariance=s.covariance[row],
            sigma0=float(s.sigma0[row]),
            redundancy=int(s.redundancy[row]),
            residuals=s.residuals[row][alone.targets],
            rejected=tuple(np.flatnonzero(s.rejected[row]).tolist()),
        )

    def further(self, alone: Adjustment, grid: ObservationGrid, epochs: int) -> Adjustment:
        """Adjust a later epoch, given its series."""
        if self.moved:
            grid = taken_off(grid, self.moved, slice(-1, None))
        seen = grid.targets(self.seen)
        _, block = self.known.adjusted(seen, epochs, np.array([0.5]))  # the last of the series
        return self.epoch(alone, 0, block.spread(self.seen, grid.points.shape[1]))


def _placed(result: Adjustment, values: Array) -> Adjustment:
    """Return a result with other parameters (16,)."""
    return replace(
        result,
        interior=InteriorOrientation.from_array(values[IOP]),
        exterior=ExteriorOrientation.from_array(values[EOP]),
    )


def _rejecting(result: Adjustment, more: Mask) -> Adjustment:
    """Return a result that rejects more targets (T,)."""
    return replace(
        result, rejected=tuple(sorted({*result.rejected, *np.flatnonzero(more).tolist()}))
    )


class RunningSeries:
    """A series in progress, whose epochs may arrive in any order; not thread-safe.

    exterior: as in `SeriesSettings`; offsets: estimate one offset per target, with the test field's
    sigmas as prior. epochs: the number taken in since the start or the last reset.
    """

    def __init__(
        self,
        sensor: Sensor,
        testfield: TestField,
        settings: AdjustmentSettings,
        *,
        exterior: Exterior,
        offsets: bool,
    ) -> None:
        self._sensor, self._field = sensor, testfield
        offsets = offsets and bool((testfield.sigmas > 0).any())
        self._asked = replace(SeriesSettings.of(settings, exterior), target_offsets=offsets)
        size = min(_WINDOW, max(_WINDOW_POINTS // max(len(testfield), 1), _FEWEST))
        self._kept: deque[_Kept] = deque(maxlen=size)
        self._hurried = False
        self.reset()

    def reset(self, after: int = 0) -> None:
        """Start a new series; after: the epoch because of which it is started."""
        self.epochs, self._restarted = 0, after
        self._look_at = [0, 0]
        self._period, self._offsets = 0.0, False
        self._kept.clear()
        self._each: _Together | None = None
        self._series: _Together | None = None
        self._level = np.zeros(16)
        self._shown = self._wrong = np.zeros(len(self._field), dtype=bool)
        self._doubts = self._away = self._refused = 0

    @property
    def tremble(self) -> Array:
        """Covariance (6, 6) of the mount's movements about its mean exterior orientation.

        A typical one until the epochs show it.
        """
        s = None if self._series is None else self._series.sample
        if s is not None and s.exterior != "per_epoch":
            return s.movement.covariance
        covariance = np.zeros((6, 6))
        if self._kept:
            angle = _USUAL_TREMBLE_PX * self._sensor.pixel_pitch / self._kept[-1].alone[0]
            covariance[:3, :3] = angle**2 * np.eye(3)
        return covariance

    @property
    def field_variance(self) -> float:
        """The estimated factor of the stated covariance of the field's coordinates."""
        return 1.0 if self._series is None else self._series.series.field_variance

    @property
    def any(self) -> bool:
        """True if epochs have both common parameters and parameters of their own."""
        s = self._asked
        return len(s.free) > 0 and (s.exterior != "per_epoch" or s.target_offsets)

    def remember(
        self, calibrated: CalibratedEpoch, seen: Observations, reported: Array | None = None
    ) -> None:
        """Store an epoch; reported (16,): its values, if they were reported before a restart."""
        epoch, alone = calibrated.epoch, calibrated.adjustment
        if alone.interior is None and not self._kept:
            return
        self.epochs += 1
        self._kept.append(
            _Kept(
                ObservationGrid.from_observations(self._field, [seen]),
                epoch.number,
                epoch.frame_time,
                next(iter(epoch.temperatures.values()), np.nan),
                self._kept[-1].alone if alone.interior is None else alone.values,
                reported,
            )
        )

    def refine(
        self, calibrated: CalibratedEpoch, seen: Observations, *, hurried: bool = False
    ) -> tuple[Adjustment, dict[str, float]]:
        """Return an epoch's own result given the epochs so far, and its result in the series.

        The latter as columns for the store. calibrated: the epoch's own calibration, whose result
        is returned unchanged if it failed; seen: its observations with the sigmas that are used;
        hurried: whether further epochs are waiting.
        """
        alone = calibrated.adjustment
        given = alone.interior is not None
        carried = alone.status in _CARRIED if given else self._may_carry(alone)
        if not self.any or not (alone.ok or carried):
            return alone, {}
        self._hurried = hurried
        columns: dict[str, float] = {}
        if self._elsewhere(seen):
            if not given:
                return alone, columns
            self._away += 1
            if self._away < _STAYS:
                return alone, columns
            self.reset(calibrated.epoch.number)
            columns["series_restarted"] = 1.0
        self._away = 0
        self.remember(calibrated, seen)
        if alone.status == "global_test" and len(self._kept) < FEW_EPOCHS:
            return alone, columns  # too few to show whether the noise is larger than stated
        own, whole = self._adjust_newest(alone)
        if not given and not whole.ok:
            self._kept.pop()
            self.epochs -= 1
            self._refused += 1
            return alone, columns
        self._refused = 0
        columns |= self._columns(whole)
        if not carried:  # what is carried contradicts nothing
            against = any(e is not None and e.status in _AGAINST for e in (own, whole))
            self._doubts = self._doubts + 1 if against else 0
        refined = alone
        wrong = self._wrong & self._kept[-1].grid.observed[0]
        if own is not None and own.ok:
            values = self._kept[-1].reported = own.values - self._level
            refined = _rejecting(_placed(own, values), wrong)
        elif carried and whole.ok and self._series is not None:
            # too weak by itself: its result in the series, plus the uncertainty of the level
            level = np.diag(self._series.sample.level_sd**2)
            refined = _rejecting(replace(whole, covariance=whole.covariance + level), wrong)
        if self._doubts >= _DOUBTED:
            self.reset(calibrated.epoch.number)
            columns["series_restarted"] = 1.0
        return refined, columns

    def report(self) -> dict[str, Any]:
        """Return how the exterior orientation is modelled and on how many epochs, for status."""
        if self._series is None:
            return {}
        series, n, asked = self._series, len(self._kept), self._asked.exterior
        if series.sample.exterior == "mount":
            text = f"the mount moves by {series.image_px:.3f} px about one orientation ({n} epochs)"
        elif series.sample.exterior == "series":
            still = "the camera stands still" if asked == "auto" else "as configured"
            text = f"{still}: one orientation for {n} epochs"
        elif asked != "per_epoch":
            good = int(series.estimate.system.good.sum())
            text = (
                f"each epoch has its own orientation until {FEWEST_EPOCHS} good epochs show "
                f"whether the camera stands still; {good} so far"
            )
        else:
            text = "each epoch has its own orientation, as configured"
        if self._wrong.any():
            names = [self._field.names[t] for t in np.flatnonzero(self._wrong)[:_MOST_SAID]]
            text += f"; left out as misplaced in the test field: {', '.join(names)}"
        if self._restarted:
            text += f"; begun again after epoch {self._restarted}"
        return {"orientation": text, "exterior": series.sample.exterior, "series_epochs": n}

    def _columns(self, whole: Adjustment) -> dict[str, float]:
        """Return an epoch's result in its series as columns for the store."""
        if self._series is None or not whole.ok:
            return {}
        sd, level = np.sqrt(np.diag(whole.covariance)), self._series.sample.level_sd
        columns = {"series_epochs": float(len(self._kept))}
        if self._series.sample.exterior != "per_epoch":
            columns["mount_px"] = self._series.image_px
        for k, name in enumerate(_ESTIMATED):
            if sd[k] > 0:
                columns[f"series_{name}"] = float(whole.values[k])
                columns[f"sd_series_{name}"] = float(sd[k])
                columns[f"level_sd_{name}"] = float(level[k])
        return columns

    def _may_carry(self, alone: Adjustment) -> bool:
        """Return whether the series may carry an epoch that has no values of its own."""
        redundancy = 2 * alone.n_observations - len(self._asked.unknowns)
        few = alone.status in _CARRIED_FEW and redundancy < TRUSTED_REDUNDANCY
        return few and len(self._kept) >= FEW_EPOCHS and self._refused < _DOUBTED

    def _elsewhere(self, seen: Observations) -> bool:
        """Return whether the targets have moved further in the image than a mount can move them."""
        if not self._kept:
            return False
        last = self._kept[-1].alone
        there = project(self._sensor, last[IOP], last[EOP], self._field.points[seen.targets])
        return bool(np.median(np.abs(seen.points - there)) > _TURNED_PX)

    def _adjust_newest(self, alone: Adjustment) -> tuple[Adjustment | None, Adjustment]:
        """Return the newest epoch's own result, None if unchanged, and that in its series."""
        whole, newest = None, self._kept[-1].grid.reject(self._wrong)
        more = (newest.observed[0] & ~self._shown).any()  # targets that no earlier epoch showed
        if self._series is not None and not more and self.epochs < self._look_at[1]:
            whole = self._series.further(alone, newest, len(self._kept))
        if whole is None or whole.status in _AGAINST:
            row = self._adjust_all()
            assert self._series is not None
            whole = self._series.epoch(alone, row)
            if not self._offsets:
                return None, whole
            if self._each is None and (last := self._own_schedule()[0]) < self.epochs:
                self._each = self._adjust_each(last)  # after a restart of the program
            due = self._each is None or self.epochs >= self._look_at[0]
            if due or whole.status in _AGAINST:
                self._each = self._adjust_each()
                return _rejecting(self._each.epoch(alone, row), self._gross()[row]), whole
        if self._each is None:
            return None, whole
        gross = np.isin(np.arange(len(self._field)), whole.rejected) & (self._binds and whole.ok)
        newest = self._kept[-1].grid.reject(self._wrong).reject(gross)
        own = self._each.further(alone, newest, len(self._kept))
        return _rejecting(own, gross), whole

    def _gross(self) -> Mask:
        """Return which image points (E, T) of the stored epochs contradict their series.

        One orientation for all of them, or small movements about it, reveals errors that an epoch's
        own orientation absorbs.
        """
        assert self._series is not None
        s = self._series.sample
        return s.rejected & s.ok[:, None] & self._binds

    @property
    def _binds(self) -> bool:
        """True if the series has one orientation, or one and small movements about it."""
        return self._series is not None and self._series.sample.exterior != "per_epoch"

    def _again(self, share: float) -> int:
        """Return the epoch at which all are adjusted together again."""
        full = len(self._kept) == self._kept.maxlen
        return self.epochs + max(int((_SELDOM if full else share) * len(self._kept)), 1)

    def _lay_out(self) -> tuple[list[_Kept], ObservationGrid, Array, int]:
        """Return stored epochs by number, observations, initial values, and the newest's row."""
        kept = sorted(self._kept, key=lambda k: k.number)
        start = np.median([k.alone for k in kept], axis=0)
        return kept, joined([k.grid for k in kept]), start, kept.index(self._kept[-1])

    def _adjust_all(self) -> int:
        """Adjust the stored epochs as `replay` does; return the row of the newest."""
        kept, grid, start, row = self._lay_out()
        # times as if the clock had never been set back
        time = np.array([k.time for k in kept])
        steps = np.diff(time)
        usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
        time[1:] = time[0] + np.cumsum(np.where(steps > 0, steps, usual))
        self._period = drift_period(time, np.array([k.temperature for k in kept]))
        self._shown = np.asarray(grid.observed.any(axis=0))
        self._offsets = self._asked.target_offsets and self._shown.sum() <= _MOST_TARGETS
        s = replace(
            self._asked, drift_period=self._period, gaps=drift_gaps(time),
            target_offsets=self._offsets,
        )  # fmt: skip
        alone, c_px = np.array([k.alone for k in kept]), start[0] / self._sensor.pixel_pitch
        self._wrong = misplaced_targets(self._sensor, self._field, grid, alone)
        while True:  # a single pass, unless misplaced targets biased the initial values
            self._series = series = self._together(grid.reject(self._wrong), start, s, ())
            drawn = find_misplaced(series.sample.offsets, c_px)
            if not drawn.any():
                break
            self._wrong = self._wrong | drawn
        grid = grid.reject(self._wrong)
        share = _OFTEN if self._hurried else 0.0 if self.epochs < _EACH else _SOON
        self._look_at[1] = self._again(share)
        if len(kept) < FEWEST_EPOCHS:
            return row
        from thermocald.analysis.series.adjusted import correct_field  # late: it takes 2 MB

        moved, still = correct_field(
            self._sensor, self._field, grid, series.sample, start,
            np.array([k.number for k in kept]), time,
        )  # fmt: skip
        if moved:
            self._series = self._together(still, start, s, moved)
        return row

    def _own_schedule(self) -> tuple[int, int]:
        """Return the last and next epoch of `_adjust_each`, the same ones after a restart."""
        if len(self._kept) == self._kept.maxlen:
            return self.epochs, self._again(_OFTEN)
        last = following = 1
        while following <= self.epochs:
            last, following = following, following + max(int(_OFTEN * following), 1)
        return last, following

    def _adjust_each(self, first: int | None = None) -> _Together:
        """Adjust the stored epochs, or the first ones, each with an orientation of its own."""
        assert self._series is not None
        kept, grid, start, _ = self._lay_out()
        each = self._series
        if self._binds or first is not None:
            grid = taken_off(grid.reject(self._wrong), each.moved).reject(self._gross())
            kept, grid = kept[:first], grid[slice(first)]
            s = replace(self._asked, exterior="per_epoch", drift_period=self._period)
            if self._binds:
                # the series has tested every point: a second test looks for large errors only
                s = replace(s, snooping_alpha=_LEFT * s.snooping_alpha)
            # such epochs do not determine the precision of the field
            each = self._together(grid, start, s, each.moved, self.field_variance)
        # differences of the present results from the reported ones
        change = [
            now - then.reported
            for now, then, ok in zip(each.sample.values, kept, each.sample.ok, strict=True)
            if ok and then.reported is not None
        ]
        self._level = np.median(change, axis=0) if change else np.zeros(16)
        self._look_at[0] = self._own_schedule()[1]
        return each

    def _together(
        self, grid: ObservationGrid, start: Array, s: SeriesSettings,
        moved: tuple[FieldMovement, ...], field_variance: float = 1.0,
    ) -> _Together:  # fmt: skip
        seen = np.flatnonzero(grid.observed.any(axis=0))
        series, estimate = adjusted(
            self._sensor, self._field.subset(seen), grid.targets(seen), start, s,
            field_variance=field_variance,
        )  # fmt: skip
        sample = result(series, estimate, affinity=False).spread(seen, len(self._field))
        return _Together(seen, series, estimate, sample, moved)
