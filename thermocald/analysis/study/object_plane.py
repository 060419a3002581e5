"""Image points on an object plane parallel to the sensor: the grid, and first-order errors.

The plane lies at a distance in front of the projection centre; a point is where the ray of an image
point meets it, (X, Y) mm in camera axes. The interior orientation shifts it.

Source: Elias et al. 2020, section 3.2 and 4.4; distances of a bivariate normal variable: Hoyt
(1947), Proc. IRE 35, 652-657.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import partials, rays

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor

__all__ = [
    "DistanceLaw",
    "on_plane",
    "plane_jacobian",
    "propagate",
]

_ANGLES = 720


@dataclass(frozen=True, eq=False)
class DistanceLaw:
    """Law of the distances |d| of a centred bivariate normal error d.

    axes (k, 2): standard deviations along the two axes of each point's ellipse, mm.
    """

    axes: Array

    def cumulative(self, distance: ArrayLike) -> Array:
        """P(|d| < distance) of each point (k, m), for distances (m,) mm."""
        r2 = np.square(np.atleast_1d(np.asarray(distance, dtype=float)))
        theta = (np.arange(_ANGLES) + 0.5) * (np.pi / _ANGLES)
        spread = (self.axes[:, :1] * np.cos(theta)) ** 2 + (self.axes[:, 1:] * np.sin(theta)) ** 2
        with np.errstate(divide="ignore", over="ignore"):
            inside = -np.expm1(-r2[None, :, None] / (2 * spread[:, None, :]))
        return np.asarray(np.mean(inside, axis=-1))

    def mean(self) -> Array:
        """E|d| of each point (k,) mm."""
        from scipy.special import ellipe

        large = np.max(self.axes, axis=1)
        small = np.min(self.axes, axis=1)
        ratio = np.divide(small, large, out=np.zeros_like(small), where=large > 0)
        return np.asarray(np.sqrt(2 / np.pi) * large * ellipe(1 - ratio**2))

    def expected_maximum(self, draws: int) -> Array:
        """Expected largest |d| among `draws` independent errors, of each point (k,) mm."""
        large = np.max(self.axes, axis=1)
        steps = np.linspace(0.0, 8.0, 1601)
        result = np.zeros(len(large))
        for k in np.flatnonzero(large > 0):
            law = DistanceLaw(self.axes[k : k + 1])
            missing = 1 - law.cumulative(steps * large[k])[0] ** draws
            result[k] = large[k] * float(np.sum((missing[1:] + missing[:-1]) * np.diff(steps)) / 2)
        return result


def on_plane(sensor: Sensor, iop: ArrayLike, points: Array, distance_mm: float) -> Array:
    """Image points (k, 2) px → points (k, 2) mm on the plane; GeometryError where no ray exists."""
    direction = rays(sensor, iop, points)
    return np.asarray(-distance_mm * direction[:, :2] / direction[:, 2:])


def plane_jacobian(sensor: Sensor, iop: ArrayLike, points: Array, distance_mm: float) -> Array:
    """∂(X, Y)/∂iop (k, 2, 10) of image points (k, 2) px: mm per unit of each IOP."""
    plane = on_plane(sensor, iop, points, distance_mm)
    object_points = np.column_stack([plane, np.full(len(plane), -distance_mm)])
    _, by_parameter, by_object = partials(sensor, iop, np.zeros(6), object_points)
    solved = np.linalg.solve(by_object[:, :, :2], by_parameter[:, :, :10])
    return np.asarray(-solved, dtype=np.float64)


def propagate(jacobian: Array, covariance: Array) -> Array:
    """Covariances (k, 2, 2) mm² of the plane points from the covariance (10, 10) of the IOP."""
    return np.asarray(jacobian @ covariance @ np.swapaxes(jacobian, 1, 2))
