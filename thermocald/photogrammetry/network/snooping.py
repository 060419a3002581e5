"""Gross errors in a network: adjust, test every image point, leave out the worst, again.

The test of a point is vᵀ Qvv⁻¹ v, chi² with two degrees of freedom: data snooping that does not
depend on the image's axes. Its limit holds for all points of the network together.

Source: Baarda, W. (1968): A testing procedure for use in geodetic networks; Förstner, W., Wrobel,
B. (2016): Photogrammetric Computer Vision, section 4.6.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.network import bundle as nb
from thermocald.photogrammetry.network.covariance import covariance

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array, Index
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.network.bundle import Bundle, ImageRays

__all__ = ["MIN_RAYS", "Cleaned", "snoop"]

MIN_RAYS = 3
"""Rays that a target needs: of two a wrong one cannot be told, and along one of them not seen."""
MIN_PHOTO_RAYS = 6
"""Rays that a photograph needs to be oriented and to say something besides."""

_FAMILY_ERROR = 0.05
_MEDIAN_CHI2 = 1.386  # of two degrees of freedom
_COARSE = 10.0  # times the limit: no accident, left out at once
_CONTROLLED = 1e-3  # cofactor of a residual below which nothing else controls it
_ROUNDS = 30


@dataclass(frozen=True, slots=True, eq=False)
class Cleaned:
    """What is left after snooping: the bundle and rays of the photographs and targets in use, with
    their rows before; of all rays which were rejected, their tests over the limit, and residuals
    in px.
    """

    bundle: Bundle
    rays: ImageRays
    photos: Index
    targets: Index
    rejected: NDArray[np.bool_]
    tests: Array
    residuals: Array


def snoop(sensor: Sensor, bundle: Bundle, rays: ImageRays, free: Index) -> Cleaned:
    """Adjust, and leave out gross errors, some per round, until none is left.

    A target or a photograph that too few rays are left of goes with them.
    """
    bundle, _ = nb.solve(sensor, bundle, rays, free, robust=True)
    limit = -2.0 * np.log(_FAMILY_ERROR / len(rays))  # chi² with 2 degrees of freedom
    v2 = np.sum(nb.residuals(sensor, bundle, rays) ** 2, axis=1)
    rejected = v2 > _COARSE * limit * max(float(np.median(v2)) / _MEDIAN_CHI2, 1e-12)
    tests = np.zeros(len(rays))
    for _round in range(_ROUNDS):
        _drop_uncontrolled(rejected, rays)
        part, used, photos, targets = _in_use(bundle, rays, ~rejected)
        part, _ = nb.solve(sensor, part, used, free)
        bundle = _written_back(bundle, part, photos, targets)
        tests = _point_tests(sensor, bundle, rays, rejected, part, used, free) / limit
        candidates = ~rejected & (tests > 1)
        if not candidates.any():
            break
        # one per target, and only the strong ones: a gross error spoils its neighbours' tests
        worst = np.zeros(int(rays.target.max()) + 1)
        np.maximum.at(worst, rays.target[candidates], tests[candidates])
        rejected |= (
            candidates & (tests >= worst[rays.target]) & (tests > 0.3 * tests[candidates].max())
        )
    plain = nb.ImageRays(
        rays.photo, rays.target, rays.points, np.broadcast_to(np.eye(2), (len(rays), 2, 2))
    )
    sizes = np.linalg.norm(nb.residuals(sensor, bundle, plain), axis=1)
    return Cleaned(part, used, photos, targets, rejected, tests, sizes)


def _drop_uncontrolled(rejected: NDArray[np.bool_], rays: ImageRays) -> None:
    """Reject all of targets and photographs that too few rays are left of (in place)."""
    shown = np.bincount(rays.photo)
    before = -1
    while rejected.sum() > before:
        before = int(rejected.sum())
        left = np.bincount(rays.target[~rejected], minlength=int(rays.target.max()) + 1)
        rejected |= left[rays.target] < MIN_RAYS
        left = np.bincount(rays.photo[~rejected], minlength=len(shown))
        # half of a photograph always fits somewhere: that is no reason to believe it
        rejected |= (left < np.maximum(MIN_PHOTO_RAYS, shown / 2))[rays.photo]
    if rejected.all():
        raise GeometryError(
            "the photographs contradict each other: no part of them fits together; is it one "
            "field that did not move, and one camera with one focus?"
        )


def _in_use(
    bundle: Bundle, rays: ImageRays, good: NDArray[np.bool_]
) -> tuple[Bundle, ImageRays, Index, Index]:
    """The part of a network that good rays belong to, renumbered, and its rows before."""
    photos, photo = np.unique(rays.photo[good], return_inverse=True)
    targets, target = np.unique(rays.target[good], return_inverse=True)
    used = nb.ImageRays(photo, target, rays.points[good], rays.whitening[good])
    part = nb.Bundle(
        bundle.interior, bundle.rotations[photos], bundle.centres[photos], bundle.points[targets]
    )
    return part, used, photos, targets


def _written_back(bundle: Bundle, part: Bundle, photos: Index, targets: Index) -> Bundle:
    rotations, centres, points = (
        a.copy() for a in (bundle.rotations, bundle.centres, bundle.points)
    )
    rotations[photos], centres[photos], points[targets] = part.rotations, part.centres, part.points
    return nb.Bundle(part.interior, rotations, centres, points)


def _point_tests(
    sensor: Sensor,
    bundle: Bundle,
    rays: ImageRays,
    rejected: NDArray[np.bool_],
    part: Bundle,
    used: ImageRays,
    free: Index,
) -> Array:
    """Test values vᵀ Qvv⁻¹ v / sigma0² of all rays, (n,); plain vᵀ v for those left out."""
    cofactors = covariance(sensor, part, used, free, np.ones(len(used))).residual_cofactors
    v = nb.residuals(sensor, bundle, rays)
    tests = np.sum(v * v, axis=1)
    values, vectors = np.linalg.eigh(cofactors)
    along = np.einsum("nji,nj->ni", vectors, v[~rejected])
    controlled = values > _CONTROLLED
    shares = np.where(controlled, along**2 / np.where(controlled, values, 1), 0)
    tests[~rejected] = np.sum(shares, axis=1)
    scale2 = max(float(np.median(tests[~rejected])) / _MEDIAN_CHI2, 1e-12)
    scaled: Array = tests / scale2
    return scaled
