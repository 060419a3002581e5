"""A fit that lacks an effect reports it, widens its standard deviations, and states no band."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.audit_thermal import rate_errors, seen
from tests.analysis.test_thermal_model import LAG, for_fit, misread, reduced, run, simulated
from tests.marks import mostly_slow
from thermocald.analysis.thermal.certificate import model_lines
from thermocald.analysis.thermal.prediction_test import predicted_error
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.analysis.thermal.thermal_model import fit_thermal_model
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.physics import catalogue
from thermocald.physics.effect import Effect, coefficient_units
from thermocald.physics.model import ModelEffect

SIZE = {"c": 3e-4, "x0": 6e-4, "y0": -4e-4}
NOISE_PX = 0.04


class Outside(Effect):
    """An effect outside the catalogue, named by the function of its course."""

    kind = "signal"
    noun = "something else"
    linear = coefficient_units("1")
    usual = ("c", "x0", "y0")

    def __init__(self, course):
        self.name, self.course = course.__name__, course

    def signal(self, history, **_):
        return self.course(history)[:, None]


def tanh(history):
    return np.tanh((history.temperature() - 38.0) / 5.0)


def signed_square(history):
    rate = np.gradient(history.temperature(), history.times) / 0.03
    return np.sign(rate) * rate**2


def integral(history):
    steps = np.diff(history.times, prepend=history.times[0])
    return np.cumsum((history.temperature() - history.T0) * steps) / 1e4


def exposure(history):
    """Return a step with the lamp, like an exposure that depends on light."""
    rate = np.gradient(history.temperature(), history.times)
    return 1.0 / (1.0 + np.exp(-(rate - 0.01) / 0.002))


def quadratic(history):
    return (history.temperature() - history.T0) ** 2 / 60


OTHERS = (exposure, quadratic)

CASES = {
    "lag": ("thermal_lag", {"tau": 120.0}),
    "tanh": ("tanh", SIZE),
    "signed_square": ("signed_square", SIZE),
    "integral": ("integral", SIZE),
}


@pytest.fixture
def outside(monkeypatch):
    """Add effects to the catalogue that no fit includes."""
    own = {c.__name__: Outside(c) for c in (tanh, signed_square, integral, *OTHERS)}
    inside = catalogue.get
    monkeypatch.setattr(catalogue, "get", lambda name: own.get(name) or inside(name))


@pytest.mark.parametrize("name", mostly_slow(CASES, "lag", "tanh"))
def test_a_camera_outside_the_family(outside, name):
    """The base model is fitted to M1; for M2, heated differently, no false band is stated."""
    effect = ModelEffect(*CASES[name])
    first = simulated(1, "M1", listed=(effect,))
    second = simulated(51, "M2", listed=(effect,), power=6.5)

    f = fit_thermal_model([reduced(first)], [])
    error = predicted_error(f.model, reduced(second), f.fitted["series"][0].thermometer_sd)

    assert f.model.evidence["fit"]["effect_missing"]
    assert f.model.evidence["fit"]["misfit_px"] > 2 * 0.004
    assert f.model.misses_an_effect
    # the missing effect is not attributed to the noise of image or thermometer
    assert abs(f.fitted["sigma0"] - 1.0) < 0.03
    assert f.fitted["series"][0].thermometer_sd < 0.06
    assert error.floor_px < 1.2 * NOISE_PX
    assert error.rms_px > 2 * error.floor_px
    assert np.isnan(error.coverage)
    if name != "tanh":  # its linear part adds to the rates
        for n in ("c", "x0", "y0"):
            assert abs(f.model.rates[n] - first.model.rates[n]) < 3 * f.model.sd(f"rates.{n}"), n


@pytest.mark.slow
@pytest.mark.parametrize("course", OTHERS)
def test_no_false_band_is_stated(outside, course):
    """For effects from hardly visible to large, a band holds at least 90 %, or none is stated."""
    for k, size in enumerate((0.03, 0.3)):
        effect = ModelEffect(course.__name__, {n: v * size for n, v in SIZE.items()})
        first = simulated(100 + k, "M1", listed=(effect,))
        second = simulated(151 + k, "M2", listed=(effect,), power=6.5)
        f = fit_thermal_model([reduced(first)], [])
        error = predicted_error(f.model, reduced(second), f.fitted["series"][0].thermometer_sd)
        assert np.isnan(error.coverage) or error.coverage > 0.9
        assert f.model.evidence["fit"]["effect_missing"] or error.rms_px < 1.1 * error.floor_px


@pytest.mark.slow
def test_a_misfit_too_small_for_an_effect_is_stated(tmp_path):
    """The preset's distortion also drifts: 0.015 px, which no 95 % band leaves out."""
    recording, page = tmp_path / "M1", tmp_path / "page.html"
    run("simulate", "--preset", "rpi-v2.1-heating", "--seed", "31", "-o", recording)
    fitted = run(
        "fit", recording, "-o", tmp_path / "m.yaml", "--effect", "permanent_set", "--report", page
    )
    left = "smooth trajectories of 0.01"
    assert "valid from" in fitted.stdout
    assert f"left over: {left}" in fitted.stdout
    assert f"Left over: {left}" in page.read_text()


