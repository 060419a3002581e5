"""A thermal camera: its interior orientation, with covariance, for any temperature and history.

    camera = load_camera("camera.thermal.yaml")
    now = camera.at(35.0)                     # steady at 35 °C
    series = camera.along(times, temperatures)
    now.interior.c, now.sd["x0"], now.undistort(points), now.object_error(10_000.0)

For a single temperature the model describes a camera that has long been at it and was never hotter:
lags and self-heating have settled, a play is in its middle, nothing creeps, slips or cycles. Along
a history, effects act as they do in a fit.

Outside the temperatures that the model was fitted on, a prediction comes with a warning, and its
standard deviation is widened by the whole drift beyond the range. More than half the range away, it
raises UsageError unless extrapolation is requested explicitly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.camera.camera import Camera
from thermocald.analysis.camera.undistortion import Maps
from thermocald.analysis.thermal.certificate import drift_figure, model_lines, render_certificate
from thermocald.analysis.thermal.modelled_camera import (
    Along,
    Validity,
    constant_history,
    formula_columns,
    moved_model,
    one_time,
    predict_orientations,
    read_history,
    reading_covariance,
    reading_operators,
    require_sd,
    steady_table,
)
from thermocald.errors import ConfigurationError, DataError, UsageError
from thermocald.figures import BAND, draw_figure
from thermocald.names import checked
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.physics.formula import GivenFormula, is_formula
from thermocald.physics.history import History
from thermocald.physics.model_file import model_document, read_model, write_model
from thermocald.result import Result, jsonable
from thermocald.thermal.thermometer import USUAL_THERMOMETER_SD

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike, NDArray

    from thermocald.arrays import Array
    from thermocald.figures import Figure as Chart
    from thermocald.physics.model import ThermalModel


_LARGEST_GAP = 10.0  # in which a live camera uses the last reading, as a log does
_NEEDED = 6  # readings that the present effects follow from, besides two of each channel
_CHUNK = 20_000  # times predicted at once
_ENTRIES = 4_000_000  # readings that the times of a chunk depend on, each counted for itself
_NUMBERS = ("interior", "distortion", "rates", "effects", "validity")
_VERDICT = ("effect_missing", "misfit_px", "significance_sigmas", "distortion_sigmas", "trembles")


@dataclass(frozen=True, repr=False)
class ThermalCamera(Result):
    """A camera whose interior orientation is given for any temperature and history.

    model: the thermal model; fitted: what `fit` reports besides, None for a camera from a file.

    >>> camera = tc.load_camera("camera.yaml")
    >>> bool(camera.at(45.0).interior.c != camera.at(25.0).interior.c)
    True
    """

    model: ThermalModel
    fitted: Mapping[str, Any] | None = field(default=None, compare=False)

    def __hash__(self) -> int:
        return hash((self.model.camera, self.model.T0, self.model.interior))

    def save(self, path: Path | str) -> Path:
        """Write the model file (YAML), whole or not at all, and return its path.

        >>> tc.load_camera("camera.yaml").save("copy.yaml").name
        'copy.yaml'
        """
        write_model(Path(path), self.model)
        return Path(path)

    def as_dict(self) -> dict[str, Any]:
        """Return what `thermocald fit --json` writes; for a camera from a file, its model alone."""
        written = model_document(self.model)
        verdict: dict[str, Any] = self.model.evidence.get("fit") or {}
        document: dict[str, Any] = jsonable(
            {
                "format": "thermocald-fit/1",
                "camera": self.model.camera,
                "reference_temperature": self.model.T0,
                **{key: written.get(key) or {} for key in _NUMBERS},
                **(verdict if self.fitted else {k: verdict[k] for k in _VERDICT if k in verdict}),
                **(self.fitted or {}),
            }
        )
        return document

    def lines(self) -> list[str]:
        """Return what `thermocald fit` prints."""
        return model_lines(self.as_dict())

    @property
    def _limits(self) -> tuple[float, float]:
        """The temperatures of the fit, °C; 15 K about T0 for a model that does not state them."""
        low, high, T0 = self.validity.low, self.validity.high, self.model.T0
        return (low, high) if math.isfinite(low) else (T0 - 15.0, T0 + 15.0)

    def page(self, title: str = "") -> str:
        """Return the model's certificate as HTML text; title: by default the camera's name."""
        sensor, drift = self.model.sensor, None
        with suppress(DataError):  # a model without a steady camera has no curve of it
            drift = self._drift(band=not self.model.misses_an_effect)
        return render_certificate(self.as_dict(), sensor, self._limits, drift, self.warning, title)

    def plot(self) -> Figure:
        """Draw the changes of c, x0 and y0 since T0 (µm) of the steady camera against temperature.

        Covers the range that the model was fitted on, with 95 % bands of these changes; other
        thermometers are taken to be as warm.
        """
        return draw_figure(replace(self._drift(band=True), columns=1))

    def _drift(self, *, band: bool) -> Chart:
        T, T0 = np.linspace(*self._limits, 60), self.model.T0
        changes, Q = map(np.array, zip(*(self.steady_change(T0, t) for t in T), strict=True))
        half = BAND * np.sqrt(np.diagonal(Q, axis1=1, axis2=2)) if band else None
        return drift_figure(T, T0, changes, half)

    def steady_change(self, since: float, T: float) -> tuple[Array, Array]:
        """Return the change (10,) of the steady camera from one temperature to another, °C.

        Also its covariance (10, 10), in which the level cancels. Other thermometers are as warm.
        """
        (then, J0), (now, J) = (self._steady(t) for t in (since, T))
        return now - then, (J - J0) @ self.covariance @ (J - J0).T

    def live(self, size: tuple[int, int] | None = None) -> LiveCamera:
        """Return a camera that follows a thermometer, reading by reading.

        size: width and height px of the frames, by default the model's. Raises ConfigurationError
        if the size is not a binning of the model's.

        >>> live = tc.load_camera("camera.yaml").live()
        >>> now = live.update(0.0, 25.0)
        >>> now.temperature
        25.0
        """
        return LiveCamera(self if size is None else self.for_images(*size))

    def for_images(self, width: int, height: int, camera: str | None = None) -> ThermalCamera:
        """Return the camera for images of a size px, scaled if pixels were binned.

        Raises ConfigurationError for another camera, or for a crop, which no factor describes.
        """
        mine = self.model.sensor
        if camera is not None and camera != self.model.camera:
            raise ConfigurationError(
                f"the model is of camera {self.model.camera}, the images are of {camera}; a "
                "thermal model belongs to one camera"
            )
        if width <= 0 or height <= 0:
            raise ConfigurationError(f"image size {width}×{height} px is impossible")
        factor = mine.width / width
        if abs(mine.height / height - factor) > 1e-9 * factor:
            raise ConfigurationError(
                f"the images have {width}×{height} px, the model's camera {mine.width}×"
                f"{mine.height} px: a crop, which cannot be converted; use whole images"
            )
        if factor == 1.0:
            return self
        sensor = Sensor(width, height, mine.pixel_pitch * factor)
        # a target is measured to the same fraction of the image
        sigma = self.model.image_sigma / factor
        return replace(self, model=replace(self.model, sensor=sensor, image_sigma=sigma))

    @property
    def warning(self) -> str:
        """The warning that an effect is missing, or that the fit did not test for one; else ""."""
        verdict = self.model.evidence.get("fit") or {}
        if why := verdict.get("not_examined"):
            return (
                f"not examined whether the model misses an effect ({why}): it left "
                f"{verdict['left_over_in_noise']:.1f} times the noise in its own series"
                + ("; no 95 % band is stated" if self.model.misses_an_effect else "")
            )
        if not self.model.misses_an_effect:
            return ""
        return (
            f"the model misses an effect: it left {verdict['misfit_px']:.3f} px in its own series. "
            "Standard deviations include this misfit, but not a larger one in other conditions; "
            "run thermocald discover to find the effect"
        )

    @property
    def thermometer_sd(self) -> float | None:
        """The noise of a reading, K, that the fit estimated; None for a model without a fit."""
        sds = [
            float(f["thermometer_sd_K"]) for f in self.model.fitted_on if "thermometer_sd_K" in f
        ]
        return float(np.median(sds)) if sds else None

    @property
    def reading_sd(self) -> float:
        """The noise of a reading, K; a typical value if no fit has estimated it."""
        sd = self.thermometer_sd
        return USUAL_THERMOMETER_SD if sd is None else sd

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
    def validity(self) -> Validity:
        """The temperatures that the model was fitted on, without limits if it states none."""
        return Validity(*next(iter(self.model.validity.values()), (-math.inf, math.inf)))

    def _steady(self, T: float, channels: Mapping[str, float] | None = None) -> tuple[Array, Array]:
        """Return the steady camera's values (10,) and derivatives (10, p).

        channels: °C of the other thermometers, by default as warm.
        """
        channels = dict.fromkeys(self.channels, T) if channels is None else channels
        if not math.isfinite(T):
            raise UsageError(f"the temperature is {T}: give one in °C")
        if missing := [name for name in self.channels if name not in channels]:
            raise DataError(
                f"the model also depends on {missing[0]!r}: give its temperature, channels="
                f"{{{missing[0]!r}: …}}"
            )
        model, names = self.model, self.parameters
        table, knees = steady_table(model, names, channels) if channels else self._table
        dT = T - model.T0
        basis = [1.0, dT, dT * dT]
        for knee in knees:
            basis += [max(T - knee, 0.0), float(knee < T)]
        columns = table @ np.array(basis) + formula_columns(model, names, T, channels)
        value, J = columns[:, 0], columns[:, 1:]
        return model.carried(value), model.carried_derivatives(value, J, names)

    @cached_property
    def _table(self) -> tuple[Array, list[float]]:
        return steady_table(self.model, self.parameters, {})

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """The other thermometers that the model's effects follow."""
        reference, named = next(iter(self.model.validity), "temperature"), list[str]()
        for e in self.model.effects:
            if is_formula(e.name):
                named += [c for c in GivenFormula(e.name).node.channels() if c != reference]
            elif channel := e.values.get("channel"):
                named.append(str(channel))
        return tuple(dict.fromkeys(named))

    def at(
        self,
        temperature: float,
        temperature_sd: float = 0.0,
        channels: Mapping[str, float] | None = None,
        extrapolate: bool = False,
    ) -> Camera:
        """Return the camera that has long been at one temperature, °C.

        temperature_sd K: is propagated into the covariance; channels: °C of other thermometers, for
        a model that uses them. Warns outside the model's validity; raises UsageError far outside it
        (unless `extrapolate`), also for a temperature that looks like Fahrenheit and for a
        thermometer that the model does not know.
        """
        T = float(temperature)
        require_sd(temperature_sd)
        known = list(dict.fromkeys([*self.model.validity, *self.channels]))
        for name, value in (channels or {}).items():
            if name not in known:
                there = ", ".join(known) or "none"
                raise UsageError(f"the model knows no thermometer {name!r}; it knows {there}")
            if not math.isfinite(value):
                raise UsageError(f"the temperature of {name} is {value!r}: give one number, °C")
        values, J = self._steady(T, channels or {})
        others = {name: np.array([float(value)]) for name, value in (channels or {}).items()}
        beyond, covariance = 0.0, J @ self.covariance @ J.T
        if temperature_sd:
            steady = constant_history(self.model, T, channels or {})
            covariance += reading_covariance(self.model, steady, temperature_sd)[0]
        if others or not self.validity.low <= T <= self.validity.high:
            (beyond,), (drift,) = self._beyond(np.array([T]), others, extrapolate)
            covariance += np.diag(drift)
        return Camera(self.model.sensor, T, values, covariance, float(beyond), self.model.camera)

    def along(
        self,
        times: ArrayLike,
        temperatures: ArrayLike | Mapping[str, ArrayLike],
        at: ArrayLike | None = None,
        extrapolate: bool = False,
        relative_to: float | None = None,
        temperature_sd: float = 0.0,
        since: Any = None,
    ) -> Along:
        """Return the camera along a temperature log, including effects with a memory.

        times (R,) s or datetime64; temperatures (R,) °C of the reference, or {channel: (R,)} with
        the reference first; at (E,): the times to predict for, by default `times`. The history
        begins with the first time. relative_to °C: the covariance is that of the difference from
        the steady camera at this temperature; since: instead, of the difference from the camera
        at this time of the log; temperature_sd K: of a reading, is propagated into the
        covariance through the model's effects. Raises UsageError far outside the model's validity
        (unless `extrapolate`), for lengths that differ and for times that run backwards, DataError
        for times `at` that the log does not cover.

        >>> along = tc.load_camera("camera.yaml").along([0.0, 60.0, 120.0], [25.0, 30.0, 35.0])
        >>> along.values.shape, along.sd.shape
        ((3, 10), (3, 10))
        """
        require_sd(temperature_sd)
        begin, instants, history = read_history(times, temperatures, at, self.model.T0)
        readings = history.readings
        others = {name: history.temperature(name) for name in self.channels if name in readings}
        outside, drift = self._beyond(history.temperature(), others, extrapolate)
        base: Array | float = 0.0  # derivatives of the camera whose difference is wanted
        then = np.zeros(0)
        if relative_to is not None:
            base = self._steady(relative_to)[1]
        elif since is not None:
            at = one_time(since, "since")
            then = read_history(times, temperatures, at, self.model.T0)[1] - begin
            base = self._predicted(history.at(then))[1]
        bases, size = None, _CHUNK
        if temperature_sd:
            last = then if len(then) else history.times[-1:]
            rows = [S.toarray()[0] for *_, S in reading_operators(self.model, history.at(last))]
            bases = rows if len(then) else None
            size = int(np.clip(_ENTRIES // max(map(np.count_nonzero, rows)), 1, _CHUNK))
        values, covariance = [], []
        for first in range(0, len(history.times), size):
            part = history.at(history.times[first : first + size])
            found, J = self._predicted(part)
            Q = (J - base) @ self.covariance @ np.swapaxes(J - base, 1, 2)
            if temperature_sd:
                Q += reading_covariance(self.model, part, temperature_sd, bases)
            values.append(found)
            covariance.append(Q)
        Q = np.concatenate(covariance)
        of_each = Q[:, range(10), range(10)]  # of a difference from itself: 0 but for rounding
        Q[:, range(10), range(10)] = np.maximum(of_each, 0.0) + drift
        return Along(
            self.model.sensor, instants, history.temperature(), np.concatenate(values), Q, outside,
            self.model.camera,
        )  # fmt: skip

    def _predicted(self, history: History) -> tuple[Array, Array]:
        return predict_orientations(self.model, self.parameters, history, self.model.drive(history))

    def _beyond(
        self, T: Array, others: Mapping[str, Array], extrapolate: bool | None
    ) -> tuple[Array, Array]:
        """Return how far outside (E,) K thermometers are, and the drift's variance (E, 10) there.

        T (E,) °C: of the reference; others {name: (E,) °C}; extrapolate: None to accept and warn of
        nothing. The drift is that of the steady camera where a thermometer is furthest outside.
        """
        reference, given = next(iter(self.model.validity), "temperature"), self.model.validity
        limits = {n: Validity(*given[n], n) for n in self.channels if n in others and n in given}
        read, beyond = {**others, reference: T}, {}
        for name, of in {reference: self.validity, **limits}.items():
            there = read[name]
            beyond[name] = of.beyond(there) if extrapolate is None else of.check(there, extrapolate)
        outside: Array = np.stack(list(beyond.values())).max(axis=0)
        variance = np.zeros((len(T), 10))
        if outside.any():
            worst, step = {n: float(x[outside.argmax()]) for n, x in read.items()}, 1e-3

            def camera(at: dict[str, float]) -> Array:
                history = constant_history(self.model, at[reference], at)
                return predict_orientations(self.model, (), history, self.model.drive(history))[0]

            drifts = [
                far[:, None] * (camera({**worst, n: worst[n] + step}) - camera(worst)) / step
                for n, far in beyond.items()
            ]
            variance += drifts.pop(0) ** 2 + sum(map(np.abs, drifts)) ** 2
        return outside, variance

    def steady_tables(self) -> tuple[Array, list[Array]]:
        """Return the steady camera's linear parameters as polynomials in T - T0, and its knees.

        Polynomials (3, 10); of each knee (11,) the temperature °C and the ten parameters' change
        per kelvin beyond it. Raises UsageError for a model that needs more than one thermometer.
        """
        if self.channels or any(is_formula(e.name) for e in self.model.effects):
            raise UsageError(
                "the model has a formula, or needs more than one thermometer: it cannot be written "
                "as code"
            )
        table, knees = steady_table(self.model, (), {})
        bends = [np.array([T, *table[:, 0, 3 + 2 * k]]) for k, T in enumerate(knees)]
        return table[:, 0, :3].T, bends


def load_camera(path: Path | str) -> ThermalCamera:
    """Load a thermal camera from the model file that `fit` wrote.

    Raises ConfigurationError naming the file and key.

    >>> tc.load_camera("camera.yaml").at(35.0).temperature
    35.0
    """
    try:
        return ThermalCamera(read_model(Path(path)))
    except ConfigurationError as error:
        if Path(path).suffix.lower() in (".yaml", ".yml"):
            raise
        raise ConfigurationError(
            f"{error}; a thermal model is the YAML file that `fit` writes"
        ) from error


def steady_camera(thermal: ThermalCamera, T: float) -> Camera:
    """Return the camera in which every thermometer shows T °C, also beyond the model's validity."""
    return thermal.at(T, channels=dict.fromkeys(thermal.channels, T), extrapolate=True)


def _push(followers: list[Any], time: float, value: float) -> Array:
    """Pass a reading °C through the followers; return the temperature that drives now, (1,) °C."""
    for one in followers:
        value = one(time, value)
    return np.array([value])


@checked
class LiveCamera:
    """A camera that follows its thermometer; made by `ThermalCamera.live`.

    `update` takes a reading and returns the camera; `correct` returns a frame as the steady camera
    would have seen it. The state belongs to one run: make a new object for another. `along` uses
    the whole history for every time; here effects with a memory store their state, and a further
    reading costs the same after an hour as after a minute. Formulas and plug-in effects may depend
    on the whole history: for them it is stored and used (`keeps_all`).

    >>> live = tc.load_camera("camera.yaml").live(size=(1640, 1232))
    >>> for k in range(3):
    ...     now = live.update(10.0 * k, 25.0 + k)
    >>> now.sensor.width, now.temperature
    (1640, 27.0)
    """

    def __init__(self, thermal: ThermalCamera) -> None:
        self.thermal = thermal
        model = thermal.model
        self._drive = model.followers()
        self.keeps_all = None in self._drive or not model.is_of_now
        self._readings: list[tuple[float, ...]] = []  # the time s, then °C of each channel
        self._channels: tuple[str, ...] = ()
        self._seen: tuple[float, ...] = ()  # when each channel was last measured, s
        self._updates = 0
        self._now: Camera | None = None
        self._maps: Maps | None = None
        drives = {name for name, _ in model.drives}
        self._moved = {
            (name, sign): moved_model(model, name, sign).followers()
            for name in thermal.parameters
            for sign in (1.0, -1.0)
            if name.split(".")[0] in drives
        }

    def __reduce__(self) -> str:  # a copy would share the state of the effects with a memory
        raise UsageError("a live camera belongs to one run: make another with live(), not a copy")

    def __repr__(self) -> str:
        now = "no reading yet" if self._now is None else f"{self._now.temperature:g} °C"
        return f"<LiveCamera {self.thermal.model.camera}: {now}>"

    def update(self, time: Any, temperature: float | Mapping[str, float]) -> Camera:
        """Take a reading and return the camera now, equal to `along` over the history so far.

        Its covariance is the model's, without the noise of readings, as that of `along` by default.
        time: s or datetime64, later than the last; temperature: °C, or {channel: °C} with the
        reference first; for NaN (a failed reading) the channel's last reading is used, for at most
        ten intervals between readings, then DataError is raised. Raises UsageError if the time is
        not later, and far outside the temperatures of the fit.

        >>> live = tc.load_camera("camera.yaml").live()
        >>> live.update(0.0, 25.0).sd["c"] > 0
        True
        """
        thermal, (t, *row) = self.thermal, self._checked(time, temperature)
        model, others = thermal.model, zip(self._channels[1:], row[1:], strict=True)
        (beyond,), drift = thermal._beyond(  # an error leaves the state unchanged
            np.array(row[:1]), {name: np.array([T]) for name, T in others}, extrapolate=False
        )
        self._remember((t, *row))
        times, *columns = np.array(self._readings).T
        readings, since = dict(zip(self._channels, columns, strict=True)), times - times[0]
        history = History(since[-1:], since, readings, self._channels[0], model.T0)
        if self.keeps_all:
            drive, driven = model.drive(history), None
        else:
            drive = _push(self._drive, t, row[0])
            driven = {key: _push(moved, t, row[0]) for key, moved in self._moved.items()}
        (values,), (J,) = predict_orientations(model, thermal.parameters, history, drive, driven)
        Q = J @ thermal.covariance @ J.T + np.diag(drift[0])
        self._now = Camera(model.sensor, row[0], values, Q, float(beyond), model.camera)
        return self._now

    def correct(self, frame: NDArray[Any], to: float | None = None) -> NDArray[Any]:
        """Return a frame (H, W) or (H, W, 3) as the steady camera would have seen it.

        to: °C of that camera, by default the model's T0. The maps for `cv2.remap` are reused until
        an image point has moved by more than 0.05 px. Raises UsageError before the first reading,
        and for a frame whose size is not that given to `live(size=…)`.

        >>> import numpy as np
        >>> live = tc.load_camera("camera.yaml").live(size=(1640, 1232))
        >>> _ = live.update(0.0, 40.0)
        >>> live.correct(np.zeros((1232, 1640), np.uint8)).shape
        (1232, 1640)
        """
        import cv2

        sensor = self.thermal.model.sensor
        if not isinstance(frame, np.ndarray) or frame.ndim not in (2, 3):
            given = getattr(frame, "shape", type(frame).__name__)
            raise UsageError(f"the frame is {given}: give an array (H, W) or (H, W, channels)")
        if frame.shape[:2] != (sensor.height, sensor.width):
            raise UsageError(
                f"the frame has {frame.shape[1]}×{frame.shape[0]} px, the camera "
                f"{sensor.width}×{sensor.height}; use live(size=({frame.shape[1]}, "
                f"{frame.shape[0]}))"
            )
        maps = self.maps(to)
        try:
            return cv2.remap(frame, *maps, cv2.INTER_LINEAR).reshape(frame.shape)
        except cv2.error:
            raise UsageError(f"a frame of {frame.dtype} cannot be resampled; give uint8") from None

    def maps(self, to: float | None = None) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the maps x, y (H, W) px for `cv2.remap` that `correct` uses now.

        They are the same objects until an image point has moved by more than 0.05 px.
        """
        if self._now is None:
            raise UsageError("there is no reading yet: call update(time, temperature) first")
        target = self.thermal.model.T0 if to is None else to
        if self._maps is None or self._maps.to != target:
            steady = steady_camera(self.thermal, target)
            self._maps = Maps(steady.sensor, steady.values, target)
        return self._maps.of(self._now.values)

    def _checked(self, time: Any, temperature: float | Mapping[str, float]) -> tuple[float, ...]:
        """Return the time s and the readings °C; a failed one is the last of its channel."""
        t = one_time(time, "time")
        given = temperature if isinstance(temperature, Mapping) else {"temperature": temperature}
        names, row = tuple(given), tuple(float(v) for v in given.values())
        if not row:
            raise UsageError("there is no reading: give a temperature, or {channel: °C}")
        if self._readings:
            before, *last = self._readings[-1]
            if t <= before:
                raise UsageError(f"time {t} is not later than the last reading, {before}")
            if names != self._channels:
                raise UsageError(f"channels {names}: the first reading had {self._channels}")
            row = tuple(b if math.isnan(n) else n for b, n in zip(last, row, strict=True))
        elif any(math.isnan(v) for v in row):
            raise UsageError("the first reading is NaN: begin with one that was measured")
        measured = [not math.isnan(float(v)) for v in given.values()]
        seen = tuple(t if m else s for m, s in zip(measured, self._seen or row, strict=True))
        if self._updates > 1:
            usual = (self._readings[-1][0] - self._readings[0][0]) / (self._updates - 1)
            oldest = min(zip(seen, names, strict=True))
            if t - oldest[0] > _LARGEST_GAP * usual:
                raise DataError(
                    f"{oldest[1]} gave no reading for {t - oldest[0]:.0f} s, over ten of its "
                    f"intervals of {usual:.0f} s: the camera's temperature is not known"
                )
        self._channels, self._seen = names, seen
        return t, *row

    def _remember(self, reading: tuple[float, ...]) -> None:
        """Store a reading; unless all are needed, drop all but first, extremes and last three."""
        self._updates += 1
        self._readings.append(reading)
        last = len(self._readings) - 1
        if not self.keeps_all and last >= _NEEDED + 2 * len(self._channels):
            T = np.array(self._readings)[:, 1:]
            extremes = {*T.argmax(axis=0).tolist(), *T.argmin(axis=0).tolist()}
            needed = sorted({0, *extremes, last - 2, last - 1, last})
            self._readings = [self._readings[i] for i in needed]
