"""A camera that is predicted from its thermometers' readings, with what they do not tell.

The temperatures before the first reading and within a gap are unknown, but effects with a memory
depend on them. A second camera is therefore predicted that was warmer during the unknown time, by
one standard deviation of the change of temperature in such a time. The difference between the two
cameras is one standard deviation of what is unknown. It fades as the memories of the effects do.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.camera.undistortion import directions, image_grid
from thermocald.analysis.thermal.modelled_camera import latest_noise
from thermocald.photogrammetry.camera.camera_model import IOP, partials
from thermocald.physics.history import History
from thermocald.store.recording.reader import TemperatureLog

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.analysis.camera.camera import Camera
    from thermocald.analysis.thermal.thermal_camera import LiveCamera, ThermalCamera
    from thermocald.arrays import Array


_LONG_S = 30 * 86400.0  # after this long at one temperature everything has settled
_CORRELATED_S = 6 * 3600.0  # temperatures further apart in time are hardly correlated
_USUAL_RANGE_K = 20.0  # for a model that does not state its range of temperature
_CHANGED_S = 60.0  # in which the second camera reaches the first reading
LONGEST_GAP_S = 120.0  # longest gap that a straight line bridges
_JUMP_SIGMAS = 4.0  # of a change between two readings, beyond which it is no temperature's
_BACK_S = 10.0  # a reading that is early by less is ignored; by more, the clock was set back
_REMEMBERED = 4000  # readings
_NOISY = 200  # of the last readings, through which noise is propagated


@dataclass(frozen=True, eq=False)
class PredictedCamera:
    """A predicted camera, whose covariance includes model, thermometer and unknown past.

    age_s: of the last reading; noise (10, 10): the part of the covariance from readings: their
    noise, age, jump, and excess over the limits of the fit; unknown (10,): one standard deviation
    due to the unknown past, and unknown_px, its largest effect in the image; jump: by how much, K,
    the reading differs from one before in a way that no temperature does.
    """

    camera: Camera
    age_s: float
    noise: Array
    unknown: Array
    unknown_px: float
    jump: float


class Predictor:
    """A predictor that follows the readings of one camera's thermometers."""

    def __init__(self, thermal: ThermalCamera) -> None:
        self.thermal = thermal
        # `at` checks the range of temperature itself, for each epoch and without a warning
        anywhere = dict.fromkeys(thermal.model.validity, (-math.inf, math.inf))
        self._free = replace(thermal, model=replace(thermal.model, validity=anywhere))
        self._channels = thermal.channels
        model = thermal.model  # rays of a grid, which temperature hardly changes
        self._across = directions(model.sensor, model.interior.as_array(), image_grid(model.sensor))
        self._pair: tuple[LiveCamera, LiveCamera] | None = None
        self._now: tuple[Camera, Camera] | None = None
        self._recent: deque[tuple[float, dict[str, float]]] = deque(maxlen=_REMEMBERED)
        self._since_begin = 0
        self._jump = 0.0
        self._trusted: tuple[float, float] | None = None  # the last reading without a jump

    def take(self, time: float, readings: Mapping[str, float]) -> None:
        """Take readings {channel: °C} at a time, s UTC; failed ones are NaN.

        The first is the reference, unless one has the name of the model's own.
        """
        row = self._row(readings)
        if row is None or not math.isfinite(time):
            return
        if self._recent and time <= (last := self._recent[-1][0]):
            if time > last - _BACK_S:
                return
            # the clock was set back: the age of earlier readings is unknown
            self._pair = self._trusted = None
            self._recent.clear()
        self._since_begin += 1
        if self._pair is not None and self._pair[0].keeps_all and self._since_begin > _REMEMBERED:
            # such a model needs all readings: begin again with the last of them
            kept = list(self._recent)[_REMEMBERED // 2 :]
            self._begin(*kept[0])
            for then, reading in kept:
                for one in self._pair:
                    one.update(then, reading)
        if self._pair is None:
            self._begin(time, row)
        elif (gap := time - self._recent[-1][0]) > LONGEST_GAP_S:
            # the second camera is warmer than the straight line across the gap; both ends are
            # known: the deviation is largest in the middle
            last, before = self._recent[-1]
            self._pair[1].update(last + 0.1 * gap, self._warmer(before, 0.5 * gap))
            self._pair[1].update(time - 0.1 * gap, self._warmer(row, 0.5 * gap))
        self._jump = self._jump_to(time, row)
        self._recent.append((time, row))
        assert self._pair is not None
        self._now = (self._pair[0].update(time, row), self._pair[1].update(time, row))

    def at(self, time: float) -> PredictedCamera | None:
        """Return the camera at a time, s UTC; None before the first reading."""
        if self._now is None:
            return None
        camera, other = self._now
        read = self._recent[-1][0]
        age, jump = max(time - read, 0.0), self._jump
        if self._recent[0][0] < time < read - _BACK_S:  # an epoch that was processed late
            times, readings = self._log(0, None)
            age, jump, known = 0.0, 0.0, TemperatureLog(times, {"": next(iter(readings.values()))})
            if not known.known_at(np.array([time]))[0]:
                nearest = float(times[np.abs(times - time).argmin()])
                age, time = abs(time - nearest), nearest
            camera = self._free.along(times, readings, [time])[0]
        T, unknown = camera.temperature, other.values - self._now[0].values
        rates = self.thermal.model.rate_vector
        aged = self._change(age) if age > LONGEST_GAP_S else 0.0
        others = {n: np.array([self._recent[-1][1][n]]) for n in self._channels}
        (beyond,), (drift,) = self.thermal._beyond(np.array([T]), others, None)
        noise = self._noise(min(time, read)) + math.hypot(aged, jump) ** 2 * np.outer(rates, rates)
        noise += np.diag(drift)
        covariance = camera.covariance + np.outer(unknown, unknown) + noise
        now = replace(camera, covariance=covariance, extrapolated=float(beyond))
        by = partials(camera.sensor, camera.values, np.zeros(6), self._across)[1][..., IOP]
        largest = float(np.linalg.norm(by @ unknown, axis=1).max())
        return PredictedCamera(now, age, noise, unknown, largest, jump)

    def _noise(self, time: float) -> Array:
        """Return the covariance (10, 10) of the camera at a time by the noise of the readings."""
        last = sum(t <= time for t, _ in self._recent)
        times, readings = self._log(max(last - _NOISY, 0), last + 1)
        reference, model = next(iter(readings)), self.thermal.model
        history = History(
            np.array([time - times[0]]), times - times[0], readings, reference, model.T0
        )
        return latest_noise(model, history, self.thermal.reading_sd)

    def _log(self, first: int, end: int | None) -> tuple[Array, dict[str, Array]]:
        """Return the times (n,) s and the readings {channel: (n,) °C} of some of the last."""
        rows = list(self._recent)[first:end]
        readings = {n: np.array([row[n] for _, row in rows]) for n in rows[0][1]}
        return np.array([t for t, _ in rows]), readings

    def settled(self) -> Camera:
        """Return the steady camera at T₀, with the covariance of an unknown temperature."""
        T = self.thermal.model.T0
        return self._free.at(T, self._change(math.inf), dict.fromkeys(self._channels, T) or None)

    def _row(self, readings: Mapping[str, float]) -> dict[str, float] | None:
        """Return the reference and the model's channels; None if one has not been read yet.

        The reference is the model's own thermometer if there is one of its name, else the first.
        """
        first = next(iter(readings), "")
        own = next(iter(self.thermal.model.validity), first)
        row = {n: float(readings.get(n, math.nan)) for n in (own, *self._channels)}
        if own not in readings:
            row[own] = float(readings.get(first, math.nan))
        missing = [n for n, v in row.items() if not math.isfinite(v)]
        if own in missing or (missing and not self._recent):
            return None
        return row | {n: self._recent[-1][1][n] for n in missing}

    def _jump_to(self, time: float, row: Mapping[str, float]) -> float:
        """Return by how much, K, a reading differs from the last that can be true; 0 if it can be.

        A jump that stays can be true once the temperature may have changed as much since then.
        """
        T = next(iter(row.values()))
        before, last = self._trusted or (time, T)
        off, since = abs(T - last), time - before
        usual = math.hypot(self._change(since), self.thermal.reading_sd)
        if off > _JUMP_SIGMAS * usual and since < _CORRELATED_S:
            return off
        self._trusted = time, T
        return 0.0

    def _begin(self, time: float, row: dict[str, float]) -> None:
        self._pair = (self._free.live(), self._free.live())
        self._since_begin = 0
        warmer = self._warmer(row, math.inf)
        self._pair[1].update(time - _LONG_S, warmer)
        self._pair[1].update(time - _CHANGED_S, warmer)

    def _warmer(self, row: Mapping[str, float], seconds: float) -> dict[str, float]:
        return {name: value + self._change(seconds) for name, value in row.items()}

    def _change(self, seconds: float) -> float:
        """Return the standard deviation of a temperature's change in a time, K."""
        span = self.thermal.validity.high - self.thermal.validity.low
        spread = (span if math.isfinite(span) else _USUAL_RANGE_K) / math.sqrt(12.0)
        return spread * math.sqrt(-math.expm1(-2.0 * seconds / _CORRELATED_S))
