"""Defocus: heat defocuses, targets blur, measuring noise grows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.simulation.effects.base import Proportional
from thermocald.simulation.effects.parameter import spoken

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.simulation.history import History

__all__ = ["Defocus"]


class Defocus(Proportional):
    """Measuring noise and blur are multiplied by max(1 + k (T - T₀), 0.1); positions stay unbiased.

    Noise and blur share the factor: the precision of an edge falls between the root of its blur
    (Cramér-Rao) and in proportion to it (an operator of fixed width), and an instrument of fixed
    windows lies at the latter.
    """

    name = "defocus"
    noun = "defocus"
    kind = "image"
    linear: ClassVar[Mapping[str, str]] = {"factor": "1/K"}
    usual = ("factor",)
    seen_in = "noise"
    behaviour: ClassVar[Mapping[str, str]] = {
        "hold": "leaves positions alone; noise stays as large as it is",
        "cycle": "makes noise come and go with the temperature",
    }

    def image_changes(self, history: History, values: Mapping[str, Any]) -> dict[str, Any]:
        factor = np.maximum(1.0 + values["factor"] * self.signal(history)[:, 0], 0.1)
        return {"noise_factor": factor, "blur_factor": factor}

    def sentence(self, estimates: Mapping[str, Mapping[str, Any]]) -> str:
        return f"heat defocuses: the measuring noise grows by {spoken(estimates['factor'])}"
