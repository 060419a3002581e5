"""Monitoring of a running camera: filter, innovation test, thermal equilibrium.

The interior orientation of a static camera, given its exterior orientation, is determined to
hundredths of a pixel in every epoch. Its drift now and the time to steady come from one exponential
approach, averaged over the plausible time constants; both sds hold for one time constant only.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from thermocald.analysis.online.filter import FieldErrors, OnlineFilter
from thermocald.numbers import with_sd
from thermocald.photogrammetry.camera.camera_model import EOP, PARAMETER_NAMES, PRINCIPAL
from thermocald.photogrammetry.linalg import scaled_inverse
from thermocald.result import with_sds

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.acquisition.calibrator import CalibratedEpoch
    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.epoch.adjustment import Adjustment
    from thermocald.photogrammetry.field.testfield import TestField

State = Literal["unknown", "drifting", "ready"]

_FEWEST = 8
# the shortest past for the drift; up to four times as long if one exponential describes it
_WINDOW_S = 180.0
_STEADY = 0.05  # px/min below which the camera counts as steady
_GROUP_S = 1.0  # epochs closer to each other are averaged
_RATES = 60
_SLOW = 2.5  # rate up to which a drift may as well accelerate
_STRAIGHT = 0.1  # rate of what cannot be told from a straight line
_NARROWINGS = 6
_WEIGHTY = 9  # points of a fine enough grid that have a weight above 1 %
_SETTLED_SD = 2.0
_WORSE = 1.0  # misfit of a longer past over that of the shortest, in sds of the ratio
_WORST_MISFIT = 3.0


@dataclass(frozen=True, slots=True)
class Equilibrium:
    """A thermal state; drift px/min now of (c, x0, y0) together, ready_in s, NaN if unknown."""

    state: State
    drift: float = float("nan")
    sd_drift: float = float("nan")
    ready_in: float = float("nan")
    sd_ready_in: float = float("nan")

    @property
    def sentence(self) -> str:
        """The state as a sentence."""
        if self.state == "unknown":
            return "not known yet whether it drifts"
        if self.state == "ready":
            return f"ready: {with_sd(self.drift, self.sd_drift, 'px/min')}"
        text = f"drifting {with_sd(self.drift, self.sd_drift, 'px/min')}"
        if np.isfinite(self.ready_in):
            text += f", ready in about {with_sd(self.ready_in / 60, self.sd_ready_in / 60, 'min')}"
        return text


def fit_approach(
    times: Array, values: Array, sds: Array, bound: float
) -> tuple[float, float, float, float, float]:
    """Fit a + b·exp(-t/tau) with a common tau to values (n, k) with sds (n, k) at times (n,) s.

    bound: speed per s below which the camera counts as steady. Returns the speed at the last epoch
    per s and its sd, the time in s from there until the camera is steady and its sd, NaN if a
    straight line fits as well, and the misfit: reduced chi-square. The rate span/tau runs over a
    grid from an accelerating drift to an approach within few epochs, weighted by its likelihood.
    """
    span = float(times[-1] - times[0])
    s = (times - times[0]) / span
    slow = np.linspace(-_SLOW, _SLOW, _RATES)
    rates = np.append(slow, np.geomspace(_SLOW, 0.5 * len(times), _RATES // 2)[1:])
    w = 1.0 / sds**2
    off = values - (w * values).sum(0) / w.sum(0)
    straight = False
    for narrowing in range(_NARROWINGS):
        # chi-square, and slopes now with their variances for every rate, with the best a and b
        E = np.expm1(-s * rates[:, None])
        see = E**2 @ w - (E @ w) ** 2 / w.sum(0)
        b = E @ (w * off) / see
        chi2 = np.sum(w * off**2) - np.sum(b**2 * see, axis=1)
        factor = max(1.0, float(chi2.min()) / max(off.size - 2 * off.shape[1] - 1, 1))
        weight = np.exp(-0.5 * (chi2 - chi2.min()) / factor)
        to_slope = (-rates * np.exp(-rates) / span)[:, None]
        slopes, variances = b * to_slope, factor * to_slope**2 / see
        approaching = rates > _STRAIGHT
        straight = straight or (narrowing == 0 and weight[~approaching].max() > 0.25)
        weighty = np.flatnonzero(weight > 0.01)
        if len(weighty) >= _WEIGHTY:
            break
        ends = np.clip([weighty[0] - 1, weighty[-1] + 1], 0, len(rates) - 1)
        rates = np.linspace(rates[ends[0]], rates[ends[1]], _RATES)
    slope = weight @ slopes / weight.sum()
    speed = float(np.linalg.norm(slope))
    direction = slope / max(speed, 1e-300)
    along, variance = slopes @ direction, variances @ direction**2
    _, sd = _mean_and_sd(along, variance, weight)
    if straight:
        return speed, sd, float("nan"), float("nan"), factor
    speeds = np.maximum(np.linalg.norm(slopes, axis=1), 1e-300)[approaching]
    taus = span / rates[approaching]
    ready = np.maximum(0.0, taus * np.log(speeds / bound))
    variance = variance[approaching] * (taus / speeds) ** 2
    return speed, sd, *_mean_and_sd(ready, variance, weight[approaching]), factor


def _mean_and_sd(values: Array, variances: Array, weights: Array) -> tuple[float, float]:
    """Return mean and sd of a mixture of distributions."""
    mean = float(weights @ values / weights.sum())
    return mean, float(np.sqrt(weights @ ((values - mean) ** 2 + variances) / weights.sum()))


class EquilibriumWatch:
    """A sliding window over (c, x0, y0) in px.

    Epochs within a second are averaged, so that the cost of an epoch at 20 Hz is that of one per
    second, and constant.
    """

    def __init__(self) -> None:
        # per second: its begin, the number of epochs, the sum of their times, and the sums (3, 8)
        # of weights, of weights times values, and of weights times gains
        self._past: deque[tuple[float, int, float, Array]] = deque()

    def add(self, time: float, values: Array, gain: Array, sds: Array) -> None:
        """Add (c, x0, y0) of an epoch as a function of the assumed exterior orientation.

        time s; values (3,) px at the exterior orientation 0; gain (3, 6): px per unit of the
        exterior orientation; sds (3,) px of the epoch's noise, NaN for a parameter that is held.
        """
        sums = np.column_stack([np.ones(3), values, gain]) / sds[:, None] ** 2
        begin, count, total = time, 1, time
        if self._past and time - self._past[-1][0] < _GROUP_S:
            begin, others, earlier, before = self._past.pop()
            count, total, sums = others + 1, earlier + time, before + sums
        self._past.append((begin, count, total, sums))
        while time - self._past[0][2] / self._past[0][1] > 4.0 * _WINDOW_S:
            self._past.popleft()

    def assess(self, exterior: Array) -> Equilibrium:
        """Assess how steady the camera is, given the present exterior orientation (6,).

        The same exterior orientation is used for all epochs: its estimate improves with time, which
        would look like drift.
        """
        if len(self._past) < _FEWEST:
            return Equilibrium("unknown")
        times = np.array([total / count for _, count, total, _ in self._past])
        sums = np.array([one for *_, one in self._past])
        values = (sums[..., 1] + sums[..., 2:] @ exterior) / sums[..., 0]
        sds = 1.0 / np.sqrt(sums[..., 0])
        good = np.isfinite(values).all(axis=0) & np.isfinite(sds).all(axis=0)
        if not good.any():
            return Equilibrium("unknown")
        values, sds = values[:, good], sds[:, good]
        # over the longest past that one exponential describes as well as the last minutes: heating
        # may have begun just now
        fits: list[tuple[float, ...]] = []
        for windows in (1.0, 2.0, 4.0):
            past = times >= times[-1] - windows * _WINDOW_S
            past[-_FEWEST:] = True
            fit = *fit_approach(times[past], values[past], sds[past], _STEADY / 60.0), past.sum()
            if fits and fit[-2] > fits[0][-2] * (
                1.0 + _WORSE * np.sqrt(1.0 / fits[0][-1] + 1.0 / fit[-1])
            ):
                break
            fits.append(fit)
        speed, sd_speed, *ready_in, misfit, _ = fits[-1]
        speed, sd_speed = 60.0 * speed, 60.0 * sd_speed
        if speed + _SETTLED_SD * sd_speed < _STEADY:
            return Equilibrium("ready", speed, sd_speed)
        drifting = speed - _SETTLED_SD * sd_speed >= _STEADY
        known = ready_in if drifting and misfit < _WORST_MISFIT else ()
        return Equilibrium("drifting" if drifting else "unknown", speed, sd_speed, *known)


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
    block, cross = covariance[EOP, EOP], covariance[PRINCIPAL, EOP]
    held = not np.diag(block).all()
    gain = np.zeros((3, 6)) if held else cross @ scaled_inverse(block)
    variance = np.diag(covariance[PRINCIPAL, PRINCIPAL] - gain @ cross.T)
    sds = np.sqrt(np.where(variance > 0, variance, np.nan))
    return (values[PRINCIPAL] - gain @ values[EOP]) / unit, gain / unit, sds / unit


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
        self._last = math.inf, math.nan  # times of frame and reading of the last epoch

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
        if not adjustment.ok or epoch.observations is None:
            return {}
        temperature = next(iter(epoch.temperatures.values()), math.nan)
        at, read_at = self._last
        if epoch.temperature_time == read_at:  # a slow thermometer: the reading of another epoch
            temperature = math.nan
        self._last = epoch.frame_time, epoch.temperature_time
        elapsed_s = max(epoch.frame_time - at, 0.0)
        errors = self._errors.split(adjustment, epoch.observations, field_variance)
        innovation = self.filter.update(adjustment, temperature, errors, tremble, elapsed_s)
        self._watch_targets(calibrated, adjustment)
        event = innovation.change if innovation.change in _SENTENCES else ""
        if event:
            self._tell(event, _SENTENCES[event], epoch.frame_time, epoch.number)
            self.forget_course()
        if innovation.change != "outlier":
            given = condition_on_exterior(adjustment.values, errors[0], self._pitch)
            self.watch.add(epoch.frame_time, *given)
        self._equilibrium = self.watch.assess(self.filter.values()[EOP])
        columns = {
            "innovation_chi2": innovation.chi2,
            "innovation_bound": innovation.bound,
            "drift_px_per_min": self._equilibrium.drift,
            "sd_drift_px_per_min": self._equilibrium.sd_drift,
        }
        names = [f"online_{name}" for name in PARAMETER_NAMES[PRINCIPAL]]
        sd = np.sqrt(np.diag(self.filter.covariance()))
        columns |= with_sds(names, self.filter.values()[PRINCIPAL], sd[PRINCIPAL])
        return columns | ({"event": 1.0} if event else {})

    def forget_course(self) -> None:
        """Begin the watch of the drift anew: no rate can be estimated across what happened."""
        self.watch = EquilibriumWatch()

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
            names = [f"d{name}_dT" for name in PARAMETER_NAMES[PRINCIPAL]]
            report |= with_sds(names, rates, sd_rates)
        return report

    def _watch_targets(self, calibrated: CalibratedEpoch, adjusted: Adjustment) -> None:
        """Report a target that is rejected in several epochs in a row.

        The epoch's own adjustment must reject it, and that in the series must not use it.
        """
        taken = np.isfinite(adjusted.residuals).all(axis=1)
        used = set(adjusted.targets[taken].tolist()) - set(adjusted.rejected)
        rejected = set(calibrated.adjustment.rejected) - used
        agrees = set(calibrated.adjustment.targets.tolist()) - rejected
        self._reported -= agrees
        for row in agrees:
            del self._rejected[row]
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
