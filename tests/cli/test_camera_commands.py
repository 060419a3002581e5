"""A camera at a temperature, two cameras compared, and a model from calibrations."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest
import yaml

from tests.commands import document, finish, refuse
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
ROWS = [IOP_NAMES.index(name) for name in FREE]


def covariance(seed=0):
    """The covariance of a calibration from a dozen photographs: c and A1 are correlated."""
    sd = np.array([4e-4, 3e-4, 3e-4, 2e-5, 4e-6])
    r = np.eye(5)
    r[0, 3] = r[3, 0] = -0.6
    C = np.zeros((10, 10))
    C[np.ix_(ROWS, ROWS)] = r * np.outer(sd, sd) * np.random.default_rng(seed).uniform(0.8, 1.2)
    return C


def interior(temperature):
    change = np.array([RATES.get(name, 0.0) for name in IOP_NAMES])
    return InteriorOrientation.from_array(COLD.as_array() + (temperature - 20.0) * change)


def drawn(temperature, rng, extra=0.0):
    """A calibration at a temperature, with the errors that its covariance states."""
    C = covariance(int(temperature))
    values = interior(temperature).as_array() + rng.multivariate_normal(np.zeros(10), C)
    return InteriorOrientation.from_array(values + extra * (temperature - 20.0)), C


def write_calibration(path, temperature, rng, start=None):
    """Write a calibration as `calibrate --json` does."""
    found, C = drawn(temperature, rng)
    sd = np.sqrt(np.diag(C))
    values = dict(zip(IOP_NAMES, found.as_array().tolist(), strict=True))
    path.write_text(json.dumps({
        "format": "thermocald-calibration/1",
        "camera": {"name": "rpi", "width": 3280, "height": 2464, "pixel_pitch": 0.00112},
        "interior": values | {f"sd_{n}": float(sd[i]) for n, i in zip(FREE, ROWS, strict=True)},
        "correlations": {"names": list(FREE), "matrix": (
            C[np.ix_(ROWS, ROWS)] / np.outer(sd[ROWS], sd[ROWS])).tolist()},
        "photographs": [
            {"image": f"{k}.jpg", "status": "ok",
             "time": start and (start + timedelta(seconds=30 * k)).isoformat()} for k in range(4)
        ],
    }))  # fmt: skip


def write_camera(path, camera, C=None, sensor=SENSOR):
    camera_files.write(CameraModel(sensor, camera), path, "json", C, "", "rpi")
    return path


def test_the_camera_at_35_degrees_as_a_ros_file(tmp_path):
    model = tmp_path / "cam.yaml"
    C = np.diag([1e-4, 2e-6, 1e-6]) ** 2
    write_model(model, ThermalModel(
        "rpi", SENSOR, 20.0, COLD, RATES, covariance=tuple(map(tuple, C.tolist())),
        covariance_names=("interior.c", "rates.c", "rates.x0"), validity={"housing": (15.0, 50.0)},
    ))  # fmt: skip
    at = ("camera", "at", model, "--temperature")
    found = document(*at, 35, "--to", "ros", "-o", tmp_path / "r.yaml")
    K = yaml.safe_load((tmp_path / "r.yaml").read_text())["camera_matrix"]["data"]
    c = COLD.c + 15 * RATES["c"]
    assert found["c"] == pytest.approx(c, abs=1e-12)
    assert found["sd_c"] == pytest.approx(np.hypot(1e-4, 15 * 2e-6), rel=1e-9)
    assert K[4] == pytest.approx(c / SENSOR.pixel_pitch, abs=1e-6)
    assert "exact" in found["statement"]
    own = finish(*at, 35, "-o", tmp_path / "own.json")
    read = camera_files.read(tmp_path / "own.json")
    assert np.sqrt(read.covariance[0, 0]) == pytest.approx(found["sd_c"], rel=1e-9)
    assert "at 35 °C" in own.stdout
    said = refuse("camera", "diff", tmp_path / "own.json", model)
    assert "`thermocald camera at` writes" in said
    assert "if it is in fahrenheit" in refuse(*at, 90, "-o", tmp_path / "x")
    assert not (tmp_path / "x").exists()


def test_two_cameras_differ_by_what_was_put_in(tmp_path):
    """A principal point moved by 1 px moves every point by 1 px; a rotation absorbs most of it.

    Without a covariance no standard deviation is stated, and other sensors are refused.
    """
    moved = replace(COLD, x0=COLD.x0 + SENSOR.pixel_pitch)
    a = write_camera(tmp_path / "a.json", COLD, covariance(1))
    b = write_camera(tmp_path / "b.json", moved, covariance(2))
    found = document("camera", "diff", a, b)
    assert found["rms_px"] == pytest.approx(1.0, abs=1e-9)
    assert found["largest_px"] == pytest.approx(1.0, abs=1e-9)
    assert found["rms_turned_px"] < 0.3
    (row,) = (row for row in found["parameters"] if row["name"] == "x0")
    assert row["difference"] == pytest.approx(SENSOR.pixel_pitch, abs=1e-12)
    sd = np.sqrt(covariance(1)[1, 1] + covariance(2)[1, 1])
    assert row["sd_difference"] == pytest.approx(sd, rel=1e-9)
    text = finish("camera", "diff", a, b, "--report", tmp_path / "d.html").stdout
    assert "in the image: 1.00 ±" in text
    assert "(1.00 ± " in text
    assert "<svg" in (tmp_path / "d.html").read_text()

    found = document("camera", "diff", a, write_camera(tmp_path / "c.json", interior(40.0)))
    assert "sd_rms_px" not in found
    assert "sd_difference" not in found["parameters"][0]
    other = write_camera(tmp_path / "d.json", COLD, sensor=Sensor(1640, 1232, 0.00224))
    assert "only cameras of one image size" in refuse("camera", "diff", a, other)


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


def test_calibrations_whose_temperatures_are_no_celsius_are_doubted(tmp_path):
    rng, model = np.random.default_rng(5), tmp_path / "cam.yaml"
    for T in (20, 50):
        write_calibration(tmp_path / f"{T}.json", T, rng)
    for unit, cold, hot in (("fahrenheit", 68, 122), ("kelvin", 293.15, 323.15)):
        given = (f"{cold}={tmp_path / '20.json'}", f"{hot}={tmp_path / '50.json'}")
        assert f"are their temperatures in {unit}?" in finish("fit", *given, "-o", model).stdout


def test_the_logger_tells_the_temperature_of_photographs(tmp_path):
    """Cold in the morning, warm at noon; the times are EXIF's, in the given time zone."""
    rng = np.random.default_rng(6)
    starts = {20: datetime(2026, 6, 14, 8, 0), 45: datetime(2026, 6, 14, 12, 0)}
    for T, start in starts.items():
        write_calibration(tmp_path / f"{T}.json", T, rng, start)
    rows = [
        f"{start + timedelta(seconds=30 * k - 60):%d/%m/%Y %H:%M:%S},{T}\n"
        for T, start in starts.items() for k in range(8)
    ]  # fmt: skip
    (tmp_path / "log.csv").write_text("Time,Celsius\n" + "".join(rows))
    command = ("fit", tmp_path / "20.json", tmp_path / "45.json", "-o", tmp_path / "cam.yaml")
    found = document(*command, "--log", tmp_path / "log.csv", "--timezone", "Europe/Berlin")
    assert [c["temperature"] for c in found["calibrations"]] == [20.0, 45.0]
    assert list(found["validity"]) == ["temperature"]
    assert not found["effect_missing"]
    for name in RATED:
        rate = found["rates"][name]
        assert abs(rate["value"] - RATES[name]) < 4 * rate["sd"] < 2e-4, name
    finish("predict", "--model", tmp_path / "cam.yaml", "--temperature", 30)
    assert "at which temperature? Write 21.5=" in refuse(*command)


