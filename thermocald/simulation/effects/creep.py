"""Creep: mount or adhesive creeps in time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from thermocald.simulation.effects.base import OfTime
from thermocald.simulation.effects.parameter import coefficient_units

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.arrays import Array
    from thermocald.simulation.history import History

__all__ = ["Creep"]


class Creep(OfTime):
    """Adds a t, t in s from the start of the series: steady-state (secondary) creep.

    Source: Findley, Lai, Onaran (1976): Creep and Relaxation of Nonlinear Viscoelastic Materials.

    """

    name = "creep"
    noun = "creep"
    kind = "signal"
    linear: ClassVar[Mapping[str, str]] = coefficient_units("s")
    usual = ("c", "x0", "y0")
    moves_mount = True
    behaviour: ClassVar[Mapping[str, str]] = {
        "idle": "goes on at the same rate and never settles",
        "restart": "goes on from where it was, whether powered or not",
        "hold": "goes on at the same rate",
        "cycle": "does not repeat with the cycles",
    }

    def signal(self, history: History, **_: Any) -> Array:
        return history.times[:, None].copy()
