"""Target displacement: single targets have moved or come loose."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.simulation.effects.base import OfTime
from thermocald.simulation.effects.influence import Displacement, Influence
from thermocald.simulation.effects.parameter import Parameter, spoken

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.simulation.history import History

__all__ = ["TargetDisplacement"]


class TargetDisplacement(OfTime):
    """The named targets are (dX, dY, dZ) mm off from `time` (s from the start) on."""

    name = "target_displacement"
    noun = "displaced targets"
    kind = "image"
    nonlinear: ClassVar[Mapping[str, Parameter]] = {
        "time": Parameter("s", 0.0, 1e9, 600.0, role="event"),
        "targets": Parameter("names", 0.0, 0.0, 0.0, text=True),
    }
    linear: ClassVar[Mapping[str, str]] = {"dX": "mm", "dY": "mm", "dZ": "mm"}
    usual = ("dX", "dY", "dZ")
    fresh = ("time", "targets")
    seen_in = "targets"
    behaviour: ClassVar[Mapping[str, str]] = {
        "turn": "concerns the same targets, wherever the camera looks",
        "cycle": "does not come again",
        "idle": "does nothing",
    }

    def signal(self, history: History, time: float = 600.0, **_: Any) -> Array:
        return (history.times >= time).astype(float)[:, None]

    def influence(
        self, history: History, values: Mapping[str, Any], field: TestField | None = None
    ) -> Influence:
        nothing = Influence.none(len(history.times))
        if field is None:
            return nothing
        targets = values["targets"]
        named = [targets] if isinstance(targets, str) else list(targets)
        for target in named:
            if target not in field.index:
                raise ConfigurationError(
                    f"effect {self.name}: the test field has no target {target!r}; it has "
                    f"{len(field)}, {field.names[0]!r} the first"
                )
        moved = Displacement(
            np.array([field.index[target] for target in named], dtype=np.int64),
            np.array([float(values.get(axis, 0.0)) for axis in self.linear]),
            history.times >= float(values["time"]),
        )
        return replace(nothing, displacements=(moved,))

    def sentence(self, estimates: Mapping[str, Mapping[str, Any]]) -> str:
        targets = estimates["targets"]["value"]
        named = targets if isinstance(targets, str) else ", ".join(targets)
        return f"targets {named} have moved at {spoken(estimates['time'])} after the start"
