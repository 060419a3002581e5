"""What the adjustment of a network gives: targets, stations, the camera, what was left out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from thermocald.arrays import Array, Index
    from thermocald.photogrammetry.camera.camera_model import CameraModel, ExteriorOrientation

__all__ = ["Network", "Rejection", "Station"]


@dataclass(frozen=True, slots=True)
class Station:
    """Where a photograph was taken from; sd of the projection centre, (3,) mm."""

    photo: str
    exterior: ExteriorOrientation
    n_targets: int
    sd_centre: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Rejection:
    """An image point that was left out: residual in px, and its test value over the limit."""

    photo: str
    target: str
    residual: float
    test: float


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """The adjusted network.

    names: m targets; points (m, 3) mm with covariance (3m, 3m) mm²; n_rays (m,); angles (m,) rad,
    the largest angle of intersection of each target; interior with covariance (10, 10), zero for
    what was held; free: names of what was not; residuals: one (n, 2) px per station; unused:
    targets and photographs left out, with reasons.
    """

    names: tuple[str, ...]
    points: Array
    covariance: Array
    n_rays: Index
    angles: Array
    camera: CameraModel
    interior_covariance: Array
    free: tuple[str, ...]
    stations: tuple[Station, ...]
    sigma0: float
    redundancy: int
    residuals: tuple[Array, ...]
    rejected: tuple[Rejection, ...]
    unused: dict[str, str]
    datum: str
    sd_scale: float

    @property
    def sigmas(self) -> Array:
        """Standard deviations of the targets (m, 3) mm."""
        result: Array = np.sqrt(np.diag(self.covariance)).reshape(-1, 3)
        return result

    @property
    def extent(self) -> float:
        """The largest distance between two targets, mm (of their bounding box)."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @property
    def relative_accuracy(self) -> float:
        """Mean standard deviation of a coordinate over the extent, without the scale's own."""
        shape = np.diag(self.covariance).mean() - self._scale_share()
        return float(np.sqrt(max(shape, 0.0)) / self.extent)

    def _scale_share(self) -> float:
        centred = self.points - self.points.mean(axis=0)
        return self.sd_scale**2 * float(np.mean(centred**2))
