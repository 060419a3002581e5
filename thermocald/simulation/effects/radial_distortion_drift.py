"""Radial distortion drift: the lens bends."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from thermocald.simulation.effects.base import Proportional
from thermocald.simulation.effects.parameter import coefficient_units

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["RadialDistortionDrift"]


class RadialDistortionDrift(Proportional):
    """Adds a (T - T₀) to A1 (A2, A3)."""

    name = "radial_distortion_drift"
    noun = "a drift of the radial distortion"
    kind = "signal"
    linear: ClassVar[Mapping[str, str]] = coefficient_units("K", ("A1", "A2", "A3"))
    usual = ("A1",)
    parameter_sets = (("A1",), ("A1", "A2"), ("A1", "A2", "A3"))
    behaviour: ClassVar[Mapping[str, str]] = {
        "turn": "stays radial about the principal point",
        "hold": "does not move while the temperature stands",
        "cycle": "runs along the same line up and down",
    }
