"""Model, camera and programme files: round trips, and a clear error for each fault."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from thermocald.errors import ConfigurationError
from thermocald.files import dump_yaml
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.physics.device import read_camera_device, read_programme
from thermocald.physics.model import ModelEffect
from thermocald.physics.model_file import model_document, read_model, write_model
from thermocald.physics.presets import given_simulation
from thermocald.physics.testfields import demonstration_field, demonstration_model


def full_model():
    model = demonstration_model(demonstration_field("circles"))
    model = model.with_effect(ModelEffect("thermal_lag", {"tau": 84.0}, {"tau": 1.9}))
    model = model.with_effect(
        ModelEffect("second_heat_source", {"channel": "board", "c": 1e-5}, {"c": 1e-7})
    )
    model = model.with_effect(
        ModelEffect("target_displacement", {"time": 60.0, "targets": ("x11", "x12"), "dX": 0.3})
    )
    return replace(
        model,
        sds={"interior.c": 1e-4, "rates.x0": 2e-6},
        covariance_names=("interior.c", "thermal_lag.tau"),
        covariance=((1e-8, 1e-6), (1e-6, 3.6)),
        validity={"temperature": (20.0, 52.5)},
        fitted_on=({"recording": "M1", "epochs": 150},),
        evidence={"why": "a lag"},
    )


def test_round_trip(tmp_path):
    """A number outside the matrix keeps its standard deviation."""
    write_model(tmp_path / "m.yaml", full_model())
    model = read_model(tmp_path / "m.yaml")
    assert model == full_model()
    assert model.version == 4
    names = ("thermal_lag.tau", "second_heat_source.c", "interior.c", "interior.A1")
    known = model.covariance_of(names)
    assert np.allclose(np.diag(known), [3.6, 1e-14, 1e-8, 0.0], rtol=1e-12, atol=0.0)
    assert known[0, 2] == known[2, 0] == 1e-6
    assert not known[1, [0, 2]].any()


CAMERA = {
    "format": "thermocald-camera/1",
    "name": "mine",
    "width": 1640,
    "height": 1232,
    "pixel_pitch": {"value": 0.00224, "unit": "mm"},
    "distance": 900.0,
    "measuring": {"sigma": 0.05, "missed": 0.1},
    "look": {"blur": 1.1},
    "heat": {
        "bodies": {"lens": {"capacity": 2.0}, "board": {"capacity": 20.0}},
        "links": [
            {"between": ["lens", "board"], "conductance": 0.1},
            {"between": ["board", "ambient"], "conductance": 0.2},
        ],
    },
    "thermometers": {
        "temperature": {"body": "lens", "lag": 5.0, "stuck": {"from": 100.0, "to": 200.0}},
        "air": {"body": "ambient", "noise": 0.0},
    },
}


PROGRAMME = {
    "format": "thermocald-programme/1",
    "name": "lamp",
    "epochs": 100,
    "interval": 10.0,
    "ambient": {"log": "log.csv", "time": "t", "value": "air", "largest_gap": 500.0},
    "sources": {
        "lens": [
            {"from": 0, "to": 100, "value": 0},
            {"from": 100, "to": 400, "begin": 0, "end": 2.0},
            {"from": 400, "to": 1000, "value": 0.5},
        ]
    },
}
LOG = "t,air\n100,20\n600,30\n1100,25\n"


def write(folder, document, log=LOG):
    """Write a document, and the log that a programme names; return the document's path."""
    (folder / "log.csv").write_text(log)
    path = folder / "m.yaml"
    path.write_text(dump_yaml(document))
    return path


def test_a_camera_file_replaces_the_camera_of_a_preset(tmp_path):
    sensor = Sensor(1640, 1232, 0.00224)
    write_model(tmp_path / "model.yaml", replace(full_model(), sensor=sensor))
    camera = write(tmp_path, CAMERA)
    found = given_simulation("nexus5-cold", tmp_path / "model.yaml", camera, None, None)
    device = found.device
    assert found.model.sensor == device.sensor == sensor
    assert device.reference == "temperature"
    assert device.thermometers["temperature"].stuck == (100.0, 200.0)
    assert (device.measuring.missed, device.look.blur_px) == (0.1, 1.1)
    assert device.network.boundaries == ("ambient",)


def test_a_programme_file_with_a_log_that_drives_a_boundary(tmp_path):
    programme = read_programme(write(tmp_path, PROGRAMME))
    lamp, air = programme.sources["lens"], programme.boundaries["ambient"]
    np.testing.assert_allclose(lamp.at([50.0, 250.0, 400.0, 999.0]), [0, 1.0, 0.5, 0.5])
    np.testing.assert_allclose(lamp.at([400.0], "left"), [2.0])
    np.testing.assert_allclose(air.at([0, 250, 1000]), [20, 25, 25])


