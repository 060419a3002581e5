"""The thermal camera: equal results from all methods, covariance against draws, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import thermocald as tc
from thermocald.analysis.camera.undistortion import ideal_points
from thermocald.analysis.thermal.correction import correct_points
from thermocald.analysis.thermal.modelled_camera import ExtrapolationWarning
from thermocald.analysis.thermal.predictions import predict_along, warm_up
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.errors import DataError, UsageError
from thermocald.photogrammetry.camera.camera_model import InteriorOrientation, Sensor, rays
from thermocald.physics.model import ModelEffect
from thermocald.physics.testfields import demonstration_field, demonstration_model
from thermocald.store.logger.temperatures import TemperatureLog


def thermal_model(*listed):
    model = demonstration_model(demonstration_field("plain"))
    sds = {"interior.c": 2e-4, "interior.x0": 3e-4, "interior.y0": 3e-4, "rates.c": 6e-7,
           "rates.x0": 1e-6, "rates.y0": 1e-6}  # fmt: skip
    return replace(model, effects=listed, sds=sds, validity={"temperature": (20.0, 50.0)})


LISTED = (
    ModelEffect("thermal_lag", {"tau": 80.0}, {"tau": 2.0}),
    ModelEffect("nonlinear_expansion", {"c": 1e-6, "x0": -2e-6}, {"c": 1e-8, "x0": 2e-8}),
    ModelEffect("softening", {"T_k": 38.0, "x0": 3e-5}, {"T_k": 0.3, "x0": 1e-6}),
    ModelEffect("radial_distortion_drift", {"A1": 3e-6}, {"A1": 1e-7}),
    ModelEffect("hysteresis", {"half_width": 0.5}, {"half_width": 0.05}),
    ModelEffect("thermal_gradient", {"x0": 1e-3}, {"x0": 1e-5}),
)
FORMULA = ModelEffect("square(offset(lag(temperature, tau), k))", {"tau": 99.0, "k": 30.5,
                      "y0": 2e-6}, {"tau": 1.0, "k": 0.3, "y0": 1e-8})  # fmt: skip


@pytest.mark.parametrize("T", [22.0, 25.0, 37.9, 44.0])
def test_the_steady_state_is_the_end_of_a_long_history(T):
    camera = ThermalCamera(thermal_model(*LISTED, FORMULA))
    now = camera.at(T)
    along = camera.along([0.0, 5e4, 1e5], [T, T, T])
    assert along[-1].name == camera.model.camera
    np.testing.assert_allclose(along.values[-1], now.values, rtol=0, atol=1e-14)
    np.testing.assert_allclose(along.covariance[-1], now.covariance, rtol=1e-6, atol=1e-22)


def test_the_noise_of_readings_against_draws():
    """A gradient magnifies it (the stated sd was 20 times too small), a lag averages it."""
    camera, rng = ThermalCamera(thermal_model(*LISTED, FORMULA)), np.random.default_rng(3)
    times, at, sd, then = np.arange(0.0, 1500.0, 10.0), np.arange(605.0, 1400.0, 90.0), 0.02, 500.0
    T = 25.0 + 15.0 * (1.0 - np.exp(-times / 600.0))
    drawn = np.array([
        camera.along(times, T + rng.normal(0.0, sd, len(T)), [*at, then]).values for _ in range(150)
    ])  # fmt: skip
    for since, values in ((None, drawn[:, :-1]), (then, drawn[:, :-1] - drawn[:, -1:])):
        with_noise, without = (camera.along(times, T, at, temperature_sd=s, since=since).covariance
                               for s in (sd, 0.0))  # fmt: skip
        stated = np.sqrt(np.diagonal(with_noise - without, axis1=1, axis2=2))[:, :4]
        scatter = np.std(values, axis=0)[:, :4] / stated
        np.testing.assert_allclose(np.sqrt(np.mean(scatter**2, axis=0)), 1.0, atol=0.08)


def test_covariance_against_draws():
    """400 models are drawn with the file's standard deviations."""
    model = thermal_model(*LISTED)
    camera = ThermalCamera(model)
    state, names = camera.at(43.0), camera.parameters
    draws = np.random.default_rng(5).standard_normal((400, len(names)))
    draws *= np.sqrt(np.diag(camera.covariance))
    values = []
    for draw in draws:
        drawn = {n: model.value(n) + d for n, d in zip(names, draw.tolist(), strict=True)}
        values.append(ThermalCamera(model.with_values(drawn)).at(43.0).values)
    scatter = np.std(values, axis=0, ddof=1)
    stated = np.sqrt(np.diag(state.covariance))
    free = stated > 0
    # 400 draws give a standard deviation to 3.5 %; the bound is three of those
    np.testing.assert_allclose(scatter[free] / stated[free], 1.0, atol=0.11)


