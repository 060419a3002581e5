"""Whether a camera is warm: how fast it drifts, and when it will be steady.

The interior orientation of a static camera, given its exterior orientation, is known to hundredths
of a pixel in every epoch. Its drift per minute is the slope of the last minutes; the time to steady
comes from an exponential approach, whose time constant is averaged over what the data allow.
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
_WINDOW_S = 180.0  # the least past that the drift is taken from; up to four times as much where a
# straight line describes it
_STEADY = 0.05  # px/min below which the camera counts as steady
_GROUP_S = 1.0  # epochs nearer to each other are averaged
_TAUS = 60
_NARROWINGS = 6
_WEIGHTY = 9  # points of the grid that carry the weight
_SETTLED_SD = 2.0
_CURVED_SD = 3.0
_WORST_MISFIT = 3.0


@dataclass(frozen=True, slots=True)
class Equilibrium:
    """drift, sd_drift: px/min of (c, x0, y0) together; ready_in, sd_ready_in: s, NaN if unknown."""

    state: State
    drift: float = float("nan")
    sd_drift: float = float("nan")
    ready_in: float = float("nan")
    sd_ready_in: float = float("nan")

    @property
    def sentence(self) -> str:
        """For a person."""
        if self.state == "unknown":
            return "not known yet"
        if self.state == "ready":
            return f"ready: {_two_digits(self.drift, self.sd_drift)} px/min"
        text = f"drifting {_two_digits(self.drift, self.sd_drift)} px/min"
        if np.isfinite(self.ready_in):
            minutes = _two_digits(self.ready_in / 60, self.sd_ready_in / 60)
            text += f", ready in about {minutes} min"
        return text


def _two_digits(value: float, sd: float) -> str:
    """`1.1085 ± 0.0015`: to the second digit of the standard deviation."""
    if not (np.isfinite(sd) and sd > 0):
        return f"{value:.3g}"
    decimals = int(np.clip(1 - np.floor(np.log10(sd)), 0, 6))
    return f"{value:.{decimals}f} ± {sd:.{decimals}f}"


def slope(times: Array, values: Array, sds: Array) -> tuple[Array, Array]:
    """Weighted straight line through values (n, k) with sds (n, k): slopes (k,) and sds (k,) per s.

    The sds are scaled up where the line does not fit within them, never down.
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
    """Fit a + b·exp(-t/tau) to values (n,) at times (n,) s; None if nothing approaches.

    bound: speed per s below which it counts as steady. Returns s from the last epoch until it is
    steady, with its sd, and the misfit: reduced chi-square. tau runs over a grid from a few epochs
    to ten times the span; every tau is weighted by its likelihood.
    """
    span = float(times[-1] - times[0])
    step = span / (len(times) - 1)
    taus = np.geomspace(2.0 * step, 10.0 * span, _TAUS)
    w = 1.0 / sds**2
    mean = float(w @ values / w.sum())
    for narrowing in range(_NARROWINGS):
        # chi-square, time to steady s and its variance for every tau, a and b at their best
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
            return None  # as good as a straight line: no end in sight
        if np.sum(weight > 0.01) >= _WEIGHTY:
            break
        best = int(weight.argmax())
        taus = np.geomspace(taus[max(best - 1, 0)], taus[min(best + 1, _TAUS - 1)], _TAUS)
    weight /= weight.sum()
    ready_in = float(weight @ ready)
    sd = float(np.sqrt(weight @ ((ready - ready_in) ** 2 + factor * variance)))
    return ready_in, sd, factor


class EquilibriumWatch:
    """Watches (c, x0, y0) in px over a sliding window.

    Epochs that follow each other within a second are averaged: at 20 Hz the cost of an epoch is
    that of one per second, and does not grow.
    """

    def __init__(self) -> None:
        # of each second: when it began, epochs, sum of their times, and (3, 8) of their weights,
        # of weights times values, and of weights times gains
        self._past: deque[tuple[float, int, float, Array]] = deque()

    def clear(self) -> None:
        """Start again, after a knock."""
        self._past.clear()

    def add(self, time: float, values: Array, gain: Array, sds: Array) -> None:
        """Add (c, x0, y0) of an epoch as a function of the exterior orientation that one assumes.

        time s; values (3,) px at the exterior orientation 0; gain (3, 6): px per unit of the
        exterior orientation; sds (3,) px of the epoch's noise, NaN for what is not estimated.
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
        """How steady the camera is, given its exterior orientation (6,) as it is known now.

        All of the past is seen from the same exterior orientation: what was known of it at each
        epoch improves with time, and would look like drift.
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
        # from the longest past that straight lines describe, else from the window
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
        # from the longest past that one exponential describes: heating may just have begun
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
    """Whether a parabola finds no curvature, of any of the columns (n, k), beyond 2 sd."""
    t = (times - times.mean()) / max(float(np.ptp(times)), 1e-9)
    A = np.stack([np.ones_like(t), t, t * t], axis=1) / sds.T[..., None]
    transposed = np.swapaxes(A, 1, 2)
    cofactors = np.linalg.inv(transposed @ A)
    curvatures = (cofactors @ transposed @ (values / sds).T[..., None])[:, 2, 0]
    return bool(np.all(np.abs(curvatures) <= _CURVED_SD * np.sqrt(cofactors[:, 2, 2])))
