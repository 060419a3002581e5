"""A camera at one time: interior orientation with covariance, and what can be done with it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.camera.image_grid import image_grid
from thermocald.analysis.camera.undistortion import undistorted_points
from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    CameraModel,
    InteriorOrientation,
    partials,
    project,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import ExteriorOrientation, Sensor

__all__ = ["CameraState"]


@dataclass(frozen=True, eq=False)
class CameraState:
    """The camera at one time.

    temperature °C; values (10,), covariance (10, 10) in the order of IOP_NAMES; extrapolated: by
    how many kelvin the temperature lies outside what the model was fitted on, 0 inside.
    """

    sensor: Sensor
    temperature: float
    values: Array
    covariance: Array
    extrapolated: float = 0.0

    @property
    def interior(self) -> InteriorOrientation:
        """The interior orientation."""
        return InteriorOrientation.from_array(self.values)

    @property
    def model(self) -> CameraModel:
        """Sensor and interior orientation together."""
        return CameraModel(self.sensor, self.interior)

    @property
    def sd(self) -> dict[str, float]:
        """Standard deviations by name, 0 where a parameter was held."""
        return dict(zip(IOP_NAMES, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def project(self, exterior: ExteriorOrientation, points: ArrayLike) -> Array:
        """Object points (n, 3) mm → image points (n, 2) px."""
        return self.model.project(exterior, points)

    def rays(self, image_points: ArrayLike) -> Array:
        """Image points (n, 2) px → unit directions (n, 3) in the camera frame."""
        return self.model.rays(image_points)

    def undistort(self, image_points: ArrayLike, to: InteriorOrientation | None = None) -> Array:
        """Image points (n, 2) px as a camera without distortion would have seen them.

        to: principal distance and point of that camera; by default this one's distance, and the
        image centre.
        """
        target = to or InteriorOrientation(self.interior.c)
        return undistorted_points(self.sensor, self.values, image_points, target)

    def as_seen_by(self, image_points: ArrayLike, other: InteriorOrientation) -> Array:
        """Image points (n, 2) px as this camera would have seen them with another IOP."""
        r = self.rays(image_points)
        points = r / -r[..., 2:]
        return project(self.sensor, other.as_array(), np.zeros(6), points)

    def point_covariance(self, image_points: ArrayLike) -> Array:
        """Covariance (n, 2, 2) px² of where a fixed direction is seen, from this IOP's."""
        r = self.rays(image_points)
        _, J, _ = partials(self.sensor, self.values, np.zeros(6), r / -r[..., 2:])
        J = J[..., :10]
        result: Array = np.einsum("ncp,pq,ndq->ncd", J, self.covariance, J)
        return result

    def object_error(self, distance_mm: float, image_points: ArrayLike | None = None) -> Array:
        """Standard deviation (n,) mm, in place, on a plane at a distance, that this IOP's makes.

        image_points (n, 2) px: by default corners, edge middles and centre, row by row.
        """
        points = image_grid(self.sensor) if image_points is None else image_points
        covariance = self.point_covariance(points) * self.sensor.pixel_pitch**2
        variance = np.trace(covariance, axis1=1, axis2=2)
        result: Array = np.sqrt(variance) * distance_mm / self.interior.c
        return result

    def object_distance(self, other: CameraState, distance_mm: float) -> Array:
        """Distances (9,) mm on a plane between where this and another state puts the grid."""
        grid = image_grid(self.sensor)
        places = []
        for state in (self, other):
            r = state.rays(grid)
            places.append(distance_mm * r[..., :2] / -r[..., 2:])
        result: Array = np.linalg.norm(places[0] - places[1], axis=1)
        return result
