"""A camera at a temperature, two cameras compared, and a model from calibrations."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest
import yaml

from tests.commands import call, finish
from thermocald.analysis.camera.camera import Camera, CameraDifference
from thermocald.analysis.thermal.calibrations import Calibration, fit_calibrations
from thermocald.photogrammetry import camera_files
from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    CameraModel,
    InteriorOrientation,
    Sensor,
)
from thermocald.physics.model import RATED, ThermalModel
from thermocald.physics.model_file import write_model

SENSOR = Sensor(3280, 2464, 0.00112)
COLD = InteriorOrientation(3.05, 0.02, -0.01, A1=-2e-3, A2=1e-4)
RATES = {"c": 0.2e-3, "x0": -0.4e-3, "y0": 0.1e-3}
FREE = ("c", "x0", "y0", "A1", "A2")


def covariance(seed=0):
    """The covariance of a calibration from a dozen photographs: c and A1 are correlated."""
    rng = np.random.default_rng(seed)
    sd = np.array([4e-4, 3e-4, 3e-4, 2e-5, 4e-6])
    r = np.eye(5)
    r[0, 3] = r[3, 0] = -0.6
    C = np.zeros((10, 10))
    rows = [IOP_NAMES.index(n) for n in FREE]
    C[np.ix_(rows, rows)] = r * np.outer(sd, sd) * rng.uniform(0.8, 1.2)
    return C


def interior(temperature):
    warm = temperature - 20.0
    return InteriorOrientation.from_array(
        COLD.as_array() + warm * np.array([RATES.get(n, 0.0) for n in IOP_NAMES])
    )


def drawn(temperature, rng, extra=None):
    """A calibration at a temperature, with the errors that its covariance states."""
    C = covariance(int(temperature))
    values = interior(temperature).as_array() + rng.multivariate_normal(np.zeros(10), C)
    if extra is not None:
        values = values + extra * (temperature - 20.0)
    return InteriorOrientation.from_array(values), C


def write_document(path, temperature, rng, start=None):
    """Write a calibration as `calibrate --json` does."""
    found, C = drawn(temperature, rng)
    rows = [IOP_NAMES.index(n) for n in FREE]
    sd = np.sqrt(np.diag(C))
    values = dict(zip(IOP_NAMES, found.as_array().tolist(), strict=True))
    document = {
        "format": "thermocald-calibration/1",
        "camera": {"name": "rpi", "width": 3280, "height": 2464, "pixel_pitch": 0.00112},
        "interior": values | {f"sd_{n}": float(sd[i]) for n, i in zip(FREE, rows, strict=True)},
        "correlations": {"names": list(FREE), "matrix": (
            C[np.ix_(rows, rows)] / np.outer(sd[rows], sd[rows])).tolist()},
        "photographs": [
            {"image": f"{k}.jpg", "status": "ok",
             "time": start and (start + timedelta(seconds=30 * k)).isoformat()} for k in range(4)
        ],
    }  # fmt: skip
    path.write_text(json.dumps(document))


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "cam.yaml"
    names = ("interior.c", "rates.c", "rates.x0")
    C = np.diag([1e-4, 2e-6, 1e-6]) ** 2
    write_model(path, ThermalModel(
        "rpi", SENSOR, 20.0, COLD, RATES, covariance_names=names,
        covariance=tuple(map(tuple, C.tolist())), validity={"housing": (15.0, 50.0)},
    ))  # fmt: skip
    return path


# --- camera at ---------------------------------------------------------------------------------


def test_the_camera_at_35_degrees_as_a_ros_file(model, tmp_path):
    done = finish("camera", "at", model, "--temperature", 35, "--to", "ros", "-o",
                tmp_path / "r.yaml", "--json", "-")  # fmt: skip
    document = json.loads(done.stdout)
    K = yaml.safe_load((tmp_path / "r.yaml").read_text())["camera_matrix"]["data"]
    c = COLD.c + 15 * RATES["c"]
    assert document["c"] == pytest.approx(c, abs=1e-12)
    assert document["sd_c"] == pytest.approx(np.hypot(1e-4, 15 * 2e-6), rel=1e-9)
    assert K[4] == pytest.approx(c / SENSOR.pixel_pitch, abs=1e-6)
    assert "exact" in document["statement"]
    own = finish("camera", "at", model, "--temperature", 35, "-o", tmp_path / "own.json")
    read = camera_files.read(tmp_path / "own.json")
    assert np.sqrt(read.covariance[0, 0]) == pytest.approx(document["sd_c"], rel=1e-9)
    assert "at 35 °C" in own.stdout
    refused = call("camera", "diff", tmp_path / "own.json", model)
    assert (refused.returncode, "`thermocald camera at` writes" in refused.stderr) == (2, True)
    # far outside its range it is refused
    assert call("camera", "at", model, "--temperature", 90, "-o", tmp_path / "x").returncode == 2
    assert not (tmp_path / "x").exists()


# --- camera diff -------------------------------------------------------------------------------


def written(path, camera, C=None):
    camera_files.write(CameraModel(SENSOR, camera), path, "json", C, "", "rpi")
    return path


def test_two_cameras_differ_by_what_was_put_in(tmp_path):
    """A principal point moved by 1 px moves every point by 1 px; a rotation absorbs most of it."""
    moved = replace(COLD, x0=COLD.x0 + SENSOR.pixel_pitch)
    a = written(tmp_path / "a.json", COLD, covariance(1))
    b = written(tmp_path / "b.json", moved, covariance(2))
    document = json.loads(call("camera", "diff", a, b, "--json", "-").stdout)
    assert document["rms_px"] == pytest.approx(1.0, abs=1e-9)
    assert document["largest_px"] == pytest.approx(1.0, abs=1e-9)
    assert document["rms_turned_px"] < 0.3
    row = next(r for r in document["parameters"] if r["name"] == "x0")
    assert row["difference"] == pytest.approx(SENSOR.pixel_pitch, abs=1e-12)
    sd = np.sqrt(covariance(1)[1, 1] + covariance(2)[1, 1])
    assert row["sd_difference"] == pytest.approx(sd, rel=1e-9)
    text = call("camera", "diff", a, b).stdout
    assert "in the image: 1.00 ±" in text
    assert "(1.00 ± " in text
    finish("camera", "diff", a, b, "--report", tmp_path / "d.html")
    assert "<svg" in (tmp_path / "d.html").read_text()


@pytest.fixture
def coarse(monkeypatch):
    """Image points on a coarse grid, for many comparisons."""
    monkeypatch.setattr("thermocald.analysis.camera.camera._GRID", 9)


def test_the_image_s_standard_deviations_are_those_of_drawn_cameras(coarse):
    """RMS and largest difference of 60 drawn pairs, also after the rotation, scatter as stated."""
    rng = np.random.default_rng(3)
    warm, C, D = interior(45.0), covariance(1), covariance(2)
    names = ("rms_px", "rms_turned_px", "largest_px", "largest_turned_px")
    found, stated = [], []
    for _ in range(60):
        cameras = [
            CameraModel(SENSOR, InteriorOrientation.from_array(
                i.as_array() + rng.multivariate_normal(np.zeros(10), V)))
            for i, V in ((COLD, C), (warm, D))
        ]  # fmt: skip
        difference = CameraDifference(("a", "b"), *cameras, (C, D)).as_dict()
        found.append([difference[name] for name in names])
        stated.append([difference[f"sd_{name}"] for name in names])
    ratio = np.std(found, axis=0) / np.median(stated, axis=0)
    assert ratio[:2] == pytest.approx(1.0, abs=0.15)  # ± 0.09 by chance
    # the largest of many values exceeds one chosen beforehand, and scatters less
    assert np.all((ratio[2:] > 0.6) & (ratio[2:] < 1.15))


def test_without_covariance_no_sd_is_stated_and_other_sensors_are_refused(tmp_path):
    a = written(tmp_path / "a.json", COLD, covariance(1))
    b = written(tmp_path / "b.json", interior(40.0))
    document = json.loads(call("camera", "diff", a, b, "--json", "-").stdout)
    assert "sd_rms_px" not in document
    assert "sd_difference" not in document["parameters"][0]
    camera_files.write(CameraModel(Sensor(1640, 1232, 0.00224), COLD), tmp_path / "c.json", "json")
    refused = call("camera", "diff", a, tmp_path / "c.json")
    assert refused.returncode == 2
    assert "only cameras of one image size" in refused.stderr


# --- fit of calibrations -----------------------------------------------------------------------


def test_calibrations_at_three_temperatures_give_the_model(tmp_path):
    rng = np.random.default_rng(5)
    for T in (20, 35, 50):
        write_document(tmp_path / f"{T}.json", T, rng)
    done = finish("fit", *(f"{T}={tmp_path / f'{T}.json'}" for T in (20, 35, 50)), "-o",
                tmp_path / "cam.yaml", "--json", "-")  # fmt: skip
    document = json.loads(done.stdout)
    for name in RATED:
        rate = document["rates"][name]
        assert abs(rate["value"] - RATES[name]) < 4 * rate["sd"], name
        assert rate["sd"] < 3e-5
    assert not document["effect_missing"]
    assert [c["temperature"] for c in document["calibrations"]] == [20.0, 35.0, 50.0]
    finish("predict", "--model", tmp_path / "cam.yaml", "--temperature", 30)


@pytest.mark.parametrize(
    ("unit", "shown"), [("fahrenheit", lambda T: 1.8 * T + 32), ("kelvin", lambda T: T + 273.15)]
)
def test_calibrations_whose_temperatures_are_no_celsius_are_doubted(tmp_path, unit, shown):
    rng = np.random.default_rng(5)
    for T in (20, 45):
        write_document(tmp_path / f"{T}.json", T, rng)
    given = [f"{shown(T)}={tmp_path / f'{T}.json'}" for T in (20, 45)]
    done = finish("fit", *given, "-o", tmp_path / "cam.yaml")
    assert f"are their temperatures in {unit}?" in done.stdout


def test_the_logger_tells_the_temperature_of_photographs(tmp_path):
    """Cold in the morning, warm at noon; the times are EXIF's, in the given time zone."""
    rng = np.random.default_rng(6)
    starts = {20: datetime(2026, 6, 14, 8, 0), 45: datetime(2026, 6, 14, 12, 0)}
    for T, start in starts.items():
        write_document(tmp_path / f"{T}.json", T, rng, start)
    rows = [
        f"{start + timedelta(seconds=30 * k - 60):%d/%m/%Y %H:%M:%S},{T}\n"
        for T, start in starts.items() for k in range(8)
    ]  # fmt: skip
    (tmp_path / "log.csv").write_text("Time,Celsius\n" + "".join(rows))
    arguments = ("fit", tmp_path / "20.json", tmp_path / "45.json", "-o", tmp_path / "cam.yaml")
    done = finish(*arguments, "--log", tmp_path / "log.csv", "--timezone", "Europe/Berlin",
                "--json", "-")  # fmt: skip
    document = json.loads(done.stdout)
    assert [c["temperature"] for c in document["calibrations"]] == [20.0, 45.0]
    assert list(document["validity"]) == ["temperature"]
    asked = call(*arguments)
    assert asked.returncode == 2
    assert "at which temperature? Write 21.5=" in asked.stderr


