"""Every effect, compared with its formula; the distortion while c changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.camera_model import (
    PARAMETER_NAMES,
    InteriorOrientation,
    Sensor,
)
from thermocald.physics import catalogue
from thermocald.physics.effect import Effect
from thermocald.physics.history import History
from thermocald.physics.model import ModelEffect, ThermalModel
from thermocald.physics.operators import play, play_turns
from thermocald.physics.testfields import corner_field

T0 = 25.0
NAMES = catalogue.names()


def history(epochs=400, step=5.0, fine=0.25, T=None, board=None):
    """Return a history with frames every 5 s, offset from finely spaced readings of a course."""
    t = np.arange(0.0, epochs * step, fine)
    course = T or (lambda s: T0 + 12.0 * np.sin(s / 300.0))
    other = board or (lambda s: T0 + 5.0 * np.cos(s / 170.0))
    readings = {"temperature": course(t), "board": other(t)}
    return History(np.arange(1.3, t[-1], step), t, readings, "temperature", T0)


def model(*listed, rates=None):
    """Return a model whose distortion does not follow c, so that courses simply add."""
    return ThermalModel(
        camera="test",
        sensor=Sensor(3280, 2464, 0.00112),
        T0=T0,
        interior=InteriorOrientation(c=3.0, A1=-0.004),
        rates=rates if rates is not None else {"c": 2e-4, "x0": -4e-4, "y0": 3e-4},
        effects=listed,
        distortion="image",
    )


def shift(h, *listed, rates=None):
    """Return what effects add to the base model's prediction, (E, 16)."""
    a = model(*listed, rates=rates).predict(h)
    b = model(rates=rates).predict(h)
    return np.hstack([a.iop - b.iop, a.eop - b.eop])


def column(name):
    return PARAMETER_NAMES.index(name)


OFF = {
    "thermal_lag": {"tau": 1e-6},
    "time_offset": {"d": 0.0},
    "hysteresis": {"half_width": 0.0},
    "second_heat_source": {"channel": "board"},
    "target_displacement": {"targets": ("x11",)},
}


