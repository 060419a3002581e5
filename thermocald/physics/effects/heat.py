"""Effects of the heat flow to the camera, and of the time at which temperature is measured."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.physics.effect import (
    Effect,
    OfTime,
    Parameter,
    Steady,
    coefficient_units,
    say_estimate,
)
from thermocald.physics.formula import OfFormula, Proportional
from thermocald.physics.history import Follower, History, follow_delay, follow_lag
from thermocald.physics.operators import interpolation_matrix

if TYPE_CHECKING:
    from collections.abc import Mapping

    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.physics.effect import Estimates, Values


class ThermalLag(OfFormula):
    """A first-order lag: L replaces T in the linear terms; τ dL/dt = T - L, L = T at the start.

    The body has a lumped capacity: τ = heat capacity × thermal resistance to the thermometer.
    Source: Incropera, DeWitt (2007): Fundamentals of Heat and Mass Transfer, 6th ed., section 5.1.
    """

    name = "thermal_lag"
    formula = "lag(T, tau)"
    noun = "a thermal lag"
    says = "the camera follows the thermometer with a lag of {tau}"
    kind = "drive"
    nonlinear: Mapping[str, Parameter] = {
        "tau": Parameter("s", 2.0, 3000.0, 60.0, log=True, role="time_constant")
    }
    behaviour: Mapping[str, str] = {
        "hold": "settles",
        "rate": "opens a wider loop when fast, and rounds its tips",
        "cycle": "returns to the same line each time",
        "idle": "does nothing",
    }

    def follower(self, values: Values) -> Follower | None:
        return follow_lag(float(values["tau"]))


class TimeOffset(Effect):
    """A pure delay d: T(t - d) replaces T in the linear terms; d < 0 if T is stamped late.

    Before the first frame, the temperature is taken as constant.
    """

    name = "time_offset"
    noun = "a time offset"
    says = "the camera follows the thermometer after a pure delay of {d}"
    kind = "drive"
    nonlinear: Mapping[str, Parameter] = {"d": Parameter("s", -300.0, 300.0, 10.0, role="delay")}
    behaviour: Mapping[str, str] = {
        "hold": "stops at once after the delay",
        "rate": "shifts the whole curve by the same time and keeps its tips sharp",
        "cycle": "returns to the same line each time",
        "idle": "does nothing",
    }

    def sentence(self, estimates: Estimates) -> str:
        """Write a sentence for a report; a negative delay is the thermometer's."""
        d = estimates["d"]
        if d["value"] >= 0.0:
            return super().sentence(estimates)
        late = say_estimate({**d, "value": -d["value"]})
        return f"the thermometer follows the camera after a pure delay of {late}"

    def follower(self, values: Values) -> Follower | None:
        return follow_delay(float(values["d"]))

    def drive(self, history: History, d: float = 0.0, **_: Any) -> Array:
        return history.polygon().at(history.times - d)

    def unresolved(self, history: History, rate_jump: Array, d: float = 0.0, **_: Any) -> Array:  # noqa: ARG002
        """Return the uncertainty after the last reading, if a negative delay looks ahead of it.

        It is the RMS change of the temperature over a time as long as the missing one.
        """
        p = history.polygon()
        missing = np.maximum(history.times - d - p.times[-1], 0.0)
        change = np.zeros(len(missing))
        for e in np.flatnonzero(missing):
            begun = p.times[p.times + missing[e] <= p.times[-1]]
            if len(begun):
                change[e] = np.sqrt(np.mean((p.at(begun + missing[e]) - p.at(begun)) ** 2))
        return change

    def sensitivity(self, history: History, d: float = 0.0, **_: Any) -> csr_array:
        p = history.polygon()
        return interpolation_matrix(p.times, history.times - d) @ p.matrix


class ThermalGradient(OfFormula):
    """A signal a dT/dt: the temperature difference across a plate through which heat flows.

    The difference bows the plate; in a body that warms steadily it is proportional to the rate.
    Source: Carslaw, Jaeger (1959): Conduction of Heat in Solids.
    """

    name = "thermal_gradient"
    formula = "rate(T)"
    noun = "a thermal gradient"
    linear: Mapping[str, str] = coefficient_units("(K/s)")
    usual = ("c", "x0", "y0")
    moves_mount = True
    follows_rate = True
    steady_signal = Steady()
    of_now = True
    behaviour: Mapping[str, str] = {
        "hold": "vanishes as soon as the temperature is constant",
        "rate": "grows in proportion to the rate",
        "cycle": "changes its sign between up and down",
        "idle": "does nothing",
    }


class SelfHeating(OfTime):
    """A signal a (1 - exp(-t/τ)), t from the start of the series.

    It is the step response of a body of capacity C and conductance G to its own power: τ = C/G.
    Source: Incropera, DeWitt (2007): Fundamentals of Heat and Mass Transfer, 6th ed., section 5.3.
    """

    name = "self_heating"
    noun = "self-heating"
    says = "the device warms itself, unseen by the thermometer, with a time constant of {tau}"
    nonlinear: Mapping[str, Parameter] = {
        "tau": Parameter("s", 10.0, 10000.0, 300.0, log=True, role="time_constant")
    }
    linear: Mapping[str, str] = coefficient_units("1")
    steady_signal = Steady((1.0, 0.0, 0.0))
    behaviour: Mapping[str, str] = {
        "idle": "rises and settles although the thermometer is constant",
        "restart": "comes again after each power-on",
        "hold": "continues with its own time constant",
        "cycle": "does not repeat with the cycles",
    }

    def signal(self, history: History, tau: float = 300.0, **_: Any) -> Array:
        return -np.expm1(-history.times / tau)[:, None]


class SecondHeatSource(Proportional):
    """A signal a (T_channel - T₀), linear in another temperature column of the recording."""

    name = "second_heat_source"
    noun = "a second heat source"
    says = "{channel} heats the camera too"
    nonlinear: Mapping[str, Parameter] = {"channel": Parameter("name", 0.0, 0.0, 0.0, text=True)}
    linear: Mapping[str, str] = coefficient_units("K")
    behaviour: Mapping[str, str] = dict.fromkeys(
        ("load", "idle", "hold"), "follows the other thermometer"
    )

    def channel(self, history: History, channel: str = "", **_: Any) -> str:
        return channel or next(c for c in history.readings if c != history.reference)

    def steady(self, values: Values, T0: float, channels: Mapping[str, float] | None) -> Steady:
        assert channels is not None
        return Steady((float(channels[str(values["channel"])]) - T0, 0.0, 0.0))
