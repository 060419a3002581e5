"""What an effect is: a physical cause with a name, a signature and parameters.

One class is used three times: forward in the simulation (`influence`), as columns in a fit
(`drive`, `signal`, with `sensitivity` to carry the thermometer's error through them), and as words
in a report (`sentence`, `experiment_against`).

Three kinds:

* `drive` replaces the temperature that drives the linear terms of the base model;
* `signal` adds coefficient × signal(t) to some of the camera's parameters;
* `image` acts beyond the camera's parameters: object points, measuring noise, blur.

Non-linear parameters are those a fit has to search (a time constant, a threshold); coefficients
are linear: for a `signal` they bear the names of the parameters they act on.
"""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.camera_model import EOP_NAMES, IOP_NAMES, PARAMETER_NAMES
from thermocald.simulation.history import History

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray
    from scipy.sparse import csr_array

    from thermocald.photogrammetry.field.testfield import TestField

    Array = NDArray[np.float64]

__all__ = [
    "EXPERIMENTS",
    "PARAMETER_UNITS",
    "Displacement",
    "Effect",
    "History",
    "Influence",
    "Parameter",
    "Proportional",
]

Kind = Literal["drive", "signal", "image"]

# Units of IOP and EOP as the files write them (CONVENTIONS §2).
PARAMETER_UNITS: dict[str, str] = {
    "c": "mm", "x0": "mm", "y0": "mm", "A1": "mm-2", "A2": "mm-4", "A3": "mm-6",
    "B1": "mm-1", "B2": "mm-1", "C1": "1", "C2": "1",
    "omega": "rad", "phi": "rad", "kappa": "rad", "X0": "mm", "Y0": "mm", "Z0": "mm",
}  # fmt: skip

# What one can do to tell two effects apart; each effect says how it answers to some of these.
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
    """A non-linear parameter: unit, range to search, usual value, searched by its logarithm?"""

    unit: str
    low: float
    high: float
    default: float
    log: bool = False
    text: bool = False  # a name (a channel), not a number


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """Some targets have moved: rows (k,) of the test field, vector (3,) mm, active (E,) when."""

    rows: NDArray[np.int64]
    vector: Array
    active: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Influence:
    """What an effect changes at E instants.

    iop (E, 10), eop (E, 6): added, in the order of IOP_NAMES and EOP_NAMES; scale (E, 3): factors
    of the object coordinates; displacements: of single targets; noise_factor, blur_factor (E,).
    """

    iop: Array
    eop: Array
    scale: Array
    noise_factor: Array
    blur_factor: Array
    displacements: tuple[Displacement, ...] = field(default=())

    @classmethod
    def none(cls, epochs: int) -> Self:
        """Nothing changes."""
        one = np.ones(epochs)
        return cls(np.zeros((epochs, 10)), np.zeros((epochs, 6)), np.ones((epochs, 3)), one, one)

    @classmethod
    def of_parameters(cls, changes: Mapping[str, Array], epochs: int) -> Self:
        """From changes (E,) of IOP and EOP by name."""
        result = cls.none(epochs)
        for name, change in changes.items():
            if name in IOP_NAMES:
                result.iop[:, IOP_NAMES.index(name)] += change
            else:
                result.eop[:, EOP_NAMES.index(name)] += change
        return result

    def __add__(self, other: Influence) -> Influence:
        """Both together."""
        return Influence(
            self.iop + other.iop,
            self.eop + other.eop,
            self.scale * other.scale,
            self.noise_factor * other.noise_factor,
            self.blur_factor * other.blur_factor,
            self.displacements + other.displacements,
        )


