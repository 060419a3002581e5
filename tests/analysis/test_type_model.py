"""A camera type, and a further camera of the type that was measured at few temperatures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.analysis.test_thermal_model import for_fit, reduced
from tests.commands import answer
from thermocald.analysis.statistics.random_effects import odd_specimens
from thermocald.analysis.thermal.prediction_test import predicted_error
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.analysis.thermal.thermal_model import (
    fit_thermal_model,
    fit_with_type,
    shrink_to_type,
    type_model,
)
from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import InteriorOrientation, Sensor
from thermocald.physics.heat import Course
from thermocald.physics.model import ModelEffect, ThermalModel
from thermocald.physics.model_file import write_model
from thermocald.physics.presets import preset_simulation
from thermocald.thermal.source import epochs_input

SENSOR = Sensor(3280, 2464, 0.00112)
T0 = 30.0
NAMES = ("interior.c", "rates.c", "rates.x0", "rates.y0", "thermal_lag.tau")
TYPE = np.array([3.04, 3.0e-4, -4.0e-4, 2.0e-4, 80.0])
SCATTER = np.array([1e-3, 5e-5, 8e-5, 5e-5, 10.0])
BETWEEN = np.outer(SCATTER, SCATTER) * (0.6 + 0.4 * np.eye(5))
FULL_CYCLE = np.array([2e-4, 2e-7, 1e-6, 1e-6, 0.1])
"""Standard deviations of the fit to a full cycle."""


def camera(values, sd, name="camera"):
    """Return the model that a fit gives, with the standard deviations of its values."""
    c, *rates, tau = values.tolist()
    return ThermalModel(
        name, SENSOR, T0, InteriorOrientation(c=c),
        dict(zip(("c", "x0", "y0"), rates, strict=True)),
        (ModelEffect("thermal_lag", {"tau": tau}, {"tau": sd[-1]}),),
        covariance_names=NAMES, covariance=tuple(map(tuple, np.diag(sd**2).tolist())),
        validity={"temperature": (10.0, 50.0)}, fitted_on=({"series": "M1"},),
    )  # fmt: skip


def cameras(rng, count, sd, between=BETWEEN):
    """Draw true values (count, 5) of cameras of the type, and their models."""
    true = rng.multivariate_normal(TYPE, between, count)
    seen = true + sd * rng.standard_normal(true.shape)
    return true, [camera(values, sd, f"cam{i}") for i, values in enumerate(seen)]


def test_a_camera_measured_at_few_temperatures_is_better_than_alone_and_than_its_type():
    """95 % are within 1.96 sds."""
    rng = np.random.default_rng(8)
    inside, off = [], []
    for _ in range(40):
        _, fleet = cameras(rng, 10, 0.1 * SCATTER)
        (true,), (new,) = cameras(rng, 1, SCATTER)
        found = shrink_to_type(new, type_model(fleet, "rpi-v2.1"))
        values, alone = (np.array([m.value(n) for n in NAMES]) for m in (found, new))
        sd = np.array([found.sd(n) for n in NAMES])
        hot = ThermalCamera(found).at(T0 + 20.0)
        hot_off = (hot.interior.c - true[0] - 20.0 * true[1]) / hot.sd["c"]
        inside.append(np.abs([*((values - true) / sd), hot_off]) < 1.96)
        off.append(np.array([values, alone, TYPE]) - true)
    assert np.mean(inside) == pytest.approx(0.95, abs=0.04)
    shrunk, by_itself, by_type = np.std(np.array(off) / SCATTER, axis=(0, 2))
    assert shrunk < 0.8 * min(by_itself, by_type)
    assert found.evidence["shrunk_to_type"] == "rpi-v2.1"
    assert (found.camera, found.validity) == (new.camera, new.validity)


@pytest.mark.parametrize("specimens", [2, 3])
def test_a_further_camera_of_a_type_of_few(specimens):
    """95 % are within 1.96 sds of a prediction; with the scatter as it is, 70 and 82 %."""
    rng, within = np.random.default_rng(10), []
    for _ in range(200):
        true, fleet = cameras(rng, specimens + 1, 0.1 * SCATTER)
        kind = ThermalCamera(type_model(fleet[1:], "rpi"))
        for temperature in (T0, T0 + 15.0):
            state = kind.at(temperature)
            c = true[0, 0] + (temperature - T0) * true[0, 1]
            within.append(abs(state.interior.c - c) < 1.96 * state.sd["c"])
    # two temperatures share the level: 400 decisions scatter by 0.015
    assert np.mean(within) == pytest.approx(0.95, abs=0.04)


@pytest.mark.slow
def test_only_odd_specimens_are_found():
    rng = np.random.default_rng(7)
    C = np.diag((0.1 * SCATTER) ** 2)
    false, seen = [], []
    for _ in range(200):
        found, covariances = rng.multivariate_normal(TYPE, BETWEEN + C, 10), np.array([C] * 10)
        false.append(odd_specimens(found, covariances) < 0.01)
        found[3, 1] += 10 * SCATTER[1]
        seen.append(odd_specimens(found, covariances)[3] < 0.01)
    assert np.mean(false) <= 0.01
    assert np.mean(seen) >= 0.95


def test_models_of_different_kinds_are_refused():
    _, fleet = cameras(np.random.default_rng(9), 4, 0.1 * SCATTER)
    kind = type_model(fleet, "rpi")
    with pytest.raises(DataError, match="not alike"):
        shrink_to_type(replace(fleet[0], T0=20.0), kind)
    with pytest.raises(DataError, match="not alike"):
        type_model([fleet[0], replace(fleet[1], T0=11.0)], "x")
    with pytest.raises(DataError, match="at least two"):
        type_model(fleet[:1], "x")


def new_world(seed):
    """Return the type of ten cameras, and the simulated full cycle of an eleventh.

    Their lags do not correlate with anything that rest shows.
    """
    between = np.diag(SCATTER**2)
    _, (new, *others) = cameras(np.random.default_rng(seed), 11, FULL_CYCLE, between)
    cycle = preset_simulation("rpi-v2.1-heating", 3)
    model = replace(cycle.model, camera="new", rates=new.rates, effects=new.effects)
    return type_model(others, "rpi-v2.1"), replace(cycle, model=model)


def at_three_temperatures(cycle, interval, epochs, seed=5):
    """Simulate the camera in a chamber at 22, 32 and 44 °C; a step takes minutes."""
    steps = Course.steps([0.0, 1500.0, 3000.0, 9000.0], [22.0, 32.0, 44.0])
    programme = replace(cycle.programme, epochs=epochs, interval=interval, initial=22.0,
                        boundaries={"ambient": steps}, sources={})  # fmt: skip
    return replace(cycle, programme=programme, seed=seed)


def at_rest_only(cycle, seed):
    """Reduce four frames at rest at each temperature; the thermometer is read in all epochs."""
    rows = {row + k for row in (26, 56, 116) for k in range(4)}
    chamber = at_three_temperatures(cycle, 50.0, 120, seed)
    epochs = [
        e if i in rows else replace(e, observations=None) for i, e in enumerate(chamber.epochs())
    ]
    return for_fit(epochs_input(cycle.head, cycle.field, epochs, "M1"))


@pytest.mark.slow
def test_three_temperatures_predict_nearly_as_well_as_the_full_cycle():
    """Twelve fleets of ten specimens and a new one, of which another recording is predicted.

    A running daemon also records the transitions between temperatures, which show the lag. Over 60
    fleets, the error over the full cycle's was 1.04 in the median and 1.11 at most; 95 % bands held
    94.5 %. With states of rest only, it was 1.6: the lag is the type's, the bands allow for that
    and held 95.5 %, and the result names such parameters.
    """
    held = {"way": [], "rest": []}
    pulls = {"way": [], "rest": []}
    for seed in range(12):
        kind, cycle = new_world([21, seed])
        other = reduced(replace(cycle, seed=1000 + seed))
        start = [ModelEffect("thermal_lag", {"tau": 80.0})]
        own = predicted_error(fit_thermal_model([reduced(cycle)], start, T0).model, other, 0.05)
        way = reduced(at_three_temperatures(cycle, 50.0, 90, 2000 + seed))
        for name, series in (("way", way), ("rest", at_rest_only(cycle, 3000 + seed))):
            fit = fit_with_type([series], kind)
            model, true = fit.model, cycle.model
            error = predicted_error(model, other, 0.05)
            held[name].append(error.coverage)
            tau = model.value("thermal_lag.tau") - true.value("thermal_lag.tau")
            pulls[name].append(tau / model.sd("thermal_lag.tau"))
            for rate, scatter in zip(NAMES[1:4], SCATTER[1:4], strict=True):
                assert abs(model.value(rate) - true.value(rate)) < 4 * model.sd(rate)
                assert model.sd(rate) < 0.2 * scatter
            weight = fit.fitted["type"]["weights"]["thermal_lag.tau"]
            assert ("show little of thermal_lag.tau" in " ".join(fit.lines())) is (name == "rest")
            if name == "way":
                assert error.rms_px <= 1.2 * own.rms_px
                assert weight < 0.05
            else:
                assert weight > 0.8
    assert np.mean(held["way"]) == pytest.approx(0.95, abs=0.015)
    assert np.mean(held["rest"]) == pytest.approx(0.95, abs=0.06)
    for found in pulls.values():
        assert 0.4 < np.sqrt(np.mean(np.square(found))) < 1.6


def test_a_wrong_type_is_refused(tmp_path):
    def error(*arguments):
        return str(answer("fit", tmp_path / "M1", "-o", "m", "--type", *arguments).exception)

    preset_simulation("rpi-v2.1-heating", 3).write(tmp_path / "M1")
    one, two = cameras(np.random.default_rng(1), 2, FULL_CYCLE)[1]
    write_model(tmp_path / "one.yaml", one)
    write_model(tmp_path / "type.yaml", type_model([one, two], "rpi"))
    assert "No such file" in error(tmp_path / "none.yaml")
    assert "not a type model" in error(tmp_path / "one.yaml")
    assert "give no others" in error(tmp_path / "type.yaml", "--t0", "20")
