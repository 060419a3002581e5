"""Thermal gradient: heat flowing through bends the mount."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.simulation.effects.base import Effect, Steady
from thermocald.simulation.effects.parameter import coefficient_units
from thermocald.simulation.operators import slope_matrix

if TYPE_CHECKING:
    from collections.abc import Mapping

    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.simulation.history import History

__all__ = ["ThermalGradient"]

_NOISE_JUMPS = 3.0  # standard deviations that a jump of the rate must be beyond noise


class ThermalGradient(Effect):
    """Adds a dT/dt: the difference across a plate that heat flows through, so its bow.

    In a body that warms steadily the difference between its faces is proportional to the rate:
    Carslaw, Jaeger (1959): Conduction of Heat in Solids.
    """

    name = "thermal_gradient"
    noun = "a thermal gradient"
    kind = "signal"
    linear: ClassVar[Mapping[str, str]] = coefficient_units("(K/s)")
    usual = ("c", "x0", "y0")
    moves_mount = True
    steady_signal = Steady()
    behaviour: ClassVar[Mapping[str, str]] = {
        "hold": "vanishes as soon as the temperature stands",
        "rate": "grows in proportion to the rate",
        "cycle": "changes its sign between up and down",
        "idle": "does nothing",
    }

    def signal(self, history: History, **_: Any) -> Array:
        p = history.polygon()
        rate: Array = slope_matrix(p.times, history.times) @ p.values
        return rate[:, None]

    def unresolved(
        self,
        history: History,
        rate_jump: Array | None = None,
        **_: Any,
    ) -> Array:
        """A lamp that is switched between two readings: the rate jumps, nobody knows when."""
        if rate_jump is not None:
            return rate_jump
        p = history.polygon()
        if len(p.times) < 5:
            return np.zeros(len(history.times))
        jumps = np.abs(np.diff(np.diff(p.values) / np.diff(p.times)))
        noise = 1.4826 * float(np.median(jumps))
        excess = np.sqrt(np.maximum(jumps**2 - (_NOISE_JUMPS * noise) ** 2, 0.0))
        at_knots = np.concatenate([excess[:1], excess, excess[-1:]]) / 2.0
        return np.interp(history.times, p.times, at_knots)

    def sensitivity(self, history: History, **_: Any) -> csr_array:
        p = history.polygon()
        return slope_matrix(p.times, history.times) @ p.matrix