@pytest.mark.parametrize(
    ("inputs", "said"),
    [
        (("20=a.json", "20.3=b.json"), "at least two temperatures"),
        (("warm=a.json", "50=b.json"), "'warm' is not a temperature"),
        (("20=a.json", "50=free.json"), "calibrate both with the same --free"),
        (("20=a.json", "M1"), "fit series and calibrations apart"),
        (("20=M1",), "fit series and calibrations apart"),
        (("20=a.json", "50=none.json"), "no covariance"),
        (("20=a.json", "50=list.json"), "not a camera file of any format"),
    ],
)
def test_calibrations_that_give_no_model_are_refused(tmp_path, inputs, said):
    rng = np.random.default_rng(7)
    write_document(tmp_path / "a.json", 20, rng)
    write_document(tmp_path / "b.json", 50, rng)
    written(tmp_path / "none.json", COLD)
    (tmp_path / "M1").mkdir()
    (tmp_path / "list.json").write_text('["thermocald-calibration/1"]')
    C = covariance()
    C[6, 6] = 1e-12
    written(tmp_path / "free.json", COLD, C)
    done = call("fit", *inputs, "-o", tmp_path / "cam.yaml", folder=tmp_path)
    assert done.returncode in (1, 2)
    assert said in done.stderr
    assert not (tmp_path / "cam.yaml").exists()


def test_the_rates_sds_are_true_and_a_drift_of_the_distortion_is_seen(coarse):
    """100 drawn calibrations at 20, 32, 50 °C, with temperature errors of 0.1 K (sd)."""
    rng = np.random.default_rng(8)
    errors, alarms = [], 0

    def calibrations(extra=None):
        given = []
        for T in (20.0, 32.0, 50.0):
            found, C = drawn(T, rng, extra)
            shown = T + rng.normal(0, 0.1)
            given.append(Calibration(None, Camera(SENSOR, shown, found.as_array(), C)))
        return fit_calibrations(given)

    for _ in range(100):
        fit = calibrations()
        alarms += fit.model.misses_an_effect
        errors.append([
            (fit.model.rates[n] - RATES[n]) / fit.model.sds[f"rates.{n}"] for n in RATED
        ])  # fmt: skip
    spread = np.sqrt(np.mean(np.square(errors), axis=0))
    assert ((spread > 0.85) & (spread < 1.15)).all(), spread  # ± 2 sd of 100 draws
    assert alarms <= 1
    drift = np.zeros(10)
    drift[IOP_NAMES.index("A1")] = 2e-5
    assert calibrations(drift).model.misses_an_effect
