"""Thermal equilibrium of a camera: how fast it drifts, and when it will be steady.

The interior orientation of a static camera, given its exterior orientation, is determined to
hundredths of a pixel in every epoch. Its drift per minute is the slope over the last minutes; the
time to steady comes from an exponential approach, averaged over the plausible time constants.
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
# the shortest past for the drift; up to four times as long if a straight line describes it
_WINDOW_S = 180.0
_STEADY = 0.05  # px/min below which the camera counts as steady
_GROUP_S = 1.0  # epochs closer to each other are averaged
_TAUS = 60
_NARROWINGS = 6
_WEIGHTY = 9  # points of a fine enough grid that have a weight above 1 %
_SETTLED_SD = 2.0
_CURVED_SD = 3.0
_WORST_MISFIT = 3.0


@dataclass(frozen=True, slots=True)
class Equilibrium:
    """A thermal state; drift px/min of (c, x0, y0) together, ready_in s, NaN if unknown."""

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


def slope(times: Array, values: Array, sds: Array) -> tuple[Array, Array]:
    """Fit straight lines to values (n, k) with sds (n, k); return slopes (k,) and sds (k,) per s.

    The sds are scaled up if the line does not fit within them, never down.
    """
    w = 1.0 / sds**2
    mean_t = (w * times[:, None]).sum(0) / w.sum(0)
    dt = times[:, None] - mean_t
    sxx = (w * dt**2).sum(0)
    slopes = (w * dt * values).sum(0) / sxx
    mean = (w * values).sum(0) / w.sum(0)
    rest = values - mean - dt * slopes
    factor = np.maximum(1.0, (w * rest**2).sum(0) / max(len(times) - 2, 1))
    result: Array = np.sqrt(factor / sxx)
    return slopes, result


def fit_approach(
    times: Array, values: Array, sds: Array, bound: float
) -> tuple[float, float, float] | None:
    """Fit a + b·exp(-t/tau) to values (n,) at times (n,) s; return None if there is no approach.

    bound: speed per s below which the camera counts as steady. Returns the time in s from the last
    epoch until it is steady, its sd, and the misfit: reduced chi-square. tau runs over a grid from
    a few epochs to ten times the span; every tau is weighted by its likelihood.
    """
    span = float(times[-1] - times[0])
    step = span / (len(times) - 1)
    taus = np.geomspace(2.0 * step, 10.0 * span, _TAUS)
    w = 1.0 / sds**2
    mean = float(w @ values / w.sum())
    for narrowing in range(_NARROWINGS):
        # chi-square, time to steady s and its variance for every tau, with the best a and b
        E = np.exp(-(times - times[0]) / taus[:, None])
        D = E - (E @ w / w.sum())[:, None]
        see = D**2 @ w
        b = D @ (w * (values - mean)) / see
        chi2 = ((values - mean - D * b[:, None]) ** 2) @ w
        with np.errstate(divide="ignore"):
            ready = np.maximum(0.0, taus * np.log(np.abs(b) * E[:, -1] / taus / bound))
        variance = (taus / (np.sqrt(see) * np.maximum(np.abs(b), 1e-300))) ** 2
        factor = max(1.0, float(chi2.min()) / max(len(times) - 3, 1))
        weight = np.exp(-0.5 * (chi2 - chi2.min()) / factor)
        if narrowing == 0 and weight[-1] > 0.25:
            return None  # a straight line fits as well: the end cannot be predicted
        if np.sum(weight > 0.01) >= _WEIGHTY:
            break
        best = int(weight.argmax())
        taus = np.geomspace(taus[max(best - 1, 0)], taus[min(best + 1, _TAUS - 1)], _TAUS)
    weight /= weight.sum()
    ready_in = float(weight @ ready)
    sd = float(np.sqrt(weight @ ((ready - ready_in) ** 2 + factor * variance)))
    return ready_in, sd, factor


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
        # over the longest past that straight lines describe, or else over the window
        pasts = [times >= times[-1] - windows * _WINDOW_S for windows in (4.0, 2.0, 1.0)]
        for past in pasts:
            recent = past.copy()
            recent[-_FEWEST:] = True
            if past is pasts[-1] or _straight(times[recent], values[recent], sds[recent]):
                break
        rate, sd_rate = slope(times[recent], values[recent], sds[recent])
        size = float(np.linalg.norm(rate))
        direction = rate / max(size, 1e-300)
        speed, sd_speed = 60.0 * size, 60.0 * float(np.sqrt(np.sum((direction * sd_rate) ** 2)))
        if speed + _SETTLED_SD * sd_speed < _STEADY:
            return Equilibrium("ready", speed, sd_speed)
        if speed - _SETTLED_SD * sd_speed < _STEADY:
            return Equilibrium("unknown", speed, sd_speed)
        along, sd_along = values @ direction, np.sqrt((sds**2) @ direction**2)
        # over the longest past that one exponential describes: heating may have begun just now
        for past in pasts:
            if past.sum() < _FEWEST:
                break
            found = fit_approach(times[past], along[past], sd_along[past], _STEADY / 60.0)
            if found is None:
                break
            ready_in, sd_ready_in, misfit = found
            if misfit < _WORST_MISFIT:
                return Equilibrium("drifting", speed, sd_speed, ready_in, sd_ready_in)
        return Equilibrium("drifting", speed, sd_speed)


def _straight(times: Array, values: Array, sds: Array) -> bool:
    """Return whether a parabola shows no significant curvature in any of the columns (n, k)."""
    t = (times - times.mean()) / max(float(np.ptp(times)), 1e-9)
    A = np.stack([np.ones_like(t), t, t * t], axis=1) / sds.T[..., None]
    transposed = np.swapaxes(A, 1, 2)
    cofactors = np.linalg.inv(transposed @ A)
    curvatures = (cofactors @ transposed @ (values / sds).T[..., None])[:, 2, 0]
    return bool(np.all(np.abs(curvatures) <= _CURVED_SD * np.sqrt(cofactors[:, 2, 2])))
