"""The camera that a thermal model predicts: long at one temperature, or along a log.

A camera that has long been at one temperature is steady: lags and self-heating have settled, a play
is in its middle, nothing creeps, slips or cycles. Along a history, effects act as they do in a fit.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.camera.camera import Camera
from thermocald.errors import DataError, UsageError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, Sensor
from thermocald.physics import catalogue
from thermocald.store.logger.dialect import to_celsius

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.arrays import Array
    from thermocald.physics.history import History
    from thermocald.physics.model import ThermalModel


OTHER_UNITS = {"fahrenheit": "degF", "kelvin": "K"}
_REFUSED_FRACTION = 0.5  # of the fitted range of temperature, beyond its ends
_STEP = 1e-3  # relative step of a parameter for its derivative
_MARGIN_K = 0.25  # differences between thermometers are not an extrapolation


class ExtrapolationWarning(UserWarning):
    """A warning that a model predicts outside the temperatures that it was fitted on."""


@dataclass(frozen=True, slots=True)
class Validity:
    """The lowest and the highest temperature of the fit, °C; of: a thermometer's name."""

    low: float
    high: float
    of: str = ""

    def beyond(self, T: float) -> float:
        """Return by how many kelvin a temperature is outside."""
        beyond = max(self.low - T, T - self.high)
        return beyond if beyond > _MARGIN_K else 0.0

    def is_far(self, T: float) -> bool:
        """Return whether a temperature is too far outside to be used."""
        return self.beyond(T) > _REFUSED_FRACTION * max(self.high - self.low, 1.0)

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
            f"{T:.5g} °C{whose} is {self.beyond(T):.1f} K outside the {self.low:g} to "
            f"{self.high:g} °C that the model was fitted on"
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
        beyond = np.maximum(self.low - temperatures, temperatures - self.high)
        outside: Array = np.where(beyond > _MARGIN_K, beyond, 0.0)
        if outside.any():
            T = self.worst(temperatures)
            if self.is_far(T) and not extrapolate:
                if unit := self.other_unit(T):
                    raise UsageError(
                        f"{T:g} looks like {unit}: the model was fitted between {self.low:g} and "
                        f"{self.high:g} °C; convert it"
                    )
                raise UsageError(
                    f"{self.place(T)}; set `extrapolate` to predict there nevertheless"
                )
            warnings.warn(
                f"{self.place(T)}; standard deviations are widened",
                ExtrapolationWarning,
                stacklevel=5,
            )
        return outside


@dataclass(frozen=True, eq=False)
class SteadyCamera:
    """p(T) and ∂p/∂(parameters) as polynomials in T - T₀, and from each knee on in T - T_k.

    knees: T_k, slope, ∂slope, ∂/∂T_k of each. `model` then makes the distortion follow c.
    """

    model: ThermalModel
    names: tuple[str, ...]
    p: tuple[Array, Array, Array]
    J: tuple[Array, Array, Array]
    knees: tuple[tuple[float, Array, Array, Array], ...]

    def at(self, T: float) -> tuple[Array, Array, Array]:
        """Return values (10,), their slope (10,) per K, and the derivatives (10, p) at T °C."""
        dT = T - self.model.T0
        p0, p1, p2 = self.p
        J0, J1, J2 = self.J
        values = p0 + dT * (p1 + dT * p2)
        slope = p1 + 2.0 * dT * p2
        J = J0 + dT * (J1 + dT * J2)
        for knee, rate, by_rate, by_knee in self.knees:
            if knee < T:
                values = values + (T - knee) * rate
                slope = slope + rate
                J = J + (T - knee) * by_rate + by_knee
        columns = np.column_stack([slope, J])
        carried = self.model.carried_derivatives(values, columns, ("slope", *self.names))
        return self.model.carried(values), carried[:, 0], carried[:, 1:]


def steady_camera(
    model: ThermalModel,
    names: tuple[str, ...],
    channels: Mapping[str, float] | None,
) -> SteadyCamera:
    """Return the steady camera of a model.

    names: of the parameters whose derivatives are wanted; channels: °C of other thermometers.
    """
    p = [np.zeros(10) for _ in range(3)]
    J = [np.zeros((10, len(names))) for _ in range(3)]
    knees = []

    def add(parameter: str, value: float, row: int, power: int, factor: float = 1.0) -> None:
        p[power][row] += value * factor
        if parameter in names:
            J[power][row, names.index(parameter)] += factor

    for row, n in enumerate(IOP_NAMES):
        add(f"interior.{n}", float(getattr(model.interior, n)), row, 0)
        if n in model.rates:
            add(f"rates.{n}", model.rates[n], row, 1)
    for effect in model.effects:
        kind = catalogue.get(effect.name)
        steady = kind.steady(effect.values, model.T0, channels)
        own = [
            (k, IOP_NAMES.index(k)) for k in kind.linear if k in effect.values and k in IOP_NAMES
        ]
        if steady.knee is not None:
            rate, by_rate, by_knee = np.zeros(10), np.zeros_like(J[0]), np.zeros_like(J[0])
            for key, row in own:
                rate[row] = float(effect.values[key])
                if (name := f"{effect.name}.{key}") in names:
                    by_rate[row, names.index(name)] = 1.0
                if (name := f"{effect.name}.{steady.knee_name}") in names:
                    by_knee[row, names.index(name)] = -rate[row]
            knees.append((steady.knee, rate, by_rate, by_knee))
        for power, factor in enumerate(steady.powers):
            if not factor:
                continue
            for key, row in own:
                add(f"{effect.name}.{key}", float(effect.values[key]), row, power, factor)
    return SteadyCamera(model, names, (p[0], p[1], p[2]), (J[0], J[1], J[2]), tuple(knees))


