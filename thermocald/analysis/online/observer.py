"""Monitoring of a running camera: filter, innovation test, equilibrium."""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.online.equilibrium import Equilibrium, EquilibriumWatch
from thermocald.analysis.online.filter import FieldErrors, OnlineFilter
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.result import with_sds

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.acquisition.calibrator import CalibratedEpoch
    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.epoch.adjustment import Adjustment
    from thermocald.photogrammetry.field.testfield import TestField

_IOP = slice(0, 3)
_MOVED_AFTER = 5  # epochs in a row
_SENTENCES = {
    "knock": "the camera was moved: its exterior orientation changed between two epochs",
    "slip": "the principal point or distance jumped: lens or sensor slipped",
    "wrong_lens": "the principal distance is a different one: another lens, or refocused",
    "change": "the orientation changed in a way that is neither a knock nor a slip",
}


def condition_on_exterior(
    values: Array, covariance: Array, unit: float
) -> tuple[Array, Array, Array]:
    """Condition (c, x0, y0) of an epoch on its exterior orientation.

    values (16,), covariance (16, 16) of the epoch's noise; unit: of the results in mm, the pixel
    pitch. Returns values (3,), gain (3, 6) and sds (3,) as `EquilibriumWatch.add` takes them.
    Errors of the test field are the same in both orientations and cancel.
    """
    block = covariance[10:, 10:]
    cross = covariance[_IOP, 10:]
    if not np.diag(block).all():
        gain = np.zeros((3, 6))
    else:
        s = np.sqrt(np.diag(block))
        gain = np.linalg.solve(block / np.outer(s, s), (cross / s).T).T / s
    variance = np.diag(covariance[_IOP, _IOP] - gain @ cross.T)
    sds = np.sqrt(np.where(variance > 0, variance, np.nan))
    return (values[_IOP] - gain @ values[10:]) / unit, gain / unit, sds / unit


class OnlineObserver:
    """An observer of a running camera, which receives every calibrated epoch in order.

    tell(kind, text, utc, epoch): called for a knock, a slip, another lens, a moved target.
    """

    def __init__(
        self,
        sensor: Sensor,
        testfield: TestField,
        tell: Callable[[str, str, float, int], None],
    ) -> None:
        self._errors = FieldErrors(sensor, testfield)
        self.filter = OnlineFilter(sensor, self._errors.variances)
        self.watch = EquilibriumWatch()
        self._pitch = sensor.pixel_pitch
        self._field = testfield
        self._tell = tell
        self._rejected: Counter[int] = Counter()
        self._reported: set[int] = set()
        self._equilibrium = Equilibrium("unknown")

    def observe(
        self, calibrated: CalibratedEpoch, adjusted: Adjustment | None = None,
        tremble: Array | None = None, field_variance: float = 1.0,
    ) -> dict[str, float]:  # fmt: skip
        """Observe an epoch; return columns for the store.

        adjusted: the epoch's result within its series, by default its own result; tremble (6, 6):
        covariance of the mount's movements about its mean, estimated from the epochs so far;
        field_variance: factor of the stated covariance of the field.
        """
        epoch, adjustment = calibrated.epoch, adjusted or calibrated.adjustment
        temperature = next(iter(epoch.temperatures.values()), math.nan)
        if not adjustment.ok or epoch.observations is None:
            return {}
        errors = self._errors.split(adjustment, epoch.observations, field_variance)
        innovation = self.filter.update(adjustment, temperature, errors, tremble)
        self._watch_targets(calibrated, adjustment)
        event = innovation.change if innovation.change in _SENTENCES else ""
        if event:
            self._tell(event, _SENTENCES[event], epoch.frame_time, epoch.number)
            self.watch.clear()
        if innovation.change != "outlier":
            given = condition_on_exterior(adjustment.values, errors[0], self._pitch)
            self.watch.add(epoch.frame_time, *given)
        self._equilibrium = self.watch.assess(self.filter.values()[10:])
        columns = {
            "innovation_chi2": innovation.chi2,
            "innovation_bound": innovation.bound,
            "drift_px_per_min": self._equilibrium.drift,
            "sd_drift_px_per_min": self._equilibrium.sd_drift,
        }
        sd = np.sqrt(np.diag(self.filter.covariance()))
        for k, name in enumerate(PARAMETER_NAMES[_IOP]):
            columns[f"online_{name}"] = float(self.filter.values()[k])
            columns[f"sd_online_{name}"] = float(sd[k])
        if event:
            columns["event"] = 1.0
        return columns

    def report(self) -> dict[str, Any]:
        """Return state, drift, time to steady and the estimates with sds, for status and page."""
        now = self._equilibrium
        report: dict[str, Any] = {
            "state": now.state,
            "sentence": now.sentence,
            "drift_px_per_min": now.drift,
            "sd_drift_px_per_min": now.sd_drift,
            "ready_in_s": now.ready_in,
            "sd_ready_in_s": now.sd_ready_in,
            "epochs": self.filter.epochs,
        }
        if self.filter.epochs:
            values = self.filter.values()
            sd = np.sqrt(np.diag(self.filter.covariance()))
            rates, sd_rates = self.filter.rates, np.sqrt(np.diag(self.filter.rates_covariance))
            free = np.flatnonzero(sd > 0)
            report |= with_sds([PARAMETER_NAMES[k] for k in free], values[free], sd[free])
            names = [f"d{name}_dT" for name in PARAMETER_NAMES[_IOP]]
            report |= with_sds(names, rates, sd_rates)
        return report

    def _watch_targets(self, calibrated: CalibratedEpoch, adjusted: Adjustment) -> None:
        """Report a target that is rejected in several epochs in a row.

        The epoch's own adjustment must reject it, and that in the series must not use it.
        """
        taken = np.isfinite(adjusted.residuals).all(axis=1)
        used = set(adjusted.targets[taken].tolist()) - set(adjusted.rejected)
        rejected = set(calibrated.adjustment.rejected) - used
        measured = set(calibrated.adjustment.targets.tolist())
        for row in list(self._rejected):
            if row in measured and row not in rejected:
                del self._rejected[row]
                self._reported.discard(row)
        self._rejected.update(rejected)
        epoch = calibrated.epoch
        for row in sorted(rejected - self._reported):
            if self._rejected[row] >= _MOVED_AFTER:
                self._reported.add(row)
                name = self._field.names[row]
                text = (
                    f"target {name} has contradicted the others for {_MOVED_AFTER} epochs: it "
                    "moved, or its coordinates are wrong"
                )
                self._tell("target_moved", text, epoch.frame_time, epoch.number)
