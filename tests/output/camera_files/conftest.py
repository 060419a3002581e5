"""Cameras that are written to files, and where they look."""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor

_SENSOR = Sensor(3280, 2464, 0.00112)
_PLAIN = InteriorOrientation(
    c=3.05, x0=0.021, y0=-0.013, A1=-2.1e-3, A2=4.0e-4, A3=-2.0e-5, B1=4e-5, B2=-3e-5
)
CAMERAS = {
    "plain": _PLAIN,
    "without A3": _PLAIN.with_values(A3=0.0),
    "pinhole with affinity": InteriorOrientation(c=3.05, x0=0.02, y0=-0.01, C1=2e-3),
    "pinhole with shear": InteriorOrientation(c=3.05, x0=0.02, y0=-0.01, C1=2e-3, C2=-1e-3),
    "affinity": _PLAIN.with_values(C1=3e-4),
    "all": _PLAIN.with_values(C1=3e-4, C2=-2e-4),
}


@pytest.fixture(params=CAMERAS, ids=list(CAMERAS))
def camera(request):
    return CameraModel(_SENSOR, CAMERAS[request.param])


@pytest.fixture
def plain():
    return CameraModel(_SENSOR, _PLAIN)


@pytest.fixture
def everything():
    return CameraModel(_SENSOR, CAMERAS["all"])


@pytest.fixture
def without_a3():
    return CameraModel(_SENSOR, CAMERAS["without A3"])


@pytest.fixture
def view():
    """Points (n, 3) in front of a camera, in OpenCV's axes, that fill the image of `plain`."""
    x, y = np.meshgrid(np.linspace(-0.58, 0.58, 23), np.linspace(-0.43, 0.43, 17))
    z = 1.0 + 0.3 * np.sin(7 * x) * np.cos(5 * y)
    return np.column_stack([(x * z).ravel(), (y * z).ravel(), z.ravel()]) * 1000


def pixels_of(model, view):
    """The truth: our own projection of points in OpenCV's axes."""
    from thermocald.photogrammetry.camera.camera_model import ExteriorOrientation

    pose = ExteriorOrientation(0, 0, 0, 0, 0, 0)
    return model.project(pose, view * [1, -1, -1])


@pytest.fixture
def truth():
    return pixels_of