def predict_orientations(
    model: ThermalModel,
    names: tuple[str, ...],
    of_names: Array,
    history: History,
    drive: Array,
    noise: Array | None = None,
    steady: Array | None = None,
    driven: Mapping[tuple[str, float], Array] | None = None,
) -> tuple[Array, Array]:
    """Return a model's interior orientations (E, 10) and their covariances (E, 10, 10).

    names: of the parameters with covariance `of_names`; drive (E,) °C: what the rates follow; noise
    (E,) K²: variance of a reading; steady: derivatives (10, p) of the camera whose difference is
    wanted; driven: {(parameter of a drive, ±1): drive (E,) with it moved by a step}, if computed.
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
        elif not catalogue.get(group).is_drive:
            up, down = (moved_model(model, name, s).influence(group, history) for s in (1.0, -1.0))
            J[:, :, i] = (up - down) / (2.0 * _step(model, name))
        else:
            if driven is None:
                up, down = (moved_model(model, name, s).drive(history) for s in (1.0, -1.0))
            else:
                up, down = driven[name, 1.0], driven[name, -1.0]
            slope = (up - down) / (2.0 * _step(model, name))
            J[:, :, i] = slope[:, None] * model.rate_vector
    J = model.carried_derivatives(linear, J, names)
    if steady is not None:
        J -= steady
    covariance: Array = np.einsum("epi,ij,eqj->epq", J, of_names, J, optimize=True)
    if noise is not None:
        rates = np.broadcast_to(model.rate_vector[:, None], (len(J), 10, 1))
        slope = model.carried_derivatives(linear, rates)
        covariance += noise[:, None, None] * slope * np.swapaxes(slope, 1, 2)
    return model.carried(linear), covariance


def moved_model(model: ThermalModel, name: str, sign: float) -> ThermalModel:
    """Return the model with one parameter moved by the step of its difference quotient."""
    return model.with_values({name: model.value(name) + sign * _step(model, name)})


def _step(model: ThermalModel, name: str) -> float:
    return _STEP * max(abs(model.value(name)), 1e-9)


def widened(covariance: Array, variance: Array) -> Array:
    """Return covariances (E, 10, 10) with the variances (E, 10) of a drift added."""
    rows = np.arange(10)
    covariance[:, rows, rows] += variance
    return covariance


@dataclass(frozen=True, eq=False, repr=False)
class Along:
    """The camera along a history; indexing gives a Camera.

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
        return f"<Along {self.camera}: {len(self)} times, {T.min():.1f} to {T.max():.1f} °C>"

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, i: int) -> Camera:
        return Camera(
            self.sensor,
            float(self.temperatures[i]),
            self.values[i],
            self.covariance[i],
            float(self.extrapolated[i]),
            self.camera,
        )

    @property
    def sd(self) -> Array:
        """Standard deviations (E, 10); 0 for a parameter that was held."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def require_known(log: Array, readings: Array, times: Array) -> None:
    """Raise DataError for times (n,) s at which a log's readings (R,) at (R,) s are not known."""
    from thermocald.store.recording.reader import TemperatureLog

    outside = ~TemperatureLog(log, {"": readings}).known_at(times)
    if outside.any():
        from thermocald.store.logger.clock import iso

        raise DataError(
            f"{int(outside.sum())} of {len(times)} times are outside the temperature log "
            f"({iso(log[0])} to {iso(log[-1])}) or in a gap of over ten of its intervals, the "
            f"first is {iso(times[outside][0])}"
        )


def require_sd(temperature_sd: float) -> None:
    if not 0.0 <= temperature_sd < math.inf:
        raise UsageError(f"temperature_sd is {temperature_sd!r}; it must be a number, at least 0")


def noise_share(times: Array, at: Array) -> Array:
    """Return the variance (E,) of an interpolated reading over that of a reading; times (R,)."""
    if len(times) < 2:
        return np.ones(len(at))
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    step = np.maximum(times[after] - times[after - 1], 1e-9)
    share = np.clip((at - times[after - 1]) / step, 0.0, 1.0)
    return share**2 + (1.0 - share) ** 2
