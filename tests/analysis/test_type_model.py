"""A camera type, and a camera of the type that was measured at few temperatures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.analysis.thermal.thermal_model import shrink_to_type, type_model
from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import InteriorOrientation, Sensor
from thermocald.physics.model import ModelEffect, ThermalModel

NAMES = ("interior.c", "rates.c", "rates.x0", "thermal_lag.tau")
TYPE = np.array([3.04, 3.0e-4, -4.0e-4, 80.0])
SCATTER = np.array([0.02, 5e-5, 8e-5, 10.0])


def camera(name, values, sd):
    found = dict(zip(NAMES, values, strict=True))
    return ThermalModel(
        name, Sensor(3280, 2464, 0.00112), 25.0,
        InteriorOrientation(c=found["interior.c"]),
        {"c": found["rates.c"], "x0": found["rates.x0"], "y0": 0.0},
        (ModelEffect("thermal_lag", {"tau": found["thermal_lag.tau"]}, {"tau": sd[3]}),),
        covariance_names=NAMES, covariance=tuple(map(tuple, np.diag(np.square(sd)))),
        validity={"temperature": (10.0, 50.0)}, fitted_on=({"series": "M1"},),
    )  # fmt: skip


def cameras(rng, count, noise):
    true = TYPE + SCATTER * rng.standard_normal((count, 4))
    seen = true + noise * SCATTER * rng.standard_normal((count, 4))
    return true, [camera(f"cam{i}", v, noise * SCATTER) for i, v in enumerate(seen)]


def values_of(model):
    tau = model.effects[0].values["tau"]
    return np.array([model.interior.c, model.rates["c"], model.rates["x0"], tau])


def test_a_camera_measured_at_few_temperatures_is_better_than_alone_and_than_its_type():
    rng = np.random.default_rng(8)
    pulls, own, shrunk, kind = [], [], [], []
    for _ in range(40):
        _, fleet = cameras(rng, 10, 0.1)
        (true,), (new,) = cameras(rng, 1, 1.0)
        found = shrink_to_type(new, type_model(fleet, "rpi-v2.1"))
        rows = [found.covariance_names.index(n) for n in NAMES]
        sd = np.sqrt(np.diag(np.array(found.covariance)))[rows]
        pulls.append((values_of(found) - true) / sd)
        own.append((values_of(new) - true) / SCATTER)
        shrunk.append((values_of(found) - true) / SCATTER)
        kind.append((TYPE - true) / SCATTER)
    assert np.mean(np.abs(pulls) < 1.96) == pytest.approx(0.95, abs=0.04)
    assert np.std(shrunk) < 0.8 * min(np.std(own), np.std(kind))
    assert found.evidence["shrunk_to_type"] == "rpi-v2.1"
    assert found.camera == "cam0"
    assert found.validity == new.validity


@pytest.mark.parametrize("specimens", [2, 3])
def test_a_further_camera_of_a_type_of_few(specimens):
    """95 % are within 1.96 sds of a prediction; with the scatter as it is, 70 and 82 %."""
    rng, within = np.random.default_rng(10), []
    for _ in range(200):
        true, fleet = cameras(rng, specimens + 1, 0.1)
        kind = ThermalCamera(type_model(fleet[1:], "rpi"))
        for temperature in (25.0, 40.0):
            state = kind.at(temperature)
            c = true[0, 0] + (temperature - 25.0) * true[0, 1]
            within.append(abs(state.interior.c - c) < 1.96 * state.sd["c"])
    # two temperatures share the level: 400 decisions scatter by 0.015
    assert np.mean(within) == pytest.approx(0.95, abs=0.04)


def test_models_of_different_kinds_are_refused():
    _, fleet = cameras(np.random.default_rng(9), 4, 0.1)
    kind = type_model(fleet, "rpi")
    with pytest.raises(DataError, match="not alike"):
        shrink_to_type(replace(fleet[0], T0=20.0), kind)
    with pytest.raises(DataError, match="not alike"):
        type_model([fleet[0], replace(fleet[1], T0=11.0)], "x")
