"""Warm-up advice: from when on a device is steady enough for a wanted error in object space.

The camera is steady from the time after which no point of the image, seen on a plane at the
working distance, lies further from where the end of the history puts it than the wanted error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.camera.image_grid import image_grid
from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import rays

if TYPE_CHECKING:
    from thermocald.analysis.thermal.thermal_camera import Along
    from thermocald.arrays import Array

__all__ = ["WarmUp", "warm_up"]


@dataclass(frozen=True, slots=True, eq=False)
class WarmUp:
    """steady_from: s since the start, None where the history ends before the camera is steady;
    times (E,) s; error (E,) mm: the worst point's distance from where it ends.
    """

    steady_from: float | None
    times: Array
    error: Array


def warm_up(along: Along, distance_mm: float, wanted_mm: float) -> WarmUp:
    """When the camera is steady enough. DataError for a single time.

    A history that still moves by more than a tenth of the wanted error over its last tenth has not
    shown its end: then there is no answer.
    """
    if len(along) < 10:
        raise DataError("a warm-up needs a history of at least 10 times")
    points = image_grid(along.sensor)
    r = rays(along.sensor, along.values, np.broadcast_to(points, (len(along), *points.shape)))
    places = distance_mm * r[..., :2] / -r[..., 2:]
    error = np.linalg.norm(places - places[-1], axis=2).max(axis=1)
    times = along.times - along.times[0]
    settled = error[-len(error) // 10 :].max() <= max(0.1 * wanted_mm, 1e-9)
    above = np.flatnonzero(error > wanted_mm)
    first = int(above[-1]) + 1 if len(above) else 0
    steady = float(times[first]) if settled and first < len(times) else None
    return WarmUp(steady, times, error)
