"""Thermal equilibrium of a camera: how fast it drifts, and when it will be steady.

The interior orientation of a static camera, given its exterior orientation, is determined to
hundredths of a pixel in every epoch. Its drift now and the time to steady come from one exponential
approach, averaged over the plausible time constants; both sds hold for one time constant only.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from thermocald.arrays import Array

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
            return f"ready: {_two_digits(self.drift, self.sd_drift)} px/min"
        text = f"drifting {_two_digits(self.drift, self.sd_drift)} px/min"
        if np.isfinite(self.ready_in):
            minutes = _two_digits(self.ready_in / 60, self.sd_ready_in / 60)
            text += f", ready in about {minutes} min"
        return text


def _two_digits(value: float, sd: float) -> str:
    """Format a value to the second digit of its standard deviation, as `1.1085 ± 0.0015`."""
    if not (np.isfinite(sd) and sd > 0):
        return f"{value:.3g}"
    decimals = int(np.clip(1 - np.floor(np.log10(sd)), 0, 6))
    return f"{value:.{decimals}f} ± {sd:.{decimals}f}"


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

    def clear(self) -> None:
        """Start again after a knock."""
        self._past.clear()

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
        sizes: list[int] = []
        for windows in (1.0, 2.0, 4.0):
            past = times >= times[-1] - windows * _WINDOW_S
            past[-_FEWEST:] = True
            sizes.append(int(past.sum()))
            fits.append(fit_approach(times[past], values[past], sds[past], _STEADY / 60.0))
            worse = 1.0 + _WORSE * np.sqrt(1.0 / sizes[0] + 1.0 / sizes[-1])
            if fits[-1][-1] > worse * fits[0][-1]:
                fits.pop()
                break
        speed, sd_speed, *ready_in, misfit = fits[-1]
        speed, sd_speed = 60.0 * speed, 60.0 * sd_speed
        if speed + _SETTLED_SD * sd_speed < _STEADY:
            return Equilibrium("ready", speed, sd_speed)
        if speed - _SETTLED_SD * sd_speed < _STEADY:
            return Equilibrium("unknown", speed, sd_speed)
        if misfit < _WORST_MISFIT:
            return Equilibrium("drifting", speed, sd_speed, *ready_in)
        return Equilibrium("drifting", speed, sd_speed)
