"""The camera that a thermal model predicts: long at one temperature, or along a log.

A camera that has long been at one temperature is steady: lags and self-heating have settled, a play
is in its middle, nothing creeps, slips or cycles. Along a history, effects act as they do in a fit.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from thermocald.analysis.camera.camera import Camera
from thermocald.arrays import floats, seconds
from thermocald.errors import DataError, UsageError
from thermocald.numbers import celsius, counted
from thermocald.photogrammetry.camera.camera_model import (
    IOP,
    IOP_NAMES,
    PARAMETER_NAMES,
    Sensor,
)
from thermocald.physics import catalogue
from thermocald.physics.catalogue import drive_matrix
from thermocald.physics.effect import Steady
from thermocald.physics.formula import is_formula
from thermocald.physics.history import History
from thermocald.store.logger.clock import iso
from thermocald.store.logger.dialect import to_celsius
from thermocald.store.recording.reader import TemperatureLog

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import ArrayLike
    from scipy.sparse import csr_array

    from thermocald.arrays import Array, Index, Mask
    from thermocald.physics.model import ThermalModel


OTHER_UNITS = {"fahrenheit": "degF", "kelvin": "K"}
_REFUSED_FRACTION = 0.5  # of the fitted range of temperature, beyond its ends
_STEP = 1e-3  # relative step of a parameter for its derivative
_OF_TIMES = ("times", "temperatures", "values", "covariance", "extrapolated")
_MARGIN_K = 0.25  # differences between thermometers are not an extrapolation


class ExtrapolationWarning(UserWarning):
    """A warning that a model predicts outside the temperatures that it was fitted on."""


@dataclass(frozen=True, slots=True)
class Validity:
    """The lowest and the highest temperature of the fit, °C, infinite if unknown.

    of: a thermometer's name.
    """

    low: float
    high: float
    of: str = ""

    def beyond(self, T: ArrayLike) -> Array:
        """Return by how many kelvin temperatures are outside."""
        beyond = np.maximum(self.low - np.asarray(T), np.asarray(T) - self.high)
        return np.where(beyond > _MARGIN_K, beyond, 0.0)

    def is_far(self, T: float) -> bool:
        """Return whether a temperature is too far outside to be used."""
        return bool(self.beyond(T) > _REFUSED_FRACTION * max(self.high - self.low, 1.0))

    def worst(self, temperatures: Array) -> float:
        """Return the temperature that is furthest outside; the median if that is far outside."""
        # half of a log in Fahrenheit may be inside the range by chance: its median shows it
        median = float(np.median(temperatures))
        away = np.abs(temperatures - 0.5 * (self.low + self.high))
        return median if self.is_far(median) else float(temperatures[int(np.argmax(away))])

    def place(self, T: float) -> str:
        """Return by how much a temperature is outside, as the beginning of a sentence."""
        whose = f" of {self.of}" if self.of else ""
        unit = self.other_unit(T)
        return (
            f"{celsius(T)} °C{whose} is {self.beyond(T):.1f} K outside the {celsius(self.low)} to "
            f"{celsius(self.high)} °C that the model was fitted on"
            + (f"; if it is in {unit}, convert it" if unit else "")
        )

    def other_unit(self, T: float) -> str:
        """Return the unit in which a temperature would be inside; "" if there is none."""
        units = {name: to_celsius(np.asarray(T), unit) for name, unit in OTHER_UNITS.items()}
        return next((name for name, C in units.items() if self.low <= C <= self.high), "")

    def check(self, temperatures: Array, extrapolate: bool) -> Array:
        """Return by how many kelvin each temperature (E,) is outside, and warn.

        Raises UsageError if one is far outside, unless `extrapolate`.
        """
        outside = self.beyond(temperatures)
        if outside.any():
            T = self.worst(temperatures)
            if self.is_far(T) and not extrapolate:
                raise UsageError(
                    f"{self.place(T)}; set `extrapolate` (--extrapolate) to predict there"
                )
            warnings.warn(
                f"{self.place(T)}; standard deviations are widened",
                ExtrapolationWarning,
                stacklevel=5,
            )
        return outside


def steady_table(
    model: ThermalModel, names: tuple[str, ...], channels: Mapping[str, float]
) -> tuple[Array, list[float]]:
    """Return a model's steady camera as a table (10, 1 + p, 3 + 2k), and its k knees, °C.

    The rows are the value and its derivatives by the parameters `names`. The
    columns are factors of 1, T - T0 and (T - T0)², and for each knee of the kelvins beyond it and
    of 1 beyond it. channels: °C of other thermometers.
    """
    effects = [
        (e, catalogue.get(e.name), catalogue.get(e.name).steady(e.values, model.T0, channels))
        for e in model.effects
    ]
    knees = [steady.knee for _, _, steady in effects if steady.knee is not None]
    table = np.zeros((10, 1 + len(names), 3 + 2 * len(knees)))

    def add(group: str, key: str, value: float, steady: Steady) -> None:
        rows = table[IOP_NAMES.index(key)]
        signal = np.zeros(table.shape[2])
        signal[:3] = steady.powers
        if steady.knee is not None:
            k = 3 + 2 * knees.index(steady.knee)
            signal[k] = 1.0
            if (knee := f"{group}.{steady.knee_name}") in names:
                rows[1 + names.index(knee), k + 1] -= value
        rows[0] += value * signal
        if (name := f"{group}.{key}") in names:
            rows[1 + names.index(name)] += signal

    for n in IOP_NAMES:
        add("interior", n, float(getattr(model.interior, n)), Steady((1.0, 0.0, 0.0)))
    for n, rate in model.rates.items():
        add("rates", n, rate, Steady((0.0, 1.0, 0.0)))
    for effect, kind, steady in effects:
        for n in kind.linear:
            if n in effect.values and n in IOP_NAMES:
                add(effect.name, n, float(effect.values[n]), steady)
    return table, knees


def constant_history(model: ThermalModel, T: float, channels: Mapping[str, float]) -> History:
    """Return the history of one reading: T °C of the reference, channels °C of others."""
    reference = next(iter(model.validity), "temperature")
    readings = {n: np.array([float(t)]) for n, t in {**channels, reference: T}.items()}
    return History(np.zeros(1), np.zeros(1), readings, reference, model.T0)


def formula_columns(
    model: ThermalModel, names: tuple[str, ...], T: float, channels: Mapping[str, float]
) -> Array:
    """Return what formulas add to a steady camera: value and derivatives (10, 1 + p).

    T °C: of the reference; channels: °C of other thermometers.
    """
    columns = np.zeros((10, 1 + len(names)))
    formulas = [e.name for e in model.effects if is_formula(e.name)]
    if not formulas:
        return columns
    history = constant_history(model, T, channels)

    def added(model: ThermalModel) -> Array:
        return sum((model.influence(name, history)[0] for name in formulas), np.zeros(10))

    columns[:, 0] = added(model)
    for i, name in enumerate(names, 1):
        if name.rsplit(".", 1)[0] in formulas:
            up, down = (added(moved_model(model, name, sign)) for sign in (1.0, -1.0))
            columns[:, i] = (up - down) / (2.0 * _step(model, name))
    return columns


def predict_orientations(
    model: ThermalModel,
    names: tuple[str, ...],
    history: History,
    drive: Array,
    driven: Mapping[tuple[str, float], Array] | None = None,
) -> tuple[Array, Array]:
    """Return a model's cameras: values (E, 10), derivatives (E, 10, p).

    names: of the parameters whose derivatives are wanted; drive (E,) °C: what the rates follow;
    driven: {(parameter of a drive, ±1): drive (E,) with it moved by a step}, if computed.
    """
    linear = model.interior.as_array() + (drive - model.T0)[:, None] * model.rate_vector
    for effect in model.effects:
        if not catalogue.get(effect.name).is_drive:
            linear = linear + model.influence(effect.name, history)
    J = np.zeros((*linear.shape, len(names)))
    for i, name in enumerate(names):
        group, key = name.rsplit(".", 1)  # a formula may contain dots
        if group == "interior":
            J[:, IOP_NAMES.index(key), i] = 1.0
        elif group == "rates":
            J[:, IOP_NAMES.index(key), i] = drive - model.T0
        elif catalogue.get(group).is_drive:
            up, down = (
                driven[name, sign] if driven else moved_model(model, name, sign).drive(history)
                for sign in (1.0, -1.0)
            )
            J[:, :, i] = ((up - down) / (2.0 * _step(model, name)))[:, None] * model.rate_vector
        else:
            up, down = (moved_model(model, name, s).influence(group, history) for s in (1.0, -1.0))
            J[:, :, i] = (up - down) / (2.0 * _step(model, name))
    return model.carried(linear), model.carried_derivatives(linear, J, names)


COLUMNS = (*PARAMETER_NAMES, "scale_X", "scale_Y", "scale_Z", "dX", "dY", "dZ")
"""What a model changes: the camera's 16, scales of the field's coordinates, a displacement, mm."""


def effect_weights(
    model: ThermalModel, name: str, coefficients: Mapping[str, float] | None = None
) -> Array:
    """Return the weights (22,) of an effect's signal in `COLUMNS`, without coefficients the rates.

    The distortion follows c, linearised at T₀.
    """
    weights = np.zeros(len(COLUMNS))
    if coefficients is None:
        weights[:10] = model.rate_vector
    else:
        for key, value in coefficients.items():
            weights[COLUMNS.index(catalogue.get(name).column(key))] = value
    moved = model.carried_derivatives(model.interior.as_array(), weights[:10, None])[:, 0]
    return np.concatenate([moved, weights[10:]])


Operators = list[tuple["Array", str, "csr_array"]]
"""How errors of readings move the camera: weights (22,), channel, ∂ signal / ∂ readings (E, R)."""


def reading_operators(model: ThermalModel, history: History) -> Operators:
    """Return the operators of the rates and effects of a model at a history's times."""
    drive = drive_matrix(history, model.drives)
    found: Operators = [(effect_weights(model, ""), history.reference, drive)]
    for effect in model.effects:
        kind = catalogue.get(effect.name)
        nonlinear, coefficients = kind.split(effect.values)
        if kind.seen_in == "noise" or kind.is_drive or not any(coefficients.values()):
            continue
        matrices = kind.sensitivities(history, **nonlinear)
        weights = effect_weights(model, effect.name, coefficients)
        found += [(weights, channel, S) for channel, S in matrices.items()]
    return found


