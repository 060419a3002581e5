"""Creep: mount or adhesive creeps in time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from thermocald.simulation.effects.base import Effect, coefficient_units

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.simulation.history import History

__all__ = ["Creep"]


class Creep(Effect):
    """Adds a t, t in s from the begin of the series: steady-state (secondary) creep.

    Source: Findley, Lai, Onaran (1976): Creep and Relaxation of Nonlinear Viscoelastic Materials.

    """

    name = "creep"
    noun = "creep"
    kind = "signal"
    linear: ClassVar[Mapping[str, str]] = coefficient_units("s")
    usual = ("c", "x0", "y0")
    behaviour: ClassVar[Mapping[str, str]] = {
        "idle": "goes on at the same rate and never settles",
        "restart": "goes on from where it was, whether powered or not",
        "hold": "goes on at the same rate",
        "cycle": "does not repeat with the cycles",
    }

    def signal(self, history: History, **_: Any) -> NDArray[np.float64]:
        return history.times[:, None].copy()

    def sensitivity(self, history: History, **_: Any) -> csr_array:
        from scipy.sparse import csr_array

        # it knows the time alone: the thermometer's error does not reach it
        return csr_array((len(history.times), len(history.reading_times)))
