"""Test field expansion: the field warms and grows, differently along its axes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.simulation.effects.base import Proportional

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.simulation.history import History

__all__ = ["TestFieldExpansion"]


class TestFieldExpansion(Proportional):
    """Object coordinates times 1 + α (T - T₀), one α per axis, about the origin of the field.

    Source: linear expansion as ISO 1:2022 uses it.
    """

    name = "test_field_expansion"
    noun = "expansion of the test field"
    kind = "image"
    linear: ClassVar[Mapping[str, str]] = {"X": "1/K", "Y": "1/K", "Z": "1/K"}
    usual = ("X", "Y", "Z")
    columns: ClassVar[Mapping[str, str]] = {"X": "scale_X", "Y": "scale_Y", "Z": "scale_Z"}
    behaviour: ClassVar[Mapping[str, str]] = {
        "shade": "stops",
        "hold": "does not move while the temperature stands",
        "cycle": "runs along the same line up and down",
    }

    def image_changes(self, history: History, values: Mapping[str, Any]) -> dict[str, Any]:
        rates = np.array([float(values.get(axis, 0.0)) for axis in self.linear])
        return {"scale": 1.0 + self.signal(history) * rates}
