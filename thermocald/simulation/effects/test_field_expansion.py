"""Test field expansion: the field warms and grows, differently along its axes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.simulation.effects.base import Effect, Influence

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.photogrammetry.testfield import TestField
    from thermocald.simulation.history import History

__all__ = ["TestFieldExpansion"]


class TestFieldExpansion(Effect):
    """Object coordinates times 1 + α (T - T₀), one α per axis, about the origin of the field.

    Source: linear expansion as ISO 1:2022 uses it.
    """

    name = "test_field_expansion"
    noun = "expansion of the test field"
    kind = "image"
    linear: ClassVar[Mapping[str, str]] = {"X": "1/K", "Y": "1/K", "Z": "1/K"}
    usual = ("X", "Y", "Z")
    behaviour: ClassVar[Mapping[str, str]] = {
        "shade": "stops",
        "hold": "does not move while the temperature stands",
        "cycle": "runs along the same line up and down",
    }

    def signal(self, history: History, **_: Any) -> NDArray[np.float64]:
        return (history.temperature() - history.T0)[:, None]

    def sensitivity(self, history: History, **_: Any) -> csr_array:
        return history.temperature_matrix()

    def influence(
        self,
        history: History,
        values: Mapping[str, Any],
        field: TestField | None = None,  # noqa: ARG002
    ) -> Influence:
        rates = np.array([float(values.get(axis, 0.0)) for axis in self.linear])
        scale = 1.0 + self.signal(history) * rates
        return replace(Influence.none(len(history.times)), scale=scale)
