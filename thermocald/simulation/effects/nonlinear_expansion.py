"""Nonlinear expansion: expansion and thermo-optic terms of second order."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from thermocald.simulation.effects.base import Effect, Steady
from thermocald.simulation.effects.parameter import coefficient_units

if TYPE_CHECKING:
    from collections.abc import Mapping

    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.simulation.history import History

__all__ = ["NonlinearExpansion"]


class NonlinearExpansion(Effect):
    """Adds a (T - T₀)² to c, x0, y0.

    Source: the second coefficient of length and of refractive index against temperature, e.g.
    Schott TIE-19: Temperature Coefficient of the Refractive Index.
    """

    name = "nonlinear_expansion"
    noun = "a quadratic expansion"
    kind = "signal"
    linear: ClassVar[Mapping[str, str]] = coefficient_units("K2")
    usual = ("c", "x0", "y0")
    steady_signal = Steady((0.0, 0.0, 1.0))
    behaviour: ClassVar[Mapping[str, str]] = {
        "hold": "does not move while the temperature stands",
        "cycle": "runs along the same curve up and down",
        "hotter": "keeps bending at every temperature",
        "rate": "shows the same curve at any rate",
        "idle": "does nothing",
    }

    def signal(self, history: History, **_: Any) -> Array:
        return ((history.temperature() - history.T0) ** 2)[:, None]

    def sensitivity(self, history: History, **_: Any) -> csr_array:
        slope = 2.0 * (history.temperature() - history.T0)
        return history.temperature_matrix().multiply(slope[:, None]).tocsr()
