"""A thermal camera: the interior orientation, with covariance, at any temperature and history.

    camera = ThermalCamera.load("camera.thermal.yaml")
    now = camera.at(35.0)                     # steady at 35 °C
    series = camera.along(times, temperatures)
    now.interior.c, now.sd["x0"], now.undistort(points), now.object_error(10_000.0)

At one temperature the model is asked for a camera that has long been there and never hotter: lags
and self-heating have settled, a play lies in its middle, nothing creeps, slips or cycles. With a
history, effects act as they do in a fit.

Outside the temperatures that the model was fitted on the answer comes with a warning, and its
standard deviation is widened by the whole drift beyond the range; more than half the range away it
is refused, unless extrapolation is asked for by name.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from thermocald.analysis.camera.state import CameraState
from thermocald.errors import ConfigurationError, UsageError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, Sensor
from thermocald.simulation import effects
from thermocald.simulation.history import History
from thermocald.simulation.model_file import read_model

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from thermocald.arrays import Array
    from thermocald.simulation.effects.base import Steady
    from thermocald.simulation.model import ModelEffect, ThermalModel

__all__ = ["Along", "ExtrapolationWarning", "ThermalCamera"]

_REFUSED_SHARE = 0.5  # of the fitted range of temperature
_MARGIN_K = 0.25  # what thermometers differ by is not an extrapolation
_CHUNK = 20_000  # times in one go


class ExtrapolationWarning(UserWarning):
    """A model was asked for a temperature that it was not fitted on."""


@dataclass(frozen=True, eq=False)
class Along:
    """The camera along a history; `[i]` is a CameraState.

    times (E,) s, temperatures (E,) °C; values (E, 10); covariance (E, 10, 10); extrapolated (E,) K.
    """

    sensor: Sensor
    times: Array
    temperatures: Array
    values: Array
    covariance: Array
    extrapolated: Array

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, i: int) -> CameraState:
        return CameraState(
            self.sensor,
            float(self.temperatures[i]),
            self.values[i],
            self.covariance[i],
            float(self.extrapolated[i]),
        )

    @property
    def sd(self) -> Array:
        """Standard deviations (E, 10), 0 where a parameter was held."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


@dataclass(frozen=True, eq=False)
class _Steady:
    """p(T) and ∂p/∂(parameters) as polynomials in T - T₀, and from each knee on in T - T_k."""

    p: tuple[Array, Array, Array]
    J: tuple[Array, Array, Array]
    knees: tuple[tuple[float, Array, Array, Array], ...]  # T_k, slope, ∂slope, ∂/∂T_k
    covariance: Array


