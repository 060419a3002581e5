"""From image points to a calibrated epoch without initial values."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.epoch.adjustment import (
    Adjustment,
    AdjustmentSettings,
    adjust,
    failed,
)
from thermocald.photogrammetry.epoch.geometry import GeometryBounds
from thermocald.photogrammetry.field.planes import plane_fit
from thermocald.photogrammetry.orientation.approximate import approximate_orientation, resection

if TYPE_CHECKING:
    from thermocald.photogrammetry.camera.camera_model import InteriorOrientation, Sensor
    from thermocald.photogrammetry.field.testfield import Observations, TestField

__all__ = ["NO_BOUNDS", "cold_start", "mirror_pose", "pose_only"]

NO_BOUNDS = GeometryBounds(0, 2.0, 1e9, 1e9, 0.0, 0.0)
_FEWEST_FOR_POSE = 8  # two markers: one alone has two poses, and few redundant observations
_AMBIGUITY = 2.0  # a second pose must fit this much worse to be excluded
_GROSS = 6.0  # times the median residual: left out at first, may come back


def cold_start(
    sensor: Sensor,
    testfield: TestField,
    observations: Observations,
    settings: AdjustmentSettings | None = None,
    nominal_c: float | None = None,
    interior: InteriorOrientation | None = None,
) -> Adjustment:
    """Adjust an epoch of which nothing is known.

    nominal_c mm, from the data sheet, or None; interior: an earlier calibration to start from.
    The principal distance and A1 are freed first, as the higher terms follow any gross error.
    Never raises for data: the result has a status and a reason.
    """
    s = settings or AdjustmentSettings()
    if len(observations) == 0:
        return failed("no_observations", "no target was measured", observations, s.free)
    points = testfield.points[observations.targets]
    try:
        start_interior, start_exterior, fits = approximate_orientation(
            sensor, points, observations.points, nominal_c, interior
        )
    except GeometryError as error:
        few = len(observations) < 4
        word = "too_few_targets" if few else "no_orientation"
        return failed(word, str(error), observations, s.free)
    first = tuple(name for name in ("c", "A1") if name in s.free)
    suspects = ~fits
    if len(first) < len(s.free):
        loose = replace(
            s, free=first, snooping_alpha=0.0, bounds=NO_BOUNDS, scale="posterior", priors={}
        )
        rough = adjust(
            sensor, testfield, observations, start_interior, start_exterior, loose, suspects
        )
        if rough.ok and rough.interior is not None and rough.exterior is not None:
            start_interior, start_exterior = rough.interior, rough.exterior
            size = np.linalg.norm(rough.residuals, axis=1)
            suspects = size > _GROSS * max(float(np.median(size)), 0.1)
    result = adjust(sensor, testfield, observations, start_interior, start_exterior, s, suspects)
    if s.snooping_alpha > 0 or not suspects.any() or result.interior is None:
        return result
    # who switches the test off wants all targets: the suspects were left out for the start only
    assert result.exterior is not None
    return adjust(sensor, testfield, observations, result.interior, result.exterior, s)


def pose_only(
    sensor: Sensor,
    testfield: TestField,
    observations: Observations,
    interior: InteriorOrientation,
    settings: AdjustmentSettings | None = None,
) -> Adjustment:
    """The exterior orientation alone, with the interior orientation held.

    A pose needs targets that exclude its mirror image: a single plane seen from far away has two.
    """
    s = replace(settings or AdjustmentSettings(), free=(), priors={})
    n = len(observations)
    if n < _FEWEST_FOR_POSE:
        return failed(
            "too_few_targets",
            f"{n} targets; a pose that can be checked needs at least {_FEWEST_FOR_POSE} (two "
            "markers)",
            observations,
        )
    points = testfield.points[observations.targets]
    try:
        _, exterior, fits = approximate_orientation(
            sensor, points, observations.points, interior=interior
        )
    except GeometryError as error:
        return failed("no_orientation", str(error), observations)
    result = adjust(sensor, testfield, observations, interior, exterior, s, ~fits)
    if not result.ok:
        return result
    other = mirror_pose(sensor, testfield, observations, interior)
    if other is not None and other < _AMBIGUITY**2:
        return failed(
            "ambiguous_pose",
            "the targets lie in one plane and a second, mirrored pose fits nearly as well: show "
            "targets of another plane or move closer",
            observations,
        )
    return result


def mirror_pose(
    sensor: Sensor,
    testfield: TestField,
    observations: Observations,
    interior: InteriorOrientation,
) -> float | None:
    """How much larger the sum of squares of a plane field's second pose is; None without one."""
    points = testfield.points[observations.targets]
    if not plane_fit(points, 0.005)[2]:
        return None
    solutions = resection(sensor, interior, points, observations.points)
    if len(solutions) < 2:
        return None
    (best, _), (second, _) = solutions[:2]
    return (second / max(best, 1e-9)) ** 2
