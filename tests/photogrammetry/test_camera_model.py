"""The camera model: projection, rays, partials, equality with OpenCV's (CONVENTIONS §2)."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import (
    PARAMETER_NAMES,
    ExteriorOrientation,
    Sensor,
    partials,
    project,
    rays,
    rotation,
)

SENSOR = Sensor(3280, 2464, 0.00112)
IOP = np.array([3.04, 0.02, -0.03, -5e-3, 4e-4, -1e-5, 3e-4, -2e-4, 1e-4, 2e-4])
EOP = np.array([0.1, -0.2, 0.3, 10.0, 20.0, 800.0])


@pytest.fixture
def points():
    return np.random.default_rng(1).uniform(-300, 300, (60, 3)) * [1, 1, 0.5]


def test_partials_equal_differences(points):
    """They agree to 1e-7 of each column; the model itself is compared with OpenCV's below."""

    def seen(values):
        return project(SENSOR, values[:10], values[10:16], points + values[16:])

    values = np.concatenate([IOP, EOP, np.zeros(3)])
    steps = np.r_[1e-6 * np.maximum(np.abs(IOP), 1e-2), np.full(6, 1e-5), np.full(3, 1e-4)]
    _, by_parameter, by_point = partials(SENSOR, IOP, EOP, points)
    analytic = np.concatenate([by_parameter, by_point], axis=2)
    largest = np.abs(analytic).max(axis=(0, 1))
    largest[16:] = np.abs(by_point).max()
    for k, name in enumerate((*PARAMETER_NAMES, "X", "Y", "Z")):
        step = steps[k] * np.eye(19)[k]
        difference = (seen(values + step) - seen(values - step)) / (2 * steps[k])
        assert np.abs(difference - analytic[:, :, k]).max() < 1e-7 * largest[k], name


@pytest.mark.parametrize("per_epoch", ["iop", "eop", "points", "iop eop", "iop eop points"])
def test_epochs_are_vectorised(points, per_epoch):
    rng = np.random.default_rng(2)
    shared = {"iop": IOP, "eop": EOP, "points": points}
    several = {
        name: value + rng.normal(0, 1e-4, (3, 4, *value.shape)) if name in per_epoch else value
        for name, value in shared.items()
    }
    one = {name: v[2, 1] if name in per_epoch else v for name, v in several.items()}
    image, by_parameter, by_point = partials(SENSOR, *several.values())
    expected, one_parameter, one_point = partials(SENSOR, *one.values())
    np.testing.assert_allclose(image[2, 1], expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(by_parameter[2, 1], one_parameter, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(by_point[2, 1], one_point, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(
        project(SENSOR, *several.values())[2, 1], expected, rtol=0, atol=1e-9
    )


def test_inverse_returns_the_ray(points):
    image = project(SENSOR, IOP, EOP, points)
    q = (points - EOP[3:]) @ rotation(EOP[:3])
    expected = q / np.linalg.norm(q, axis=1, keepdims=True)
    np.testing.assert_allclose(rays(SENSOR, IOP, image), expected, atol=1e-12)


def test_a_folding_distortion_has_no_ray():
    with pytest.raises(GeometryError, match="no ray"):
        rays(SENSOR, [3.04, 0, 0, -0.2, 0, 0, 0, 0, 0, 0], [[0.0, 0.0]])


def test_the_model_equals_opencvs(points):
    """All terms but C1 and C2, converted with CONVENTIONS' table, agree to 1e-9 px."""
    iop = IOP.copy()
    iop[8] = iop[9] = 0.0
    c, x0, y0, A1, A2, A3, B1, B2 = iop[:8]
    p = SENSOR.pixel_pitch
    K = np.array([[c / p, 0, SENSOR.centre[0] + x0 / p], [0, c / p, SENSOR.centre[1] - y0 / p],
                  [0, 0, 1]])  # fmt: skip
    distortion = np.array([A1 * c**2, A2 * c**4, -B2 * c, B1 * c, A3 * c**6])
    exterior = ExteriorOrientation.from_array(EOP)
    R = np.diag([1.0, -1.0, -1.0]) @ exterior.rotation.T
    rvec = cv2.Rodrigues(R)[0]
    expected = cv2.projectPoints(points, rvec, -R @ exterior.centre, K, distortion)[0][:, 0]
    np.testing.assert_allclose(project(SENSOR, iop, EOP, points), expected, atol=1e-9)


def test_a_point_behind_the_camera_has_no_image():
    image = project(SENSOR, IOP, np.zeros(6), [[0, 0, -1000.0], [0, 0, 1000.0]])
    assert np.isnan(image).all(axis=1).tolist() == [False, True]