@dataclass(frozen=True)
class ThermalCamera:
    """A thermal model ready for use."""

    model: ThermalModel

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a model file; ConfigurationError names file and key."""
        return cls(read_model(Path(path)))

    def for_images(self, width: int, height: int, camera: str | None = None) -> ThermalCamera:
        """The camera for images of a size px: as it is, or scaled where pixels were binned.

        ConfigurationError for another camera, or a crop, which no factor can tell.
        """
        mine = self.model.sensor
        if camera is not None and camera != self.model.camera:
            raise ConfigurationError(
                f"the model is of camera {self.model.camera}, the images are of {camera}; a "
                "thermal model belongs to one camera"
            )
        factor = mine.width / width
        if abs(mine.height / height - factor) > 1e-9 * factor:
            raise ConfigurationError(
                f"the images have {width}×{height} px, the model's camera {mine.width}×"
                f"{mine.height} px: a crop, which cannot be converted; use whole images"
            )
        if factor == 1.0:
            return self
        sensor = Sensor(width, height, mine.pixel_pitch * factor)
        # a target is measured to the same share of the image
        sigma = self.model.image_sigma / factor
        return ThermalCamera(replace(self.model, sensor=sensor, image_sigma=sigma))

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """The parameters with a covariance, as the model file names them."""
        if self.model.covariance is not None:
            return self.model.covariance_names
        own = {f"{e.name}.{k}": s for e in self.model.effects for k, s in e.sds.items()}
        return (*self.model.sds, *own)

    @cached_property
    def covariance(self) -> Array:
        """Of the parameters: the file's matrix, or its standard deviations without correlation."""
        if self.model.covariance is not None:
            return np.array(self.model.covariance)
        own = {f"{e.name}.{k}": s for e in self.model.effects for k, s in e.sds.items()}
        known = {**self.model.sds, **own}
        return np.diag([known[n] ** 2 for n in self.parameters])

    def at(
        self,
        temperature: float,
        temperature_sd: float = 0.0,
        channels: Mapping[str, float] | None = None,
        extrapolate: bool = False,
    ) -> CameraState:
        """The camera that has long been at one temperature °C.

        temperature_sd K: is carried into the covariance; channels: °C of other thermometers, for a
        model that uses them. Warns outside the model's validity; raises UsageError far outside it
        (unless `extrapolate`), and for what looks like fahrenheit.
        """
        T = float(temperature)
        beyond = self._beyond(T, extrapolate) if self._limits else 0.0
        s = self._steady if channels is None and not self._uses_channels else self._with(channels)
        dT = T - self.model.T0
        p0, p1, p2 = s.p
        J0, J1, J2 = s.J
        values = p0 + dT * (p1 + dT * p2)
        slope = p1 + 2.0 * dT * p2
        J = J0 + dT * (J1 + dT * J2)
        for knee, rate, by_rate, by_knee in s.knees:
            if knee < T:
                values = values + (T - knee) * rate
                slope = slope + rate
                J = J + (T - knee) * by_rate + by_knee
        covariance = J @ s.covariance @ J.T
        if temperature_sd:
            covariance += temperature_sd**2 * np.outer(slope, slope)
        if beyond:
            covariance += np.diag((slope * beyond) ** 2)
        return CameraState(self.model.sensor, T, values, covariance, beyond)

    def along(
        self,
        times: ArrayLike,
        temperatures: ArrayLike | Mapping[str, ArrayLike],
        at: ArrayLike | None = None,
        extrapolate: bool = False,
        relative_to: float | None = None,
        temperature_sd: float = 0.0,
    ) -> Along:
        """The camera along a temperature log.

        times (R,) s; temperatures (R,) °C of the reference, or {channel: (R,)}, the first is the
        reference; at (E,): the times asked for, by default `times`. The past begins with the first
        time. relative_to °C: the covariance is that of the difference to the steady camera at this
        temperature; temperature_sd K: of a reading, is carried into the covariance.
        """
        t = np.asarray(times, dtype=float)
        columns = temperatures if isinstance(temperatures, dict) else {"temperature": temperatures}
        readings = {str(n): np.asarray(c, dtype=float) for n, c in columns.items()}
        instants = t if at is None else np.asarray(at, dtype=float)
        begin = float(min(t[0], instants[0]))
        reference = next(iter(readings))
        history = History(instants - begin, t - begin, readings, reference, self.model.T0)
        outside = self._outside(history.temperature(), extrapolate)
        values, covariance = [], []
        steady = None if relative_to is None else self._steady_derivative(relative_to)
        for first in range(0, len(instants), _CHUNK):
            part = history.at(history.times[first : first + _CHUNK])
            found, matrix = self._propagated(part, outside[first : first + _CHUNK], steady)
            if temperature_sd:
                rates = self.model.rate_vector
                matrix += temperature_sd**2 * np.outer(rates, rates)
            values.append(found)
            covariance.append(matrix)
        return Along(
            self.model.sensor,
            instants,
            history.temperature(),
            np.concatenate(values),
            np.concatenate(covariance),
            outside,
        )

    def _steady_derivative(self, temperature: float) -> Array:
        """∂ IOP / ∂ parameters (10, p) of the steady camera."""
        s = self._steady
        dT = temperature - self.model.T0
        J = s.J[0] + dT * (s.J[1] + dT * s.J[2])
        for knee, _, by_rate, by_knee in s.knees:
            if temperature > knee:
                J = J + (temperature - knee) * by_rate + by_knee
        return J

    def _propagated(
        self, history: History, outside: Array, steady: Array | None
    ) -> tuple[Array, Array]:
        values = self.model.predict(history).iop
        J = np.zeros((*values.shape, len(self.parameters)))
        for i, name in enumerate(self.parameters):
            J[:, :, i] = self._derivative(history, name)
        if steady is not None:
            J -= steady
        covariance = np.einsum("epi,ij,eqj->epq", J, self.covariance, J, optimize=True)
        beyond = np.abs(self.model.rate_vector) * outside[:, None]
        rows = np.arange(10)
        covariance[:, rows, rows] += beyond**2
        return values, covariance

    def _derivative(self, history: History, name: str) -> Array:
        """∂ IOP / ∂ one parameter, (E, 10)."""
        group, key = name.split(".", 1)
        result = np.zeros((len(history.times), 10))
        if group == "interior":
            result[:, IOP_NAMES.index(key)] = 1.0
            return result
        if group == "rates":
            result[:, IOP_NAMES.index(key)] = self.model.drive(history) - self.model.T0
            return result
        place = next(i for i, e in enumerate(self.model.effects) if e.name == group)
        value = float(self.model.effects[place].values[key])
        step = 1e-3 * max(abs(value), 1e-9)
        sides = []
        for sign in (1.0, -1.0):
            effect = self.model.effects[place]
            moved = replace(effect, values={**effect.values, key: value + sign * step})
            listed = list(self.model.effects)
            listed[place] = moved
            sides.append(replace(self.model, effects=tuple(listed)).predict(history).iop)
        return np.asarray((sides[0] - sides[1]) / (2.0 * step))

    @cached_property
    def _limits(self) -> tuple[float, float] | None:
        return next(iter(self.model.validity.values()), None)

    @cached_property
    def _uses_channels(self) -> bool:
        return any("channel" in effects.get(e.name).nonlinear for e in self.model.effects)

    def _beyond(self, T: float, extrapolate: bool) -> float:
        """How many kelvin a temperature lies outside; warns or refuses."""
        assert self._limits is not None
        low, high = self._limits
        if low - _MARGIN_K <= T <= high + _MARGIN_K:
            return 0.0
        beyond = low - T if low > T else T - high
        far = beyond > _REFUSED_SHARE * max(high - low, 1.0)
        if far and not extrapolate and low <= (T - 32.0) / 1.8 <= high:
            raise UsageError(
                f"{T:g} looks like fahrenheit: the model was fitted between {low:g} and {high:g} "
                "°C; convert it"
            )
        if far and not extrapolate:
            raise UsageError(
                f"{T:g} °C is {beyond:.1f} K outside the {low:g} to {high:g} °C that the model was "
                "fitted on; ask for extrapolation by name if you mean it"
            )
        warnings.warn(
            f"{T:g} °C is {beyond:.1f} K outside the {low:g} to {high:g} °C that the model was "
            "fitted on; standard deviations are widened",
            ExtrapolationWarning,
            stacklevel=3,
        )
        return beyond

    def _outside(self, temperatures: Array, extrapolate: bool) -> Array:
        outside = np.zeros(len(temperatures))
        if self._limits is None or not len(temperatures):
            return outside
        low, high = self._limits
        outside = np.maximum(np.maximum(low - temperatures, temperatures - high), 0.0)
        outside[outside <= _MARGIN_K] = 0.0
        worst = float(temperatures[int(np.argmax(outside))])
        # half of a log in fahrenheit may lie inside the range by chance: its middle tells
        middle = float(np.median(temperatures))
        if outside.max() > 0:
            self._beyond(middle if self._is_far(middle) else worst, extrapolate)
        return outside

    def _is_far(self, T: float) -> bool:
        assert self._limits is not None
        low, high = self._limits
        return max(low - T, T - high) > _REFUSED_SHARE * max(high - low, 1.0)

    @cached_property
    def _steady(self) -> _Steady:
        return self._with(None)

    def steady_polynomials(self) -> tuple[Array, Array, Array]:
        """The parameters of the steady camera as polynomials in T - T0: three times (10,).

        UsageError for a model that needs more than one thermometer.
        """
        if self._uses_channels:
            raise UsageError("the model needs more than one thermometer: it is not a function of T")
        return self._steady.p

    def steady_knees(self) -> tuple[tuple[float, ...], ...]:
        """For each knee its temperature °C, and by how much a kelvin beyond it changes each of the
        ten parameters.
        """
        return tuple((knee, *rate.tolist()) for knee, rate, _, _ in self._steady.knees)

    def _with(self, channels: Mapping[str, float] | None) -> _Steady:
        """The steady camera as polynomials; see the module's docstring for what steady means."""
        names = self.parameters
        p = [np.zeros(10) for _ in range(3)]
        J = [np.zeros((10, len(names))) for _ in range(3)]
        knees = []

        def add(parameter: str, value: float, row: int, power: int, factor: float = 1.0) -> None:
            p[power][row] += value * factor
            if parameter in names:
                J[power][row, names.index(parameter)] += factor

        for row, n in enumerate(IOP_NAMES):
            add(f"interior.{n}", float(getattr(self.model.interior, n)), row, 0)
            if n in self.model.rates:
                add(f"rates.{n}", self.model.rates[n], row, 1)
        for effect in self.model.effects:
            kind = effects.get(effect.name)
            steady = kind.steady(effect.values, self.model.T0, channels)
            own = [
                (k, IOP_NAMES.index(k))
                for k in kind.linear
                if k in effect.values and k in IOP_NAMES
            ]
            if steady.knee is not None:
                knees.append(_knee(effect, steady, own, names))
            for power, factor in enumerate(steady.powers):
                if not factor:
                    continue
                for key, row in own:
                    add(f"{effect.name}.{key}", float(effect.values[key]), row, power, factor)
        return _Steady(tuple(p), tuple(J), tuple(knees), self.covariance)  # type: ignore[arg-type]


def _knee(
    effect: ModelEffect, steady: Steady, own: list[tuple[str, int]], names: tuple[str, ...]
) -> tuple[float, Array, Array, Array]:
    rate, by_rate, by_knee = np.zeros(10), np.zeros((10, len(names))), np.zeros((10, len(names)))
    for key, row in own:
        rate[row] = float(effect.values[key])
        if f"{effect.name}.{key}" in names:
            by_rate[row, names.index(f"{effect.name}.{key}")] = 1.0
        if f"{effect.name}.{steady.knee_name}" in names:
            by_knee[row, names.index(f"{effect.name}.{steady.knee_name}")] = -rate[row]
    assert steady.knee is not None
    return steady.knee, rate, by_rate, by_knee
