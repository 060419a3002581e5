"""The camera that a thermal model predicts: long at one temperature, or along a log.

A camera that has long been at one temperature is steady: lags and self-heating have settled, a play
is in its middle, nothing creeps, slips or cycles. Along a history, effects act as they do in a fit.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.camera.camera import Camera
from thermocald.arrays import floats, seconds
from thermocald.errors import DataError, UsageError
from thermocald.figures import BAND
from thermocald.names import checked
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, Sensor
from thermocald.physics import catalogue
from thermocald.physics.history import History

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from thermocald.arrays import Array
    from thermocald.physics.model import ThermalModel


_REFUSED_FRACTION = 0.5  # of the fitted range of temperature, beyond its ends
_MARGIN_K = 0.25  # differences between thermometers are not an extrapolation
_CHUNK = 20_000  # times predicted at once
_STEP = 1e-3  # relative step of a parameter for its derivative


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

    def check(self, temperatures: Array, extrapolate: bool) -> Array:
        """Return by how many kelvin each temperature (E,) is outside, and warn.

        Raises UsageError if one is far outside, unless `extrapolate`.
        """
        low, high = self.low, self.high
        outside: Array = np.maximum(np.maximum(low - temperatures, temperatures - high), 0.0)
        outside[outside <= _MARGIN_K] = 0.0
        if not outside.any():
            return outside
        # half of a log in Fahrenheit may be inside the range by chance: its median shows it
        T = float(np.median(temperatures))
        if not self.is_far(T):
            T = float(temperatures[int(np.argmax(outside))])
        whose = f" of {self.of}" if self.of else ""
        place = (
            f"{T:g} °C{whose} is {self.beyond(T):.1f} K outside the {low:g} to {high:g} °C that "
            "the model was fitted on"
        )
        if self.is_far(T) and not extrapolate:
            if low <= (T - 32.0) / 1.8 <= high:
                raise UsageError(
                    f"{T:g} looks like fahrenheit: the model was fitted between {low:g} and "
                    f"{high:g} °C; convert it"
                )
            raise UsageError(f"{place}; set `extrapolate` to predict there nevertheless")
        warnings.warn(
            f"{place}; standard deviations are widened", ExtrapolationWarning, stacklevel=4
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


def widened(covariance: Array, drift: Array | float) -> Array:
    """Return covariances (E, 10, 10) with a drift (E, 10) beyond a thermometer's range added."""
    rows = np.arange(10)
    covariance[:, rows, rows] += np.square(drift)
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


