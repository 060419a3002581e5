"""Decentering drift: lens elements shift against each other."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from thermocald.simulation.effects.base import Proportional
from thermocald.simulation.effects.parameter import coefficient_units

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["DecenteringDrift"]


class DecenteringDrift(Proportional):
    """Adds a (T - T₀) to B1, B2."""

    name = "decentering_drift"
    noun = "a drift of the decentering distortion"
    kind = "signal"
    linear: ClassVar[Mapping[str, str]] = coefficient_units("K", ("B1", "B2"))
    usual = ("B1", "B2")
    behaviour: ClassVar[Mapping[str, str]] = {
        "turn": "turns with the camera",
        "hold": "does not move while the temperature stands",
        "cycle": "runs along the same line up and down",
    }
