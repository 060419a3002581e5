"""What an effect is: a physical cause with a name, a signature and parameters.

One class is used three times: forward in the simulation (`influence`), as columns in a fit
(`drive`, `signal`, with `sensitivity` to carry the thermometer's error through them), and as words
in a report (`sentence`, `experiment_against`). Everything in which effects differ is stated here
as a property or a method: no other module asks for an effect by its name.

Three kinds:

* `drive` replaces the temperature that drives the linear terms of the base model;
* `signal` adds coefficient × signal(t) to some of the camera's parameters;
* `image` acts beyond the camera's parameters: object points, measuring noise, blur.

Non-linear parameters are those a fit has to search (a time constant, a threshold); coefficients
are linear: for a `signal` they bear the names of the parameters they act on.
"""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from thermocald.errors import ConfigurationError, DataError
from thermocald.simulation.effects.influence import Influence
from thermocald.simulation.effects.parameter import EXPERIMENTS, Parameter, spoken

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.simulation.history import History

__all__ = ["Effect", "OfTime", "Proportional", "Steady"]

Kind = Literal["drive", "signal", "image"]
SeenIn = Literal["trajectory", "noise", "targets"]


@dataclass(frozen=True, slots=True)
class Steady:
    """An effect's signal at a temperature T at which the camera has long been.

    powers: factors of (T - T₀)⁰, (T - T₀)¹, (T - T₀)²; knee: °C above which T - knee is added,
    and the name of the parameter that it is; nothing of all this by default.
    """

    powers: tuple[float, float, float] = (0.0, 0.0, 0.0)
    knee: float | None = None
    knee_name: str = ""


