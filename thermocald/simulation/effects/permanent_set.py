"""Permanent set: what has once been hot does not come back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from thermocald.simulation.effects.base import Effect, Steady
from thermocald.simulation.effects.parameter import coefficient_units
from thermocald.simulation.operators import running_maximum, running_maximum_matrix

if TYPE_CHECKING:
    from collections.abc import Mapping

    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.simulation.history import History

__all__ = ["PermanentSet"]


class PermanentSet(Effect):
    """Adds a (max over the past of T - T₀); the past begins with the series.

    Source: the reference study found it in the RPi camera v2.1 (Elias et al. 2020, Sensors 20, 643,
    section 4.2: image points do not return to their starting position).
    """

    name = "permanent_set"
    noun = "a permanent set"
    kind = "signal"
    linear: ClassVar[Mapping[str, str]] = coefficient_units("K")
    usual = ("c", "x0", "y0")
    irreversible = True
    steady_signal = Steady((0.0, 1.0, 0.0))
    behaviour: ClassVar[Mapping[str, str]] = {
        "hold": "stays where it is",
        "cycle": "appears the first time only: the second loop does not widen it",
        "hotter": "grows again as soon as it is hotter than ever before",
        "rate": "is the same at any rate",
        "idle": "does nothing",
    }

    def signal(self, history: History, **_: Any) -> Array:
        p = history.polygon()
        return (running_maximum(p.times, p.values, history.times) - history.T0)[:, None]

    def sensitivity(self, history: History, **_: Any) -> csr_array:
        p = history.polygon()
        return running_maximum_matrix(p.times, p.values, history.times) @ p.matrix