@checked
class ModelledCamera:
    """The predictions of a thermal model, with their covariance."""

    model: ThermalModel

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """The parameters with a standard deviation, as the model file names them."""
        if self.model.covariance is not None:
            return self.model.covariance_names
        return (*self.model.sds, *(f"{e.name}.{k}" for e in self.model.effects for k in e.sds))

    @cached_property
    def covariance(self) -> Array:
        """The covariance of the parameters: the file's matrix, or its sds uncorrelated.

        That of a type is widened so that 95 % of further cameras are within 1.96 sds: the scatter
        of few specimens is itself uncertain (Student's t).
        """
        covariance: Array = self.model.covariance_of(self.parameters)
        specimens = sum("camera" in fit for fit in self.model.fitted_on)
        if specimens > 1:
            from scipy.special import stdtrit

            covariance = covariance * (float(stdtrit(specimens - 1, 0.975)) / BAND) ** 2
        return covariance

    @cached_property
    def validity(self) -> Validity | None:
        """The temperatures that the model was fitted on; None if it does not state them."""
        limits = next(iter(self.model.validity.values()), None)
        return None if limits is None else Validity(*limits)

    @cached_property
    def _steady(self) -> SteadyCamera:
        return steady_camera(self.model, self.parameters, None)

    @property
    def channels(self) -> tuple[str, ...]:
        """The other thermometers that the model's effects follow."""
        named = (e.values.get("channel") for e in self.model.effects)
        return tuple(dict.fromkeys(str(c) for c in named if c))

    def _beyond(
        self, readings: Mapping[str, Array], extrapolate: bool
    ) -> tuple[Array | float, Array | float]:
        """Return by how many kelvin (E,) other thermometers are outside, and the drift (E, 10)."""
        outside: Array | float = 0.0
        drift: Array | float = 0.0
        for effect in self.model.effects:
            name = str(effect.values.get("channel", ""))
            if name in readings and name in self.model.validity:
                of_fit = Validity(*self.model.validity[name], name)
                beyond = of_fit.check(readings[name], extrapolate)
                rates = [float(effect.values.get(n, 0.0)) for n in IOP_NAMES]
                outside = np.maximum(outside, beyond)
                drift = drift + np.abs(beyond[:, None] * rates)
        return outside, drift

    def along(
        self,
        times: ArrayLike,
        temperatures: ArrayLike | Mapping[str, ArrayLike],
        at: ArrayLike | None = None,
        extrapolate: bool = False,
        relative_to: float | None = None,
        temperature_sd: float = 0.0,
    ) -> Along:
        """Return the camera along a temperature log, including effects with a memory.

        times (R,) s or datetime64; temperatures (R,) °C of the reference, or {channel: (R,)} with
        the reference first; at (E,): the times to predict for, by default `times`. The history
        begins with the first time. relative_to °C: the covariance is that of the difference from
        the steady camera at this temperature; temperature_sd K: of a reading, is propagated into
        the covariance (as if no effect had a memory, which would average it). Raises UsageError far
        outside the model's validity (unless `extrapolate`), for lengths that differ and for times
        that run backwards, DataError for times `at` that the log does not cover.

        >>> along = tc.load_camera("camera.yaml").along([0.0, 60.0, 120.0], [25.0, 30.0, 35.0])
        >>> along.values.shape, along.sd.shape
        ((3, 10), (3, 10))
        """
        require_sd(temperature_sd)
        t = seconds(times)
        columns = (
            temperatures if isinstance(temperatures, Mapping) else {"temperature": temperatures}
        )
        try:
            readings = {str(n): floats(c) for n, c in columns.items()}
        except (TypeError, ValueError):
            raise UsageError("a temperature is no number: give °C, NaN if unknown") from None
        instants = t if at is None else np.atleast_1d(seconds(at))
        sizes = ", ".join(f"{c.size} of {name}" for name, c in readings.items()) or "no temperature"
        shapes = {t.shape, (t.size,), *(c.shape for c in readings.values())}
        if not readings or not t.size or instants.ndim != 1 or not len(instants) or len(shapes) > 1:
            raise UsageError(
                f"{t.size} times, {sizes}, at {instants.size} times: a log needs a temperature for "
                "each of its times, and at least one time"
            )
        if (np.diff(t) < 0).any():
            raise UsageError("the times run backwards: give a log in the order of time")
        reference = next(iter(readings))
        if at is not None:
            _require_known(t, readings[reference], instants)
        begin = float(min(t[0], instants.min()))
        history = History(instants - begin, t - begin, readings, reference, self.model.T0)
        outside = np.zeros(len(instants))
        if self.validity is not None:
            outside = self.validity.check(history.temperature(), extrapolate)
        others = {name: history.temperature(name) for name in self.channels if name in readings}
        further, drift = self._beyond(others, extrapolate)
        values, covariance = [], []
        steady = None if relative_to is None else self._steady.at(relative_to)[2]
        for first in range(0, len(instants), _CHUNK):
            part = history.at(history.times[first : first + _CHUNK])
            drive, beyond = self.model.drive(part), outside[first : first + _CHUNK]
            linear = self._linear(part, drive)
            carried = self.model.carried(linear)
            matrix = self._propagate(part, drive, linear, beyond, steady)
            if temperature_sd:
                rates = np.broadcast_to(self.model.rate_vector[:, None], (len(carried), 10, 1))
                slope = self.model.carried_derivatives(linear, rates)
                share = _noise_share(t - begin, part.times) * temperature_sd**2
                matrix += share[:, None, None] * slope * np.swapaxes(slope, 1, 2)
            values.append(carried)
            covariance.append(matrix)
        return Along(
            self.model.sensor,
            instants,
            history.temperature(),
            np.concatenate(values),
            widened(np.concatenate(covariance), drift),
            np.maximum(outside, further),
            self.model.camera,
        )

    def _linear(self, history: History, drive: Array) -> Array:
        """Return level plus rates plus effects, (E, 10); drive (E,) °C: what the rates follow."""
        model = self.model
        linear: Array = model.interior.as_array() + (drive - model.T0)[:, None] * model.rate_vector
        for effect in model.effects:
            if not catalogue.get(effect.name).is_drive:
                linear = linear + model.influence(effect.name, history)
        return linear

    def _propagate(
        self,
        history: History,
        drive: Array,
        linear: Array,
        outside: Array,
        steady: Array | None = None,
        driven: Mapping[tuple[str, float], Array] | None = None,
    ) -> Array:
        """Return the covariance (E, 10, 10) of the orientations that follow from `linear` (E, 10).

        driven: {(parameter of a drive, ±1): drive (E,) with it moved by a step}, if computed.
        """
        J = np.zeros((*linear.shape, len(self.parameters)))
        for i, name in enumerate(self.parameters):
            group, key = name.rsplit(".", 1)  # a formula may contain dots
            if group == "interior":
                J[:, IOP_NAMES.index(key), i] = 1.0
            elif group == "rates":
                J[:, IOP_NAMES.index(key), i] = drive - self.model.T0
            elif not catalogue.get(group).is_drive:
                up, down = (self._moved(name, s).influence(group, history) for s in (1.0, -1.0))
                J[:, :, i] = (up - down) / (2.0 * self._step(name))
            else:
                if driven is None:
                    up, down = (self._moved(name, s).drive(history) for s in (1.0, -1.0))
                else:
                    up, down = driven[name, 1.0], driven[name, -1.0]
                slope = (up - down) / (2.0 * self._step(name))
                J[:, :, i] = slope[:, None] * self.model.rate_vector
        J = self.model.carried_derivatives(linear, J, self.parameters)
        if steady is not None:
            J -= steady
        covariance: Array = np.einsum("epi,ij,eqj->epq", J, self.covariance, J, optimize=True)
        rows = np.arange(10)
        covariance[:, rows, rows] += (np.abs(self.model.rate_vector) * outside[:, None]) ** 2
        return covariance

    def _step(self, name: str) -> float:
        """Return the step of a parameter for its difference quotient."""
        return _STEP * max(abs(self.model.value(name)), 1e-9)

    def _moved(self, name: str, sign: float) -> ThermalModel:
        """Return the model with one parameter moved by a step."""
        return self.model.with_values({name: self.model.value(name) + sign * self._step(name)})


def _require_known(log: Array, readings: Array, times: Array) -> None:
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


def _noise_share(times: Array, at: Array) -> Array:
    """Return the variance (E,) of an interpolated reading over that of a reading; times (R,)."""
    if len(times) < 2:
        return np.ones(len(at))
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    step = np.maximum(times[after] - times[after - 1], 1e-9)
    share = np.clip((at - times[after - 1]) / step, 0.0, 1.0)
    return share**2 + (1.0 - share) ** 2
