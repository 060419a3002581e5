"""Thermal lag: lens and housing warm later than the thermometer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from thermocald.simulation.effects.base import Effect
from thermocald.simulation.effects.parameter import Parameter, spoken
from thermocald.simulation.operators import lag, lag_matrix

if TYPE_CHECKING:
    from collections.abc import Mapping

    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.simulation.history import History

__all__ = ["ThermalLag"]


class ThermalLag(Effect):
    """The linear terms follow L instead of T, with τ dL/dt = T - L and L = T at the start.

    The lumped-capacity body: τ = heat capacity × thermal resistance to where T is measured.
    Source: Incropera, DeWitt (2007): Fundamentals of Heat and Mass Transfer, 6th ed., section 5.1.
    """

    name = "thermal_lag"
    noun = "a thermal lag"
    kind = "drive"
    nonlinear: ClassVar[Mapping[str, Parameter]] = {
        "tau": Parameter("s", 2.0, 3000.0, 60.0, log=True, role="time_constant")
    }
    behaviour: ClassVar[Mapping[str, str]] = {
        "hold": "settles",
        "rate": "opens the loop more when fast, and rounds its tips",
        "cycle": "returns to the same line each time",
        "idle": "does nothing",
    }

    def drive(self, history: History, tau: float = 60.0, **_: Any) -> Array:
        p = history.polygon()
        return lag(p.times, p.values, tau, history.times)

    def sensitivity(self, history: History, tau: float = 60.0, **_: Any) -> csr_array:
        p = history.polygon()
        return lag_matrix(p.times, tau, history.times) @ p.matrix

    def propagate(self, history: History, errors: Array, tau: float = 60.0, **_: Any) -> Array:
        p = history.polygon()
        # the operator is linear: no matrix needed, whatever the length
        return lag(p.times, p.matrix @ errors, tau, history.times)

    def sentence(self, estimates: Mapping[str, Mapping[str, Any]]) -> str:
        return f"the camera follows the thermometer with a lag of {spoken(estimates['tau'])}"
