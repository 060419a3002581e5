"""Every effect, compared with its formula; the distortion while c changes."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

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
RATES = {"c": 2e-4, "x0": -4e-4, "y0": 3e-4}


def sine(t):
    return 12.0 * np.sin(t / 300.0)


def history(course=sine):
    """Return a history with frames every 5 s, offset from finely spaced readings of a course."""
    t = np.arange(0.0, 2000.0, 0.25)
    readings = {"temperature": T0 + course(t), "board": T0 + 5.0 * np.cos(t / 170.0)}
    return History(np.arange(1.3, t[-1], 5.0), t, readings, "temperature", T0)


def model(*effects, **changes):
    """Return a model whose distortion does not follow c, so that courses simply add."""
    interior = InteriorOrientation(c=3.0, A1=-0.004)
    sensor = Sensor(3280, 2464, 0.00112)
    plain = ThermalModel("test", sensor, T0, interior, RATES, effects=effects, distortion="image")
    return replace(plain, **changes)


def lagging(t, tau):
    """Return the sine after a first-order lag."""
    wt = tau / 300.0
    late = np.sin(t / 300.0) - wt * np.cos(t / 300.0) + wt * np.exp(-t / tau)
    return 12.0 * late / (1.0 + wt**2)


def with_play(t):
    """Return the sine after a play of ± 1.5 K."""
    up, down = np.maximum(sine(t) - 1.5, 0.0), np.minimum(sine(t) + 1.5, 10.5)
    again = np.maximum(sine(t) - 1.5, -10.5)
    return np.select([t < 150 * np.pi, t < 450 * np.pi], [up, down], again)


# parameters, coefficients, and the course that they multiply; drives move the linear terms
FORMULAS = {
    "thermal_lag": ({"tau": 84.0}, RATES, lambda t: lagging(t, 84.0) - sine(t)),
    "time_offset": ({"d": 37.0}, RATES, lambda t: sine(np.maximum(t - 37.0, 0.0)) - sine(t)),
    "hysteresis": ({"half_width": 1.5}, RATES, lambda t: with_play(t) - sine(t)),
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


def test_every_effect_has_its_formula_here():
    of_points_and_noise = {"defocus", "test_field_expansion", "target_displacement"}
    assert {name.split()[0] for name in FORMULAS} | of_points_and_noise == set(NAMES)


@pytest.mark.parametrize("name", FORMULAS)
def test_an_effect_adds_its_formula_to_its_parameters_alone(name):
    values, coefficients, expected = FORMULAS[name]
    h, own = history(), {} if coefficients is RATES else coefficients
    on = model(ModelEffect(name.split()[0], {**values, **own})).predict(h)
    off = model().predict(h)
    added = np.hstack([on.iop - off.iop, on.eop - off.eop])
    for column, parameter in enumerate(PARAMETER_NAMES):
        course = coefficients.get(parameter, 0.0) * expected(h.times)
        scale = max(1e-12, np.abs(course).max())
        np.testing.assert_allclose(added[:, column] / scale, course / scale, atol=3e-6)
    np.testing.assert_array_equal(on.noise_factor, 1.0)


def test_effects_in_image_and_object_space_change_nothing_else():
    h, field = history(lambda t: 0.01 * t), corner_field("circles", 3, 200.0)
    off, rise = model().predict(h, field), 0.01 * h.times
    defocus = model(ModelEffect("defocus", {"factor": 0.125})).predict(h, field)
    np.testing.assert_allclose(defocus.noise_factor, 1 + 0.125 * rise, rtol=1e-12)
    np.testing.assert_array_equal(defocus.blur_factor, defocus.noise_factor)
    axes = {"X": 2e-5, "Z": -1e-5}
    grown = model(ModelEffect("test_field_expansion", axes)).predict(h, field)
    expected = field.points * [1 + 2e-5 * rise[-1], 1.0, 1 - 1e-5 * rise[-1]]
    np.testing.assert_allclose(grown.points(field.points)[-1], expected, rtol=1e-13)
    for found in (defocus, grown):
        np.testing.assert_array_equal(found.iop, off.iop)


def test_target_displacement_moves_only_its_targets():
    h, field = history(), corner_field("circles", 3, 200.0)
    values = {"time": 500.0, "targets": ("x12", "z33"), "dX": 0.2, "dY": -0.1}
    moved = model(ModelEffect("target_displacement", values)).predict(h, field)
    expected = np.zeros((len(h.times), *field.points.shape))
    late = h.times >= 500.0
    for name in values["targets"]:
        expected[late, field.index[name]] = 0.2, -0.1, 0.0
    np.testing.assert_allclose(moved.points(field.points) - field.points, expected, atol=1e-12)
    with pytest.raises(ConfigurationError, match="no target 'nobody'"):
        model(ModelEffect("target_displacement", {**values, "targets": "nobody"})).predict(h, field)


READING = [n for n in NAMES if catalogue.get(n).kind != "image" or n == "defocus"]


@pytest.mark.parametrize("name", READING)
@pytest.mark.parametrize("step", [1.0, 10.0])
def test_sensitivity_is_the_derivative(name, step):
    """The matrix equals differences; missing readings have no column."""
    rng = np.random.default_rng(3)
    t = np.arange(0, 70) * step + rng.uniform(-0.4, 0.4, 70) * step
    T = T0 + 10 * np.sin(t / t[-1] * 9) + 0.05 * rng.standard_normal(70)
    T[[7, 8, 60]] = np.nan
    frames = np.arange(0, 70) * step
    h = History(frames, t, {"temperature": T, "board": T[::-1].copy()}, "temperature", T0)
    effect = catalogue.get(name)
    values = {k: "board" if p.text else p.default for k, p in effect.nonlinear.items()}
    values.pop("phase", None)
    exact = effect.sensitivity(h, **values).toarray()
    by_differences = Effect.sensitivity(effect, h, **values).toarray()
    np.testing.assert_allclose(exact, by_differences, atol=5e-6)


def test_two_drives_are_applied_in_order():
    both = model(
        ModelEffect("time_offset", {"d": 20.0}), ModelEffect("thermal_lag", {"tau": 60.0})
    ).drive(history())
    delayed = history(lambda s: sine(np.maximum(s - 20.0, 0)))
    lagged = catalogue.get("thermal_lag").drive(delayed, tau=60.0)
    np.testing.assert_allclose(both, lagged, atol=1e-5)


def test_a_mount_that_moves_later_is_said_with_its_lag():
    late = {"tau": {"value": 400.0, "sd": 9.0, "unit": "s"}}
    assert "with a lag of 400.0 ± 9.0 s" in catalogue.get("mount_motion").sentence(late)


def test_every_pair_of_effects_has_an_experiment():
    lag, play = catalogue.get("thermal_lag"), catalogue.get("hysteresis")
    assert lag.experiment_against(play) == (
        "hold the lamp at 45 °C for 20 minutes: a thermal lag settles, hysteresis does not settle: "
        "it stays where it is"
    )
    for a, b in permutations(NAMES, 2):
        assert catalogue.get(a).experiment_against(catalogue.get(b))


def test_a_play_is_uncertain_only_at_both_ends_of_its_rest():
    knots = np.arange(0.0, 400.0, 10.0)
    T = np.interp(knots, [0.0, 200.0, 390.0], [0.0, 20.0, 1.0])  # up and down by 0.1 K/s
    rest = play(knots, T, 3.0, knots)
    resting = np.flatnonzero((rest == rest[20]) & (knots > 200.0))  # 60 s: 6 K to the other side
    near = np.flatnonzero(play_turns(knots, T, 3.0, knots))
    assert set(near) == {resting[0], resting[1], resting[-2], resting[-1], resting[-1] + 1}


def opencv(iop):
    """Convert to OpenCV's k1, k2, k3, p1, p2 (E, 5)."""
    c, A, B = iop[:, :1], iop[:, 3:6], iop[:, 6:8]
    return np.hstack([A * c ** np.array([2, 4, 6]), -B[:, 1:] * c, B[:, :1] * c])


def test_opencvs_constants_stay_while_c_changes_and_a_drift_adds_to_them():
    base = InteriorOrientation(3.0, A1=-4e-3, A2=5e-4, A3=-2e-5, B1=1e-4, B2=-2e-4, C1=1e-3)
    still = model(interior=base, rates={**RATES, "c": 1e-3})
    h, constants = history(), base.as_array()
    iop = still.predict(h).iop
    np.testing.assert_array_equal(iop[:, 3:], np.tile(constants[3:], (len(iop), 1)))
    drift = ModelEffect("radial_distortion_drift", {"A1": 1e-5})
    expected = np.tile(opencv(constants[None]), (len(iop), 1))
    expected[:, 0] += 1e-5 * (h.temperature() - T0) * base.c**2
    found = replace(still.with_effect(drift), distortion="angle").predict(h).iop
    assert np.ptp(found[:, 0]) > 0.02
    np.testing.assert_allclose(opencv(found), expected, rtol=1e-12)
