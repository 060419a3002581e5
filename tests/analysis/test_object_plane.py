"""Points on the object plane: analytic derivatives against differences, the law of distances."""

import numpy as np
import pytest

from thermocald.analysis.camera.undistortion import image_grid
from thermocald.analysis.study.montecarlo import (
    mean_and_largest,
    on_plane,
    plane_jacobian,
    shares_within,
)
from thermocald.photogrammetry.camera.camera_model import Sensor

SENSOR = Sensor(3264, 2448, 0.0014)
IOP = np.array([3.97, 0.021, -0.034, 0.0051, -4e-4, 1e-5, 1.2e-4, -0.9e-4, 1e-4, -2e-4])
STEPS = np.array([1e-4, 1e-4, 1e-4, 1e-5, 1e-6, 1e-7, 1e-6, 1e-6, 1e-5, 1e-5])


def test_the_grid_goes_from_corner_to_corner():
    points = image_grid(SENSOR)
    np.testing.assert_array_equal(points[[0, 4, 8]], [[0, 0], SENSOR.centre, [3263, 2447]])


def test_jacobian_is_that_of_differences():
    points = image_grid(SENSOR)
    jacobian = plane_jacobian(SENSOR, IOP, points, 1e4)
    for k, step in enumerate(STEPS):
        change = np.zeros(10)
        change[k] = step
        difference = (
            on_plane(SENSOR, IOP + change, points, 1e4)
            - on_plane(SENSOR, IOP - change, points, 1e4)
        ) / (2 * step)
        scale = np.abs(difference).max()
        np.testing.assert_allclose(jacobian[:, :, k], difference, atol=1e-5 * scale)


@pytest.mark.parametrize("axes", [(3.0, 3.0), (3.0, 1.0), (3.0, 0.0)])
def test_law_of_distances_is_that_of_a_million_draws(axes):
    rng = np.random.default_rng(1)
    distance = np.linalg.norm(rng.standard_normal((1_000_000, 2)) * axes, axis=1)
    mean, expected = mean_and_largest(np.array([axes]), 5000)
    assert mean[0] == pytest.approx(distance.mean(), rel=3e-3)
    limits = np.array([1.0, 3.0, 6.0])
    shares = [(distance < limit).mean() for limit in limits]
    np.testing.assert_allclose(shares_within(np.array([axes]), limits)[0], shares, atol=2e-3)
    largest = distance[:1_000_000].reshape(200, 5000).max(axis=1).mean()
    assert expected[0] == pytest.approx(largest, rel=0.02)