def test_the_rates_sds_are_true_and_a_drift_of_the_distortion_is_seen(coarse):
    """100 drawn calibrations at 20, 32, 50 °C, with temperature errors of 0.1 K (sd)."""
    rng = np.random.default_rng(8)
    errors, alarms = [], 0

    def fit(extra=0.0):
        given = []
        for T in (20.0, 32.0, 50.0):
            found, C = drawn(T, rng, extra)
            shown = T + rng.normal(0, 0.1)
            given.append(Calibration(None, Camera(SENSOR, shown, found.as_array(), C)))
        return fit_calibrations(given).model

    for _ in range(100):
        model = fit()
        alarms += model.misses_an_effect
        errors.append([(model.rates[n] - RATES[n]) / model.sds[f"rates.{n}"] for n in RATED])
    spread = np.sqrt(np.mean(np.square(errors), axis=0))
    assert ((spread > 0.85) & (spread < 1.15)).all(), spread  # ± 2 sd of 100 draws
    assert alarms <= 1
    bent = fit(2e-5 * (np.array(IOP_NAMES) == "A1"))
    assert bent.misses_an_effect
    wider = bent.sds["rates.x0"] / model.sds["rates.x0"]
    assert wider == pytest.approx(bent.evidence["fit"]["significance_sigmas"], rel=0.05)
