"""Softening: an adhesive or plastic gives way above a temperature."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.simulation.effects.base import Effect, Steady
from thermocald.simulation.effects.parameter import Parameter, coefficient_units, spoken

if TYPE_CHECKING:
    from collections.abc import Mapping

    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.simulation.history import History

__all__ = ["Softening"]


class Softening(Effect):
    """Adds a max(T - T_k, 0): a second slope above the knee T_k.

    Source: expansion of a polymer is two straight lines that meet at the glass transition (ISO
    11359-2: Thermomechanical analysis).
    """

    name = "softening"
    noun = "softening"
    kind = "signal"
    nonlinear: ClassVar[Mapping[str, Parameter]] = {
        "T_k": Parameter("degC", -40.0, 150.0, 40.0, role="threshold")
    }
    linear: ClassVar[Mapping[str, str]] = coefficient_units("K")
    usual = ("c", "x0", "y0")
    behaviour: ClassVar[Mapping[str, str]] = {
        "hold": "does not move while the temperature stands",
        "cycle": "runs along the same bent line up and down",
        "hotter": "goes on along a straight line above its knee",
        "rate": "shows the same curve at any rate",
        "idle": "does nothing",
    }

    def signal(self, history: History, T_k: float = 40.0, **_: Any) -> Array:
        return np.maximum(history.temperature() - T_k, 0.0)[:, None]

    def sensitivity(self, history: History, T_k: float = 40.0, **_: Any) -> csr_array:
        above = (history.temperature() > T_k).astype(float)
        return history.temperature_matrix().multiply(above[:, None]).tocsr()

    def steady(
        self,
        values: Mapping[str, Any],
        T0: float,  # noqa: ARG002
        channels: Mapping[str, float] | None,  # noqa: ARG002
    ) -> Steady:
        return Steady(knee=float(values["T_k"]), knee_name="T_k")

    def sentence(self, estimates: Mapping[str, Mapping[str, Any]]) -> str:
        return f"something gives way above {spoken(estimates['T_k'])}"
