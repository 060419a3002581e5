"""Cyclic interference: a fan, heater or charger cycles."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.simulation.effects.base import OfTime
from thermocald.simulation.effects.parameter import Parameter, coefficient_units, spoken

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.arrays import Array
    from thermocald.simulation.history import History

__all__ = ["CyclicInterference"]


class CyclicInterference(OfTime):
    """Adds a sin(2πt/P + φ), t from the start of the series.

    Its signals are sin(2πt/P) and cos(2πt/P): the phase φ is linear in a fit, is shared by all
    parameters and belongs to one series.
    """

    name = "cyclic_interference"
    noun = "a cyclic interference"
    kind = "signal"
    nonlinear: ClassVar[Mapping[str, Parameter]] = {
        "P": Parameter("s", 20.0, 5000.0, 120.0, log=True, role="period"),
        "phase": Parameter("rad", -np.pi, np.pi, 0.0, role="phase"),
    }
    linear: ClassVar[Mapping[str, str]] = coefficient_units("1")
    usual = ("c", "x0", "y0")
    fresh = ("phase",)
    moves_mount = True
    behaviour: ClassVar[Mapping[str, str]] = {
        "disconnect": "stops",
        "idle": "goes on at the same period",
        "hold": "goes on at the same period",
    }

    def signal(self, history: History, P: float = 120.0, **_: Any) -> Array:
        angle = (2.0 * np.pi / P) * history.times
        return np.stack([np.sin(angle), np.cos(angle)], axis=1)

    def weights(self, values: Mapping[str, Any], name: str) -> Array:
        a, phase = float(values[name]), float(values["phase"])
        return a * np.array([np.cos(phase), np.sin(phase)])

    def sentence(self, estimates: Mapping[str, Mapping[str, Any]]) -> str:
        return f"something cycles with a period of {spoken(estimates['P'])}"
