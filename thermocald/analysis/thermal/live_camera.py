"""A thermal camera that follows a thermometer: each reading gives a camera, at its own cost.

`along` asks the whole history for every time; here the effects with a memory keep their state, and
a further reading costs the same after an hour as after a minute. Both say the same of the same
history. Formulas, and effects of others, may depend on all of it: with them it is kept and asked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from thermocald.analysis.camera.camera import Camera
from thermocald.analysis.camera.undistortion import Maps
from thermocald.errors import UsageError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.physics import catalogue
from thermocald.physics.history import History

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from thermocald.analysis.thermal.steady import Validity
    from thermocald.arrays import Array
    from thermocald.physics.model import ModelEffect, ThermalModel

_STEP = 1e-3  # of a parameter, for its derivative; as `along` has it


class _Thermal(Protocol):
    """What is asked of a thermal camera."""

    @property
    def model(self) -> ThermalModel: ...
    @property
    def parameters(self) -> tuple[str, ...]: ...
    @property
    def covariance(self) -> Array: ...
    @property
    def validity(self) -> Validity | None: ...
    def at(self, temperature: float, *, extrapolate: bool = ...) -> Camera: ...
    def along(
        self, times: Any, temperatures: Any, at: Any = ..., extrapolate: bool = ...
    ) -> Any: ...


class _Drive:
    """The temperature behind the linear terms: readings through all drives of a model, in order."""

    def __init__(self, effects: Sequence[ModelEffect]) -> None:
        found = [catalogue.get(e.name).follower(e.values) for e in effects]
        self.stages = [stage for stage in found if stage is not None]
        self.known = len(self.stages) == len(effects)

    def push(self, time: float, value: float) -> float:
        for stage in self.stages:
            value = stage.push(time, value)
        return value


@dataclass
class _Readings:
    """The readings that effects of now follow from: times s, rows of °C by channel.

    kept: all of them, where an effect may ask for any.
    """

    kept: bool
    times: list[float] = field(default_factory=list)
    rows: list[tuple[float, ...]] = field(default_factory=list)
    extremes: dict[tuple[int, bool], int] = field(default_factory=dict)

    def push(self, time: float, row: tuple[float, ...]) -> None:
        self.times.append(time)
        self.rows.append(row)
        if not self.kept and len(self.times) > 6 + 2 * len(row):
            T = np.array(self.rows)
            last = len(T) - 1
            needed = {0, *T.argmax(axis=0).tolist(), *T.argmin(axis=0).tolist(), last - 2, last - 1}
            rows = sorted(needed | {last})
            self.times = [self.times[i] for i in rows]
            self.rows = [self.rows[i] for i in rows]


class _LiveState(Camera):
    """A camera whose covariance is computed when somebody asks for it."""

    def __init__(
        self, live: LiveCamera, T: float, values: Array, beyond: float, J: Callable[[], Array]
    ) -> None:
        known = {
            "sensor": live.thermal.model.sensor,
            "temperature": T,
            "values": values,
            "extrapolated": beyond,
            "name": live.thermal.model.camera,
            "_known": (live.thermal, J),
        }
        for name, value in known.items():
            object.__setattr__(self, name, value)

    @cached_property
    def covariance(self) -> Array:
        """(10, 10), in the order of IOP_NAMES."""
        thermal, derivatives = self.__dict__["_known"]
        J = derivatives()
        covariance: Array = J @ thermal.covariance @ J.T
        widened = thermal.model.rate_vector * self.extrapolated
        return covariance + np.diag(widened**2)


class LiveCamera:
    """A camera that follows its thermometer; made by `ThermalCamera.live`.

    `update` takes a reading and gives the camera, `correct` a frame as the steady camera would have
    seen it. Its state is that of one run: begin a new one for another.

    >>> live = tc.load_camera("camera.yaml").live(size=(1640, 1232))
    >>> for k in range(3):
    ...     now = live.update(10.0 * k, 25.0 + k)
    >>> now.sensor.width, now.temperature
    (1640, 27.0)
    """

    def __init__(self, thermal: _Thermal, *, extrapolate: bool = False) -> None:
        self.thermal, self.extrapolate = thermal, extrapolate
        model = thermal.model
        self._drives = [e for e in model.effects if catalogue.get(e.name).is_drive]
        self._signals = [e for e in model.effects if not catalogue.get(e.name).is_drive]
        self._drive = _Drive(self._drives)
        of_now = all(catalogue.get(e.name).of_now or _moves_only_pose(e) for e in self._signals)
        self._asks_along = not (self._drive.known and of_now and not _asks_ahead(self._drives))
        self._readings = _Readings(kept=self._asks_along)
        self._channels: tuple[str, ...] = ()
        self._now: Camera | None = None
        self._maps: Maps | None = None
        self._moved = {
            name: tuple(_Drive(_moved_by(self._drives, name, sign)[0]) for sign in (1.0, -1.0))
            for name in thermal.parameters
            if name.split(".")[0] in {e.name for e in self._drives}
        }

    @property
    def keeps_all(self) -> bool:
        """Whether every reading is kept and asked at each update."""
        return self._asks_along

    def update(self, time: Any, temperature: float | Mapping[str, float]) -> Camera:
        """Take a reading and return the camera now, the same as `along` says of the history so far.

        time: s, or datetime64, later than that before; temperature: °C, or {channel: °C}, the
        first is the reference; NaN where a reading failed: the last one stands. Raises UsageError
        for a time that is not later, and far outside the temperatures of the fit.

        >>> live = tc.load_camera("camera.yaml").live()
        >>> live.update(0.0, 25.0).sd["c"] > 0
        True
        """
        t, row = self._checked(time, temperature)
        validity = self.thermal.validity
        beyond = 0.0
        if validity is not None:  # before anything is kept: a refused reading leaves no trace
            beyond = float(validity.outside(np.array([row[0]]), self.extrapolate)[0])
        self._readings.push(t, row)
        if self._asks_along:
            columns = np.array(self._readings.rows).T
            readings = dict(zip(self._channels, columns, strict=True))
            self._now = self.thermal.along(self._readings.times, readings, [t], extrapolate=True)[0]
            return self._now
        model = self.thermal.model
        D = self._drive.push(t, row[0])
        moved = {n: tuple(d.push(t, row[0]) for d in pair) for n, pair in self._moved.items()}
        values = model.interior.as_array() + (D - model.T0) * model.rate_vector
        history = self._history() if self._signals else None
        if history is not None:
            values = values + _influence(self._signals, history)
        self._now = _LiveState(
            self, row[0], model.carried(values), beyond,
            lambda: model.carried_derivatives(
                values, self._derivatives(D, moved, history), self.thermal.parameters
            ),
        )  # fmt: skip
        return self._now

    def correct(self, frame: NDArray[Any], to: float | None = None) -> NDArray[Any]:
        """Return a frame (H, W) or (H, W, 3) as the steady camera had seen it.

        to: °C of that camera, by default the model's T0. The maps of `cv2.remap` are kept, and
        renewed when an image point has moved by more than 0.05 px. Raises UsageError before the
        first reading, and for a frame of another size than `live(size=…)` said.

        >>> import numpy as np
        >>> live = tc.load_camera("camera.yaml").live(size=(1640, 1232))
        >>> _ = live.update(0.0, 40.0)
        >>> live.correct(np.zeros((1232, 1640), np.uint8)).shape
        (1232, 1640)
        """
        import cv2

        sensor = self.thermal.model.sensor
        if frame.shape[:2] != (sensor.height, sensor.width):
            raise UsageError(
                f"the frame has {frame.shape[1]}×{frame.shape[0]} px, the camera "
                f"{sensor.width}×{sensor.height}: say live(size=({frame.shape[1]}, "
                f"{frame.shape[0]}))"
            )
        return cv2.remap(frame, *self.maps(to), cv2.INTER_LINEAR)

    def maps(self, to: float | None = None) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the maps x, y (H, W) px of `cv2.remap` that `correct` uses now.

        They are the same objects until an image point has moved by more than 0.05 px.
        """
        if self._now is None:
            raise UsageError("there is no reading yet: update(time, temperature) comes first")
        target = self.thermal.model.T0 if to is None else to
        if self._maps is None or self._maps.to != target:
            steady = self.thermal.at(target, extrapolate=True)
            self._maps = Maps(steady.sensor, steady.values, target)
        return self._maps.of(self._now.values)

    def _checked(
        self, time: Any, temperature: float | Mapping[str, float]
    ) -> tuple[float, tuple[float, ...]]:
        t = time
        if not isinstance(time, float | int):
            t = np.datetime64(time, "us").astype(np.int64) * 1e-6
        given = temperature
        if isinstance(given, float | int):
            given = {"temperature": given}
        names, row = tuple(given), tuple(float(v) for v in given.values())
        past = self._readings
        if past.times:
            if t <= past.times[-1]:
                raise UsageError(f"time {t} is not later than the last reading, {past.times[-1]}")
            if names != self._channels:
                raise UsageError(f"channels {names}: the first reading had {self._channels}")
            row = tuple(
                old if math.isnan(new) else new for old, new in zip(past.rows[-1], row, strict=True)
            )
        elif any(math.isnan(v) for v in row):
            raise UsageError("the first reading is NaN: begin with one that was measured")
        self._channels = names
        return float(t), row

    def _history(self) -> History:
        t = np.array(self._readings.times)
        columns = np.array(self._readings.rows).T
        readings = dict(zip(self._channels, columns, strict=True))
        begin, T0 = t[0], self.thermal.model.T0
        return History(t[-1:] - begin, t - begin, readings, self._channels[0], T0)

    def _derivatives(
        self, D: float, moved: Mapping[str, tuple[float, ...]], history: History | None
    ) -> Array:
        """∂ linear IOP / ∂ parameters (10, p), as `along` has them."""
        model = self.thermal.model
        J = np.zeros((10, len(self.thermal.parameters)))
        for i, name in enumerate(self.thermal.parameters):
            group, key = name.split(".", 1)
            if group == "interior":
                J[IOP_NAMES.index(key), i] = 1.0
            elif group == "rates":
                J[IOP_NAMES.index(key), i] = D - model.T0
            elif name in moved:
                high, low = moved[name]
                _, step = _moved_by(self._drives, name, 1.0)
                J[:, i] = model.rate_vector * (high - low) / (2.0 * step)
            elif history is not None:
                (up, step), (down, _) = (_moved_by(self._signals, name, s) for s in (1.0, -1.0))
                change = _influence(up, history) - _influence(down, history)
                J[:, i] = change / (2.0 * step)
        return J


