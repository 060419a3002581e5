"""The camera that a thermal model predicts from a thermometer's readings, as they arrive.

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

from thermocald.analysis.camera.undistortion import image_grid

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.analysis.camera.camera import Camera
    from thermocald.analysis.thermal.thermal_camera import LiveCamera, ThermalCamera
    from thermocald.arrays import Array

_LONG_S = 30 * 86400.0  # after this long at one temperature everything has settled
_CORRELATED_S = 6 * 3600.0  # temperatures further apart in time are hardly correlated
_USUAL_RANGE_K = 20.0  # for a model that does not state its range of temperature
_CHANGED_S = 60.0  # in which the second camera reaches the first reading
GAP_S = 120.0  # longest gap that a straight line bridges
_BACK_S = 10.0  # a reading that is early by less is ignored; by more, the clock was set back
_REMEMBERED = 4000  # readings


@dataclass(frozen=True, eq=False)
class PredictedCamera:
    """A predicted camera, whose covariance includes model, thermometer and unknown past.

    age_s: of the last reading; temperature_sd: K, of its temperature, including a reading's age and
    the excess over the limits of the fit; unknown (10,): one standard deviation due to the unknown
    past, and unknown_px, its largest effect in the image.
    """

    camera: Camera
    age_s: float
    temperature_sd: float
    unknown: Array
    unknown_px: float


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
        drifted = math.hypot(self.thermal.reading_sd, self._change(age) if age > GAP_S else 0.0)
        beyond = float(self.thermal.validity.beyond(T))
        covariance = camera.covariance + np.outer(unknown, unknown)
        covariance += drifted**2 * np.outer(rates, rates) + np.diag((rates * beyond) ** 2)
        now = replace(camera, covariance=covariance, extrapolated=beyond)
        alone = replace(camera, covariance=np.outer(unknown, unknown))
        variance = alone.point_covariance(image_grid(camera.sensor)).trace(axis1=1, axis2=2)
        largest = math.sqrt(variance.max())
        return PredictedCamera(now, age, math.hypot(drifted, beyond), unknown, largest)

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
        span = self.thermal.validity.high - self.thermal.validity.low
        spread = (span if math.isfinite(span) else _USUAL_RANGE_K) / math.sqrt(12.0)
        return spread * math.sqrt(-math.expm1(-2.0 * seconds / _CORRELATED_S))
