"""A camera before a corner field, as arrays: what the adjustment's tests measure."""

from __future__ import annotations

import numpy as np

from thermocald.photogrammetry.camera.camera_model import (
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
    project,
)
from thermocald.photogrammetry.field.testfield import Observations, TestField

SENSOR = Sensor(3280, 2464, 0.00112)
INTERIOR = InteriorOrientation(3.04, 0.02, -0.03, -5e-3, 4e-4, -1e-5, 3e-4, -2e-4)
SIGMA_PX = 0.04


def corner_field(sigma_mm: float = 0.0) -> TestField:
    """147 targets on three mutually perpendicular planes."""
    a, b = (g.ravel() for g in np.meshgrid(np.linspace(60, 600, 7), np.linspace(60, 600, 7)))
    z = np.zeros_like(a)
    points = np.vstack([np.c_[a, b, z], np.c_[a, z, b], np.c_[z, a, b]])
    return TestField.build([str(i) for i in range(len(points))], points, sigma_mm)


def looking_at(centre, target, roll=0.0):
    """A camera at one place that looks at another."""
    backward = np.array(centre, dtype=float) - np.array(target, dtype=float)
    backward /= np.linalg.norm(backward)
    up = [0, 0, 1] if abs(backward[2]) < 0.95 else [0, 1, 0]
    right = np.cross(up, backward)
    right /= np.linalg.norm(right)
    R = np.column_stack([right, np.cross(backward, right), backward])
    c, s = np.cos(roll), np.sin(roll)
    return ExteriorOrientation.from_rotation(
        R @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), centre
    )


EXTERIOR = looking_at([950, 900, 800], [150, 180, 160])


def true_points(field: TestField, interior=INTERIOR, exterior=EXTERIOR):
    """Image points without noise, px."""
    return project(SENSOR, interior.as_array(), exterior.as_array(), field.points)


def observe(field: TestField, rng, interior=INTERIOR, exterior=EXTERIOR, sigma_px=SIGMA_PX):
    """All targets in the image, with their noise."""
    points = true_points(field, interior, exterior)
    seen = np.flatnonzero(np.nan_to_num(points[:, 0], nan=-1) > 0)
    seen = seen[SENSOR.contains(points[seen])]
    noisy = points[seen] + rng.normal(0, sigma_px, (len(seen), 2))
    return Observations(seen, noisy, np.full((len(seen), 2), sigma_px))
