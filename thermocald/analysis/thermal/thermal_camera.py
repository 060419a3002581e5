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

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from thermocald.analysis.camera.state import CameraState
from thermocald.analysis.thermal.steady import SteadyCamera, steady_camera
from thermocald.analysis.thermal.validity import ExtrapolationWarning, Validity
from thermocald.errors import ConfigurationError, UsageError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, Sensor
from thermocald.simulation import effects
from thermocald.simulation.history import History
from thermocald.simulation.model_file import read_model

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from thermocald.arrays import Array
    from thermocald.simulation.model import ThermalModel

__all__ = ["Along", "ExtrapolationWarning", "ThermalCamera"]

_CHUNK = 20_000  # times in one go


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
        beyond = self._validity.beyond(T, extrapolate) if self._validity else 0.0
        plain = channels is None and not self._uses_channels
        values, slope, J = (self._steady if plain else self._with(channels)).at(T)
        covariance = J @ self.covariance @ J.T
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
        outside = np.zeros(len(instants))
        if self._validity is not None:
            outside = self._validity.outside(history.temperature(), extrapolate)
        values, covariance = [], []
        steady = None if relative_to is None else self._steady.at(relative_to)[2]
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
    def _validity(self) -> Validity | None:
        limits = next(iter(self.model.validity.values()), None)
        return None if limits is None else Validity(*limits)

    @cached_property
    def _uses_channels(self) -> bool:
        return any("channel" in effects.get(e.name).nonlinear for e in self.model.effects)

    @cached_property
    def _steady(self) -> SteadyCamera:
        return self._with(None)

    def _with(self, channels: Mapping[str, float] | None) -> SteadyCamera:
        return steady_camera(self.model, self.parameters, channels)

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