def test_undistort_is_exact():
    """A polynomial that folds outside the image circle has no fast inverse."""
    state = ThermalCamera(thermal_model(*LISTED)).at(33.0)
    points = np.random.default_rng(2).uniform([0, 0], [3279, 2463], (30_000, 2))
    folding = Sensor(1000, 800, 0.004), InteriorOrientation(c=3.0, A1=-0.055).as_array()
    for sensor, iop, seen in (
        (state.sensor, state.values, points), (*folding, points[:300] * 0.1 + [350, 250])
    ):  # fmt: skip
        r = rays(sensor, iop, seen)
        found = ideal_points(sensor, iop, seen)
        np.testing.assert_allclose(found, r[:, :2] / -r[:, 2:], rtol=0, atol=1e-12)
    back = state.as_seen_by(points, InteriorOrientation(state.interior.c))
    np.testing.assert_allclose(state.undistort(points), back, rtol=0, atol=1e-7)


def test_outside_the_validity_it_warns_or_refuses():
    """Standard deviations there grow by the whole drift."""
    camera = ThermalCamera(thermal_model())
    inside = camera.at(50.0)
    with pytest.warns(ExtrapolationWarning, match=r"4\.0 K outside the 20 to 50 °C"):
        outside = camera.at(54.0)
    assert outside.extrapolated == pytest.approx(4.0)
    assert outside.sd["x0"] > np.hypot(inside.sd["x0"], 4 * 4.5e-4) * 0.99
    with pytest.warns(ExtrapolationWarning):
        along = camera.along([0.0, 10.0], [45.0, 54.0])
    assert along.extrapolated.tolist() == [0.0, 4.0]
    with pytest.raises(UsageError, match="set `extrapolate`"):
        camera.at(-20.0)
    with pytest.warns(ExtrapolationWarning):
        assert camera.at(-20.0, extrapolate=True).sd["c"] > 40 * 2e-4 * 0.99
    bent = ThermalCamera(thermal_model(*LISTED))
    with pytest.warns(ExtrapolationWarning):  # by the drift of all effects, not of the rates alone
        along = bent.along([0.0, 1e5], [53.0, 53.0]).sd[1, :4]
    with pytest.warns(ExtrapolationWarning):
        at = bent.at(53.0).covariance
    np.testing.assert_allclose(along**2, at.diagonal()[:4], rtol=1e-6)


def test_missing_readings_are_refused():
    """Also those of a second thermometer, and no NumPy number is."""
    heated = ModelEffect("second_heat_source", {"channel": "board", "c": 1e-5})
    camera, two = (ThermalCamera(thermal_model(*effects)) for effects in (LISTED, [heated]))
    with pytest.raises(UsageError, match="temperature is nan: give one in °C"):
        camera.at(float("nan"))
    for times, temperatures, at in (([], [], None), ([0.0, 1.0], [25.0], None), ([0], [25], [])):
        with pytest.raises(UsageError, match="for each time"):
            camera.along(times, temperatures, at)
    with pytest.raises(UsageError, match="no reading"):
        camera.live().update(0.0, {})
    assert camera.live().update(0.0, np.float32(25.0)).temperature == 25.0
    with pytest.raises(DataError, match="'board': give its temperature"):
        two.at(30.0)
    a, b = (two.at(30.0, channels={"board": T}).interior.c for T in (45.0, 25.0))
    assert a - b == pytest.approx(20 * 1e-5)


def test_a_camera_with_two_thermometers():
    """The noise of both is propagated, each with its own size; steady, both are as warm."""
    heated = ModelEffect("second_heat_source", {"channel": "board", "c": 1e-5, "x0": 1e-4})
    fitted = {"thermometer_sd_K": 0.1, "other_sds_K": {"board": 0.4}}
    camera = ThermalCamera(replace(thermal_model(heated), fitted_on=(fitted,)))
    log = [0.0, 60.0], {"temperature": [25.0, 30.0], "board": [35.0, 40.0]}
    own, other = camera.model.rate_vector[:3], np.array([1e-5, 1e-4, 0.0])
    wanted = 0.2**2 * np.outer(own, own) + 0.8**2 * np.outer(other, other)
    a, b = (camera.along(*log, temperature_sd=sd).covariance[1] for sd in (0.0, 0.2))
    c, d = (camera.at(30.0, sd, {"board": 40.0}).covariance for sd in (0.0, 0.2))
    for change in (b - a, d - c):
        np.testing.assert_allclose(change[:3, :3], wanted, rtol=1e-6)
    product = ModelEffect("product(offset(temperature, 25.0), offset(board, 25.0))", {"x0": 1e-5})
    both = ThermalCamera(replace(thermal_model(product), fitted_on=(fitted,)))
    a, b = (both.along(*log, temperature_sd=sd).covariance[1, 1, 1] for sd in (0.0, 0.2))
    by_both = (0.2 * (own[1] + 15e-5)) ** 2 + (0.8 * 5e-5) ** 2
    assert b - a == pytest.approx(by_both, rel=1e-6)
    T0, point = np.full(2, camera.model.T0), np.array([[1500.0, 1200.0]])
    for warmer in (0.0, 20.0):  # correcting raised DataError
        table = TemperatureLog(np.array([0.0, 9.0]), {"temperature": T0, "board": T0 + warmer})
        found, sds, *_ = correct_points(camera, table, np.array([5.0]), point, None, 0.2)
        assert sds[0, 0] == pytest.approx(0.2 * np.hypot(own[1], 4e-4) / 0.00112 / 2**0.5, rel=0.1)
        moved = found - point
        assert moved[0, 0] == pytest.approx(-warmer * 1e-4 / 0.00112, abs=0.02)
    live = camera.live()
    live.update(0.0, {"temperature": T0[0], "board": T0[0]})
    assert np.ptp(live.maps()[0] - live.maps()[0][0]) < 1e-3
    assert "the drift since" in str(tc.predict(camera, 30.0, channels={"board": 45.0}))