def shared_errors(
    operators: Operators, bases: Sequence[Array] | None = None
) -> Iterator[tuple[str, Array, Array, Array]]:
    """Yield a channel, the share (E,) of its readings' variance, and two weights (22,).

    The outer product of the weights times the share is a term of the covariance; bases (R,): the
    rows of the state relative to which the operators are taken. Thermometers are independent.
    """
    for i, (c, a, S) in enumerate(operators):
        for k, (d, b, R) in enumerate(operators):
            if a == b and S.nnz and R.nnz:
                shared = np.asarray(S.multiply(R).sum(axis=1)).ravel()
                if bases:
                    shared = shared - S @ bases[k] - R @ bases[i] + bases[i] @ bases[k]
                yield a, shared, c, d


def reading_covariance(
    model: ThermalModel, history: History, sd: float, bases: Sequence[Array] | None = None
) -> Array:
    """Return the covariance (E, 10, 10) of the camera by the errors of the readings.

    sd K: of a reading of the reference; bases: as in `shared_errors`, by default none.
    """
    operators = reading_operators(model, history)
    found = np.zeros((len(history.times), 10, 10))
    for channel, shared, c, d in shared_errors(operators, bases):
        variance = (sd * relative_noise(model, channel)) ** 2
        found += variance * shared[:, None, None] * np.outer(c[IOP], d[IOP])
    return found


