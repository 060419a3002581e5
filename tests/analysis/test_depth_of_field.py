"""Depth of field against the geometry of the blur circle itself."""

import numpy as np
import pytest

from thermocald.analysis.study.series_study import circle_of_confusion, depth_of_field
from thermocald.photogrammetry.camera.camera_model import Sensor


def blur(f, f_number, focus, distance):
    """Diameter of the blur circle, by the thin lens: image distances of both objects."""
    image, other = (f * s / (s - f) for s in (focus, distance))
    return f / f_number * abs(other - image) / other


def test_limits_have_the_blur_circle_that_was_allowed():
    near, far = depth_of_field(3.97, 1000.0, 2.4, 0.0029)
    assert blur(3.97, 2.4, 1000.0, near) == pytest.approx(0.0029, rel=1e-9)
    assert blur(3.97, 2.4, 1000.0, far) == pytest.approx(0.0029, rel=1e-9)


def test_beyond_the_hyperfocal_distance_everything_far_is_sharp():
    assert np.isinf(depth_of_field(3.04, 3000.0, 2.0, 0.003)[1])


@pytest.mark.parametrize(
    ("sensor", "c", "f_number", "drift", "quoted"),
    [
        (Sensor(3264, 2448, 0.0014), 3.97, 2.4, 0.007, 5),
        (Sensor(3264, 2448, 0.0014), 3.97, 2.4, 0.003, 3),
        (Sensor(4032, 3024, 0.0014), 4.2, 1.7, 0.007, 3),
        (Sensor(4032, 3024, 0.0014), 4.2, 1.7, 0.003, 2),
    ],
)
def test_changes_of_the_reference(sensor, c, f_number, drift, quoted):
    """Quoted in whole mm at 1 m, without f-number and circle of confusion: within 1 mm."""
    confusion = circle_of_confusion(sensor)
    before, after = (depth_of_field(v, 1000.0, f_number, confusion) for v in (c, c + drift))
    assert np.ptp(before) - np.ptp(after) == pytest.approx(quoted, abs=1.0)


def test_a_focus_inside_the_lens_is_refused():
    with pytest.raises(ValueError, match="no depth of field"):
        depth_of_field(3.97, 3.0, 2.0, 0.003)
