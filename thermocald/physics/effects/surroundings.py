"""Effects of what surrounds the camera: appliances that cycle, the test field and its targets."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.physics.effect import (
    Displacement,
    Influence,
    OfTime,
    Parameter,
    Proportional,
    coefficient_units,
    say_estimate,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.physics.history import History


class CyclicInterference(OfTime):
    """Adds a sin(2πt/P + φ), t from the start of the series.

    Its signals are sin(2πt/P) and cos(2πt/P): the phase φ is linear in a fit, is shared by all
    parameters and belongs to one series.
    """

    name = "cyclic_interference"
    noun = "a cyclic interference"
    kind = "signal"
    nonlinear: ClassVar[Mapping[str, Parameter]] = {
        "P": Parameter("s", 20.0, 5000.0, 120.0, log=True, role="period"),
        "phase": Parameter("rad", -np.pi, np.pi, 0.0, role="phase"),
    }
    linear: ClassVar[Mapping[str, str]] = coefficient_units("1")
    usual = ("c", "x0", "y0")
    fresh = ("phase",)
    moves_mount = True
    behaviour: ClassVar[Mapping[str, str]] = {
        "disconnect": "stops",
        "idle": "goes on at the same period",
        "hold": "goes on at the same period",
    }

    def signal(self, history: History, P: float = 120.0, **_: Any) -> Array:
        angle = (2.0 * np.pi / P) * history.times
        return np.stack([np.sin(angle), np.cos(angle)], axis=1)

    def weights(self, values: Mapping[str, Any], name: str) -> Array:
        a, phase = float(values[name]), float(values["phase"])
        return a * np.array([np.cos(phase), np.sin(phase)])

    def sentence(self, estimates: Mapping[str, Mapping[str, Any]]) -> str:
        return f"something cycles with a period of {say_estimate(estimates['P'])}"


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
        return f"targets {named} have moved at {say_estimate(estimates['time'])} after the start"
