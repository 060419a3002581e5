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

__all__ = ["Approach", "Equilibrium", "EquilibriumWatch", "GivenInterior", "fit_approach", "slope"]

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
class Approach:
    """An exponential approach: tau s, and s from the last epoch until it is steady, with sds;
    misfit: reduced chi-square.
    """

    tau: float
    sd_tau: float
    ready_in: float
    sd_ready_in: float
    misfit: float


@dataclass(frozen=True, slots=True, eq=False)
class GivenInterior:
    """(c, x0, y0) of one epoch as a function of the exterior orientation that one assumes.

    time s; values (3,) px at the exterior orientation 0; gain (3, 6): px per unit of the exterior
    orientation; sds (3,) px of the epoch's noise, NaN for what is not estimated.
    """

    time: float
    values: Array
    gain: Array
    sds: Array

    def at(self, exterior: Array | None) -> Array:
        """(3,) px, given the exterior orientation (6,)."""
        return self.values if exterior is None else self.values + self.gain @ exterior


@dataclass(frozen=True, slots=True)
class Equilibrium:
    """drift, sd_drift: px/min of (c, x0, y0) together; ready_in, sd_ready_in: s, NaN if unknown."""

    state: State
    drift: float
    sd_drift: float
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


def fit_approach(times: Array, values: Array, sds: Array, bound: float) -> Approach | None:
    """Fit a + b·exp(-t/tau) to values (n,) at times (n,) s; None if nothing approaches.

    bound: speed per s below which it counts as steady. tau runs over a grid from a few epochs to
    ten times the span; every tau is weighted by its likelihood.
    """
    span = float(times[-1] - times[0])
    step = span / (len(times) - 1)
    taus = np.geomspace(2.0 * step, 10.0 * span, _TAUS)
    for narrowing in range(_NARROWINGS):
        chi2, ready, variance = _profile(times - times[0], values, 1.0 / sds**2, taus, bound)
        factor = max(1.0, float(chi2.min()) / max(len(times) - 3, 1))
        weight = np.exp(-0.5 * (chi2 - chi2.min()) / factor)
        if narrowing == 0 and weight[-1] > 0.25:
            return None  # as good as a straight line: no end in sight
        if np.sum(weight > 0.01) >= _WEIGHTY:
            break
        best = int(weight.argmax())
        taus = np.geomspace(taus[max(best - 1, 0)], taus[min(best + 1, _TAUS - 1)], _TAUS)
    weight /= weight.sum()
    tau = float(weight @ taus)
    ready_in = float(weight @ ready)
    return Approach(
        tau,
        float(np.sqrt(weight @ (taus - tau) ** 2)),
        ready_in,
        float(np.sqrt(weight @ ((ready - ready_in) ** 2 + factor * variance))),
        factor,
    )


def _profile(
    t: Array, values: Array, w: Array, taus: Array, bound: float
) -> tuple[Array, Array, Array]:
    """Chi-square, time to steady s and its variance for every tau, a and b at their best."""
    E = np.exp(-t / taus[:, None])
    D = E - (E @ w / w.sum())[:, None]
    mean = float(w @ values / w.sum())
    see = D**2 @ w
    b = D @ (w * (values - mean)) / see
    chi2 = ((values - mean - D * b[:, None]) ** 2) @ w
    with np.errstate(divide="ignore"):
        ready = np.maximum(0.0, taus * np.log(np.abs(b) * E[:, -1] / taus / bound))
    variance = (taus / (np.sqrt(see) * np.maximum(np.abs(b), 1e-300))) ** 2
    return chi2, ready, variance


class _Group:
    """Epochs within a second, as weighted sums."""

    def __init__(self, begin: float) -> None:
        self.begin = begin
        self._count = 0
        self._time = 0.0
        self._weight: Array = np.zeros(3)
        self._values: Array = np.zeros(3)
        self._gain: Array = np.zeros((3, 6))

    def with_one(self, one: GivenInterior) -> GivenInterior:
        """Add an epoch; returns the mean of all, the epoch itself where it is the only one."""
        weight = 1.0 / one.sds**2
        self._count += 1
        self._time += one.time
        self._weight = self._weight + weight
        self._values = self._values + weight * one.values
        self._gain = self._gain + weight[:, None] * one.gain
        if self._count == 1:
            return one
        return GivenInterior(
            self._time / self._count,
            self._values / self._weight,
            self._gain / self._weight[:, None],
            1.0 / np.sqrt(self._weight),
        )


