"""Affinity drift: sensor or readout geometry changes."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from thermocald.simulation.effects.base import Proportional
from thermocald.simulation.effects.parameter import coefficient_units

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["AffinityDrift"]


class AffinityDrift(Proportional):
    """Adds a (T - T₀) to C1, C2: scale difference of the axes and their shear."""

    name = "affinity_drift"
    noun = "a drift of the affinity"
    kind = "signal"
    linear: ClassVar[Mapping[str, str]] = coefficient_units("K", ("C1", "C2"))
    usual = ("C1", "C2")
    behaviour: ClassVar[Mapping[str, str]] = {
        "turn": "turns with the camera, along the sensor axes",
        "hold": "does not move while the temperature stands",
        "cycle": "runs along the same line up and down",
    }
