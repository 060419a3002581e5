"""Slip: a part jumps, a lens re-locks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from thermocald.simulation.effects.base import OfTime
from thermocald.simulation.effects.parameter import Parameter, coefficient_units, spoken

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.arrays import Array
    from thermocald.simulation.history import History

__all__ = ["Slip"]


class Slip(OfTime):
    """Adds a from one time on: a step at `time` (s from the start of the series).

    Each series has its own slip: the time does not carry over, nor does the height.
    """

    name = "slip"
    noun = "a slip"
    kind = "signal"
    nonlinear: ClassVar[Mapping[str, Parameter]] = {
        "time": Parameter("s", 0.0, 1e9, 600.0, role="event")
    }
    linear: ClassVar[Mapping[str, str]] = coefficient_units("1")
    usual = ("c", "x0", "y0")
    fresh = ("time",)
    moves_mount = True
    behaviour: ClassVar[Mapping[str, str]] = {
        "hold": "does not come again",
        "cycle": "does not come again at the same temperature",
        "idle": "does nothing",
    }

    def signal(self, history: History, time: float = 600.0, **_: Any) -> Array:
        return (history.times >= time).astype(float)[:, None]

    def sentence(self, estimates: Mapping[str, Mapping[str, Any]]) -> str:
        return f"a part slipped at {spoken(estimates['time'])} after the start"
