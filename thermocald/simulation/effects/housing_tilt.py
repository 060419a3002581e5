"""Housing tilt: the housing turns the whole camera."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from thermocald.simulation.effects.base import Proportional
from thermocald.simulation.effects.parameter import coefficient_units

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["HousingTilt"]


class HousingTilt(Proportional):
    """Adds a (T - T₀) to omega, phi, kappa; the projection centre stays."""

    name = "housing_tilt"
    noun = "a tilt of the housing"
    kind = "signal"
    linear: ClassVar[Mapping[str, str]] = coefficient_units("K", ("omega", "phi", "kappa"))
    usual = ("omega", "phi", "kappa")
    behaviour: ClassVar[Mapping[str, str]] = {
        "turn": "keeps its direction in space",
        "hold": "does not move while the temperature stands",
        "cycle": "runs along the same line up and down",
    }
