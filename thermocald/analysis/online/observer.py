"""What is said about a camera while it runs: filter, innovation test and equilibrium together."""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.online.equilibrium import Equilibrium, EquilibriumWatch
from thermocald.analysis.online.filter import OnlineFilter
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from thermocald.acquisition.calibrator import CalibratedEpoch
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.field.testfield import TestField

    Array = NDArray[np.float64]

__all__ = ["OnlineObserver", "given_exterior"]

_IOP = slice(0, 3)
_MOVED_AFTER = 5  # epochs in a row
_SENTENCES = {
    "knock": "the camera was moved: its exterior orientation changed between two epochs",
    "slip": "the principal point or distance jumped: lens or sensor slipped",
    "wrong_lens": "the principal distance is another one: another lens, or refocused",
    "change": "the orientation changed in a way that is neither a knock nor a slip",
}


def given_exterior(values: Array, covariance: Array, exterior: Array) -> tuple[Array, Array]:
    """(c, x0, y0) and their sds mm, given that the exterior orientation is `exterior` (6,).

    values (16,), covariance (16, 16) of one epoch; NaN for what was held.
    """
    block = covariance[10:, 10:]
    cross = covariance[_IOP, 10:]
    if not np.diag(block).all():
        gain = np.zeros((3, 6))
    else:
        s = np.sqrt(np.diag(block))
        gain = np.linalg.solve(block / np.outer(s, s), (cross / s).T).T / s
    given = values[_IOP] - gain @ (values[10:] - exterior)
    variance = np.diag(covariance[_IOP, _IOP] - gain @ cross.T)
    sds = np.sqrt(np.where(variance > 0, variance, np.nan))
    return given, sds


class OnlineObserver:
    """Told every calibrated epoch, in order.

    tell(kind, text, utc, epoch): told of a knock, a slip, another lens, a moved target.
    """

    def __init__(
        self,
        sensor: Sensor,
        testfield: TestField,
        tell: Callable[[str, str, float, int], None],
    ) -> None:
        self.filter = OnlineFilter(sensor)
        self.watch = EquilibriumWatch()
        self._pitch = sensor.pixel_pitch
        self._field = testfield
        self._tell = tell
        self._rejected: Counter[int] = Counter()
        self._told: set[int] = set()
        self._equilibrium = Equilibrium("unknown", float("nan"), float("nan"))

    def observe(self, calibrated: CalibratedEpoch) -> dict[str, float]:
        """Take an epoch in; returns columns for the store."""
        epoch, adjustment = calibrated.epoch, calibrated.adjustment
        temperature = next(iter(epoch.temperatures.values()), math.nan)
        innovation = self.filter.update(adjustment, temperature)
        if innovation is None:
            return {}
        self._watch_targets(calibrated)
        event = innovation.change if innovation.change in _SENTENCES else ""
        if event:
            self._tell(event, _SENTENCES[event], epoch.frame_time, epoch.number)
            self.watch.clear()
        if innovation.change != "outlier":
            exterior = self.filter.values()[10:]
            given, sds = given_exterior(adjustment.values, adjustment.covariance, exterior)
            self.watch.add(epoch.frame_time, given / self._pitch, sds / self._pitch)
        self._equilibrium = self.watch.judge()
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
        """For status and page: state, drift, time to steady, the estimate with its sds."""
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
            for k, name in enumerate(PARAMETER_NAMES):
                if sd[k] > 0:
                    report[name], report[f"sd_{name}"] = float(values[k]), float(sd[k])
            for k, name in enumerate(PARAMETER_NAMES[_IOP]):
                report[f"d{name}_dT"] = float(rates[k])
                report[f"sd_d{name}_dT"] = float(sd_rates[k])
        return report

    def _watch_targets(self, calibrated: CalibratedEpoch) -> None:
        """A target that is rejected again and again has moved, or its coordinates are wrong."""
        rejected = set(calibrated.adjustment.rejected)
        measured = set(calibrated.adjustment.targets.tolist())
        for row in list(self._rejected):
            if row in measured and row not in rejected:
                del self._rejected[row]
                self._told.discard(row)
        self._rejected.update(rejected)
        epoch = calibrated.epoch
        for row in sorted(rejected - self._told):
            if self._rejected[row] >= _MOVED_AFTER:
                self._told.add(row)
                name = self._field.names[row]
                text = f"target {name} contradicts the others for {_MOVED_AFTER} epochs: it moved"
                self._tell("target_moved", text, epoch.frame_time, epoch.number)
