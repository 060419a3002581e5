"""Simulated series of a camera on a trembling mount, as arrays."""

from __future__ import annotations

from dataclasses import dataclass

import corner_camera as scene
import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP, PRINCIPAL, project
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.series.normals import ObservationGrid, linearise


@dataclass(frozen=True)
class Tremble:
    """A mount's tremble: its size in the image, px, and the correlation of neighbouring epochs."""

    px: float
    memory: float = 0.0


def simulate(rng, field: TestField, epochs: int, tremble: Tremble, warm_px: float = 8.0):
    """Return observations and true values (E, 16) of a camera that warms up on a moving mount."""
    truth = np.tile(scene.TRUTH, (epochs, 1))
    at = linearise(scene.SENSOR, field, truth[0, :10], truth[0, 10:])
    per_px = 1.0 / np.sqrt((at.A[..., EOP] ** 2).sum(axis=1).mean(axis=0))
    warm = warm_px * (1 - np.exp(-np.arange(epochs) / 25))
    truth[:, PRINCIPAL] += warm[:, None] * np.array([1e-4, 5e-4, -4e-4])
    move = rng.normal(size=(epochs, 3))
    for e in range(1, epochs):
        move[e] = tremble.memory * move[e - 1] + np.sqrt(1 - tremble.memory**2) * move[e]
    truth[:, 10:13] += tremble.px * move * per_px[:3]
    points = np.array(
        [project(scene.SENSOR, t[:10], t[10:], field.points) for t in truth]
    ) + rng.normal(0, scene.SIGMA_PX, (epochs, len(field), 2))
    weights = np.zeros((epochs, len(field), 3))
    weights[..., :2] = scene.SIGMA_PX**-2
    weights[rng.random(weights.shape[:2]) < 0.03] = 0.0
    points[weights[..., 0] == 0] = np.nan
    return ObservationGrid(points, weights), truth


def standardised(seed: int, count: int, epochs: int, tremble: Tremble, exterior: str = "auto"):
    """Return errors of c, x0, y0 about each series' mean over sds (count·E, 3), and the sds, px."""
    field = scene.corner_field(per_side=4)
    z, sds = [], []
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        grid, truth = simulate(rng, field, epochs, tremble)
        r = scene.adjusted_series(field, grid, exterior=exterior)
        error = (r.values - truth)[r.ok, PRINCIPAL]
        z.append((error - error.mean(axis=0)) / r.sd[r.ok, PRINCIPAL])
        sds.append(r.sd[r.ok, PRINCIPAL])
    return np.concatenate(z), np.concatenate(sds) / scene.SENSOR.pixel_pitch