def latest_noise(model: ThermalModel, history: History, sd: float) -> Array:
    """Return the covariance (10, 10) of the camera at a history's only time, by the readings.

    As `reading_covariance`; lags and delays are followed without sparse matrices, whose library
    takes 12 MB of a daemon. All readings are finite, and begin before the time and end after it.
    """
    kinds = [(catalogue.get(e.name), e.values) for e in model.effects]
    if not all(kind.delay and float(values[kind.delay]) > 0 for kind, values in kinds):
        return np.asarray(reading_covariance(model, history, sd)[0])
    (now,), times = history.times, history.reading_times
    rows = np.eye(len(times))
    k = int(np.searchsorted(times, now))
    if k:
        share = (now - times[k - 1]) / (times[k] - times[k - 1])
        rows[k] = (1.0 - share) * rows[k - 1] + share * rows[k]
    for follow in model.followers():
        for t, row in zip([*times[:k], now], rows, strict=False):
            row[:] = follow(t, row.copy())
    rates = effect_weights(model, "")[IOP]
    return np.asarray(sd**2 * (rows[k] @ rows[k]) * np.outer(rates, rates))


def relative_noise(model: ThermalModel, channel: str) -> float:
    """Return a thermometer's noise over that of the reference; 1 if no fit has estimated it."""
    fits = [f for f in model.fitted_on if channel in f.get("other_sds_K", ())]
    ratios = [f["other_sds_K"][channel] / f["thermometer_sd_K"] for f in fits]
    return float(np.median(ratios)) if ratios else 1.0


