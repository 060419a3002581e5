"""A measuring noise that follows the temperature.

It is looked for in the variances of the epochs' free cameras, which no movement of the camera
touches. Source: variances as a generalised linear model, McCullagh and Nelder (1989), Generalized
Linear Models, chapter 10.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.reduction.series import ReducedSeries

__all__ = ["NoiseGrowth", "noise_growth", "noise_slope"]

_CLEAR = 10.0  # in -2 log L, by which one trajectory excludes another
_LEAST = 0.005  # fraction of the noise at T0 that is left where it is coldest


@dataclass(frozen=True, eq=False)
class NoiseGrowth:
    """Noise 1 + factor (T - T0): factor per K and its sd; gain in -2 log L; noise (E,) per series.

    other_gain: of the best trajectory that is not the reference temperature (time, another
    channel).
    """

    factor: float
    sd: float
    gain: float
    other_gain: float
    other: str
    noise: tuple[Array, ...]

    @property
    def excludes_other(self) -> bool:
        """Whether the reference temperature explains it better than anything else."""
        return self.gain > self.other_gain + _CLEAR


def noise_growth(series: Sequence[ReducedSeries]) -> NoiseGrowth | None:
    """Does the measuring noise follow the reference temperature? None where it does not.

    None also where another thermometer explains it better, or time does as well.

    The variances of the epochs' adjustments are χ² distributed about (1 + k (T - T0))².
    """
    data = _variances(series)
    temperature = [e.history.temperature() - e.T0 for e in series]
    k, gain, _ = _slope(temperature, data)
    others: list[tuple[float, str]] = []
    for name in series[0].history.readings:
        if name != series[0].history.reference and all(name in e.history.readings for e in series):
            trajectory = [e.history.temperature(name) for e in series]
            others.append((_slope([c - c.mean() for c in trajectory], data)[1], name))
    # two thermometers of a camera rise together: another one is in the way only where it is better
    if others and gain < max(others)[0] - _CLEAR:
        return None
    time = [(e.times - e.times.mean()) / max(float(np.ptp(e.times)), 1.0) for e in series]
    by_time = _slope(time, data)[1]
    other_gain, other = max([*others, (by_time, "time")])
    if gain < 40.0 or gain < by_time + _CLEAR:
        return None
    rough = _roughness(temperature, data, k)
    if gain / rough < 40.0:
        return None
    return replace(noise_slope(series), other_gain=other_gain / rough, other=other)


def noise_slope(series: Sequence[ReducedSeries]) -> NoiseGrowth:
    """How the measuring noise follows the reference temperature, significant or not."""
    data = _variances(series)
    temperature = [e.history.temperature() - e.T0 for e in series]
    k, gain, sd = _slope(temperature, data)
    rough = _roughness(temperature, data, k)
    noise = tuple(np.maximum(1.0 + k * t, _LEAST) for t in temperature)
    return NoiseGrowth(k, sd * float(np.sqrt(rough)), gain / rough, 0.0, "", noise)


def _variances(
    series: Sequence[ReducedSeries],
) -> list[tuple[NDArray[np.bool_], Array, Array]]:
    """Of each series: epochs that count, their degrees of freedom, their variances."""
    free = [np.maximum(2.0 * e.n - e.N.shape[1], 1.0) for e in series]
    return [(e.n > 0, f, e.sigma0**2) for e, f in zip(series, free, strict=True)]


def _roughness(
    trajectories: Sequence[Array], data: Sequence[tuple[NDArray[np.bool_], Array, Array]], k: float
) -> float:
    """By how much the variances scatter more, and slower, than χ² lets them; at least 1."""
    total = []
    for trajectory, (ok, free, v) in zip(trajectories, data, strict=True):
        f = free[ok]
        ratio = v[ok] / np.maximum(1.0 + k * trajectory[ok], _LEAST) ** 2
        z = (ratio / (np.sum(f * ratio) / np.sum(f)) - 1.0) * np.sqrt(f / 2.0)
        power = float(np.mean(z**2))
        slow = 1.0 + 2.0 * sum(
            float(np.mean(z[j:] * z[:-j])) / max(power, 1e-9) for j in range(1, min(11, len(z)))
        )
        total.append(power * max(slow, 1.0))
    return max(1.0, float(np.mean(total)))


def _slope(
    trajectories: Sequence[Array],
    data: Sequence[tuple[NDArray[np.bool_], Array, Array]],
) -> tuple[float, float, float]:
    """k, gain in -2 log L, and sd of k for the noise 1 + k trajectory, with a level per series."""
    from scipy.optimize import minimize_scalar

    def objective(k: float) -> float:
        total = 0.0
        for trajectory, (ok, free, v) in zip(trajectories, data, strict=True):
            s2 = np.maximum(1.0 + k * trajectory[ok], _LEAST) ** 2
            # the targets' offsets are means over all epochs, and bring their noise into each
            s2 = s2 + (s2.mean() - s2) / len(s2)
            f = free[ok]
            level = np.sum(f * v[ok] / s2) / np.sum(f)
            total += float(np.sum(f * (np.log(s2) + np.log(level))))
        return total

    reach = max(float(np.max(np.abs(c))) for c in trajectories)
    low = min(float(np.min(c)) for c in trajectories)
    high = max(float(np.max(c)) for c in trajectories)
    bounds = (-0.995 / max(high, 1e-9), 0.995 / max(-low, 1e-9))
    start = minimize_scalar(objective, bounds=bounds, method="bounded", options={"xatol": 1e-7})
    k = float(start.x)
    gain = objective(0.0) - float(start.fun)
    h = 0.01 / reach
    curvature = (objective(k + h) - 2 * objective(k) + objective(k - h)) / h**2
    # log variances scatter a little more than χ² does: gross errors near the limit
    sd = float(np.sqrt(2.0 / curvature)) if curvature > 0 else float("inf")
    return k, gain, sd
