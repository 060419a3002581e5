"""A camera before a corner field, as arrays, for the tests of the adjustment."""

from __future__ import annotations

import numpy as np

from tests.photogrammetry.exact_rendering import look_at
from thermocald.photogrammetry.camera.camera_model import (
    PRINCIPAL,
    InteriorOrientation,
    Sensor,
    project,
)
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings, adjust
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.series.adjustment import adjust_series
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.photogrammetry.series.result import SeriesSettings

SENSOR = Sensor(3280, 2464, 0.00112)
INTERIOR = InteriorOrientation(3.04, 0.02, -0.03, -5e-3, 4e-4, -1e-5, 3e-4, -2e-4)
SIGMA_PX = 0.04


def corner_field(sigma_mm: float = 0.0, per_side: int = 7) -> TestField:
    """Return 3 × per_side² targets on three mutually perpendicular planes."""
    at = np.linspace(60, 600, per_side)
    a, b = (g.ravel() for g in np.meshgrid(at, at))
    z = np.zeros_like(a)
    points = np.vstack([np.c_[a, b, z], np.c_[a, z, b], np.c_[z, a, b]])
    return TestField.build([str(i) for i in range(len(points))], points, sigma_mm)


EXTERIOR = look_at([950, 900, 800], [150, 180, 160])
TRUTH = np.concatenate([INTERIOR.as_array(), EXTERIOR.as_array()])


def warming_up(px) -> np.ndarray:
    """Return true parameters (E, 16) of a camera whose x0 has moved by about px (E,) / 2."""
    truth = np.tile(TRUTH, (len(px), 1))
    truth[:, :3] += px[:, None] * np.array([1e-4, 5e-4, -4e-4])
    return truth


def grid_of(points, seen) -> ObservationGrid:
    """Return the grid of image points (E, T, 2) px where seen (E, T), with the usual sigmas."""
    weights = np.zeros((*seen.shape, 3))
    weights[seen, :2] = SIGMA_PX**-2
    return ObservationGrid(np.where(seen[..., None], points, np.nan), weights)


def true_points(field: TestField, interior=INTERIOR, exterior=EXTERIOR):
    """Return image points without noise, px."""
    return project(SENSOR, interior.as_array(), exterior.as_array(), field.points)


def observe(field: TestField, rng, interior=INTERIOR, exterior=EXTERIOR, sigma_px=SIGMA_PX):
    """Draw noisy observations of all targets inside the image."""
    points = true_points(field, interior, exterior)
    seen = np.flatnonzero(np.nan_to_num(points[:, 0], nan=-1) > 0)
    seen = seen[SENSOR.contains(points[seen])]
    noisy = points[seen] + rng.normal(0, sigma_px, (len(seen), 2))
    return Observations(seen, noisy, np.full((len(seen), 2), sigma_px))


def observe_series(field: TestField, truth, rng, coordinate_error=0.0, hidden=0.0, noise=1.0):
    """Draw the grid of a camera's true parameters (E, 16), before a field that errs by mm.

    hidden: share of the targets; noise: of points (E, T, 2), times the usual.
    """
    true = field.points
    if coordinate_error:
        true = true + rng.normal(0, coordinate_error, true.shape)
    points = project(SENSOR, truth[:, :10], truth[:, 10:], true)
    points += rng.normal(0, SIGMA_PX, points.shape) * noise
    seen = rng.random(points.shape[:2]) >= hidden if np.any(hidden) else points[..., 0] < np.inf
    return grid_of(points, seen)


def adjusted(field: TestField, observations: Observations, **settings):
    """Adjust one epoch, with the truth as initial values."""
    return adjust(SENSOR, field, observations, INTERIOR, EXTERIOR, AdjustmentSettings(**settings))


def adjusted_series(field: TestField, observations, **settings):
    """Adjust a series, with the truth as initial values."""
    return adjust_series(
        SENSOR, field, observations, INTERIOR, EXTERIOR, SeriesSettings(**settings)
    )


def ratios(result, truth, columns=PRINCIPAL):
    """Return errors about their mean over their sds (n, k), of the epochs with a result."""
    ok = np.array([word == "ok" for word in result.status])
    error = (result.values - truth)[ok][:, columns]
    return (error - error.mean(axis=0)) / result.sd[ok][:, columns]