@pytest.mark.parametrize("name", NAMES)
def test_an_effect_of_size_zero_changes_nothing(name):
    effect, h, field = catalogue.get(name), history(), corner_field("circles", 3, 200.0)
    values = {k: p.default for k, p in effect.nonlinear.items()}
    values |= dict.fromkeys(effect.usual, 0.0) | OFF.get(name, {})
    on, off = model(ModelEffect(name, values)).predict(h, field), model().predict(h, field)
    # a lag of a microsecond may change values by rate × tau × dT/dt = 1e-11 mm
    np.testing.assert_allclose(on.iop, off.iop, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(on.eop, off.eop)
    np.testing.assert_array_equal(on.noise_factor, 1.0)
    np.testing.assert_array_equal(on.points(field.points)[-1], field.points)


def sine(t):
    return 12.0 * np.sin(t / 300.0)


def lagging(t, tau):
    """Return the sine after a first-order lag."""
    wt = tau / 300.0
    late = np.sin(t / 300.0) - wt * np.cos(t / 300.0) + wt * np.exp(-t / tau)
    return 12.0 * late / (1.0 + wt**2)


def triangle(t):
    return 10.0 - np.abs(t / 50.0 - 10.0)  # up to 10 at 500 s, then down


@pytest.mark.parametrize(
    ("name", "values", "course", "expected", "atol"),
    [
        ("thermal_lag", {"tau": 84.0}, lambda t: 0.02 * t,
         lambda t: 0.02 * (t - 84.0 * (1 - np.exp(-t / 84.0))), 1e-10),
        ("thermal_lag", {"tau": 84.0}, sine, lambda t: lagging(t, 84.0), 2e-6),
        ("time_offset", {"d": 37.0}, sine, lambda t: sine(np.maximum(t - 37.0, 0.0)), 2e-6),
        ("hysteresis", {"half_width": 1.5}, triangle,
         lambda t: np.where(t < 500, np.maximum(triangle(t) - 1.5, 0.0),
                            np.minimum(8.5, triangle(t) + 1.5)), 1e-10),
    ],
)  # fmt: skip
def test_a_drive_follows_its_formula_and_moves_the_linear_terms(
    name, values, course, expected, atol
):
    h = history(epochs=190, T=lambda s: T0 + course(s))
    driven = expected(h.times)
    np.testing.assert_allclose(catalogue.get(name).drive(h, **values) - T0, driven, atol=atol)
    added = shift(h, ModelEffect(name, values))
    late = -4e-4 * (driven - course(h.times))
    np.testing.assert_allclose(added[:, column("x0")], late, atol=1e-8)
    assert np.all(added[:, [column(n) for n in PARAMETER_NAMES if n not in ("c", "x0", "y0")]] == 0)


# parameters, coefficients, and the course that they multiply
FORMULAS = {
    "nonlinear_expansion": ({}, {"c": 2e-6}, lambda t: sine(t) ** 2),
    "softening": ({"T_k": 30.0}, {"y0": 1e-4}, lambda t: np.maximum(sine(t) - 5.0, 0)),
    "thermal_gradient": ({}, {"x0": 0.02}, lambda t: 12 / 300 * np.cos(t / 300)),
    "permanent_set": ({}, {"x0": 1e-4}, lambda t: np.where(t < 150 * np.pi, sine(t), 12.0)),
    "self_heating": ({"tau": 240.0}, {"x0": 5e-3}, lambda t: 1 - np.exp(-t / 240)),
    "creep": ({}, {"x0": 1e-6, "y0": -2e-6}, lambda t: t),
    "slip": ({"time": 777.0}, {"x0": 3e-3}, lambda t: np.where(t >= 777, 1.0, 0)),
    "cyclic_interference": (
        {"P": 130.0, "phase": 0.7}, {"x0": 1e-3}, lambda t: np.sin(2 * np.pi * t / 130 + 0.7)),
    "second_heat_source": ({"channel": "board"}, {"c": 1e-4}, lambda t: 5 * np.cos(t / 170)),
    "housing_tilt": ({}, {"phi": 1e-5}, sine),
    "mount_motion": ({}, {"phi": 1e-5, "Z0": 2e-3}, sine),
    "mount_motion later": (
        {"tau": 400.0}, {"kappa": 1e-5, "X0": 3e-3}, lambda t: lagging(t, 400.0)),
    "radial_distortion_drift": ({}, {"A1": 1e-5, "A2": 2e-6}, sine),
    "decentering_drift": ({}, {"B1": 1e-6}, sine),
    "affinity_drift": ({}, {"C2": 1e-6}, sine),
}  # fmt: skip


@pytest.mark.parametrize("name", FORMULAS)
def test_signal_follows_its_formula(name):
    values, coefficients, expected = FORMULAS[name]
    h = history()
    added = shift(h, ModelEffect(name.split()[0], {**values, **coefficients}))
    for parameter in PARAMETER_NAMES:
        course = coefficients.get(parameter, 0.0) * expected(h.times)
        scale = max(1e-12, np.abs(course).max())
        np.testing.assert_allclose(added[:, column(parameter)] / scale, course / scale, atol=3e-6)


def test_defocus_scales_noise_and_blur():
    h = history(T=lambda s: T0 + 0.01 * s)
    p = model(ModelEffect("defocus", {"factor": 0.125})).predict(h)
    np.testing.assert_allclose(p.noise_factor, 1 + 0.125 * 0.01 * h.times, rtol=1e-12)
    np.testing.assert_array_equal(p.blur_factor, p.noise_factor)
    np.testing.assert_array_equal(p.iop, model().predict(h).iop)


def test_test_field_expansion_scales_each_axis():
    h, field = history(T=lambda s: T0 + 0.01 * s), corner_field("circles", 3, 200.0)
    p = model(ModelEffect("test_field_expansion", {"X": 2e-5, "Z": -1e-5})).predict(h, field)
    rise = 0.01 * h.times[-1]
    expected = field.points * [1 + 2e-5 * rise, 1.0, 1 - 1e-5 * rise]
    np.testing.assert_allclose(p.points(field.points)[-1], expected, rtol=1e-13)


def test_target_displacement_moves_only_its_targets():
    h, field = history(), corner_field("circles", 3, 200.0)
    values = {"time": 500.0, "targets": ("x12", "z33"), "dX": 0.2, "dY": -0.1}
    moved = model(ModelEffect("target_displacement", values)).predict(h, field)
    change = moved.points(field.points) - field.points
    rows = [field.index["x12"], field.index["z33"]]
    late = h.times >= 500.0
    expected = np.broadcast_to([0.2, -0.1, 0], (late.sum(), 2, 3))
    np.testing.assert_allclose(change[np.ix_(late, rows)], expected, atol=1e-12)
    assert np.all(change[~late] == 0)
    assert np.all(np.delete(change, rows, axis=1) == 0)
    with pytest.raises(ConfigurationError, match="no target 'nobody'"):
        model(ModelEffect("target_displacement", {**values, "targets": "nobody"})).predict(h, field)


READING = [n for n in NAMES if catalogue.get(n).kind != "image" or n == "defocus"]


@pytest.mark.parametrize("name", READING)
@pytest.mark.parametrize("coarse", [False, True])
def test_sensitivity_is_the_derivative(name, coarse):
    """The matrix equals differences; missing readings have no column."""
    rng = np.random.default_rng(3)
    step = 10.0 if coarse else 1.0
    t = np.arange(0, 70) * step + rng.uniform(-0.4, 0.4, 70) * step
    T = T0 + 10 * np.sin(t / t[-1] * 9) + 0.05 * rng.standard_normal(70)
    T[[7, 8, 60]] = np.nan
    frames = np.arange(0, 70) * step
    h = History(frames, t, {"temperature": T, "board": T[::-1].copy()}, "temperature", T0)
    effect = catalogue.get(name)
    values = {k: p.default for k, p in effect.nonlinear.items() if not p.text}
    values.pop("phase", None)
    if name == "second_heat_source":
        values["channel"] = "board"
    exact = effect.sensitivity(h, **values).toarray()
    by_differences = Effect.sensitivity(effect, h, **values).toarray()
    np.testing.assert_allclose(exact, by_differences, atol=5e-6)


def test_two_drives_are_applied_in_order():
    h = history()
    both = model(
        ModelEffect("time_offset", {"d": 20.0}), ModelEffect("thermal_lag", {"tau": 60.0})
    ).drive(h)
    delayed = history(T=lambda s: T0 + 12 * np.sin(np.maximum(s - 20.0, 0) / 300.0))
    lagged = catalogue.get("thermal_lag").drive(delayed, tau=60.0)
    np.testing.assert_allclose(both, lagged, atol=1e-5)


def test_sentences():
    lag, play = catalogue.get("thermal_lag"), catalogue.get("hysteresis")
    sentence = lag.sentence({"tau": {"value": 84.13, "sd": 1.92, "unit": "s"}})
    assert sentence == "the camera follows the thermometer with a lag of 84.1 ± 1.9 s"
    late = {"tau": {"value": 400.0, "sd": 9.0, "unit": "s"}}
    assert "with a lag of 400.0 ± 9.0 s" in catalogue.get("mount_motion").sentence(late)
    assert lag.experiment_against(play) == (
        "hold the lamp at 45 °C for 20 minutes: a thermal lag settles, hysteresis does not settle: "
        "it stays where it is"
    )
    for a in NAMES:
        for b in NAMES:
            assert a == b or catalogue.get(a).experiment_against(catalogue.get(b))


def test_a_play_is_uncertain_only_at_both_ends_of_its_rest():
    knots = np.arange(0.0, 400.0, 10.0)
    T = np.interp(knots, [0.0, 200.0, 390.0], [0.0, 20.0, 1.0])  # up and down by 0.1 K/s
    rest = play(knots, T, 3.0, knots)
    resting = np.flatnonzero((rest == rest[20]) & (knots > 200.0))  # 60 s: 6 K to the other side
    near = np.flatnonzero(play_turns(knots, T, 3.0, knots))
    assert set(near) == {resting[0], resting[1], resting[-2], resting[-1], resting[-1] + 1}


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
