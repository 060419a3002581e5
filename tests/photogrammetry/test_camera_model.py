"""The camera model: projection, rays, partials, equality with OpenCV's (CONVENTIONS §2)."""

from __future__ import annotations

import cv2
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
    """They agree to 1e-7 of each column; the model itself is compared with OpenCV's below."""

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


def test_the_model_equals_opencvs():
    """All terms but C1 and C2, converted with CONVENTIONS' table, agree to 1e-9 px."""
    iop = np.append(IOP[:8], [0.0, 0.0])
    c, x0, y0, A1, A2, A3, B1, B2 = iop[:8]
    p, (u, v) = SENSOR.pixel_pitch, SENSOR.centre
    K = np.array([[c / p, 0, u + x0 / p], [0, c / p, v - y0 / p], [0, 0, 1]])
    distortion = np.array([A1 * c**2, A2 * c**4, -B2 * c, B1 * c, A3 * c**6])
    R = np.diag([1.0, -1.0, -1.0]) @ rotation(EOP[:3]).T
    expected, _ = cv2.projectPoints(POINTS, cv2.Rodrigues(R)[0], -R @ EOP[3:], K, distortion)
    np.testing.assert_allclose(project(SENSOR, iop, EOP, POINTS), expected[:, 0], atol=1e-9)
