"""Self-heating: the device warms itself after power-on, unseen by the thermometer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.simulation.effects.base import OfTime, Steady
from thermocald.simulation.effects.parameter import Parameter, coefficient_units, spoken

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.arrays import Array
    from thermocald.simulation.history import History

__all__ = ["SelfHeating"]


class SelfHeating(OfTime):
    """Adds a (1 - exp(-t/τ)), t from the start of the series.

    The step response of one body with capacity C and conductance G to its own power: τ = C/G.
    Source: Incropera, DeWitt (2007): Fundamentals of Heat and Mass Transfer, 6th ed., section 5.3.
    """

    name = "self_heating"
    noun = "self-heating"
    kind = "signal"
    nonlinear: ClassVar[Mapping[str, Parameter]] = {
        "tau": Parameter("s", 10.0, 10000.0, 300.0, log=True, role="time_constant")
    }
    linear: ClassVar[Mapping[str, str]] = coefficient_units("1")
    usual = ("c", "x0", "y0")
    steady_signal = Steady((1.0, 0.0, 0.0))
    behaviour: ClassVar[Mapping[str, str]] = {
        "idle": "rises and settles although the thermometer stands",
        "restart": "comes again after each power-on",
        "hold": "goes on with its own time constant",
        "cycle": "does not repeat with the cycles",
    }

    def signal(self, history: History, tau: float = 300.0, **_: Any) -> Array:
        return -np.expm1(-history.times / tau)[:, None]

    def sentence(self, estimates: Mapping[str, Mapping[str, Any]]) -> str:
        return (
            "the device warms itself, unseen by the thermometer, with a time constant of "
            f"{spoken(estimates['tau'])}"
        )