class EquilibriumWatch:
    """Watches (c, x0, y0) in px over a sliding window."""

    def __init__(self) -> None:
        self._past: deque[GivenInterior] = deque()
        self._group = _Group(float("-inf"))

    def clear(self) -> None:
        """Start again, after a knock."""
        self._past.clear()
        self._group = _Group(float("-inf"))

    def add(self, one: GivenInterior) -> None:
        """Add an epoch; the sds of what is not estimated are NaN.

        Epochs that follow each other within a second are averaged: at 20 Hz the cost of an epoch is
        that of one per second, and does not grow.
        """
        if one.time - self._group.begin < _GROUP_S and self._past:
            self._past[-1] = self._group.with_one(one)
        else:
            self._group = _Group(one.time)
            self._past.append(self._group.with_one(one))
        while self._past and one.time - self._past[0].time > 4.0 * _WINDOW_S:
            self._past.popleft()

    def assess(self, exterior: Array | None = None) -> Equilibrium:
        """How steady the camera is, given its exterior orientation (6,) as it is known now.

        All of the past is seen from the same exterior orientation: what was known of it at each
        epoch improves with time, and would look like drift.
        """
        if len(self._past) < _FEWEST:
            return Equilibrium("unknown", float("nan"), float("nan"))
        times = np.array([one.time for one in self._past])
        values = np.array([one.at(exterior) for one in self._past])
        sds = np.array([one.sds for one in self._past])
        good = np.isfinite(values).all(axis=0) & np.isfinite(sds).all(axis=0)
        if not good.any():
            return Equilibrium("unknown", float("nan"), float("nan"))
        values, sds = values[:, good], sds[:, good]
        rate, sd_rate = self._rate(times, values, sds)
        speed = 60.0 * float(np.linalg.norm(rate))
        direction = rate / max(float(np.linalg.norm(rate)), 1e-300)
        sd_speed = 60.0 * float(np.sqrt(np.sum((direction * sd_rate) ** 2)))
        if speed + _SETTLED_SD * sd_speed < _STEADY:
            return Equilibrium("ready", speed, sd_speed)
        if speed - _SETTLED_SD * sd_speed < _STEADY:
            return Equilibrium("unknown", speed, sd_speed)
        along = values @ direction
        sd_along = np.sqrt((sds**2) @ direction**2)
        approach = self._approach(times, along, sd_along)
        if approach is None:
            return Equilibrium("drifting", speed, sd_speed)
        return Equilibrium("drifting", speed, sd_speed, approach.ready_in, approach.sd_ready_in)

    def _rate(self, times: Array, values: Array, sds: Array) -> tuple[Array, Array]:
        """Slope from the longest past that straight lines describe, else from the window."""
        for multiple in (4.0, 2.0, 1.0):
            recent = times >= times[-1] - multiple * _WINDOW_S
            if recent.sum() < _FEWEST:
                recent[-_FEWEST:] = True
            if multiple == 1.0 or _straight(times[recent], values[recent], sds[recent]):
                break
        return slope(times[recent], values[recent], sds[recent])

    def _approach(self, times: Array, values: Array, sds: Array) -> Approach | None:
        """From the longest past that one exponential describes: heating may just have begun."""
        for fraction in (1.0, 0.5, 0.25):
            recent = times >= times[-1] - 4.0 * fraction * _WINDOW_S
            if recent.sum() < _FEWEST:
                return None
            found = fit_approach(times[recent], values[recent], sds[recent], _STEADY / 60.0)
            if found is None or found.misfit < _WORST_MISFIT:
                return found
        return None


def _straight(times: Array, values: Array, sds: Array) -> bool:
    """Whether a parabola finds no curvature, of any of the columns (n, k), beyond 2 sd."""
    t = (times - times.mean()) / max(float(np.ptp(times)), 1e-9)
    design = np.stack([np.ones_like(t), t, t * t], axis=1)
    for column, sd in zip(values.T, sds.T, strict=True):
        A = design / sd[:, None]
        cofactor = np.linalg.inv(A.T @ A)
        curvature = float((cofactor @ A.T @ (column / sd))[2])
        if abs(curvature) > _CURVED_SD * np.sqrt(cofactor[2, 2]):
            return False
    return True
