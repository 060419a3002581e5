"""The camera of a thermal model while readings arrive: the camera now, and its unknown past.

`LiveCamera` follows the readings. The temperatures before the first reading and within a gap are
unknown, but effects with a memory depend on them: for `Predictor` a second camera was warmer during
the unknown time, by one standard deviation of the change of temperature in such a time. The
difference between the two cameras is one standard deviation of what is unknown. It fades as the
memories of the effects do.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.camera.camera import Camera
from thermocald.analysis.camera.undistortion import Maps, image_grid
from thermocald.analysis.thermal.modelled_camera import widened
from thermocald.arrays import seconds
from thermocald.errors import DataError, UsageError
from thermocald.photogrammetry.camera.camera_model import IOP, partials, rays
from thermocald.physics.history import History

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.arrays import Array

_LARGEST_GAP = 10.0  # in which a live camera uses the last reading, as a log does
_NEEDED = 6  # readings that the present effects follow from, besides two of each channel
_LONG_S = 30 * 86400.0  # after this long at one temperature everything has settled
_CORRELATED_S = 6 * 3600.0  # temperatures further apart in time are hardly correlated
_USUAL_RANGE_K = 20.0  # for a model that does not state its range of temperature
_CHANGED_S = 60.0  # in which the second camera reaches the first reading
GAP_S = 120.0  # longest gap that a straight line bridges
_BACK_S = 10.0  # a reading that is early by less is ignored; by more, the clock was set back
_REMEMBERED = 4000  # readings


def _push(followers: list[Any], time: float, value: float) -> Array:
    """Pass a reading °C through the followers; return the temperature that drives now, (1,) °C."""
    for one in followers:
        value = one(time, value)
    return np.array([value])


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
        self._times: list[float] = []
        self._rows: list[tuple[float, ...]] = []
        self._channels: tuple[str, ...] = ()
        self._seen: tuple[float, ...] = ()  # when each channel was last measured, s
        self._updates = 0
        self._now: Camera | None = None
        self._maps: Maps | None = None
        drives = {name for name, _ in model.drives}
        self._moved = {
            (name, sign): thermal._moved(name, sign).followers()
            for name in thermal.parameters
            for sign in (1.0, -1.0)
            if name.split(".")[0] in drives
        }

    def update(self, time: Any, temperature: float | Mapping[str, float]) -> Camera:
        """Take a reading and return the camera now, equal to `along` over the history so far.

        time: s or datetime64, later than the last; temperature: °C, or {channel: °C} with the
        reference first; for NaN (a failed reading) the channel's last reading is used, for at most
        ten intervals between readings, then DataError is raised. Raises UsageError if the time is
        not later, and far outside the temperatures of the fit.

        >>> live = tc.load_camera("camera.yaml").live()
        >>> live.update(0.0, 25.0).sd["c"] > 0
        True
        """
        thermal, (t, row) = self.thermal, self._checked(time, temperature)
        if self.keeps_all:  # the state changes only if `along` raises nothing
            rows = np.array([*self._rows, row]).T
            history_of = dict(zip(self._channels, rows, strict=True))
            self._now = thermal.along([*self._times, t], history_of, [t])[0]
            self._remember(t, row)
            return self._now
        others = {name: np.array([T]) for name, T in zip(self._channels[1:], row[1:], strict=True)}
        (beyond,), drift = thermal._beyond(  # an error leaves the state unchanged
            np.array(row[:1]), others, thermal.model.rate_vector, extrapolate=False
        )
        self._remember(t, row)
        times = np.array(self._times)
        readings = dict(zip(self._channels, np.array(self._rows).T, strict=True))
        drive = _push(self._drive, t, row[0])
        driven = {key: _push(moved, t, row[0]) for key, moved in self._moved.items()}
        begin, model = times[0], thermal.model
        history = History(times[-1:] - begin, times - begin, readings, self._channels[0], model.T0)
        values, covariance = thermal._orientation(history, drive, driven=driven)
        C = widened(covariance, drift)[0]
        self._now = Camera(model.sensor, row[0], values[0], C, float(beyond), model.camera)
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
        if not isinstance(frame, np.ndarray) or frame.ndim < 2:
            raise UsageError(f"the frame is a {type(frame).__name__}: give an array (H, W)")
        if frame.shape[:2] != (sensor.height, sensor.width):
            raise UsageError(
                f"the frame has {frame.shape[1]}×{frame.shape[0]} px, the camera "
                f"{sensor.width}×{sensor.height}; use live(size=({frame.shape[1]}, "
                f"{frame.shape[0]}))"
            )
        maps = self.maps(to)
        try:
            return cv2.remap(frame, *maps, cv2.INTER_LINEAR)
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
            steady = self.thermal.at(target, extrapolate=True)
            self._maps = Maps(steady.sensor, steady.values, target)
        return self._maps.of(self._now.values)

    def _checked(
        self, time: Any, temperature: float | Mapping[str, float]
    ) -> tuple[float, tuple[float, ...]]:
        """Return the time s and the readings °C; a failed one is the last of its channel."""
        t = float(seconds(time))
        given = temperature if isinstance(temperature, Mapping) else {"temperature": temperature}
        try:
            names, row = tuple(given), tuple(float(v) for v in given.values())
        except (TypeError, ValueError):
            raise UsageError(f"{temperature!r}: give °C, NaN for a failed reading") from None
        if not row:
            raise UsageError("there is no reading: give a temperature, or {channel: °C}")
        if self._times:
            if t <= self._times[-1]:
                raise UsageError(f"time {t} is not later than the last reading, {self._times[-1]}")
            if names != self._channels:
                raise UsageError(f"channels {names}: the first reading had {self._channels}")
            last = self._rows[-1]
            row = tuple(b if math.isnan(n) else n for b, n in zip(last, row, strict=True))
        elif any(math.isnan(v) for v in row):
            raise UsageError("the first reading is NaN: begin with one that was measured")
        measured = [not math.isnan(float(v)) for v in given.values()]
        seen = tuple(t if m else s for m, s in zip(measured, self._seen or row, strict=True))
        if self._updates > 1:
            usual = (self._times[-1] - self._times[0]) / (self._updates - 1)
            oldest = min(zip(seen, names, strict=True))
            if t - oldest[0] > _LARGEST_GAP * usual:
                raise DataError(
                    f"{oldest[1]} gave no reading for {t - oldest[0]:.0f} s, over ten of its "
                    f"intervals of {usual:.0f} s: the camera's temperature is not known"
                )
        self._channels, self._seen = names, seen
        return t, row

    def _remember(self, time: float, row: tuple[float, ...]) -> None:
        """Store a reading; unless all are needed, drop all but first, extremes and last three."""
        self._updates += 1
        self._times.append(time)
        self._rows.append(row)
        last = len(self._times) - 1
        if not self.keeps_all and last >= _NEEDED + 2 * len(row):
            T = np.array(self._rows)
            extremes = {*T.argmax(axis=0).tolist(), *T.argmin(axis=0).tolist()}
            needed = sorted({0, *extremes, last - 2, last - 1, last})
            self._times = [self._times[i] for i in needed]
            self._rows = [self._rows[i] for i in needed]


@dataclass(frozen=True, eq=False)
class PredictedCamera:
    """A predicted camera, whose covariance includes model, thermometer and unknown past.

    age_s: of the last reading; temperature_sd: K, of its temperature, including a reading's age and
    the excess over the limits of the fit; unknown (10,): one standard deviation due to the unknown
    past, and unknown_px, its largest effect in the image; far: whether the temperature is so far
    outside those of the fit that nothing should be predicted.
    """

    camera: Camera
    age_s: float
    temperature_sd: float
    unknown: Array
    unknown_px: float
    far: bool


class Predictor:
    """A predictor that follows the readings of one camera's thermometers."""

    def __init__(self, thermal: ThermalCamera) -> None:
        self.thermal = thermal
        # `at` checks the range of temperature itself, for each epoch and without a warning
        self._free = replace(thermal, model=replace(thermal.model, validity={}))
        self._channels = thermal.channels
        self._pair: tuple[LiveCamera, LiveCamera] | None = None
        self._now: tuple[Camera, Camera] | None = None
        self._recent: deque[tuple[float, dict[str, float]]] = deque(maxlen=_REMEMBERED)
        self._since_begin = 0
        self._across: Array | None = None

    def take(self, time: float, readings: Mapping[str, float]) -> None:
        """Take readings {channel: °C}, the reference first; failed ones are NaN or missing.

        time: s UTC.
        """
        row = self._row(readings)
        if row is None or not math.isfinite(time):
            return
        if self._recent and time <= (last := self._recent[-1][0]):
            if time > last - _BACK_S:
                return
            self._pair = None  # the clock was set back: the age of earlier readings is unknown
            self._recent.clear()
        self._since_begin += 1
        if self._pair is not None and self._pair[0].keeps_all and self._since_begin > _REMEMBERED:
            self._begin_again()
        if self._pair is None:
            self._begin(time, row)
        elif time - self._recent[-1][0] > GAP_S:
            self._cross_gap(time, row)
        self._recent.append((time, row))
        assert self._pair is not None
        self._now = (self._pair[0].update(time, row), self._pair[1].update(time, row))

    def at(self, time: float) -> PredictedCamera | None:
        """Return the camera at a time, s UTC; None before the first reading."""
        if self._now is None:
            return None
        camera, other = self._now
        read = self._recent[-1][0]
        age = max(time - read, 0.0)
        if self._recent[0][0] < time < read - _BACK_S:  # an epoch that was processed late
            times = [t for t, _ in self._recent]
            rows = {n: np.array([row[n] for _, row in self._recent]) for n in self._recent[0][1]}
            camera, age = self._free.along(times, rows, [time])[0], 0.0
        T, unknown = camera.temperature, other.values - self._now[0].values
        rates = self.thermal.model.rate_vector
        covariance = camera.covariance + np.outer(unknown, unknown)
        drifted = math.hypot(self.thermal.reading_sd, self._change(age) if age > GAP_S else 0.0)
        covariance = covariance + drifted**2 * np.outer(rates, rates)
        beyond, far = 0.0, False
        if (validity := self.thermal.validity) is not None:
            beyond, far = validity.beyond(T), validity.is_far(T)
            covariance = covariance + np.diag((rates * beyond) ** 2)
        model = self.thermal.model
        now = Camera(model.sensor, T, camera.values, covariance, beyond, model.camera)
        shift = self._largest_px(camera.values, unknown)
        spread = math.hypot(drifted, beyond)
        return PredictedCamera(now, age, spread, unknown, shift, far)

    def settled(self) -> Camera:
        """Return the steady camera at T₀, with the covariance of an unknown temperature."""
        T = self.thermal.model.T0
        return self._free.at(T, self._change(math.inf), dict.fromkeys(self._channels, T) or None)

    def _row(self, readings: Mapping[str, float]) -> dict[str, float] | None:
        """Return the reference and the model's channels; None if one has not been read yet."""
        reference = next(iter(readings), None)
        if reference is None:
            return None
        row = {n: float(readings.get(n, math.nan)) for n in (reference, *self._channels)}
        if math.isnan(row[reference]):
            return None
        missing = [n for n, v in row.items() if math.isnan(v)]
        if missing and not self._recent:
            return None
        return row | {n: self._recent[-1][1][n] for n in missing}

    def _begin(self, time: float, row: dict[str, float]) -> None:
        self._pair = (self._free.live(), self._free.live())
        self._since_begin = 0
        warmer = self._warmer(row, math.inf)
        self._pair[1].update(time - _LONG_S, warmer)
        self._pair[1].update(time - _CHANGED_S, warmer)

    def _begin_again(self) -> None:
        """Start again from the last readings, for a model that would need all readings."""
        kept = list(self._recent)[_REMEMBERED // 2 :]
        self._begin(*kept[0])
        assert self._pair is not None
        for time, row in kept:
            for one in self._pair:
                one.update(time, row)

    def _cross_gap(self, time: float, row: dict[str, float]) -> None:
        """Update the second camera through a gap, warmer than the straight line across it."""
        assert self._pair is not None
        last, before = self._recent[-1]
        gap = time - last
        # both ends are known: the deviation is largest in the middle
        self._pair[1].update(last + 0.1 * gap, self._warmer(before, 0.5 * gap))
        self._pair[1].update(time - 0.1 * gap, self._warmer(row, 0.5 * gap))

    def _warmer(self, row: Mapping[str, float], seconds: float) -> dict[str, float]:
        return {name: value + self._change(seconds) for name, value in row.items()}

    def _change(self, seconds: float) -> float:
        """Return the standard deviation of a temperature's change in a time, K."""
        v = self.thermal.validity
        spread = (_USUAL_RANGE_K if v is None else v.high - v.low) / math.sqrt(12.0)
        return spread * math.sqrt(-math.expm1(-2.0 * seconds / _CORRELATED_S))

    def _largest_px(self, values: Array, shift: Array) -> float:
        """Return the largest shift of an image point, px, for a change of interior orientation."""
        if not shift.any():
            return 0.0
        if self._across is None:  # rays of a grid, which temperature hardly changes
            sensor = self.thermal.model.sensor
            across = rays(sensor, values, image_grid(sensor))
            self._across = across / -across[:, 2:]
        J = partials(self.thermal.model.sensor, values, np.zeros(6), self._across)[1][..., IOP]
        return float(np.linalg.norm(J @ shift, axis=1).max())
