"""Gross errors in a network: adjust, test every image point, leave out the worst, again.

The test of a point is vᵀ Qvv⁻¹ v, chi² with two degrees of freedom: data snooping that does not
depend on the image's axes. Its limit holds for all points of the network together.

Source: Baarda, W. (1968): A testing procedure for use in geodetic networks; Förstner, W., Wrobel,
B. (2016): Photogrammetric Computer Vision, section 4.6.4.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry import network_bundle as nb
from thermocald.photogrammetry.network_covariance import covariance

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.photogrammetry.camera_model import Sensor
    from thermocald.photogrammetry.network_bundle import Bundle, ImageRays

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]

__all__ = ["MIN_RAYS", "compact", "snoop"]

MIN_RAYS = 3
"""Rays that a target needs: of two a wrong one cannot be told, and along one of them not seen."""

_FAMILY_ERROR = 0.05
_MEDIAN_CHI2 = 1.386  # of two degrees of freedom


def snoop(
    sensor: Sensor, bundle: Bundle, rays: ImageRays, free: Index
) -> tuple[Bundle, NDArray[np.bool_], Array]:
    """Adjust, and leave out gross errors one per target and round until none is left.

    Returns the bundle, which of the rays are rejected, and the test values over their limit (n,).
    """
    bundle, _ = nb.solve(sensor, bundle, rays, free, robust=True)
    limit = -2.0 * np.log(_FAMILY_ERROR / len(rays))  # chi² with 2 degrees of freedom
    rejected = np.zeros(len(rays), dtype=bool)
    # the robust solution shows the coarse ones at once: ten times the limit is no accident
    v2 = np.sum(nb.residuals(sensor, bundle, rays) ** 2, axis=1)
    rejected |= v2 > 10 * limit * max(float(np.median(v2)) / _MEDIAN_CHI2, 1e-12)
    tests = np.zeros(len(rays))
    for _round in range(30):
        _drop_uncontrolled(rejected, rays)
        bundle, _ = nb.solve(sensor, bundle, rays, free, weights=(~rejected).astype(float))
        tests = _point_tests(sensor, bundle, rays, free, rejected)
        tests /= limit
        candidates = ~rejected & (tests > 1)
        if not candidates.any():
            break
        worst = np.zeros(int(rays.target.max()) + 1)
        np.maximum.at(worst, rays.target[candidates], tests[candidates])
        strongest = (
            candidates & (tests >= worst[rays.target]) & (tests > 0.3 * tests[candidates].max())
        )
        rejected |= strongest
    return bundle, rejected, tests


def _drop_uncontrolled(rejected: NDArray[np.bool_], rays: ImageRays) -> None:
    """A target that too few rays are left of is no target (in place)."""
    left = np.bincount(rays.target[~rejected], minlength=int(rays.target.max()) + 1)
    rejected |= left[rays.target] < MIN_RAYS


def _point_tests(
    sensor: Sensor, bundle: Bundle, rays: ImageRays, free: Index, rejected: NDArray[np.bool_]
) -> Array:
    """Test values vᵀ Qvv⁻¹ v / sigma0² of all rays, (n,); plain vᵀ v for those left out."""
    good = ~rejected
    numbers, targets = compact(rays.target[good], len(bundle.points))
    part = nb.ImageRays(
        rays.photo[good], numbers[rays.target[good]], rays.points[good], rays.whitening[good]
    )
    small = nb.Bundle(bundle.interior, bundle.rotations, bundle.centres, bundle.points[targets])
    cofactors = covariance(sensor, small, part, free, np.ones(len(part))).residual_cofactors
    v = nb.residuals(sensor, bundle, rays)
    tests = np.sum(v * v, axis=1)
    values, vectors = np.linalg.eigh(cofactors)
    along = np.einsum("nji,nj->ni", vectors, v[good])
    # a direction that nothing else controls cannot be tested
    controlled = values > 1e-3
    tests[good] = np.sum(
        np.where(controlled, along**2 / np.where(controlled, values, 1), 0), axis=1
    )
    scale2 = max(float(np.median(tests[good])) / _MEDIAN_CHI2, 1e-12)
    scaled: Array = tests / scale2
    return scaled


def compact(targets: Index, m: int) -> tuple[Index, Index]:
    """New numbers for the targets in use, (m,) with -1 for the others, and the rows in use."""
    rows = np.unique(targets)
    numbers = np.full(m, -1)
    numbers[rows] = np.arange(len(rows))
    return numbers, rows
