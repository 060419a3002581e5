"""The distortion follows the angle while c changes, or stays fixed in the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.simulation.test_effects import history, model
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, InteriorOrientation
from thermocald.physics.model import ModelEffect

INTERIOR = InteriorOrientation(3.0, A1=-4e-3, A2=5e-4, A3=-2e-5, B1=1e-4, B2=-2e-4, C1=1e-3)
RATES = {"c": 1e-3, "x0": -4e-4, "y0": 3e-4}


def follows_angle(*effects):
    return replace(model(*effects, rates=RATES), interior=INTERIOR, distortion="angle")


def opencv(iop):
    """Convert to OpenCV's k1, k2, k3, p1, p2 (E, 5)."""
    c, A, B = iop[:, :1], iop[:, 3:6], iop[:, 6:8]
    return np.hstack([A * c ** np.array([2, 4, 6]), -B[:, 1:] * c, B[:, :1] * c])


def test_opencvs_constants_stay_while_c_changes():
    iop = follows_angle(ModelEffect("thermal_lag", {"tau": 60.0})).predict(history()).iop
    assert np.ptp(iop[:, 0]) > 0.02
    start = opencv(INTERIOR.as_array()[None])
    np.testing.assert_allclose(opencv(iop), np.repeat(start, len(iop), axis=0), rtol=1e-12)
    still = replace(follows_angle(), distortion="image").predict(history()).iop
    np.testing.assert_array_equal(still[:, 3:], np.tile(INTERIOR.as_array()[3:], (len(still), 1)))


def test_a_drift_of_the_distortion_adds_to_the_constants_of_the_angle():
    drifts = follows_angle(ModelEffect("radial_distortion_drift", {"A1": 1e-5}))
    h = history()
    T = h.temperature() - drifts.T0
    k1 = opencv(drifts.predict(h).iop)[:, 0]
    np.testing.assert_allclose(k1, (INTERIOR.A1 + 1e-5 * T) * INTERIOR.c**2, rtol=1e-12)


@pytest.mark.parametrize("distortion", ["angle", "image"])
def test_the_covariance_equals_differences(distortion):
    """For the steady camera and along a history, compared with differences of predictions."""
    effects = (
        ModelEffect("nonlinear_expansion", {"c": 2e-5}),
        ModelEffect("radial_distortion_drift", {"A1": 1e-5}),
    )
    base = replace(follows_angle(*effects), distortion=distortion)
    names = ("interior.c", "interior.A1", "rates.c", "nonlinear_expansion.c",
             "radial_distortion_drift.A1")  # fmt: skip
    scales = np.array([1e-2, 1e-4, 1e-4, 1e-6, 1e-6])
    roots = np.diag(scales)
    known = replace(
        base, covariance_names=names, covariance=tuple(map(tuple, (roots @ roots).tolist()))
    )
    T = base.T0 + 15.0

    def at(m):
        camera = ThermalCamera(m)
        return camera.at(T).values, camera.along([0.0, 10.0], [T, T])[1].values

    J = np.zeros((2, len(IOP_NAMES), len(names)))
    for k, name in enumerate(names):
        sides = []
        for step in (1e-3 * scales[k], -1e-3 * scales[k]):
            if name.startswith("interior"):
                key = name.removeprefix("interior.")
                changed = INTERIOR.with_values(**{key: getattr(INTERIOR, key) + step})
                sides.append(replace(base, interior=changed))
            else:
                sides.append(base.with_values({name: base.value(name) + step}))
        one, other = at(sides[0]), at(sides[1])
        J[:, :, k] = (np.array(one) - np.array(other)) / (2e-3 * scales[k])
    camera = ThermalCamera(known)
    found = camera.at(T).covariance, camera.along([0.0, 10.0], [T, T])[1].covariance
    for covariance, j in zip(found, J, strict=True):
        expected = j @ roots @ roots @ j.T
        size = np.sqrt(np.maximum(np.diag(expected), 1e-30))
        np.testing.assert_allclose(covariance / np.outer(size, size),
                                   expected / np.outer(size, size), atol=2e-5)  # fmt: skip
