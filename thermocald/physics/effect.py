"""Effects: physical causes with a name, a signature and parameters.

An effect is used in three ways: forward in a simulation (`influence`), as columns of a fit
(`drive`, `signal`, and `sensitivity`, which propagates the thermometer's error through them), and
as text in a report (`sentence`, `experiment_against`). Whatever distinguishes effects is a property
or a method here: no other module tests for an effect by its name.

There are three kinds:

* a `drive` replaces the temperature in the linear terms of the base model;
* a `signal` adds coefficient × signal(t) to some of the camera's parameters;
* an `image` effect acts on what the camera's parameters do not hold: object points, measuring
  noise, blur.

A fit has to search for the non-linear parameters (a time constant, a threshold). The coefficients
are linear; those of a `signal` are named after the parameters that they act on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from thermocald.errors import ConfigurationError, DataError
from thermocald.numbers import parameter_label, with_sd
from thermocald.photogrammetry.camera.camera_model import EOP_NAMES, IOP_NAMES, PARAMETER_NAMES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.physics.history import Follower, History

    Values = Mapping[str, Any]  # of parameters: numbers, a channel's name, or targets' names
    Estimates = Mapping[str, Mapping[str, Any]]  # {parameter: {value, sd, unit}}


@dataclass(slots=True, eq=False)
class Prediction:
    """A model's prediction for E times, to which its effects add their influence in turn.

    iop (E, 10), eop (E, 6): orientations, in the order of IOP_NAMES and EOP_NAMES (eop holds only
    the effects' changes if the model has no exterior orientation); scale (E, 3): factors of the
    object coordinates; noise_factor, blur_factor (E,); displacements: of displaced targets the rows
    (k,) in the test field, the vector (3,) mm, and the epochs concerned (E,); drive (E,) °C: the
    temperature in the linear terms; field: the test field, if given.
    """

    iop: Array
    eop: Array
    scale: Array
    noise_factor: Array
    blur_factor: Array
    drive: Array
    displacements: list[tuple[NDArray[np.int64], Array, NDArray[np.bool_]]]
    field: TestField | None

    @classmethod
    def none(cls, epochs: int, field: TestField | None = None) -> Prediction:
        """Return a prediction without any influence."""
        iop, eop = np.zeros((epochs, 10)), np.zeros((epochs, 6))
        factors = np.ones((epochs, 3)), np.ones(epochs), np.ones(epochs)
        return cls(iop, eop, *factors, np.zeros(epochs), [], field)

    def is_like(self, other: Prediction) -> bool:
        """Return whether another prediction for the same times is the same."""
        arrays = ("iop", "eop", "scale", "noise_factor")
        moved = [sum(active.any() for *_, active in p.displacements) for p in (self, other)]
        same = all(np.array_equal(getattr(self, n), getattr(other, n)) for n in arrays)
        return same and moved[0] == moved[1]

    @property
    def moves_points(self) -> bool:
        """Whether any object point differs from the test field's file."""
        return bool(self.displacements) or bool(np.any(self.scale != 1.0))

    def points(self, points: Array, epochs: slice = slice(None)) -> Array:
        """Return the positions (e, n, 3) mm of object points (n, 3) mm at some of the epochs."""
        moved = points[None, :, :] * self.scale[epochs][:, None, :]
        for rows, vector, active in self.displacements:
            moved[:, rows, :] += active[epochs].astype(float)[:, None, None] * vector
        return moved


Role = Literal["", "period", "phase", "event", "delay", "time_constant", "threshold", "width"]

# Units of IOP and EOP as written in files (CONVENTIONS §2).
PARAMETER_UNITS = dict.fromkeys(PARAMETER_NAMES, "mm") | {
    "A1": "mm-2", "A2": "mm-4", "A3": "mm-6", "B1": "mm-1", "B2": "mm-1", "C1": "1", "C2": "1",
    "omega": "rad", "phi": "rad", "kappa": "rad",
}  # fmt: skip

# Experiments that separate two effects; an effect's `behaviour` is its response to some of them.
EXPERIMENTS: dict[str, str] = {
    "hold": "hold the lamp at 45 °C for 20 minutes",
    "cycle": "heat and cool twice between the same two temperatures",
    "rate": "heat over the same range once slowly and once fast",
    "hotter": "heat 10 K further than before",
    "idle": "leave the lamp off and let the device run for an hour",
    "restart": "switch the device off for an hour and record again",
    "shade": "shade the test field and heat the camera alone",
    "turn": "turn the camera by 180° about its optical axis and heat it again",
    "disconnect": "disconnect fan, heater and charger",
    "load": "load the processor without heating from outside",
}


@dataclass(frozen=True, slots=True)
class Parameter:
    """A non-linear parameter of an effect.

    unit; low, high: range of the search; default: start value; log: whether the search is in its
    logarithm; text: whether it is a name (a channel, targets) rather than a number; role: its
    meaning, which determines the grid of trial values; sized: whether its order of magnitude is
    unknown beforehand.
    """

    unit: str
    low: float
    high: float
    default: float
    log: bool = False
    text: bool = False
    role: Role = ""
    sized: bool = False

    def difference_step(self, value: float) -> float:
        """Return a step for difference quotients: linear in effect, yet well above rounding."""
        if self.log or self.sized:
            return 1e-3 * max(abs(value), 1e-6)
        if self.unit == "degC" or self.role == "threshold":
            return 0.02
        return 0.05 if self.role == "delay" else 1e-3

    def bounded(self, old: float, new: float) -> float:
        """Limit an iteration's new value to the range and, if `log`, to a factor of 2 from the old.

        Data may then call for a tenth of the lower bound, which a simulation cannot use.
        """
        low = self.low
        if self.log:
            new, low = np.clip(new, old / 2.0, old * 2.0), 0.1 * low
        return float(np.clip(new, low, self.high))


def say_estimate(estimate: Values) -> str:
    """Format an estimate with two digits of its standard deviation: 84.1 ± 1.9 s."""
    value, unit = estimate.get("value"), estimate.get("unit", "")
    unit = "" if unit == "1" else unit
    if isinstance(value, str) or value is None:
        return f"{value} {unit}".rstrip()
    return with_sd(value, estimate.get("sd") or np.nan, unit)


def coefficient_units(per: str, parameters: tuple[str, ...] = PARAMETER_NAMES) -> dict[str, str]:
    """Return the units of coefficients by parameter: mm/K, rad/K, …; `per`: "K", "s", "1"."""
    return {n: PARAMETER_UNITS[n] + (f"/{per}" if per != "1" else "") for n in parameters}


Kind = Literal["drive", "signal", "image"]
SeenIn = Literal["trajectory", "noise", "targets"]


@dataclass(frozen=True, slots=True)
class Steady:
    """An effect's signal once the camera has settled at a temperature T; 0 by default.

    powers: factors of (T - T₀)⁰, (T - T₀)¹, (T - T₀)²; knee: °C above which T - knee is added, or
    None; knee_name: the effect's parameter that is the knee.
    """

    powers: tuple[float, float, float] = (0.0, 0.0, 0.0)
    knee: float | None = None
    knee_name: str = ""


class Effect:
    """A physical cause. Subclasses are stateless; their docstrings state the formula.

    name: as in the catalogue; noun: its name in sentences; says: a sentence with its estimates in
    braces; nonlinear: the parameters to search; linear: {coefficient: unit}; usual: the
    coefficients that act by default; fresh: non-linear parameters that differ between series;
    optional: non-linear parameters that a model may leave out; behaviour: {experiment: response},
    for keys of EXPERIMENTS.

    For a search: seen_in: where it shows, in the trajectories of the camera's parameters, in the
    measuring noise, or in single targets; parameter_sets: the sets of coefficients that it may act
    on, by default the usual ones; moves_mount: whether it may act on the exterior orientation
    instead; irreversible: whether it remains after cooling; follows_rate: whether its signal is the
    rate of the temperature; columns: {coefficient: column of the reduced series} where names
    differ; steady_signal: see `steady`; of_now: whether it follows from the first, the highest, the
    lowest and the last three readings, so that a live camera need not store the others.
    """

    name: str
    noun: str
    says: str = ""
    kind: Kind = "signal"
    nonlinear: Mapping[str, Parameter] = {}
    linear: Mapping[str, str] = {}
    usual: tuple[str, ...] = ()
    fresh: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()
    behaviour: Mapping[str, str] = {}
    seen_in: SeenIn = "trajectory"
    parameter_sets: tuple[tuple[str, ...], ...] = ()
    moves_mount: bool = False
    irreversible: bool = False
    follows_rate: bool = False
    columns: Mapping[str, str] = {}
    steady_signal: Steady | None = None
    of_now: bool = False

    def follower(self, values: Values) -> Follower | None:  # noqa: ARG002
        """Return the drive for readings that come one by one; None if it needs all of them."""
        return None

    @property
    def is_drive(self) -> bool:
        """Whether it replaces the temperature in the linear terms."""
        return self.kind == "drive"

    @property
    def is_event(self) -> bool:
        """Whether it happens at one time of a series, with a size of its own, or not at all."""
        return any(self.nonlinear[name].role == "event" for name in self.fresh)

    @property
    def is_periodic(self) -> bool:
        """Whether it cycles: two signals, whose weights give each series' amplitude and phase."""
        return any(self.nonlinear[name].role == "phase" for name in self.fresh)

    @property
    def delay(self) -> str:
        """The name of the parameter that, to first order, is a delay in s; "" if there is none."""
        if not self.is_drive:
            return ""
        roles = ("delay", "time_constant")
        return next((n for n, p in self.nonlinear.items() if p.role in roles), "")

    def column(self, coefficient: str) -> str:
        """Return the column of a reduced series on which a coefficient acts."""
        return self.columns.get(coefficient, coefficient)

    def drive(self, history: History, **nonlinear: Any) -> Array:
        """Return the temperature (E,) °C that replaces T in the linear terms."""
        raise NotImplementedError(f"{self.name} is not a drive")

    def signal(self, history: History, **nonlinear: Any) -> Array:
        """Return the signal (E, k) that the coefficients multiply; k is 1, or 2 for a wave."""
        raise NotImplementedError(f"{self.name} has no signal")

    def channel(self, history: History, **nonlinear: Any) -> str:  # noqa: ARG002
        """Return the temperature column that the effect reads."""
        return history.reference

    def sensitivity(self, history: History, **nonlinear: Any) -> csr_array:
        """Return ∂ (drive or first signal) / ∂ readings of `channel`, (E, R), sparse.

        Differences, one reading at a time, unless a subclass has a formula.
        """
        from scipy.sparse import csr_array

        name = self.channel(history, **nonlinear)
        readings = np.asarray(history.readings[name], dtype=float)
        step = 1e-4
        columns = np.zeros((len(history.times), len(readings)))
        for i in np.flatnonzero(np.isfinite(readings)):
            for sign in (1.0, -1.0):
                moved = readings.copy()
                moved[i] += sign * step
                other = replace(history, readings={**history.readings, name: moved})
                course = self.drive if self.is_drive else self.signal
                columns[:, i] += sign * course(other, **nonlinear).reshape(len(columns), -1)[:, 0]
            columns[:, i] /= 2 * step
        return csr_array(columns)

    def sensitivities(
        self, history: History, averages: csr_array | None = None, **nonlinear: Any
    ) -> dict[str, csr_array]:
        """Return the sensitivity to every column that it reads, {channel: (E, R)}.

        averages (B, E): weights; the sensitivities of these averages are returned, (B, R).
        """
        own = self.sensitivity(history, **nonlinear)
        channel = self.channel(history, **nonlinear)
        return {channel: own if averages is None else averages @ own}

    def unresolved(self, history: History, rate_jump: Array, **_: Any) -> Array:  # noqa: ARG002
        """Return the sd (E,) of drive or first signal due to the spacing of the readings.

        The readings do not show what happens between two of them or after the last one; their noise
        is not included. rate_jump (E,) K/s: sd of the temperature's rate at the frames, because it
        jumps next to them. Most effects need the temperature alone, for which straight lines
        between the readings are accurate enough: 0 by default.
        """
        return np.zeros(len(history.times))

    def turns(self, history: History, **nonlinear: Any) -> NDArray[np.bool_]:  # noqa: ARG002
        """Find the epochs (E,) in which the drive depends on which reading was the extreme.

        There the `sensitivity` itself is uncertain.
        """
        return np.zeros(len(history.times), dtype=bool)

    def steady(self, values: Values, T0: float, channels: Mapping[str, float] | None) -> Steady:  # noqa: ARG002
        """Return the signal of a camera that has settled at a temperature and was never hotter.

        T0: the model's reference temperature °C; channels: °C of other thermometers. Drives have
        settled too. Raises DataError if the effect has no steady state: the model then needs a
        temperature log.
        """
        if self.steady_signal is None and self.kind == "signal":
            raise DataError(
                f"effect {self.name} has no value at a steady temperature, so there is no steady "
                "camera to predict or to correct to; predict along a temperature log (predict "
                "--log, camera.along)"
            )
        return self.steady_signal or Steady()

    def weights(self, values: Values, name: str) -> Array:
        """Return the weight (k,) of each signal for one coefficient; the phase splits a wave's."""
        return np.array([float(values[name])])

    def split(self, values: Values) -> tuple[dict[str, Any], dict[str, float]]:
        """Split parameter values into non-linear ones and coefficients."""
        searched = {k: values[k] for k in self.nonlinear if k in values}
        return searched, {k: float(values[k]) for k in self.linear if k in values}

    def influence(self, history: History, values: Values, found: Prediction) -> None:
        """Add the effect's changes at the history's times to a prediction; none for a drive."""
        searched, coefficients = self.split(values)
        if self.kind == "signal" and any(coefficients.values()):
            course = self.signal(history, **searched)
            for name in coefficients:
                names, to = (IOP_NAMES, found.iop) if name in IOP_NAMES else (EOP_NAMES, found.eop)
                to[:, names.index(name)] += course @ self.weights(values, name)

    def units(self) -> dict[str, str]:
        """Return the units of all parameters by name."""
        return {**{k: p.unit for k, p in self.nonlinear.items()}, **self.linear}

    def check(self, values: Values) -> None:
        """Raise ConfigurationError if a parameter is missing, unknown, or not a number in range."""
        place = f"effect {self.name}"
        known = self.units()
        for name in values:
            if name not in known:
                raise ConfigurationError(
                    f"{place} has no parameter {name!r}; it has: {', '.join(known)}"
                )
        for name, parameter in self.nonlinear.items():
            if name not in values and name not in self.optional:
                raise ConfigurationError(
                    f"{place}: parameter {name!r} ({parameter.unit}) is missing"
                )
        for name in (n for n in known if n in values):
            value, given = values[name], self.nonlinear.get(name)
            if given is not None and given.text:
                continue
            if not isinstance(value, (int, float)) or not np.isfinite(value):
                raise ConfigurationError(f"{place}: {name} = {value!r} is not a finite number")
            if given is None or given.low < 0 or not (given.log or self.is_drive):
                continue
            if value < 0 or (value == 0 and name not in self.optional):
                raise ConfigurationError(f"{place}: {name} = {value} {given.unit} is not above 0")
        if self.linear and not any(name in values for name in self.linear):
            raise ConfigurationError(
                f"{place} needs at least one of the coefficients {', '.join(self.linear)}"
            )

    def sentence(self, estimates: Estimates) -> str:
        """Write a sentence for a report; estimates: {parameter: {value, sd, unit}}."""
        texts = {}
        for name, estimate in estimates.items():
            match estimate["value"]:
                case str(channel):
                    texts[name] = parameter_label(channel)
                case list(targets):
                    texts[name] = ", ".join(targets)
                case _:
                    texts[name] = say_estimate(estimate)
        if self.says:
            return self.says.format_map(texts)
        numbers = ", ".join(f"{name} = {value}" for name, value in texts.items())
        return f"{self.noun}{': ' if numbers else ''}{numbers}"

    def experiment_against(self, other: Effect) -> str:
        """Describe an experiment that separates this effect from another, with both outcomes."""
        answers = [
            (action, self.behaviour.get(key), other.behaviour.get(key))
            for key, action in EXPERIMENTS.items()
        ]
        for action, mine, theirs in answers:
            if mine and theirs and mine != theirs:
                return f"{action}: {self.noun} {mine}, {other.noun} {theirs}"
        for action, mine, theirs in answers:
            if mine or theirs:
                outcome = f"{self.noun} {mine}" if mine else f"{other.noun} {theirs}"
                return f"{action}: {outcome}"
        return f"record longer, with another temperature programme ({self.noun}, {other.noun})"


class OfTime(Effect):
    """An effect that depends on time alone: the thermometer's error does not reach it."""

    usual: tuple[str, ...] = IOP_NAMES[:3]
    of_now = True
    steady_signal = Steady()

    def sensitivity(self, history: History, **_: Any) -> csr_array:
        from scipy.sparse import csr_array

        return csr_array((len(history.times), len(history.reading_times)))
