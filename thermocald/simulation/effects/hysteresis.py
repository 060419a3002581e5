"""Hysteresis: friction or backlash, the way up is not the way down."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from thermocald.simulation.effects.base import Effect
from thermocald.simulation.effects.parameter import Parameter, spoken
from thermocald.simulation.operators import play, play_matrix, play_turns

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.simulation.history import History

__all__ = ["Hysteresis"]


class Hysteresis(Effect):
    """The linear terms follow P = min(max(P, T - r), T + r): a play of half-width r on T.

    P rests until T is r away from it, then follows; the loop closes. P = T at the start.
    Source: Krasnosel'skii, Pokrovskii (1989): Systems with Hysteresis.
    """

    name = "hysteresis"
    noun = "hysteresis"
    kind = "drive"
    nonlinear: ClassVar[Mapping[str, Parameter]] = {
        "half_width": Parameter("K", 0.05, 20.0, 1.0, log=True, role="width")
    }
    behaviour: ClassVar[Mapping[str, str]] = {
        "hold": "does not settle: it stays where it is",
        "cycle": "closes its loop each time, with flat pieces at the turns",
        "rate": "shows the same loop at any rate",
        "idle": "does nothing",
    }

    def drive(self, history: History, half_width: float = 1.0, **_: Any) -> Array:
        p = history.polygon()
        return play(p.times, p.values, half_width, history.times)

    def sensitivity(self, history: History, half_width: float = 1.0, **_: Any) -> csr_array:
        p = history.polygon()
        return play_matrix(p.times, p.values, half_width, history.times) @ p.matrix

    def turns(self, history: History, half_width: float = 1.0, **_: Any) -> NDArray[np.bool_]:
        p = history.polygon()
        return play_turns(p.times, p.values, half_width, history.times)

    def sentence(self, estimates: Mapping[str, Mapping[str, Any]]) -> str:
        return (
            "the way up is not the way down: the camera follows with a play of "
            f"± {spoken(estimates['half_width'])}"
        )
