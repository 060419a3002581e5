"""Tests of whether the geometry determines the estimated parameters.

An adjustment of a frontal plane, or of targets in one corner of the image, converges with small
residuals; nevertheless its parameters are not those of the camera. Every reason states the bound
and the figure that exceeds it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import (
    EOP,
    IOP_NAMES,
    PARAMETER_NAMES,
    Sensor,
    rotation,
)
from thermocald.photogrammetry.field.testfield import plane_fit

if TYPE_CHECKING:
    from collections.abc import Container, Iterable

    from thermocald.arrays import Array


@dataclass(frozen=True, slots=True)
class GeometryBounds:
    """Bounds beyond which an epoch's geometry is weak.

    minimum_redundancy: of the adjustment; correlation: largest |coefficient| of two estimated
    parameters; relative_sd_c: sd(c)/c; sd_point_px: sd of x0, y0; coverage: share of the image
    inside the targets' convex hull; plane_obliqueness_deg: angle between the optical axis and the
    normal of a plane field.
    """

    minimum_redundancy: int = 6
    correlation: float = 0.9999
    relative_sd_c: float = 0.01
    sd_point_px: float = 25.0
    coverage: float = 0.10
    plane_obliqueness_deg: float = 15.0


def image_coverage(sensor: Sensor, image_points: Array) -> float:
    """Return the share of the image inside the convex hull of image points (n, 2)."""
    import cv2

    hull = cv2.convexHull(np.ascontiguousarray(image_points, dtype=np.float32))
    return float(cv2.contourArea(hull)) / (sensor.width * sensor.height)


def obliqueness_deg(eop: Array, normal: Array) -> float:
    """Return the angle between the optical axis and a plane's normal; 0 for a frontal view."""
    axis = rotation(eop[:3])[:, 2]
    return float(np.degrees(np.arccos(min(1.0, abs(float(axis @ normal))))))


def weaknesses(
    sensor: Sensor,
    points: Array,
    image_points: Array,
    values: Array,
    covariance: Array,
    free: Iterable[str],
    bounds: GeometryBounds,
) -> list[str]:
    """Return the reasons why the geometry does not determine the free IOP; empty if it does.

    points (n, 3) mm and image_points (n, 2) px of the targets used; values (16,) and covariance
    (16, 16) of the adjustment. Held parameters are not tested: a pose alone needs far less.
    """
    sd = np.sqrt(covariance.diagonal())
    free = set(free)
    reasons = uncertain(sensor, values, sd, free, bounds)
    if "c" in free and not _has_depth(points):
        _, axes, flat = plane_fit(points)
        angle = obliqueness_deg(values[EOP], axes[2])
        if flat and angle < bounds.plane_obliqueness_deg:
            reasons.append(
                f"one plane seen at {angle:.0f}° from frontal (at least "
                f"{bounds.plane_obliqueness_deg:.0f}° are needed): principal distance and "
                "distance to the field cannot be separated"
            )
    if free & {"x0", "y0", "A1", "A2", "A3", "B1", "B2"}:
        coverage = image_coverage(sensor, image_points)
        if coverage < bounds.coverage:
            reasons.append(
                f"the targets cover {coverage:.1%} of the image (at least {bounds.coverage:.0%} "
                "are needed)"
            )
    # only pairs with an IOP: correlated EOP do no harm to the camera
    scale = 1.0 / np.where(sd > 0, sd, np.inf)
    inner = np.abs(covariance[: len(IOP_NAMES)] * scale) * scale[: len(IOP_NAMES), None]
    inner.flat[:: len(sd) + 1] = 0.0
    i, j = divmod(int(inner.argmax()), len(sd))
    if inner[i, j] > bounds.correlation:
        reasons.append(
            f"{PARAMETER_NAMES[i]} and {PARAMETER_NAMES[j]} correlate at {inner[i, j]:.5f} "
            f"(bound {bounds.correlation})"
        )
    return reasons


def uncertain(
    sensor: Sensor, values: Array, sd: Array, free: Container[str], bounds: GeometryBounds
) -> list[str]:
    """Return a reason for each of c, x0 and y0 that is free and has an sd beyond its bound.

    values, sd (16,): of the adjustment.
    """
    reasons = []
    share = sd[0] / values[0]
    if "c" in free and share > bounds.relative_sd_c:
        known = f"is known to {share:.1%} only" if share < 1 else "is not determined"
        reasons.append(f"the principal distance {known} (bound {bounds.relative_sd_c:.1%})")
    for name, column in (("x0", 1), ("y0", 2)):
        size = sd[column] / sensor.pixel_pitch
        if name in free and size > bounds.sd_point_px:
            inside = size < max(sensor.width, sensor.height)
            known = f"is known to {size:.0f} px only" if inside else "is not determined"
            reasons.append(f"{name} {known} (bound {bounds.sd_point_px:.0f} px)")
    return reasons


def _has_depth(points: Array) -> bool:
    """Return whether points are certainly not in one plane: a quick test before `plane_fit`."""
    reduced = points - np.full(len(points), 1.0 / len(points)) @ points
    (a, b, c), (_, d, e), (_, _, f) = (points.T @ reduced).tolist()
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    return bool(determinant > 1e-4 * (a + d + f) ** 3)