class Effect(ABC):
    """One physical cause. Subclasses are stateless; their docstrings state the formula.

    name: as in the catalogue; noun: for sentences; nonlinear: searched parameters; linear:
    {coefficient: unit}; usual: the coefficients that act unless told otherwise; fresh: non-linear
    parameters that belong to one series and do not carry over to another; behaviour: answers to
    EXPERIMENTS.
    """

    name: ClassVar[str]
    noun: ClassVar[str]
    kind: ClassVar[Kind]
    nonlinear: ClassVar[Mapping[str, Parameter]] = {}
    linear: ClassVar[Mapping[str, str]] = {}
    usual: ClassVar[tuple[str, ...]] = ()
    fresh: ClassVar[tuple[str, ...]] = ()
    behaviour: ClassVar[Mapping[str, str]] = {}

    def drive(self, history: History, **nonlinear: Any) -> Array:
        """The temperature (E,) °C that drives the linear terms in place of T."""
        raise NotImplementedError(f"{self.name} is no drive")

    def signal(self, history: History, **nonlinear: Any) -> Array:
        """The time courses (E, k) that the coefficients multiply; k is 1 but for oscillations."""
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
                other = History(
                    history.times,
                    history.reading_times,
                    {**history.readings, name: moved},
                    history.reference,
                    history.T0,
                )
                sides.append(self._course(other, **nonlinear))
            columns[:, i] = (sides[0] - sides[1]) / (2 * step)
        return csr_array(columns)

    def propagate(self, history: History, errors: Array, **nonlinear: Any) -> Array:
        """Errors (R, m) K of the readings → errors (E, m) of drive or first signal, first order."""
        result: Array = self.sensitivity(history, **nonlinear) @ np.nan_to_num(errors)
        return result

    def unresolved(self, history: History, **nonlinear: Any) -> Array:  # noqa: ARG002
        """Standard deviation (E,) of drive or first signal that the readings' instants leave open.

        What happens between two readings, or after the last, no reading tells; their noise is not
        meant. Most effects need the temperature alone, which straight lines between readings tell.
        """
        return np.zeros(len(history.times))

    def turns(self, history: History, **nonlinear: Any) -> NDArray[np.bool_]:  # noqa: ARG002
        """Epochs (E,) in which the course hangs on which reading was an extreme.

        What `sensitivity` says is not sure there.
        """
        return np.zeros(len(history.times), dtype=bool)

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
        """What it changes at the history's instants; a drive changes nothing by itself."""
        epochs = len(history.times)
        searched, coefficients = self.split(values)
        if self.kind != "signal" or not any(coefficients.values()):
            return Influence.none(epochs)
        course = self.signal(history, **searched)
        changes = {name: course @ self.weights(values, name) for name in coefficients}
        return Influence.of_parameters(changes, epochs)

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


def spoken(estimate: Mapping[str, Any]) -> str:
    """An estimate as people write it: 84.1 ± 1.9 s, two digits of the standard deviation."""
    value, sd, unit = estimate.get("value"), estimate.get("sd"), estimate.get("unit", "")
    unit = "" if unit == "1" else f" {unit}"
    if isinstance(value, str) or value is None:
        return f"{value}{unit}"
    if not sd or not np.isfinite(sd):
        return f"{value:.4g}{unit}"
    digits = 1 - int(np.floor(np.log10(sd)))
    if -2 <= digits <= 5:
        d = max(digits, 0)
        return f"{round(value, digits):.{d}f} ± {round(sd, digits):.{d}f}{unit}"
    exponent = int(np.floor(np.log10(max(abs(value), sd))))
    d = max(digits + exponent, 0)
    return f"({value / 10.0**exponent:.{d}f} ± {sd / 10.0**exponent:.{d}f})e{exponent}{unit}"


def coefficient_units(per: str, parameters: tuple[str, ...] = PARAMETER_NAMES) -> dict[str, str]:
    """Units of coefficients that act on parameters: mm/K, rad/K, …; `per`: "K", "K2", "s", "1"."""
    if per == "1":
        return {name: PARAMETER_UNITS[name] for name in parameters}
    return {name: f"{PARAMETER_UNITS[name]}/{per}" for name in parameters}


class Proportional(Effect):
    """An effect whose signal is T - T₀, at once."""

    def signal(self, history: History, **_: Any) -> Array:
        return (history.temperature() - history.T0)[:, None]

    def sensitivity(self, history: History, **_: Any) -> csr_array:
        return history.temperature_matrix()
