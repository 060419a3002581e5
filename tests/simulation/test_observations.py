"""Simulated recordings: noise, missing targets, gross errors, readings; the command."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.commands import answer
from thermocald.errors import ConfigurationError, GeometryError, ThermocaldError
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.physics.device import Measuring
from thermocald.physics.heat import SimulatedThermometer
from thermocald.physics.model import ModelEffect
from thermocald.physics.model_file import read_model
from thermocald.physics.presets import preset_simulation
from thermocald.store.recording.reader import read_recording


@pytest.fixture(scope="module")
def simulation():
    return preset_simulation("nexus5-cold", seed=1)


def test_noise_missing_targets_and_gross_errors_are_as_given(simulation):
    device = replace(simulation.device, measuring=Measuring(0.05, 0.1, 0.01, 5.0))
    s = replace(simulation, device=device, programme=replace(simulation.programme, epochs=300))
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
    at = np.arange(5.0, 4900.0, 1.3)
    ideal, true = SimulatedThermometer("x", noise=0.0, resolution=0.0), 20.0 + 0.01 * at

    def read(**changes):
        return replace(ideal, **changes).read(t, 20.0 + 0.01 * t, at, rng)

    np.testing.assert_allclose(read(), true, atol=1e-12)
    late = at > 400
    np.testing.assert_allclose(read(lag=30.0, offset=0.5)[late], true[late] + 0.2, atol=1e-5)
    assert abs((read(noise=0.2) - true).std() - 0.2) < 0.01
    stepped = read(resolution=0.0625)
    np.testing.assert_array_equal(np.mod(stepped, 0.0625), 0.0)
    assert np.abs(stepped - true).max() <= 0.0625 / 2 + 1e-12
    assert abs(np.isnan(read(missing=0.1)).mean() - 0.1) < 0.02
    stuck, held = read(stuck=(1000.0, 2000.0)), (at >= 1000) & (at < 2000)
    assert len(set(stuck[held])) == 1
    np.testing.assert_allclose(stuck[~held], true[~held], atol=1e-12)


def test_frames_and_readings_have_their_own_instants(simulation):
    """A programme without an initial temperature begins at the ambient one."""
    uneven = {"jitter": 0.3, "reading_offset": 0.2, "reading_spread": 1.0, "initial": None}
    s = replace(simulation, programme=replace(simulation.programme, **uneven))
    ambient = s.programme.boundaries["ambient"].at(s.frame_times[:1])
    assert s.true_history.temperature()[:1] == pytest.approx(ambient, abs=0.01)
    shift = s.reading_times - s.frame_times
    assert -0.8 <= shift.min() < -0.7
    assert 1.1 < shift.max() <= 1.2
    assert np.all(np.diff(s.frame_times) > 5)
    assert 0.2 < np.diff(s.frame_times).std() / np.sqrt(2) < 0.4
    wild = replace(s, programme=replace(s.programme, jitter=100.0))
    assert np.diff(wild.frame_times).min() >= 0.2 * s.programme.interval - 1e-9


def test_another_camera_and_a_view_without_targets_are_refused(simulation):
    device = replace(simulation.device, sensor=Sensor(640, 480, 0.005))
    with pytest.raises(ConfigurationError, match="a model belongs to one camera"):
        replace(simulation, device=device)
    away = replace(simulation.exterior, kappa=0.0, phi=3.0)
    model = replace(simulation.model, exterior=away)
    with pytest.raises(GeometryError, match="the camera sees 0 of 147 targets"):
        next(replace(simulation, model=model).observations())


def test_what_is_probably_not_meant_is_said(simulation):
    """A time after the end, a knee above all temperatures, rad/K for µrad/K."""
    listed = [ModelEffect("slip", {"time": 1e9, "c": 1e-3}), ModelEffect("creep", {"c": 1e-9}),
              ModelEffect("softening", {"T_k": 90.0, "c": 1e-4}),
              ModelEffect("housing_tilt", {"omega": 1.0})]  # fmt: skip
    model = replace(simulation.model, effects=listed)
    doubts = replace(simulation, model=model).as_dict()["doubts"]
    assert [" ".join(d.split()[:4]) for d in doubts] == [
        "effect slip changes nothing", "effect softening changes nothing", "the camera sees fewer"
    ]  # fmt: skip
    assert simulation.as_dict()["doubts"] == []


def test_nothing_is_written_of_a_camera_that_cannot_be(simulation, tmp_path):
    course = simulation.programme
    cold = replace(simulation, programme=replace(course, initial=-400.0))
    collapsing = replace(simulation, model=replace(simulation.model, rates={"c": -1.0}))
    for impossible, reason in ((cold, "would be between -400"), (collapsing, "would fall to")):
        with pytest.raises(ConfigurationError, match=reason):
            impossible.write(tmp_path / "M1")
    assert not list(tmp_path.iterdir())


def run(*arguments):
    return answer("simulate", *arguments)


def test_preset_to_recording_and_json(tmp_path):
    """An effect has a name and a size; the written model gives the same recording."""
    given = "--preset", "nexus5-cold", "--seed", 5, "--out"
    first = run(*given, tmp_path / "r", "--effect", "slip:time=300,x0=0.0001", "--json", "-",
                "--model-out", tmp_path / "m.yaml")  # fmt: skip
    assert first.exit_code == 0
    assert round(json.loads(first.stdout)["drift"]["principal_point_px"]) == 16
    recording = read_recording(tmp_path / "r")
    assert recording.head.extra["simulated"]["seed"] == 5
    expected = next(preset_simulation("nexus5-cold", seed=5).observations())
    np.testing.assert_allclose(recording.epochs[0].observations.points, expected.points, atol=1e-5)
    slip = read_model(tmp_path / "m.yaml").effects[-1]
    assert (slip.name, slip.values["x0"]) == ("slip", 0.0001)
    again = run(*given, tmp_path / "s", "--model", tmp_path / "m.yaml")
    assert again.exit_code == 0
    files = [(tmp_path / n / "observations.csv").read_bytes() for n in "rs"]
    assert files[0] == files[1]


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ("--preset nexus6 --out r", "'nexus6'; known are: nexus5-cold"),
        ("--preset nexus5-cold", "--out is missing"),
        ("--out r", "give --preset"),
        ("--model none.yaml --programme p.yaml --out r", "cannot be read"),
        ("--preset nexus5-cold --effect slip --out r", "slip:c=…"),
        ("--preset nexus5-cold --effect creep:c=1e-6,c=2e-6 --out r", "c is given twice"),
        ("--list --out r", "--list writes no recording"),
    ],
)
def test_wrong_usage(tmp_path, monkeypatch, arguments, reason):
    monkeypatch.chdir(tmp_path)
    result = run(*arguments.split())
    assert isinstance(result.exception, ThermocaldError)
    assert result.exception.exit_status == 2
    assert reason in str(result.exception)
    assert not (tmp_path / "r").exists()