def _asks_ahead(drives: Sequence[ModelEffect]) -> bool:
    """Whether a drive before another asks for the temperature of later: what it said changes."""
    for effect in drives[:-1]:
        delay = catalogue.get(effect.name).delay
        if delay and float(effect.values[delay]) < 0:
            return True
    return False


def _moves_only_pose(effect: ModelEffect) -> bool:
    """Whether an effect leaves the interior orientation alone."""
    return not set(catalogue.get(effect.name).linear) & set(IOP_NAMES)


def _moved_by(
    effects: Sequence[ModelEffect], parameter: str, sign: float
) -> tuple[list[ModelEffect], float]:
    """Effects with one parameter moved by a step, and the step."""
    group, key = parameter.split(".", 1)
    step, out = 0.0, []
    for effect in effects:
        if effect.name == group:
            value = float(effect.values[key])
            step = _STEP * max(abs(value), 1e-9)
            effect = replace(effect, values={**effect.values, key: value + sign * step})
        out.append(effect)
    return out, step


def _influence(effects: Sequence[ModelEffect], history: History) -> Array:
    """What signals add to the interior orientation (10,) at the history's only time."""
    total = np.zeros(10)
    for effect in effects:
        total += catalogue.get(effect.name).influence(history, effect.values, None).iop[0]
    return total
