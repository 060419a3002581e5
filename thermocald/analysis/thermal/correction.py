"""Correcting what was measured before: image points and images as one steady camera had seen them.

A point that was measured at some time becomes the point that the camera would have measured at the
model's reference temperature (or another): through its ray, with the interior orientation that the
temperature log gives for that time. The error left over comes from the model's parameters, as far
as they do not cancel between both temperatures, and from the thermometer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from thermocald.analysis.camera.undistortion import Maps, ideal_points
from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import partials, project, rays
from thermocald.store.logger.series import iso

if TYPE_CHECKING:
    from thermocald.analysis.thermal.thermal_camera import Along, ThermalCamera
    from thermocald.arrays import Array
    from thermocald.store.logger.temperatures import TemperatureLog

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
    unique, place = np.unique(times, return_inverse=True)
    require_inside(log, times)
    steady, along = _course(camera, log, unique, to, temperature_sd, extrapolate)
    sensor = camera.model.sensor
    r = rays(sensor, along.values[place], points[:, None, :])
    direction = (r / -r[..., 2:])[:, 0]
    corrected = project(sensor, steady, np.zeros(6), direction)
    _, J, _ = partials(sensor, steady, np.zeros(6), direction)
    J = J[:, :, :10]
    sds = np.sqrt(np.einsum("ncp,npq,ncq->nc", J, along.covariance[place], J, optimize=True))
    return Corrected(corrected, sds, along.temperatures[place], along.extrapolated[place])


def require_inside(log: TemperatureLog, times: Array) -> None:
    """Raise DataError for times (n,) s that a temperature log does not cover."""
    begin, end = float(log.times[0]), float(log.times[-1])
    step = float(np.median(np.diff(log.times))) if len(log.times) > 1 else 0.0
    outside = (times < begin - step) | (times > end + step)
    if outside.any():
        raise DataError(
            f"{int(outside.sum())} of {len(times)} times are outside the temperature log "
            f"({iso(begin)} to {iso(end)}), the first is {iso(times[outside][0])}"
        )


@dataclass(frozen=True, slots=True, eq=False)
class ImageCorrection:
    """For one image: maps, and values (10,) of its camera, that turn it into one at the wanted
    temperature; temperature °C; largest and rms shift px; left_over: rms sd px of the correction,
    both over a grid of points; extrapolated K.
    """

    JSON: ClassVar = {
        "maps": "", "values": "", "rms_px": "rms_correction_px",
        "largest_px": "largest_correction_px", "left_over_px": "rms_left_over_px",
        "extrapolated": "extrapolated_K",
    }  # fmt: skip

    maps: Maps
    values: Array
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
) -> list[ImageCorrection]:
    """One correction per time; arguments and errors as those of `correct_points`."""
    require_inside(log, times)
    steady, along = _course(camera, log, times, to, temperature_sd, extrapolate)
    sensor = camera.model.sensor
    maps = Maps(sensor, steady, camera.model.T0 if to is None else to)
    pixels = np.linspace(0, sensor.width * sensor.height - 1, _SAMPLE).astype(int)
    points = np.stack([pixels % sensor.width, pixels // sensor.width], axis=1).astype(float)
    ideal = ideal_points(sensor, steady, points)
    direction = np.concatenate([ideal, np.full((len(ideal), 1), -1.0)], axis=1)
    _, J, _ = partials(sensor, steady, np.zeros(6), direction)
    J = J[:, :, :10]
    found = []
    for i, values in enumerate(along.values):
        seen = project(sensor, values, np.zeros(6), direction)
        shift = np.linalg.norm(seen - points, axis=1)
        variance = np.einsum("ncp,pq,ncq->nc", J, along.covariance[i], J, optimize=True)
        found.append(
            ImageCorrection(
                maps,
                values,
                float(along.temperatures[i]),
                float(np.sqrt(np.mean(shift**2))),
                float(shift.max()),
                float(np.sqrt(np.mean(variance))),
                float(along.extrapolated[i]),
            )
        )
    return found


def _course(
    camera: ThermalCamera, log: TemperatureLog, times: Array, to: float | None,
    temperature_sd: float, extrapolate: bool,
) -> tuple[Array, Along]:  # fmt: skip
    """Return the steady camera (10,) at a temperature, and the camera at some times against it."""
    target = camera.model.T0 if to is None else to
    along = camera.along(
        log.times, log.channels, times, extrapolate, relative_to=target,
        temperature_sd=temperature_sd,
    )  # fmt: skip
    return camera.at(target, extrapolate=True).values, along