def test_the_object_error_equals_differences():
    state, change = ThermalCamera(thermal_model()).at(30.0), 1e-3 * np.eye(10)[1]
    only_x0 = replace(state, covariance=np.outer(change, change))
    moved = replace(state, values=state.values + change)
    found, expected = only_x0.object_error(10_000.0), moved.object_distance(state, 10_000.0)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert found[4] == pytest.approx(1e-3 / state.interior.c * 10_000.0, rel=1e-3)


def test_warm_up_time_of_an_exponential():
    camera = ThermalCamera(thermal_model())
    t = np.arange(0.0, 3000.0, 5.0)
    T = 25.0 + 20.0 * (1 - np.exp(-t / 300.0))
    steady_from, error = warm_up(camera.along(t, T), 10_000.0, 2.0)
    worst = error[0]
    assert worst > 20.0
    assert steady_from == pytest.approx(300.0 * np.log(worst / 2.0), abs=6.0)
    still_moving, _ = warm_up(camera.along(t[:60], T[:60]), 10_000.0, 0.1)
    assert still_moving is None


def test_a_model_that_does_not_settle_has_a_certificate_without_a_curve():
    """It was refused, as was correcting with a formula, with a request for a log that was given."""
    camera = ThermalCamera(thermal_model(ModelEffect("integral(temperature)", {"c": 1e-9})))
    assert "Change of the camera with its temperature" not in camera.page()
    assert "Change of the camera" in ThermalCamera(thermal_model(FORMULA)).page()
    with pytest.raises(DataError, match="no steady camera to predict or to correct to"):
        camera.plot()
    board = ThermalCamera(thermal_model(ModelEffect("above(board, k)", {"k": 30.0, "y0": 1e-5})))
    with pytest.raises(DataError, match="'board': give its temperature"):
        board.at(30.0)
    a, b = (board.at(30.0, channels={"board": T}).interior.y0 for T in (40.0, 25.0))
    assert a - b == pytest.approx(10 * 1e-5)


def test_a_formula_with_a_decimal_point_is_predicted_along_a_log(tmp_path):
    series = tc.simulate("rpi-v2.1-heating", seed=1, epochs=60)
    camera = tc.fit(series, effects=["above(temperature, 30.5):c"])
    log = np.arange(0, 100, 10.0), np.linspace(25, 40, 10)
    along = camera.along(*log)
    assert (along.sd[:, 0] > 0).all()
    camera.save(tmp_path / "camera.yaml")
    again = tc.load_camera(tmp_path / "camera.yaml").along(*log)
    np.testing.assert_allclose(again.values, along.values, rtol=1e-9)


@pytest.mark.parametrize("formula", [False, True])
def test_a_dead_thermometer_is_not_followed_for_ever(formula):
    """The last reading stands in for ten intervals; one warning outside the fit's range."""
    model = replace(thermal_model(), validity={"temperature": (20.0, 30.0)})
    live = ThermalCamera(model).live()
    live.keeps_all = formula
    for k in range(3):
        live.update(10.0 * k, 25.0)
    assert live.update(120.0, float("nan")).temperature == 25.0
    with pytest.raises(DataError, match="temperature gave no reading for 980 s"):
        live.update(1000.0, float("nan"))
    with pytest.warns(ExtrapolationWarning) as said:
        assert live.update(1010.0, 32.0).temperature == 32.0
    assert len(said) == 1


def test_nothing_is_predicted_in_a_gap_of_the_log():
    """A reading that failed is interpolated, a quarter of an hour of them is not."""
    times, temperatures = 10.0 * np.arange(120), np.linspace(25.0, 35.0, 120)
    temperatures[5], temperatures[20:110] = np.nan, np.nan
    log = TemperatureLog(times, {"temperature": temperatures})
    with pytest.warns(UserWarning, match="90 of 120 times are in a gap"):
        rows = predict_along(ThermalCamera(thermal_model()), log, False).document["rows"]
    assert [row[0] for row in rows] == [*times[:20], *times[110:]]


def test_a_model_that_no_fit_has_tested_is_not_judged():
    """Its page said that the residuals show no missing effect."""
    assert "smooth trajectories" not in ThermalCamera(thermal_model()).page()