BAD = {
    "model": [
        (("format",), "thermocald-model/9", "this program reads 'thermocald-model/1'"),
        (("effects", 0, "effect"), "thermal_leg", "did you mean 'thermal_lag'"),
        (("effects", 0, "parameters"), {}, "'tau' .s. is missing"),
        (("effects", 0, "parameters", "tau", "unit"), "min", "'min'; it must be 's'"),
        (("effects", 0, "parameters", "tau", "value"), -5.0, "not above 0"),
        (("effects", 0, "parameters", "tau", "value"), 0.0, "not above 0"),
        (("effects", 0, "parameters", "tau", "value"), float("nan"), "not a finite number"),
        (("effects", 0, "parameters", "tua"), 5.0, "did you mean 'tau'"),
        (("rates", "A1"), 1e-5, "unknown"),
        (("rates", "x0", "sd"), -1e-5, "not negative"),
        (("interior", "c"), None, "interior.c: is missing"),
        (("camera", "width"), 3280.5, "whole number"),
        (("camera", "pixel_pitch"), 1.12, "thousandths of a mm"),
        (("reference_temperature",), {"value": 298.0, "unit": "K"}, "'K'; it must be 'degC'"),
        (("exterior", "Z0"), None, "exterior.Z0: is missing"),
        (("covariance", "matrix"), [[1.0]], "2 × 2"),
        (("covariance", "matrix"), [[1.0, 2.0], [0.0, 1.0]], "not symmetric"),
        (("validity", "temperature"), [50.0, 20.0], "begins at 50"),
        (("efects",), [], "did you mean 'effects'"),
    ],
    "camera": [
        (("heat", "bodies", "lens", "capacity"), -2.0, "-2 J/K; it must be above 0"),
        (("heat", "links", 0, "conductance"), 0.0, "0 W/K; it must be above 0"),
        (("heat", "links", 0, "between"), ["lens", "board", "air"], "must be a list of two names"),
        (("heat", "links", 0, "between"), ["lens", "lens"], "between 'lens' and itself"),
        (("thermometers", "temperature", "body"), "lans", "is 'lans'; bodies are lens, board"),
        (("thermometers", "air", "missing"), 1.0, "share below 1"),
        (("thermometers", "air", "stuck"), {"from": 9, "to": 3}, "3 s; it must be above 9"),
        (("measuring", "sigma"), 0.0, "above 0"),
        (("look", "paper"), 300, "at most 255"),
    ],
    "programme": [
        (("sources", "lens", 1, "from"), 130, "ends at 100 s: a gap"),
        (("sources", "lens", 1, "from"), 90, "ends at 100 s: an overlap"),
        (("sources", "lens", 2, "to"), 800, "covers 0 to 800 s; the programme lasts from 0 to 990"),
        (("sources", "lens", 0, "to"), 0, "not after 0 s"),
        (("ambient",), None, "ambient: is missing"),
        (("ambient",), {"log": "none.csv"}, "cannot be read"),
        (("epochs",), 0, "at least 1"),
        (("interval",), -1, "above 0"),
    ],
}
FILES = {
    "model": (read_model, model_document(full_model())),
    "camera": (read_camera_device, CAMERA),
    "programme": (read_programme, PROGRAMME),
}


@pytest.mark.parametrize(
    ("kind", "path", "value", "reason"),
    [(kind, *row) for kind, rows in BAD.items() for row in rows],
)
def test_a_fault_is_reported_with_file_and_key(tmp_path, kind, path, value, reason):
    read, right = FILES[kind]
    document = part = copy.deepcopy(right)
    *parents, last = path
    for key in parents:
        part = part[key]
    part[last] = value
    if value is None:
        del part[last]
    with pytest.raises(ConfigurationError, match=reason) as error:
        read(write(tmp_path, document))
    assert "m.yaml" in str(error.value) or "csv" in str(error.value)


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        ("0,20\n300,21\n1300,22\n", "line 4, column t: a gap of 1000 s"),
        ("0,20\n300,21\n200,22\n", "line 4, column t: time runs backwards"),
        ("0,20\n300,\n1300,22\n", "line 3, column air: is empty; a number"),
        ("0,20\n", "two rows"),
        ("0,20\n300,nan\n900,22\n", "finite"),
    ],
)
def test_faulty_logs(tmp_path, rows, reason):
    with pytest.raises(ConfigurationError, match=reason):
        read_programme(write(tmp_path, PROGRAMME, "t,air\n" + rows))
