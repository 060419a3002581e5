"""What has changed between the first and the last epoch, and how image content moves.

Table 2 and Figures 3 to 6 of the reference (Elias et al. 2020): last minus first of every
parameter, the path of the principal point, and the displacement of image points when everything in
front of the camera stands still.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import project, rays

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor

__all__ = ["Deviation", "deviation", "image_displacement", "sd_of_sigma0"]


@dataclass(frozen=True, slots=True)
class Deviation:
    """Last minus first value with its standard deviation, the largest departure, the range.

    largest: signed, from the first value; range: largest minus smallest value; both tell a camera
    that comes back from one that never left, and of noise alone they are some sds as well.
    """

    first: float
    last: float
    change: float
    sd_change: float
    largest: float
    range: float
    sd_over_time: float

    @property
    def returned(self) -> bool:
        """Whether it went much farther than it ended: `change` alone would hide it."""
        return abs(self.largest) > max(1.5 * abs(self.change), 6 * self.sd_change)


def deviation(values: Array, sds: Array) -> Deviation | None:
    """Deviation of a column (n,) with its standard deviations (n,); NaN epochs are left out.

    The first and the last epoch are taken as independent, which they are when the standard
    deviations hold what one epoch adds to its series. None where fewer than two values are left.
    """
    have = np.flatnonzero(np.isfinite(values))
    if len(have) < 2:
        return None
    first, last = int(have[0]), int(have[-1])
    difference = values[have] - values[first]
    return Deviation(
        float(values[first]),
        float(values[last]),
        float(difference[-1]),
        float(np.hypot(sds[first], sds[last])),
        float(difference[np.argmax(np.abs(difference))]),
        float(np.ptp(difference)),
        float(np.std(values[have], ddof=1)),
    )


def sd_of_sigma0(sigma0: Array, redundancy: Array) -> Array:
    """Standard deviation of the standard deviation of unit weight: sigma0 / √(2 r)."""
    return np.asarray(sigma0 / np.sqrt(2 * np.maximum(redundancy, 1.0)))


def image_displacement(sensor: Sensor, first: Array, later: Array, points: Array) -> Array:
    """How image points (k, 2) px of a still scene move when the IOP change from first to later.

    first (10,), later (10,) or (n, 10); returns px (k, 2) or (n, k, 2), y down. Raises
    GeometryError where the first IOP have no ray for a point.
    """
    direction = rays(sensor, first, points)
    # The same rays seen again: a camera at the origin before points 1 m away along them.
    scene = direction / -direction[:, 2:] * 1000.0
    seen = project(sensor, later, np.zeros((*later.shape[:-1], 6)), scene)
    return np.asarray(seen - points)
