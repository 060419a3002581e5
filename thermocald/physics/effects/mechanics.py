"""Effects of mechanical parts and of the camera's surroundings.

Friction, softening, permanent set, creep, slips, the housing and the mount; appliances that cycle,
the test field and its targets.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.camera_model import EOP_NAMES
from thermocald.physics.effect import (
    OfTime,
    Parameter,
    Steady,
    coefficient_units,
    say_estimate,
)
from thermocald.physics.formula import Node, OfFormula, Proportional
from thermocald.physics.history import Follower, History, follow_play
from thermocald.physics.operators import play_turns

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.physics.effect import Estimates, Prediction, Values


class Hysteresis(OfFormula):
    """A play of half-width r: P = min(max(P, T - r), T + r) replaces T in the linear terms.

    P rests until T is r away from it, and then follows; the loop closes. P = T at the start.
    Source: Krasnosel'skii, Pokrovskii (1989): Systems with Hysteresis.
    """

    name = "hysteresis"
    formula = "play(T, half_width)"
    noun = "hysteresis"
    says = "the way up is not the way down: the camera follows with a play of ± {half_width}"
    kind = "drive"
    nonlinear: Mapping[str, Parameter] = {
        "half_width": Parameter("K", 0.05, 20.0, 1.0, log=True, role="width")
    }
    behaviour: Mapping[str, str] = {
        "hold": "does not settle: it stays where it is",
        "cycle": "closes its loop each time, with flat pieces at the turns",
        "rate": "shows the same loop at any rate",
        "idle": "does nothing",
    }

    def follower(self, values: Values) -> Follower | None:
        return follow_play(float(values["half_width"]))

    def turns(self, history: History, half_width: float = 1.0, **_: Any) -> NDArray[np.bool_]:
        p = history.polygon()
        return play_turns(p.times, p.values, half_width, history.times)


class Softening(OfFormula):
    """A signal a max(T - T_k, 0): a second slope above the knee T_k.

    Source: the expansion of a polymer is two straight lines that meet at the glass transition (ISO
    11359-2: Thermomechanical analysis).
    """

    name = "softening"
    formula = "above(T, T_k)"
    noun = "softening"
    says = "something gives way above {T_k}"
    nonlinear: Mapping[str, Parameter] = {
        "T_k": Parameter("degC", -40.0, 150.0, 40.0, role="threshold")
    }
    linear: Mapping[str, str] = coefficient_units("K")
    usual = ("c", "x0", "y0")
    of_now = True
    behaviour: Mapping[str, str] = {
        "hold": "does not move while the temperature is constant",
        "cycle": "runs along the same bent line up and down",
        "hotter": "continues along a straight line above its knee",
        "rate": "shows the same curve at any rate",
        "idle": "does nothing",
    }

    def steady(self, values: Values, T0: float, channels: Mapping[str, float] | None) -> Steady:  # noqa: ARG002
        return Steady(knee=float(values["T_k"]), knee_name="T_k")


class PermanentSet(OfFormula):
    """A signal a (max of T so far - T₀), from the start of the series on.

    Source: the reference study found it in the RPi camera v2.1 (Elias et al. 2020, Sensors 20, 643,
    section 4.2: image points do not return to their starting position).
    """

    name = "permanent_set"
    formula = "offset(maximum(T), T0)"
    noun = "a permanent set"
    linear: Mapping[str, str] = coefficient_units("K")
    usual = ("c", "x0", "y0")
    irreversible = True
    steady_signal = Steady((0.0, 1.0, 0.0))
    of_now = True
    behaviour: Mapping[str, str] = {
        "hold": "stays where it is",
        "cycle": "appears the first time only: the second loop does not widen it",
        "hotter": "grows again as soon as it is hotter than ever before",
        "rate": "is the same at any rate",
        "idle": "does nothing",
    }


class Creep(OfTime):
    """A signal a t, t in s from the start of the series: steady-state (secondary) creep.

    Source: Findley, Lai, Onaran (1976): Creep and Relaxation of Nonlinear Viscoelastic Materials.
    """

    name = "creep"
    noun = "creep"
    linear: Mapping[str, str] = coefficient_units("s")
    moves_mount = True
    behaviour: Mapping[str, str] = {
        "idle": "continues at the same rate and never settles",
        "restart": "continues from where it was, whether powered or not",
        "hold": "continues at the same rate",
        "cycle": "does not repeat with the cycles",
    }

    def signal(self, history: History, **_: Any) -> Array:
        return history.times[:, None].copy()


class Slip(OfTime):
    """A step of height a at `time` (s from the start of the series).

    Each series has its own slip: neither its time nor its height carries over to another.
    """

    name = "slip"
    noun = "a slip"
    says = "a part slipped at {time} after the start"
    nonlinear: Mapping[str, Parameter] = {"time": Parameter("s", 0.0, 1e9, 600.0, role="event")}
    linear: Mapping[str, str] = coefficient_units("1")
    fresh = ("time",)
    moves_mount = True
    behaviour: Mapping[str, str] = {
        "hold": "does not recur",
        "cycle": "does not recur at the same temperature",
        "idle": "does nothing",
    }

    def signal(self, history: History, time: float = 600.0, **_: Any) -> Array:
        return (history.times >= time).astype(float)[:, None]


class HousingTilt(Proportional):
    """A signal a (T - T₀) in omega, phi, kappa; the projection centre does not move."""

    name = "housing_tilt"
    noun = "a tilt of the housing"
    linear: Mapping[str, str] = coefficient_units("K", ("omega", "phi", "kappa"))
    usual = ("omega", "phi", "kappa")
    behaviour: Mapping[str, str] = {
        **Proportional.behaviour, "turn": "keeps its direction in space"
    }  # fmt: skip


class MountMotion(OfFormula):
    """A signal a (L - T₀) in the exterior orientation; τ dL/dt = T - L, L = T at the start.

    Without tau, or with tau = 0, L is T. A bracket of length l and expansion α shifts the camera by
    l α per K, and turns it by l α ΔT over its thickness if one side is warmer by ΔT.
    Source: Timoshenko (1925), J. Optical Society of America 11, 233-255 (bending by heat).
    """

    name = "mount_motion"
    formula = "offset(lag(T, tau), T0)"
    noun = "a motion of the mount"
    nonlinear: Mapping[str, Parameter] = {
        "tau": Parameter("s", 2.0, 3000.0, 300.0, log=True, role="time_constant")
    }
    optional = ("tau",)
    linear: Mapping[str, str] = coefficient_units("K", EOP_NAMES)
    usual = EOP_NAMES
    parameter_sets = (EOP_NAMES, EOP_NAMES[:3])
    steady_signal = Steady((0.0, 1.0, 0.0))
    behaviour: Mapping[str, str] = {
        "turn": "keeps its direction in space",
        "hold": "settles",
        "rate": "opens a loop when fast",
        "shade": "moves the image of any field by the same amount",
    }

    def bound(self, history: History, tau: float = 0.0, **_: Any) -> Node:
        node = super().bound(history, tau=tau)
        return node if tau > 0 else replace(node, inputs=node.inputs[0].inputs)  # without the lag

    def sentence(self, estimates: Estimates) -> str:
        moved = ", ".join(f"{k} = {say_estimate(e)}" for k, e in estimates.items() if k != "tau")
        tau = estimates.get("tau")
        late = "at once" if not tau or not tau["value"] else f"with a lag of {say_estimate(tau)}"
        return f"the mount moves the camera with the temperature, {late}: {moved}"


class CyclicInterference(OfTime):
    """A signal a sin(2πt/P + φ), t from the start of the series.

    In a fit it has two signals, sin(2πt/P) and cos(2πt/P), so that the phase φ is linear; the phase
    is shared by all parameters and belongs to one series.
    """

    name = "cyclic_interference"
    noun = "a cyclic interference"
    says = "something cycles with a period of {P}"
    nonlinear: Mapping[str, Parameter] = {
        "P": Parameter("s", 20.0, 5000.0, 120.0, log=True, role="period"),
        "phase": Parameter("rad", -np.pi, np.pi, 0.0, role="phase"),
    }
    linear: Mapping[str, str] = coefficient_units("1")
    fresh = ("phase",)
    moves_mount = True
    behaviour: Mapping[str, str] = {
        "disconnect": "stops",
        "idle": "continues with the same period",
        "hold": "continues with the same period",
    }

    def signal(self, history: History, P: float = 120.0, **_: Any) -> Array:
        angle = (2.0 * np.pi / P) * history.times
        return np.stack([np.sin(angle), np.cos(angle)], axis=1)

    def weights(self, values: Values, name: str) -> Array:
        a, phase = float(values[name]), float(values["phase"])
        return a * np.array([np.cos(phase), np.sin(phase)])


class TestFieldExpansion(Proportional):
    """A factor 1 + α (T - T₀) on the object coordinates, one α per axis, about the field's origin.

    Source: linear expansion as in ISO 1:2022.
    """

    name = "test_field_expansion"
    noun = "expansion of the test field"
    kind = "image"
    linear: Mapping[str, str] = {"X": "1/K", "Y": "1/K", "Z": "1/K"}
    usual = ("X", "Y", "Z")
    columns: Mapping[str, str] = {"X": "scale_X", "Y": "scale_Y", "Z": "scale_Z"}
    behaviour: Mapping[str, str] = {**Proportional.behaviour, "shade": "stops"}

    def influence(self, history: History, values: Values, found: Prediction) -> None:
        rates = np.array([float(values.get(axis, 0.0)) for axis in self.linear])
        found.scale *= 1.0 + self.signal(history) * rates


class TargetDisplacement(OfTime):
    """A displacement (dX, dY, dZ) mm of the named targets from `time` (s from the start) on."""

    name = "target_displacement"
    noun = "displaced targets"
    says = "targets {targets} have moved at {time} after the start"
    kind = "image"
    nonlinear: Mapping[str, Parameter] = {
        "time": Parameter("s", 0.0, 1e9, 600.0, role="event"),
        "targets": Parameter("names", 0.0, 0.0, 0.0, text=True),
    }
    linear: Mapping[str, str] = {"dX": "mm", "dY": "mm", "dZ": "mm"}
    usual = ("dX", "dY", "dZ")
    fresh = ("time", "targets")
    seen_in = "targets"
    behaviour: Mapping[str, str] = {
        "turn": "concerns the same targets, wherever the camera looks",
        "cycle": "does not recur",
        "idle": "does nothing",
    }

    def influence(self, history: History, values: Values, found: Prediction) -> None:
        field = found.field
        if field is None:
            return
        targets = values["targets"]
        named = [targets] if isinstance(targets, str) else list(targets)
        for target in named:
            if target not in field.index:
                raise ConfigurationError(
                    f"effect {self.name}: the test field has no target {target!r}; it has "
                    f"{len(field)} targets, the first is {field.names[0]!r}"
                )
        rows = np.array([field.index[target] for target in named], dtype=np.int64)
        vector = np.array([float(values.get(axis, 0.0)) for axis in self.linear])
        found.displacements.append((rows, vector, history.times >= float(values["time"])))
