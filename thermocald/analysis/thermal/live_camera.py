"""A thermal camera that follows its thermometer, reading by reading."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.camera.camera import Camera
from thermocald.analysis.camera.undistortion import Maps
from thermocald.analysis.thermal.steady import widened
from thermocald.arrays import seconds
from thermocald.errors import DataError, UsageError
from thermocald.physics.history import History

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.arrays import Array

LARGEST_GAP_IN_INTERVALS = 10.0  # as in a log
_REMEMBERED = 6  # readings that the present effects follow from, besides two of each channel


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
        outside = np.zeros(1)
        if thermal.validity is not None:  # first, so that an error leaves the state unchanged
            outside = thermal.validity.check(np.array(row[:1]), extrapolate=False)
        others = {name: np.array([T]) for name, T in zip(self._channels[1:], row[1:], strict=True)}
        further, drift = thermal._beyond(others, extrapolate=False)
        self._remember(t, row)
        times = np.array(self._times)
        readings = dict(zip(self._channels, np.array(self._rows).T, strict=True))
        drive = _push(self._drive, t, row[0])
        driven = {key: _push(moved, t, row[0]) for key, moved in self._moved.items()}
        begin, model = times[0], thermal.model
        history = History(times[-1:] - begin, times - begin, readings, self._channels[0], model.T0)
        linear = thermal._linear(history, drive)
        covariance = thermal._propagate(history, drive, linear, outside, driven=driven)
        values = model.carried(linear)[0]
        beyond = float(np.max(np.maximum(outside, further)))
        covariance = widened(covariance, drift)
        self._now = Camera(model.sensor, row[0], values, covariance[0], beyond, model.camera)
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
            if t - oldest[0] > LARGEST_GAP_IN_INTERVALS * usual:
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
        if not self.keeps_all and last >= _REMEMBERED + 2 * len(row):
            T = np.array(self._rows)
            extremes = {*T.argmax(axis=0).tolist(), *T.argmin(axis=0).tolist()}
            needed = sorted({0, *extremes, last - 2, last - 1, last})
            self._times = [self._times[i] for i in needed]
            self._rows = [self._rows[i] for i in needed]
