"""Last minus first, and the movement of a still scene's image."""

import numpy as np
import pytest

from thermocald.analysis.camera.undistortion import image_grid
from thermocald.analysis.study.series_study import deviation, image_displacement
from thermocald.photogrammetry.camera.camera_model import Sensor

SENSOR = Sensor(3264, 2448, 0.0014)


def test_last_minus_first_with_its_sd_passes_over_missing_epochs():
    values = np.array([np.nan, 1.0, 5.0, 2.5, np.nan])
    found = deviation(values, np.array([9.0, 0.3, 9.0, 0.4, 9.0]))
    assert found is not None
    assert (found.first, found.last, found.change) == (1.0, 2.5, 1.5)
    assert found.sd_change == pytest.approx(0.5)
    assert found.largest == 4.0


def test_one_value_is_no_deviation():
    assert deviation(np.array([np.nan, 1.0]), np.ones(2)) is None


def test_a_moved_principal_point_moves_every_image_point_by_as_much():
    first = np.array([3.97, 0.01, -0.02, 5e-3, -4e-4, 0, 1e-4, -1e-4, 0, 0])
    later = first.copy()
    later[1:3] += np.array([10.0, 5.0]) * 0.0014
    moved = image_displacement(SENSOR, first, later, image_grid(SENSOR))
    np.testing.assert_allclose(moved, np.tile([10.0, -5.0], (9, 1)), atol=1e-6)


def test_a_longer_principal_distance_moves_points_outwards_in_proportion():
    first = np.array([3.97, 0, 0, 0, 0, 0, 0, 0, 0, 0.0])
    later = first.copy()
    later[0] *= 1.002
    points = image_grid(SENSOR)
    moved = image_displacement(SENSOR, first, later, points)
    np.testing.assert_allclose(moved, 0.002 * (points - SENSOR.centre), atol=1e-9)
