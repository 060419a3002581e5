"""A fit that lacks an effect reports it, widens its standard deviations, and states no band."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.audit_thermal import rate_errors, seen
from tests.analysis.test_thermal_model import for_fit, reduced, simulated
from tests.commands import answer as run
from tests.marks import mostly_slow
from thermocald.analysis.thermal.certificate import model_lines
from thermocald.analysis.thermal.prediction_test import predicted_error
from thermocald.analysis.thermal.thermal_model import fit_thermal_model
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.physics.model import ModelEffect

SIZE = {"c": 3e-4, "x0": 6e-4, "y0": -4e-4}
NOISE_PX = 0.04


def formula(text: str, unit: float = 1.0, size: float = 1.0) -> ModelEffect:
    """Return an effect that no fit includes, with `size` times SIZE per unit of the formula."""
    return ModelEffect(text, {name: size * value / unit for name, value in SIZE.items()})


CASES = {
    "lag": ModelEffect("thermal_lag", {"tau": 120.0}),
    "tanh": formula("saturation(temperature, 38, 5)"),
    "signed_square": formula("signed_square(rate(temperature))", 0.03**2),
    "integral": formula("integral(offset(temperature, 25))", 1e4),
}


def fit_and_test(effect, first=1, second=51):
    """Fit the base model to M1 and test it on M2, heated differently."""
    cameras = [simulated(first, "M1", listed=(effect,)),
               simulated(second, "M2", listed=(effect,), power=6.5)]  # fmt: skip
    f = fit_thermal_model([reduced(cameras[0])], [])
    sd = f.fitted["series"][0].thermometer_sd
    return f, predicted_error(f.model, reduced(cameras[1]), sd), cameras[0]


@pytest.mark.parametrize("name", mostly_slow(CASES, "lag", "tanh"))
def test_a_camera_outside_the_family(name):
    """For M2, no false band is stated."""
    f, error, camera = fit_and_test(CASES[name])
    evidence = f.model.evidence["fit"]
    assert evidence["effect_missing"]
    assert evidence["misfit_px"] > 2 * 0.004
    assert "trembles" not in evidence
    assert f.model.misses_an_effect
    # the missing effect is not attributed to the noise of image or thermometer
    assert abs(f.fitted["sigma0"] - 1.0) < 0.03
    assert f.fitted["series"][0].thermometer_sd < 0.06
    assert error.floor_px < 1.2 * NOISE_PX
    assert error.rms_px > 2 * error.floor_px
    assert np.isnan(error.coverage)
    if name != "tanh":  # its linear part adds to the rates
        assert np.abs(rate_errors(f, camera)).max() < 3


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
        simulated(k, name, listed=(CASES["lag"],)).write(tmp_path / name)
    model, out = tmp_path / "camera.yaml", tmp_path / "out.json"
    fitted = run("fit", tmp_path / "M1", "-o", model, "--json", out)
    assert "an effect is missing" in fitted.stdout
    assert "run: thermocald discover" in fitted.stdout
    assert "valid from" not in fitted.stdout
    assert json.loads(out.read_text())["effect_missing"] is True
    tested = run("predict", "--model", model, "--test", tmp_path / "M2", "--json", out)
    assert "no 95 % band is stated" in tested.stdout
    assert "the model misses an effect" in tested.stderr
    assert json.loads(out.read_text())["series"][0]["coverage"] is None


WEAK_LAG = ModelEffect("thermal_lag", {"tau": 60.0})


@pytest.mark.parametrize(("effects", "sound"), [((), True), ((WEAK_LAG,), False)])
def test_a_model_that_is_not_examined_is_not_called_valid(tmp_path, effects, sound):
    """With fewer than 30 epochs, the excess over the noise decides on a band."""
    s = simulated(5, "M1", 25, effects)
    s.write(tmp_path / "M1")
    model, out = tmp_path / "m.yaml", tmp_path / "m.json"
    fitted = run("fit", tmp_path / "M1", "-o", model, "--json", out).stdout
    document = json.loads(out.read_text())
    assert document["effect_missing"] is None
    assert document["not_examined"] == "fewer than 30 epochs"
    assert "not examined" in fitted
    assert "not examined" in run("predict", "--model", model, "--temperature", "30").stderr
    assert "valid from" not in fitted
    assert (document["left_over_in_noise"] < 1.1) == sound
    assert document["band"] == sound
    assert ("no 95 % band" in fitted) != sound
    for n in ("c", "x0", "y0"):
        rate = document["rates"][n]
        assert abs(rate["value"] - s.model.rates[n]) < (3 if sound else 5) * rate["sd"], n


@pytest.mark.parametrize(("effects", "missing"), [((), False), ((WEAK_LAG,), True)])
def test_short_series_are_examined_together(effects, missing):
    series = [reduced(simulated(k, f"M{k}", 20, effects, 9.0 - k)) for k in (1, 2)]
    assert fit_thermal_model(series, []).model.evidence["fit"]["effect_missing"] is missing
    assert fit_thermal_model(series[:1], []).model.evidence["fit"]["effect_missing"] is None


@pytest.mark.slow
@pytest.mark.parametrize("px", [0.0, 0.3, 0.8])
def test_a_wandering_mount_is_reported_as_an_alternative_to_a_missing_effect(px):
    """The camera's angles walk at random, by `px` at the end."""
    for seed in (1, 2):
        s = simulated(seed, listed=())
        source, rng = seen(s), np.random.default_rng([seed, 9])
        epochs, eop = len(s.frame_times), s.truth.eop.copy()
        step = px / np.sqrt(epochs) * s.model.sensor.pixel_pitch / s.model.interior.c
        eop[:, :3] += np.cumsum(rng.normal(0.0, step, (epochs, 3)), axis=0)
        points = project(s.model.sensor, s.truth.iop, eop, s.field.points)
        points += rng.normal(0.0, NOISE_PX, points.shape)
        points[~source.grid.observed] = np.nan
        moved = replace(source, grid=replace(source.grid, points=points))
        f = fit_thermal_model([for_fit(moved)], [])
        assert f.model.evidence["fit"]["effect_missing"] is (px > 0)
        assert ("trembles" in f.model.evidence["fit"]) is (px > 0)
        assert ("or the mount moves" in model_lines(f.as_dict())[1]) is (px > 0)
