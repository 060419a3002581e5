"""The grid of trial values of a non-linear parameter: one for fit and discovery.

The grid replaces a lucky start: each parameter is scanned over everything that the recordings
could show, as finely as they can resolve it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array
    from thermocald.reduction.series import ReducedSeries
    from thermocald.simulation.effects.parameter import Parameter

__all__ = ["trial_values"]


def trial_values(parameter: Parameter, series: Sequence[ReducedSeries]) -> Array:
    """Values to scan, chosen by the parameter's role; the first series decides."""
    first = series[0]
    duration = float(first.times[-1])
    step = float(np.median(np.diff(first.times)))
    T = first.history.temperature()
    low, high = float(T.min()), float(T.max())
    match parameter.role:
        case "period":
            # at least two periods, and two frames in each; four frequencies to one resolution
            frequencies = np.arange(1.8 / duration, 1.0 / (2.1 * step), 1.0 / (3.0 * duration))
            return np.asarray(1.0 / frequencies[:4000])
        case "threshold":
            return np.linspace(low + 0.03 * (high - low), high - 0.03 * (high - low), 32)
        case "width":
            return np.geomspace(max(0.2 * parameter.low, 0.01), max(0.45 * (high - low), 0.2), 36)
        case "time_constant":
            return np.geomspace(max(0.2 * parameter.low, 0.05 * step), 2.0 * duration, 44)
        case "event":
            return first.times[1:]
        case "delay":
            reach = min(parameter.high, 0.25 * duration)
            coarse = np.arange(max(parameter.low, -reach), reach, min(0.5 * step, reach / 20)) + 0.1
            fine = np.linspace(-step, step, 21) + 0.001 * step  # small delays are the usual ones
            return np.unique(np.concatenate([coarse, fine]))
    if parameter.log:
        return np.geomspace(parameter.low, parameter.high, 40)
    return np.linspace(parameter.low, parameter.high, 40)
