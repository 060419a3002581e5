"""Correcting what was measured before: image points and images as one steady camera had seen them.

A point that was measured at some time becomes the point that the camera would have measured at the
model's reference temperature (or another): through its ray, with the interior orientation that the
temperature log gives for that time. The error left over comes from the model's parameters, as far
as they do not cancel between both temperatures, and from the thermometer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.camera.undistortion import ideal_points
from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import partials, project, rays

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from thermocald.analysis.thermal.thermal_camera import Along, ThermalCamera
    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.store.logger.temperatures import TemperatureLog

_BLOCK = 100_000
_SAMPLE = 997  # points of an image that tell how much it is corrected


@dataclass(frozen=True, slots=True, eq=False)
class Corrected:
    """points (n, 2) px as they would have been; sds (n, 2) px of the correction; temperature (n,)
    °C; extrapolated (n,) K outside what the model was fitted on.
    """

    points: Array
    sds: Array
    temperature: Array
    extrapolated: Array


def correct_points(
    camera: ThermalCamera,
    log: TemperatureLog,
    times: Array,
    points: Array,
    to: float | None = None,
    temperature_sd: float = 0.0,
    extrapolate: bool = False,
) -> Corrected:
    """Image points (n, 2) px measured at times (n,) s → as at temperature `to` (default T₀).

    temperature_sd K: of a reading of the log. DataError for times outside the log.
    """
    target = camera.model.T0 if to is None else to
    require_inside(log, times)
    unique, place = np.unique(times, return_inverse=True)
    along = camera.along(
        log.times, dict(log.channels), unique, extrapolate, relative_to=target,
        temperature_sd=temperature_sd,
    )  # fmt: skip
    steady = camera.at(target, extrapolate=True).values
    sensor = camera.model.sensor
    corrected, sds = np.empty_like(points), np.empty_like(points)
    for first in range(0, len(points), _BLOCK):
        rows = slice(first, first + _BLOCK)
        state = along.values[place[rows]]
        r = rays(sensor, state, points[rows, None, :])
        direction = r / -r[..., 2:]
        corrected[rows] = project(sensor, steady, np.zeros(6), direction[:, 0])
        _, J, _ = partials(sensor, steady, np.zeros(6), direction[:, 0])
        J = J[:, :, :10]
        covariance = along.covariance[place[rows]]
        sds[rows] = np.sqrt(np.einsum("ncp,npq,ncq->nc", J, covariance, J, optimize=True))
    return Corrected(corrected, sds, along.temperatures[place], along.extrapolated[place])


def require_inside(log: TemperatureLog, times: Array) -> None:
    """Raise DataError for times (n,) s that a temperature log does not cover."""
    begin, end = float(log.times[0]), float(log.times[-1])
    step = float(np.median(np.diff(log.times))) if len(log.times) > 1 else 0.0
    outside = (times < begin - step) | (times > end + step)
    if outside.any():
        raise DataError(
            f"{int(outside.sum())} of {len(times)} rows were measured outside the temperature log "
            f"({begin:.0f} to {end:.0f} s), the first at {times[outside][0]:.0f} s"
        )


@dataclass(frozen=True, slots=True, eq=False)
class ImageCorrection:
    """For one image: maps x, y (H, W) of `cv2.remap` that turn it into one at the wanted
    temperature; temperature °C; largest and rms shift px; left_over: rms sd px of the correction,
    both over a grid of points; extrapolated K.
    """

    map_x: NDArray[np.float32]
    map_y: NDArray[np.float32]
    temperature: float
    rms_px: float
    largest_px: float
    left_over_px: float
    extrapolated: float


def image_corrections(
    camera: ThermalCamera,
    log: TemperatureLog,
    times: Array,
    to: float | None = None,
    temperature_sd: float = 0.0,
    extrapolate: bool = False,
) -> Iterator[ImageCorrection]:
    """One correction per time; arguments as those of `correct_points`, errors before the first."""
    require_inside(log, times)
    target = camera.model.T0 if to is None else to
    steady = camera.at(target, extrapolate=True).values
    along = camera.along(
        log.times, dict(log.channels), times, extrapolate, relative_to=target,
        temperature_sd=temperature_sd,
    )  # fmt: skip
    return _maps(camera.model.sensor, steady, along)


def _maps(sensor: Sensor, steady: Array, along: Along) -> Iterator[ImageCorrection]:
    v, u = np.mgrid[0 : sensor.height, 0 : sensor.width]
    grid = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    ideal = ideal_points(sensor, steady, grid)
    direction = np.concatenate([ideal, np.full((len(ideal), 1), -1.0)], axis=1)
    sample = np.linspace(0, len(grid) - 1, _SAMPLE).astype(int)
    _, J, _ = partials(sensor, steady, np.zeros(6), direction[sample])
    J = J[:, :, :10]
    shape = (sensor.height, sensor.width)
    for i, values in enumerate(along.values):
        seen = project(sensor, values, np.zeros(6), direction)
        shift = np.linalg.norm(seen[sample] - grid[sample], axis=1)
        variance = np.einsum("ncp,pq,ncq->nc", J, along.covariance[i], J, optimize=True)
        maps = seen.astype(np.float32)
        yield ImageCorrection(
            maps[:, 0].reshape(shape),
            maps[:, 1].reshape(shape),
            float(along.temperatures[i]),
            float(np.sqrt(np.mean(shift**2))),
            float(shift.max()),
            float(np.sqrt(np.mean(variance))),
            float(along.extrapolated[i]),
        )