def moved_model(model: ThermalModel, name: str, sign: float) -> ThermalModel:
    """Return the model with one parameter moved by the step of its difference quotient."""
    return model.with_values({name: model.value(name) + sign * _step(model, name)})


def _step(model: ThermalModel, name: str) -> float:
    return _STEP * max(abs(model.value(name)), 1e-9)


@dataclass(frozen=True, eq=False, repr=False)
class Along:
    """The camera along a history; an index gives a Camera, a slice or a mask a part of it.

    times (E,) s, temperatures (E,) °C; values (E, 10); covariance (E, 10, 10); extrapolated (E,) K.
    """

    sensor: Sensor
    times: Array
    temperatures: Array
    values: Array
    covariance: Array
    extrapolated: Array
    camera: str = "camera"

    def __repr__(self) -> str:
        T = self.temperatures
        span = f", {celsius(T.min())} to {celsius(T.max())} °C" if len(T) else ""
        return f"<Along {self.camera}: {counted(len(self), 'time')}{span}>"

    def __len__(self) -> int:
        return len(self.times)

    @overload
    def __getitem__(self, i: int) -> Camera: ...
    @overload
    def __getitem__(self, i: slice | Sequence[int] | Index | Mask) -> Along: ...
    def __getitem__(self, i: int | slice | Sequence[int] | Index | Mask) -> Camera | Along:
        if np.ndim(self.times[i]):
            return replace(self, **{name: getattr(self, name)[i] for name in _OF_TIMES})
        return Camera(
            self.sensor, float(self.temperatures[i]), self.values[i], self.covariance[i],
            float(self.extrapolated[i]), self.camera,
        )  # fmt: skip

    @property
    def sd(self) -> Array:
        """Standard deviations (E, 10); 0 for a parameter that was held."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def read_history(
    times: ArrayLike,
    temperatures: ArrayLike | Mapping[str, ArrayLike],
    at: ArrayLike | None,
    T0: float,
) -> tuple[float, Array, History]:
    """Return when a log begins s, the times (E,) s to predict for, and the history since then.

    times (R,) s or datetime64; temperatures (R,) °C, or {channel: (R,)} with the reference first.
    Raises UsageError for lengths that differ, for what is no number and for times that run
    backwards, DataError for times `at` that the log does not cover.
    """
    t = seconds(times)
    columns = temperatures if isinstance(temperatures, Mapping) else {"temperature": temperatures}
    try:
        readings = {str(n): floats(c) for n, c in columns.items()}
    except (TypeError, ValueError):
        raise UsageError("a temperature is no number: give °C, NaN if unknown") from None
    instants = t if at is None else np.atleast_1d(seconds(at))
    sizes = ", ".join(f"{name} {c.shape}" for name, c in readings.items()) or "nothing"
    shapes = {t.shape, (t.size,), *(c.shape for c in readings.values())}
    if not readings or not t.size or instants.ndim != 1 or not len(instants) or len(shapes) > 1:
        raise UsageError(
            f"times {t.shape}, {sizes}, at {instants.shape}: give columns (n,) with a temperature "
            "for each time, and at least one time"
        )
    if (np.diff(t) < 0).any():
        raise UsageError("the times run backwards: give a log in the order of time")
    reference = next(iter(readings))
    log = TemperatureLog(t, {"": readings[reference]})
    if at is not None and (outside := ~log.known_at(instants)).any():
        raise DataError(
            f"{int(outside.sum())} of {len(instants)} times are outside the temperature log "
            f"({iso(t[0])} to {iso(t[-1])}) or in a gap of over ten of its intervals, the "
            f"first is {iso(instants[outside][0])}"
        )
    begin = float(min(t[0], instants.min()))
    return begin, instants, History(instants - begin, t - begin, readings, reference, T0)


def one_time(time: Any, name: str) -> float:
    """Return one time in s. Raises UsageError for several."""
    if np.ndim(time):
        raise UsageError(f"{name}: give one time")
    return float(seconds(time))


def require_sd(temperature_sd: float) -> None:
    if not 0.0 <= temperature_sd < math.inf:
        raise UsageError(f"temperature_sd is {temperature_sd!r}; it must be a number, at least 0")
