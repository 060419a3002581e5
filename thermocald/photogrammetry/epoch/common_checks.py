"""Photographs adjusted together: which rays contradict others, and what the geometry carries."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.epoch.geometry import image_coverage, obliqueness_deg, uncertain
from thermocald.photogrammetry.epoch.snooping import chi2_2d
from thermocald.photogrammetry.field.planes import plane_fit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array, Mask
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
    from thermocald.photogrammetry.field.testfield import Observations, TestField

__all__ = ["ray_tests", "snoop_rays", "weaknesses_together"]

_UNTESTABLE = 1e-6  # of its variance: a ray whose residual the unknowns take up
_LARGEST_OBLIQUENESS_NEEDED_DEG = 20.0


def ray_tests(r: Array, share: Array, P: Array, mask: Mask) -> Array:
    """Chi-square (2) of residuals (n, 2) of weights P (n, 2, 2), of which the unknowns explain a
    covariance `share` (n, 2, 2).
    """
    V = np.linalg.inv(P) + np.where(mask, -1.0, 1.0)[:, None, None] * share
    determinant = np.linalg.det(V) * np.linalg.det(P)
    testable = determinant > _UNTESTABLE
    V[~testable] = np.eye(2)
    test = np.einsum("ni,nij,nj->n", r, np.linalg.inv(V), r)
    return np.where(testable, test, 0.0)


def snoop_rays(
    tests: Sequence[Array], photographs: Sequence[Observations], used: Sequence[Mask], alpha: float
) -> list[Mask]:
    """Which image points stay; of the rays of one target only the worst goes at a time."""
    if alpha <= 0:
        return list(used)
    offered = np.concatenate([test[m] for test, m in zip(tests, used, strict=True)])
    limit = chi2_2d(alpha) * max(float(np.median(offered)) / (2 * np.log(2)), 1e-12)
    size = 1 + max(int(o.targets.max(initial=0)) for o in photographs)
    worst = np.zeros(size)
    for test, o, m in zip(tests, photographs, used, strict=True):
        np.maximum.at(worst, o.targets[m], test[m])
    return [
        (test <= limit) | (m & (test < worst[o.targets]))
        for test, o, m in zip(tests, photographs, used, strict=True)
    ]


def weaknesses_together(
    sensor: Sensor,
    testfield: TestField,
    photographs: Sequence[Observations],
    used: Sequence[Mask],
    values: Array,
    eops: Array,
    covariance: Array,
    s: AdjustmentSettings,
) -> list[str]:
    """Why the photographs do not carry the free parameters."""
    reasons: list[str] = []
    if not s.free:
        return reasons
    seen = np.unique(np.concatenate([o.targets[m] for o, m in zip(photographs, used, strict=True)]))
    _, axes, flat = plane_fit(testfield.points[seen])
    if flat and "c" in s.free:
        angles = [obliqueness_deg(eop, axes[2]) for eop in eops]
        if max(angles) < _LARGEST_OBLIQUENESS_NEEDED_DEG:
            reasons.append(
                f"one plane, in all {len(eops)} photographs within {max(angles):.0f}° of frontal "
                f"(some at {_LARGEST_OBLIQUENESS_NEEDED_DEG:.0f}° and more are needed): principal "
                "distance and distance to the field cannot be separated, however small the "
                "residuals are"
            )
    points = np.concatenate([o.points[m] for o, m in zip(photographs, used, strict=True)])
    coverage = image_coverage(sensor, points)
    if coverage < s.bounds.coverage:
        reasons.append(
            f"the targets cover {coverage:.1%} of the image in all photographs together (at least "
            f"{s.bounds.coverage:.0%} are needed)"
        )
    return reasons + uncertain(sensor, values, np.sqrt(np.diag(covariance)), s.free, s.bounds)