class Effect(ABC):
    """One physical cause. Subclasses are stateless; their docstrings state the formula.

    name: as in the catalogue; noun: for sentences; nonlinear: searched parameters; linear:
    {coefficient: unit}; usual: the coefficients that act unless told otherwise; fresh: non-linear
    parameters that belong to one series and do not carry over to another; optional: non-linear
    parameters that a model may leave out; behaviour: answers to EXPERIMENTS.

    For a search: seen_in: the trajectories of the camera's parameters, the measuring noise, or
    single targets; parameter_sets: the sets of coefficients that it may act on, by default the
    usual ones; moves_mount: it may act on the orientation of the camera instead;
    irreversible: it stays after cooling; columns:
    {coefficient: column of the reduced series} where names differ; steady_signal: see `steady`.
    """

    name: ClassVar[str]
    noun: ClassVar[str]
    kind: ClassVar[Kind]
    nonlinear: ClassVar[Mapping[str, Parameter]] = {}
    linear: ClassVar[Mapping[str, str]] = {}
    usual: ClassVar[tuple[str, ...]] = ()
    fresh: ClassVar[tuple[str, ...]] = ()
    optional: ClassVar[tuple[str, ...]] = ()
    behaviour: ClassVar[Mapping[str, str]] = {}
    seen_in: ClassVar[SeenIn] = "trajectory"
    parameter_sets: ClassVar[tuple[tuple[str, ...], ...]] = ()
    moves_mount: ClassVar[bool] = False
    irreversible: ClassVar[bool] = False
    columns: ClassVar[Mapping[str, str]] = {}
    steady_signal: ClassVar[Steady | None] = None

    @property
    def is_drive(self) -> bool:
        """Whether it replaces the temperature behind the linear terms."""
        return self.kind == "drive"

    @property
    def is_event(self) -> bool:
        """Whether it happens at one time of a series or not at all; its size is the series' own."""
        return any(self.nonlinear[name].role == "event" for name in self.fresh)

    @property
    def is_periodic(self) -> bool:
        """Whether it cycles: two signals, whose weights are amplitude and phase of the series."""
        return any(self.nonlinear[name].role == "phase" for name in self.fresh)

    @property
    def delay(self) -> str:
        """The parameter that to first order delays the temperature, s; "" where there is none."""
        if not self.is_drive:
            return ""
        roles = ("delay", "time_constant")
        return next((n for n, p in self.nonlinear.items() if p.role in roles), "")

    def column(self, coefficient: str) -> str:
        """The column of a reduced series that a coefficient acts on."""
        return self.columns.get(coefficient, coefficient)

    def drive(self, history: History, **nonlinear: Any) -> Array:
        """The temperature (E,) °C that drives the linear terms in place of T."""
        raise NotImplementedError(f"{self.name} is not a drive")

    def signal(self, history: History, **nonlinear: Any) -> Array:
        """The time series (E, k) that the coefficients multiply; k is 1 but for oscillations."""
        raise NotImplementedError(f"{self.name} has no signal")

    def channel(self, history: History, **nonlinear: Any) -> str:  # noqa: ARG002
        """The temperature column that it reads."""
        return history.reference

    def sensitivity(self, history: History, **nonlinear: Any) -> csr_array:
        """∂ (drive or first signal) / ∂ readings of `channel`, (E, R), sparse.

        Where a subclass knows no formula: by differences, one reading at a time.
        """
        from scipy.sparse import csr_array

        name = self.channel(history, **nonlinear)
        readings = np.asarray(history.readings[name], dtype=float)
        step = 1e-4
        columns = np.zeros((len(history.times), len(readings)))
        for i in np.flatnonzero(np.isfinite(readings)):
            sides = []
            for sign in (1.0, -1.0):
                moved = readings.copy()
                moved[i] += sign * step
                other = replace(history, readings={**history.readings, name: moved})
                sides.append(self._course(other, **nonlinear))
            columns[:, i] = (sides[0] - sides[1]) / (2 * step)
        return csr_array(columns)

    def further_sensitivities(
        self,
        history: History,  # noqa: ARG002
        **nonlinear: Any,  # noqa: ARG002
    ) -> dict[str, csr_array]:
        """The same by the readings of every further column that it reads, {channel: (E, R)}."""
        return {}

    def propagate(self, history: History, errors: Array, **nonlinear: Any) -> Array:
        """Errors (R, m) K of the readings → errors (E, m) of drive or first signal, first order."""
        result: Array = self.sensitivity(history, **nonlinear) @ np.nan_to_num(errors)
        return result

    def unresolved(
        self,
        history: History,
        rate_jump: Array | None = None,  # noqa: ARG002
        **nonlinear: Any,  # noqa: ARG002
    ) -> Array:
        """Standard deviation (E,) of drive or first signal that the times of the readings leave.

        What happens between two readings, or after the last, no reading tells; their noise is not
        meant. rate_jump (E,) K/s: how uncertain the rate of the temperature is at the frames,
        because it jumps next to them. Most effects need the temperature alone, which straight lines
        between readings tell.
        """
        return np.zeros(len(history.times))

    def turns(self, history: History, **nonlinear: Any) -> NDArray[np.bool_]:  # noqa: ARG002
        """Epochs (E,) in which the drive depends on which reading was an extreme.

        What `sensitivity` says is uncertain there.
        """
        return np.zeros(len(history.times), dtype=bool)

    def steady(
        self,
        values: Mapping[str, Any],  # noqa: ARG002
        T0: float,  # noqa: ARG002
        channels: Mapping[str, float] | None,  # noqa: ARG002
    ) -> Steady:
        """The signal of a camera that has long been at one temperature, and never hotter.

        T0: the model's reference temperature °C; channels: °C of other thermometers. A drive has
        settled. DataError where the effect does not say: such a model needs a temperature log.
        """
        if self.steady_signal is None and self.kind == "signal":
            raise DataError(
                f"effect {self.name} does not say what it is at a steady temperature; "
                "give a temperature log instead"
            )
        return self.steady_signal or Steady()

    def _course(self, history: History, **nonlinear: Any) -> Array:
        if self.kind == "drive":
            return self.drive(history, **nonlinear)
        return self.signal(history, **nonlinear)[:, 0]

    def weights(self, values: Mapping[str, Any], name: str) -> Array:
        """The weight (k,) of each signal in one coefficient; oscillations split by their phase."""
        return np.array([float(values[name])])

    def split(self, values: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, float]]:
        """Parameter values → (non-linear ones, coefficients)."""
        searched = {k: values[k] for k in self.nonlinear if k in values}
        return searched, {k: float(values[k]) for k in self.linear if k in values}

    def influence(
        self,
        history: History,
        values: Mapping[str, Any],
        field: TestField | None = None,  # noqa: ARG002
    ) -> Influence:
        """What it changes at the history's times; a drive changes nothing by itself."""
        epochs = len(history.times)
        if self.kind == "image":
            return replace(Influence.none(epochs), **self.image_changes(history, values))
        searched, coefficients = self.split(values)
        if self.kind != "signal" or not any(coefficients.values()):
            return Influence.none(epochs)
        course = self.signal(history, **searched)
        changes = {name: course @ self.weights(values, name) for name in coefficients}
        return Influence.of_parameters(changes, epochs)

    def image_changes(
        self,
        history: History,  # noqa: ARG002
        values: Mapping[str, Any],  # noqa: ARG002
    ) -> dict[str, Any]:
        """Of an `image` effect that needs no test field: what it changes of an `Influence`."""
        return {}

    def units(self) -> dict[str, str]:
        """The unit of every parameter by name."""
        return {**{k: p.unit for k, p in self.nonlinear.items()}, **self.linear}

    def check(self, values: Mapping[str, Any], where: str = "") -> None:
        """ConfigurationError where a parameter is missing, unknown or not a number in range."""
        place = f"{where}effect {self.name}"
        known = self.units()
        for name in values:
            if name not in known:
                raise ConfigurationError(
                    f"{place} has no parameter {name!r}; it has: {', '.join(known)}"
                )
        for name, parameter in self.nonlinear.items():
            if name not in values:
                if name in self.optional:
                    continue
                raise ConfigurationError(
                    f"{place}: parameter {name!r} ({parameter.unit}) is missing"
                )
            value = values[name]
            if parameter.text:
                continue
            if not isinstance(value, (int, float)) or not np.isfinite(value):
                raise ConfigurationError(f"{place}: {name} = {value!r} is not a finite number")
            if (parameter.log or self.kind == "drive") and parameter.low >= 0 and value < 0:
                raise ConfigurationError(f"{place}: {name} = {value} {parameter.unit} is negative")
        if self.linear and not any(name in values for name in self.linear):
            raise ConfigurationError(
                f"{place}: it needs at least one of the coefficients {', '.join(self.linear)}"
            )
        for name in self.linear:
            if name in values and not (
                isinstance(values[name], (int, float)) and np.isfinite(values[name])
            ):
                raise ConfigurationError(
                    f"{place}: {name} = {values[name]!r} is not a finite number"
                )

    def sentence(self, estimates: Mapping[str, Mapping[str, Any]]) -> str:
        """One sentence for a report; estimates: {parameter: {value, sd, unit}}."""
        numbers = ", ".join(f"{name} = {spoken(e)}" for name, e in estimates.items())
        return f"{self.noun}{': ' if numbers else ''}{numbers}"

    def experiment_against(self, other: Effect) -> str:
        """What to do to tell this effect from another, and what one would see."""
        for key, action in EXPERIMENTS.items():
            mine, theirs = self.behaviour.get(key), other.behaviour.get(key)
            if mine and theirs and mine != theirs:
                return f"{action}: {self.noun} {mine}, {other.noun} {theirs}"
        for key, action in EXPERIMENTS.items():
            mine, theirs = self.behaviour.get(key), other.behaviour.get(key)
            if mine or theirs:
                mover, said = (self, mine) if mine else (other, theirs)
                return f"{action}: {mover.noun} {said}"
        return f"record longer and under another programme than now ({self.noun}, {other.noun})"


class OfTime(Effect):
    """An effect that knows the time alone: the thermometer's error does not reach it."""

    steady_signal = Steady()

    def sensitivity(self, history: History, **_: Any) -> csr_array:
        from scipy.sparse import csr_array

        return csr_array((len(history.times), len(history.reading_times)))


class Proportional(Effect):
    """An effect whose signal is T - T₀, at once."""

    steady_signal = Steady((0.0, 1.0, 0.0))

    def signal(self, history: History, **_: Any) -> Array:
        return (history.temperature() - history.T0)[:, None]

    def sensitivity(self, history: History, **_: Any) -> csr_array:
        return history.temperature_matrix()
