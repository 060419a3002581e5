"""Simulated recordings: noise, missing targets, gross errors, readings; the command."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.commands import answer
from thermocald.errors import ConfigurationError, GeometryError, ThermocaldError
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.physics.device import CameraDevice, Measuring, Programme
from thermocald.physics.heat import Course, SimulatedThermometer
from thermocald.physics.model_file import read_model
from thermocald.physics.presets import preset_simulation
from thermocald.physics.simulation import Simulation
from thermocald.physics.testfields import demonstration_field, demonstration_model
from thermocald.store.recording.reader import read_recording


def simulation(epochs=180, seed=1, effects=(), measuring=None, field=None, **changes):
    test_field = field or demonstration_field("plain")
    model = demonstration_model(test_field)
    for effect in effects:
        model = model.with_effect(effect)
    device = CameraDevice("rpi", model.sensor)
    if measuring:
        device = replace(device, measuring=measuring)
    programme = Programme(
        "lamp",
        epochs,
        10.0,
        {"ambient": Course.constant(22.0)},
        {"board": Course.steps([0, 60, 900, 1e6], [0, 4.0, 0])},
    )
    return Simulation(model, device, test_field, replace(programme, **changes), seed)


def test_noise_missing_targets_and_gross_errors_are_as_given():
    s = simulation(epochs=300, measuring=Measuring(0.05, 0.1, 0.01, 5.0))
    true = s.image_points(slice(0, 300))
    rows = list(s.observations())
    error = np.concatenate([o.points - true[e, o.targets] for e, o in enumerate(rows)])
    visible = s.model.sensor.contains(true, 5.0).sum()
    assert abs(len(error) / visible - 0.9) < 0.01
    gross = np.abs(error).max(axis=1) > 6 * 0.05
    # a gross error with an sd of 5 px is below 0.3 px in both coordinates in 1 of 400 cases
    assert abs(gross.mean() - 0.01) < 0.003
    good = error[~gross]
    assert abs(good.std() / 0.05 - 1) < 0.02
    assert np.abs(good.mean(axis=0)).max() < 0.001
    assert all(np.all(o.sigmas == 0.05) for o in rows)


def test_errors_of_thermometers():
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 5000.0, 1.0)
    T = 20.0 + 0.01 * t
    at = np.arange(5.0, 4900.0, 1.3)
    ideal = SimulatedThermometer("x", noise=0.0, resolution=0.0)
    np.testing.assert_allclose(ideal.read(t, T, at, rng), 20 + 0.01 * at, atol=1e-12)
    lagging = replace(ideal, lag=30.0, offset=0.5)
    late = at > 400
    expected = 20.5 + 0.01 * (at - 30.0)
    np.testing.assert_allclose(lagging.read(t, T, at, rng)[late], expected[late], atol=1e-5)
    noisy = replace(ideal, noise=0.2).read(t, T, at, rng) - 20 - 0.01 * at
    assert abs(noisy.std() - 0.2) < 0.01
    stepped = replace(ideal, resolution=0.0625).read(t, T, at, rng)
    np.testing.assert_array_equal(np.mod(stepped, 0.0625), 0.0)
    assert np.abs(stepped - 20 - 0.01 * at).max() <= 0.0625 / 2 + 1e-12
    failing = replace(ideal, missing=0.1).read(t, T, at, rng)
    assert abs(np.isnan(failing).mean() - 0.1) < 0.02
    stuck = replace(ideal, stuck=(1000.0, 2000.0)).read(t, T, at, rng)
    held = (at >= 1000) & (at < 2000)
    assert len(set(stuck[held])) == 1
    assert np.ptp(stuck[~held]) > 40


def test_frames_and_readings_have_their_own_instants():
    s = simulation(jitter=0.3, reading_offset=0.2, reading_spread=1.0)
    shift = s.reading_times - s.frame_times
    assert -0.8 <= shift.min() < -0.7
    assert 1.1 < shift.max() <= 1.2
    assert np.all(np.diff(s.frame_times) > 5)
    assert 0.2 < np.diff(s.frame_times).std() / np.sqrt(2) < 0.4


def test_another_camera_is_refused():
    s = simulation()
    with pytest.raises(ConfigurationError, match="a model belongs to one camera"):
        replace(s, device=replace(s.device, sensor=Sensor(640, 480, 0.005)))


def test_a_view_without_targets_is_refused():
    s = simulation()
    away = replace(s.model.exterior, kappa=0.0, phi=3.0)
    with pytest.raises(GeometryError, match="the camera sees 0 of 147 targets"):
        next(replace(s, model=replace(s.model, exterior=away)).observations())


def run(*arguments):
    return answer("simulate", *arguments)


def test_preset_to_recording_and_json(tmp_path):
    result = run("--preset", "nexus5-cold", "--out", tmp_path / "r", "--seed", 5, "--json", "-",
                 "--model-out", tmp_path / "m.yaml")  # fmt: skip
    assert result.exit_code == 0
    assert round(json.loads(result.stdout)["drift"]["principal_point_px"]) == 16
    recording = read_recording(tmp_path / "r")
    assert recording.head.extra["simulated"]["seed"] == 5
    expected = next(preset_simulation("nexus5-cold", seed=5).observations())
    np.testing.assert_allclose(recording.epochs[0].observations.points, expected.points, atol=1e-5)
    # the written model gives the same recording
    again = run("--preset", "nexus5-cold", "--model", tmp_path / "m.yaml", "--out", tmp_path / "s",
                "--seed", 5)  # fmt: skip
    assert again.exit_code == 0
    files = [(tmp_path / n / "observations.csv").read_bytes() for n in "rs"]
    assert files[0] == files[1]


def test_an_effect_has_a_name_and_a_size(tmp_path):
    given = "--effect", "slip:time=300,x0=0.01", "--model-out", tmp_path / "m.yaml"
    assert run("--preset", "nexus5-cold", "--out", tmp_path / "r", *given).exit_code == 0
    slip = read_model(tmp_path / "m.yaml").effects[-1]
    assert (slip.name, slip.values["x0"]) == ("slip", 0.01)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--preset", "nexus6", "--out", "r"], "'nexus6'; known are: nexus5-cold"),
        (["--preset", "nexus5-cold"], "--out is missing"),
        (["--out", "r"], "give --preset"),
        (["--model", "none.yaml", "--programme", "p.yaml", "--out", "r"], "cannot be read"),
        (["--preset", "nexus5-cold", "--effect", "slip", "--out", "r"], "slip:c=…"),
    ],
)
def test_wrong_usage(tmp_path, monkeypatch, arguments, reason):
    monkeypatch.chdir(tmp_path)
    result = run(*arguments)
    assert isinstance(result.exception, ThermocaldError)
    assert result.exception.exit_status == 2
    assert reason in str(result.exception)
    assert not (tmp_path / "r").exists()
