"""The camera model: projection, rays, partials (CONVENTIONS §2).

`tests/output/camera_files` compares it with OpenCV and six other programs.
"""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import (
    PARAMETER_NAMES,
    Sensor,
    partials,
    project,
    rays,
    rotation,
)

SENSOR = Sensor(3280, 2464, 0.00112)
IOP = np.array([3.04, 0.02, -0.03, -5e-3, 4e-4, -1e-5, 3e-4, -2e-4, 1e-4, 2e-4])
EOP = np.array([0.1, -0.2, 0.3, 10.0, 20.0, 800.0])


POINTS = np.random.default_rng(1).uniform(-300, 300, (60, 3)) * [1, 1, 0.5]


def test_partials_equal_differences():
    """They agree to 1e-7 of each column; this does not prove the model itself."""

    def seen(values):
        return project(SENSOR, values[:10], values[10:16], POINTS + values[16:])

    values = np.concatenate([IOP, EOP, np.zeros(3)])
    steps = np.r_[1e-6 * np.maximum(np.abs(IOP), 1e-2), np.full(6, 1e-5), np.full(3, 1e-4)]
    _, by_parameter, by_point = partials(SENSOR, IOP, EOP, POINTS)
    analytic = np.concatenate([by_parameter, by_point], axis=2)
    largest = np.abs(analytic).max(axis=(0, 1))
    largest[16:] = np.abs(by_point).max()
    for k, name in enumerate((*PARAMETER_NAMES, "X", "Y", "Z")):
        step = steps[k] * np.eye(19)[k]
        difference = (seen(values + step) - seen(values - step)) / (2 * steps[k])
        assert np.abs(difference - analytic[:, :, k]).max() < 1e-7 * largest[k], name


def test_a_ray_passes_through_its_point_if_there_is_one():
    q = (POINTS - EOP[3:]) @ rotation(EOP[:3])
    expected = q / np.linalg.norm(q, axis=1, keepdims=True)
    found = rays(SENSOR, IOP, project(SENSOR, IOP, EOP, POINTS))
    np.testing.assert_allclose(found, expected, atol=1e-12)
    with pytest.raises(GeometryError, match="no ray"):  # its distortion folds
        rays(SENSOR, [3.04, 0, 0, -0.2, 0, 0, 0, 0, 0, 0], [[0.0, 0.0]])
    behind = project(SENSOR, IOP, np.zeros(6), [[0, 0, -1000.0], [0, 0, 1000.0]])
    assert np.isnan(behind).all(axis=1).tolist() == [False, True]
