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

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from thermocald.analysis.camera.camera import Camera
from thermocald.analysis.thermal.live_camera import LiveCamera
from thermocald.analysis.thermal.model_text import model_lines
from thermocald.analysis.thermal.steady import SteadyCamera, Validity, steady_camera
from thermocald.errors import ConfigurationError, UsageError
from thermocald.figures import BAND
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, Sensor
from thermocald.physics import catalogue
from thermocald.physics.history import History
from thermocald.physics.model_file import model_document, read_model, write_model
from thermocald.result import Result, jsonable, new_figure

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike

    from thermocald.arrays import Array
    from thermocald.physics.model import ThermalModel

_CHUNK = 20_000  # times in one go
_TOLD = ("effect_missing", "misfit_px", "significance_sigmas", "distortion_sigmas", "trembles")


def seconds(times: ArrayLike) -> Array:
    """Return times in s, of which datetime64 and pandas' are since 1970-01-01 UTC."""
    given = np.asarray(times)
    if np.issubdtype(given.dtype, np.datetime64):
        given = given.astype("datetime64[us]").astype(np.int64) * 1e-6
    return np.asarray(given, dtype=float)


@dataclass(frozen=True, eq=False)
class Along:
    """The camera along a history; `[i]` is a Camera.

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

    def __getitem__(self, i: int) -> Camera:
        return Camera(
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


@dataclass(frozen=True, repr=False)
class ThermalCamera(Result):
    """A camera whose interior orientation is known at any temperature and history.

    model: the thermal model; fitted: what `fit` said of it, None for one from a file.

    >>> camera = tc.load_camera("camera.yaml")
    >>> bool(camera.at(45.0).interior.c != camera.at(25.0).interior.c)
    True
    """

    model: ThermalModel
    fitted: Mapping[str, Any] | None = field(default=None, compare=False)

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a model file; ConfigurationError names file and key."""
        return cls(read_model(Path(path)))

    def save(self, path: Path | str) -> Path:
        """Write the model file (YAML), whole or not at all; returns its path.

        >>> tc.load_camera("camera.yaml").save("copy.yaml").name
        'copy.yaml'
        """
        write_model(Path(path), self.model)
        return Path(path)

    def as_dict(self) -> dict[str, Any]:
        """Return what `thermocald fit --json` writes; of a camera from a file its model alone."""
        document: dict[str, Any] = jsonable(dict(self.fitted or self._document()))
        return document

    def lines(self) -> list[str]:
        """Return what `thermocald fit` prints."""
        return model_lines(self.fitted or self._document())

    def _document(self) -> dict[str, Any]:
        written = model_document(self.model)
        evidence = self.model.evidence.get("fit") or {}
        return {
            "format": "thermocald-fit/1",
            "camera": self.model.camera,
            "reference_temperature": self.model.T0,
            "distortion": self.model.distortion,
            **{k: written.get(k) or {} for k in ("interior", "rates", "effects", "validity")},
            **{k: evidence[k] for k in _TOLD if k in evidence},
        }

    def plot(self) -> Figure:
        """Draw c, x0 and y0 of the steady camera against the temperature, µm from those at T0.

        The range is that which the model was fitted on, with a band of 95 %.
        """
        limits = next(iter(self.model.validity.values()), (self.model.T0 - 15, self.model.T0 + 15))
        T = np.linspace(*limits, 60)
        states = [self.at(t) for t in T.tolist()]
        base = self.at(self.model.T0, extrapolate=True)
        figure, axes = new_figure(3)
        for k, axis in enumerate(axes[:, 0]):
            y = 1e3 * np.array([s.values[k] - base.values[k] for s in states])
            band = 1e3 * BAND * np.array([np.sqrt(s.covariance[k, k]) for s in states])
            axis.plot(T, y)
            axis.fill_between(T, y - band, y + band, alpha=0.3)
            axis.set_ylabel(f"change of {IOP_NAMES[k]} in µm")
            axis.grid(alpha=0.3)
        axes[0, 0].set_title(f"{self.model.camera}, from {self.model.T0:g} °C")
        axes[-1, 0].set_xlabel("temperature in °C")
        return figure

    def live(self, size: tuple[int, int] | None = None) -> LiveCamera:
        """Return the camera as it follows a thermometer, reading by reading.

        size: width and height px of the frames; by default the model's. Raises ConfigurationError
        for a size that is no binning of the model's.

        >>> live = tc.load_camera("camera.yaml").live()
        >>> now = live.update(0.0, 25.0)
        >>> now.temperature
        25.0
        """
        return LiveCamera(self if size is None else self.for_images(*size))

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
        return replace(self, model=replace(self.model, sensor=sensor, image_sigma=sigma))

    @property
    def warning(self) -> str:
        """What its user must know where the model's own fit found that an effect is missing, or
        did not examine it.
        """
        found = self.model.evidence.get("fit") or {}
        if why := found.get("not_examined"):
            return (
                f"not examined whether the model misses an effect ({why}): it left "
                f"{found['left_over_in_noise']:.1f} times the noise in its own series"
                + ("; no 95 % band is stated" if self.model.misses_an_effect else "")
            )
        if not self.model.misses_an_effect:
            return ""
        return (
            f"the model misses an effect: it left {found['misfit_px']:.3f} px in its own series. "
            "Standard deviations hold what it left there, not what it leaves elsewhere; thermocald "
            "discover looks for the effect"
        )

    @property
    def thermometer_sd(self) -> float | None:
        """The noise of a reading K that the fit found; None for a model that no fit has made."""
        known = [
            float(f["thermometer_sd_K"]) for f in self.model.fitted_on if "thermometer_sd_K" in f
        ]
        return float(np.median(known)) if known else None

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
    ) -> Camera:
        """Return the camera that has long been at one temperature °C.

        temperature_sd K: is carried into the covariance; channels: °C of other thermometers, for a
        model that uses them. Warns outside the model's validity; raises UsageError far outside it
        (unless `extrapolate`), and for what looks like fahrenheit.
        """
        T = float(temperature)
        beyond = self.validity.beyond(T, extrapolate) if self.validity else 0.0
        plain = channels is None and not self._uses_channels
        values, slope, J = (self._steady if plain else self._with(channels)).at(T)
        covariance = J @ self.covariance @ J.T
        if temperature_sd:
            covariance += temperature_sd**2 * np.outer(slope, slope)
        if beyond:
            covariance += np.diag((slope * beyond) ** 2)
        return Camera(self.model.sensor, T, values, covariance, beyond, self.model.camera)

    def along(
        self,
        times: ArrayLike,
        temperatures: ArrayLike | Mapping[str, ArrayLike],
        at: ArrayLike | None = None,
        extrapolate: bool = False,
        relative_to: float | None = None,
        temperature_sd: float = 0.0,
    ) -> Along:
        """Return the camera along a temperature log, effects with a memory in force.

        times (R,) s or datetime64; temperatures (R,) °C of the reference, or {channel: (R,)}, the
        first is the reference; at (E,): the times asked for, by default `times`. The past begins
        with the first time. relative_to °C: the covariance is that of the difference to the steady
        camera at this temperature; temperature_sd K: of a reading, is carried into the covariance
        (as if nothing had a memory, which would average it). Raises UsageError far outside the
        model's validity (unless `extrapolate`).

        >>> along = tc.load_camera("camera.yaml").along([0.0, 60.0, 120.0], [25.0, 30.0, 35.0])
        >>> along.values.shape, along.sd.shape
        ((3, 10), (3, 10))
        """
        t = seconds(times)
        columns = temperatures if isinstance(temperatures, dict) else {"temperature": temperatures}
        readings = {str(n): np.asarray(c, dtype=float) for n, c in columns.items()}
        instants = t if at is None else seconds(at)
        begin = float(min(t[0], instants[0]))
        reference = next(iter(readings))
        history = History(instants - begin, t - begin, readings, reference, self.model.T0)
        outside = np.zeros(len(instants))
        if self.validity is not None:
            outside = self.validity.outside(history.temperature(), extrapolate)
        values, covariance = [], []
        steady = None if relative_to is None else self._steady.at(relative_to)[2]
        for first in range(0, len(instants), _CHUNK):
            part = history.at(history.times[first : first + _CHUNK])
            linear, matrix = self._propagated(part, outside[first : first + _CHUNK], steady)
            found = self.model.carried(linear)
            if temperature_sd:
                rates = np.broadcast_to(self.model.rate_vector[:, None], (len(found), 10, 1))
                slope = self.model.carried_derivatives(linear, rates)
                share = _noise_share(t - begin, part.times) * temperature_sd**2
                matrix += share[:, None, None] * slope * np.swapaxes(slope, 1, 2)
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
        """Return the linear orientation (E, 10), and the covariance of the carried one."""
        values = self._linear.predict(history).iop
        J = np.zeros((*values.shape, len(self.parameters)))
        for i, name in enumerate(self.parameters):
            J[:, :, i] = self._derivative(history, name)
        J = self.model.carried_derivatives(values, J, self.parameters)
        if steady is not None:
            J -= steady
        covariance = np.einsum("epi,ij,eqj->epq", J, self.covariance, J, optimize=True)
        beyond = np.abs(self.model.rate_vector) * outside[:, None]
        rows = np.arange(10)
        covariance[:, rows, rows] += beyond**2
        return values, covariance

    def _derivative(self, history: History, name: str) -> Array:
        """∂ linear IOP / ∂ one parameter, (E, 10)."""
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
            sides.append(replace(self._linear, effects=tuple(listed)).predict(history).iop)
        return np.asarray((sides[0] - sides[1]) / (2.0 * step))

    @cached_property
    def _linear(self) -> ThermalModel:
        """The model without what the distortion does: rates and effects add up."""
        return replace(self.model, distortion="image")

    @cached_property
    def validity(self) -> Validity | None:
        """The temperatures that the model was fitted on, None where it does not say."""
        limits = next(iter(self.model.validity.values()), None)
        return None if limits is None else Validity(*limits)

    @cached_property
    def _uses_channels(self) -> bool:
        return any("channel" in catalogue.get(e.name).nonlinear for e in self.model.effects)

    @cached_property
    def _steady(self) -> SteadyCamera:
        return self._with(None)

    def _with(self, channels: Mapping[str, float] | None) -> SteadyCamera:
        return steady_camera(self.model, self.parameters, channels)

    def steady_polynomials(self) -> tuple[Array, Array, Array]:
        """The linear parameters of the steady camera as polynomials in T - T0: three times (10,).

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


def _noise_share(times: Array, at: Array) -> Array:
    """Variance (E,) of what is interpolated between readings at times (R,), in that of one."""
    if len(times) < 2:
        return np.ones(len(at))
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    step = np.maximum(times[after] - times[after - 1], 1e-9)
    share = np.clip((at - times[after - 1]) / step, 0.0, 1.0)
    return share**2 + (1.0 - share) ** 2


def load_camera(path: Path | str) -> ThermalCamera:
    """Load a thermal camera from the model file that `fit` wrote.

    Raises ConfigurationError naming file and key.

    >>> tc.load_camera("camera.yaml").at(35.0).temperature
    35.0
    """
    return ThermalCamera.load(Path(path).expanduser())