def test_the_commands_report_it(tmp_path):
    for k, name in enumerate(("M1", "M2")):
        simulated(k, name, listed=(ModelEffect(*CASES["lag"]),)).write(tmp_path / name)
    model = tmp_path / "camera.yaml"
    fitted = run("fit", tmp_path / "M1", "-o", model, "--json", tmp_path / "fit.json")
    tested = run("predict", "--model", model, "--test", tmp_path / "M2")
    written = json.loads(run("predict", "--model", model, "--test", tmp_path / "M2",
                             "--json", "-").stdout)  # fmt: skip

    assert "an effect is missing" in fitted.stdout
    assert "run: thermocald discover" in fitted.stdout
    assert "valid from" not in fitted.stdout
    document = json.loads((tmp_path / "fit.json").read_text())
    assert document["effect_missing"] is True
    assert "no 95 % band is stated" in tested.stdout
    assert "the model misses an effect" in tested.stderr
    assert written["series"][0]["coverage"] is None


def test_the_sd_of_the_level_does_not_grow_with_the_thermometers_noise():
    """The field alone gives ± 0.4 px; with 0.1 K of noise, 2.8 px was once stated.

    Wrong coordinates affect the level only.
    """
    pulls = []
    for seed in range(4):
        s, source = misread(seed, 40, 0.1, 0.02)
        f = fit_thermal_model([for_fit(source)], [LAG], T0=30.0, search=False)
        true = s.model.interior.as_array() + 5.0 * s.model.rate_vector
        names = ("c", "x0", "y0", "A1", "A2", "A3", "B1", "B2")
        pull = [
            (getattr(f.model.interior, n) - t) / f.model.sd(f"interior.{n}")
            for n, t in zip(names, true, strict=False)
        ]
        pulls.append(pull + rate_errors(f, s))
    pulls = np.array(pulls)
    assert 0.5 < np.sqrt(np.mean(pulls[:, :3] ** 2)) < 1.6
    assert np.abs(pulls[:, 8:]).max() < 3.5


def test_a_model_that_is_not_examined_is_not_called_valid(tmp_path):
    """With fewer than 30 epochs, the excess over the noise decides on a band."""
    lag = ModelEffect("thermal_lag", {"tau": 60.0})
    for effects, sound in (((), True), ((lag,), False)):
        s = simulated(5, "M1", 25, effects)
        s.write(tmp_path / f"{sound}")
        model = tmp_path / f"{sound}.yaml"
        out = tmp_path / f"{sound}.json"
        fitted = run("fit", tmp_path / f"{sound}", "-o", model, "--json", out).stdout
        warning = run("predict", "--model", model, "--temperature", "30").stderr
        document = json.loads(out.read_text())
        assert document["effect_missing"] is None
        assert document["not_examined"] == "fewer than 30 epochs"
        assert "not examined" in fitted
        assert "not examined" in warning
        assert "valid from" not in fitted
        assert (document["left_over_in_noise"] < 1.1) == sound
        assert document["band"] == sound
        assert ("no 95 % band" in fitted) != sound
        for n in ("c", "x0", "y0"):
            rate = document["rates"][n]
            assert abs(rate["value"] - s.model.rates[n]) < (3 if sound else 5) * rate["sd"], n


def test_short_series_are_examined_together():
    lag = ModelEffect("thermal_lag", {"tau": 60.0})
    for effects, missing in (((), False), ((lag,), True)):
        series = [reduced(simulated(k, f"M{k}", 20, effects, 9.0 - k)) for k in (1, 2)]
        assert fit_thermal_model(series, []).model.evidence["fit"]["effect_missing"] is missing
        assert fit_thermal_model(series[:1], []).model.evidence["fit"]["effect_missing"] is None


def on_a_mount(s, px):
    """Return the series with a random walk of the camera's angles, `px` at its end."""
    source = seen(s)
    rng = np.random.default_rng([s.seed, 9])
    epochs, eop = len(s.frame_times), s.truth.eop.copy()
    step = px / np.sqrt(epochs) * s.model.sensor.pixel_pitch / s.model.interior.c
    eop[:, :3] += np.cumsum(rng.normal(0.0, step, (epochs, 3)), axis=0)
    points = project(s.model.sensor, s.truth.iop, eop, s.field.points)
    points += rng.normal(0.0, NOISE_PX, points.shape)
    points[~source.grid.observed] = np.nan
    return replace(source, grid=replace(source.grid, points=points))


@pytest.mark.slow
@pytest.mark.parametrize("px", [0.3, 0.8])
def test_a_wandering_mount_is_reported_as_an_alternative_to_a_missing_effect(px):
    for seed in (1, 2):
        f = fit_thermal_model([for_fit(on_a_mount(simulated(seed, listed=()), px))], [])
        assert f.model.evidence["fit"]["effect_missing"]
        assert f.model.evidence["fit"]["trembles"]
        document = ThermalCamera(f.model).as_dict()
        assert "or the mount moves" in model_lines(document)[1]
    still = fit_thermal_model([for_fit(on_a_mount(simulated(1, listed=()), 0.0))], [])
    assert still.model.evidence["fit"]["effect_missing"] is False
    assert "trembles" not in still.model.evidence["fit"]
    lag = fit_thermal_model([reduced(simulated(1, listed=[LAG]))], [])
    assert lag.model.evidence["fit"]["effect_missing"]
    assert "trembles" not in lag.model.evidence["fit"]
