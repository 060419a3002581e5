"""Affinity drift: sensor or readout geometry changes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from thermocald.simulation.effects.base import Effect, coefficient_units

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.simulation.history import History

__all__ = ["AffinityDrift"]


class AffinityDrift(Effect):
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

    def signal(self, history: History, **_: Any) -> NDArray[np.float64]:
        return (history.temperature() - history.T0)[:, None]

    def sensitivity(self, history: History, **_: Any) -> csr_array:
        return history.temperature_matrix()
