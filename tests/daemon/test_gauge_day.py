"""Twenty-four hours of a gauge in a minute: kills, downtimes and a lost thermometer."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.daemon.conftest import fast_run
from tests.store.small import write_recording
from thermocald.epoch import Epoch
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.physics.model import ModelEffect
from thermocald.physics.model_file import write_model
from thermocald.physics.testfields import corner_field, demonstration_model
from thermocald.store.recording.head import CameraSpec, Channel, Head

pytestmark = pytest.mark.slow

BEGIN, PERIOD_S, TAU = 1.7e9, 60.0, 1200.0
RATES = np.array([2.0e-4, -4.5e-4, -3.0e-4])
LOST = (9.0, 10.5)  # hours without a thermometer
DOWN_S = 900.0  # from a kill to the next start
FIELD = corner_field("plain", per_side=2, pitch_mm=286.0)
MODEL = demonstration_model(FIELD)


def warmth(seconds: np.ndarray) -> np.ndarray:
    """Return the air temperature, °C, at seconds of a day."""
    return 20.0 - 10.0 * np.cos(2 * np.pi * seconds / 86_400) + 3.0 * np.sin(seconds / 2_700)


FINE = np.arange(-86_400.0, 90_000.0, 5.0)
LENS = np.empty_like(FINE)
LENS[0] = warmth(FINE[0])
for _k, _T in enumerate(warmth(FINE[1:])):  # the lens lags
    LENS[_k + 1] = _T + (LENS[_k] - _T) * np.exp(-5.0 / TAU)


def true_interior(seconds: np.ndarray) -> np.ndarray:
    """Return c, x0, y0 (n, 3) mm at times of the day."""
    T = np.interp(seconds, FINE, LENS)
    return MODEL.interior.as_array()[:3] + RATES * (T[:, None] - 25.0)


def record(folder: Path, first_s: float, rng: np.random.Generator) -> Path:
    """Write a recording of the devices from a second of the day to its end."""

    def epochs():
        for k, second in enumerate(np.arange(first_s, 86_400.0, PERIOD_S)):
            values = MODEL.interior.as_array()
            values[:3] = true_interior(np.array([second]))[0]
            at = project(MODEL.sensor, values, MODEL.exterior.as_array(), FIELD.points)
            at = at + rng.normal(0, 0.04, at.shape)
            seen = Observations(np.arange(len(FIELD)), at, np.full(at.shape, 0.04))
            lost = LOST[0] <= second / 3600 < LOST[1]
            reading = np.nan if lost else float(warmth(second) + rng.normal(0, 0.03))
            time_s = BEGIN + second
            yield Epoch(k + 1, time_s, time_s, {"temperature": reading}, observations=seen)

    spec = CameraSpec("gauge", MODEL.sensor, 3.04)
    head = Head("day", "M1", PERIOD_S, spec, {"temperature": Channel(0.01)})
    write_recording(folder, head, FIELD, epochs())
    return folder


@pytest.fixture
def site(tmp_path):
    """Crosses and a thermal model with small sds, so that past and thermometer dominate."""
    names = ("c", "x0", "y0")
    rates = dict(zip(names, RATES.tolist(), strict=True))
    lag = ModelEffect("thermal_lag", {"tau": TAU})
    write_model(tmp_path / "model.yaml", replace(MODEL, rates=rates, T0=25.0, effects=(lag,)))
    document = yaml.safe_load((tmp_path / "model.yaml").read_text())
    sds = [2e-5, 2e-5, 2e-5, 1e-7, 1e-7, 1e-7]
    listed = [f"interior.{n}" for n in names] + [f"rates.{n}" for n in names]
    document["covariance"] = {"parameters": listed, "matrix": np.diag(np.square(sds)).tolist()}
    document["validity"] = {"temperature": [0.0, 45.0]}
    (tmp_path / "model.yaml").write_text(yaml.safe_dump(document))
    with (tmp_path / "gcp.csv").open("w", newline="") as out:
        rows = csv.writer(out)
        rows.writerow(["target", "X", "Y", "Z", "sX", "sY", "sZ", "code"])
        for i, (name, at) in enumerate(zip(FIELD.names, FIELD.points, strict=True)):
            rows.writerow([name, *at, 0.05, 0.05, 0.05, f"DICT_4X4_50:{i}"])
    return tmp_path


def run_until_killed(daemon, recording: Path, rows: int) -> list[dict]:
    """Run a daemon at full speed, kill it after a number of rows, and return all rows."""
    replay = {"driver": "replay", "recording": str(recording), "period_s": PERIOD_S}
    document = {
        "store": {"path": str(daemon.store)}, "frames": {"keep": "none"},
        "cameras": [{"name": "gauge", "thermal_model": "model.yaml", "control_points": "gcp.csv",
                     "thermometers": ["box"], **replay}],
        "thermometers": [{"name": "box", **replay}],
        "outputs": [{"name": "log", "driver": "jsonl", "path": "results.jsonl"}],
    }  # fmt: skip
    script = fast_run(json.dumps(document), 0)
    daemon.process = daemon.forker.start(daemon.folder, script=script)
    daemon.until(
        lambda: daemon.process.poll() is not None or len(daemon.results()) >= rows, 300, alive=False
    )
    daemon.kill()
    return daemon.results()


@pytest.mark.timeout(900)
def test_a_day_with_kills_and_a_lost_thermometer(daemon, site):
    """No reported row is lost; c, x0, y0 are within their sds, which rise and fall as expected."""
    rng = np.random.default_rng(5)
    first, told, starts, left = 0.0, [], [], 86_400.0
    while left > 0:
        starts.append(BEGIN + first)
        folder = record(site / f"part-{len(starts)}", first, rng)
        # the last daemon has time to forget, and stops by itself
        more = int(rng.integers(150, 300)) if first < 57_600 else 10_000
        told = run_until_killed(daemon, folder, len(told) + more)
        left = BEGIN + 86_400 - PERIOD_S - told[-1]["frame_time"]
        first = told[-1]["frame_time"] - BEGIN + DOWN_S
    stored, _ = daemon.stored()
    assert "camera_moved" not in daemon.events()
    assert {row["epoch"] for row in told} <= set(stored)
    assert len(starts) >= 5
    when = np.array([row["frame_time"] for row in told])
    values = np.array([[row[n] for n in ("c", "x0", "y0")] for row in told])
    sd = np.array([[row[f"sd_{n}"] for n in ("c", "x0", "y0")] for row in told])
    ratio = np.abs(values - true_interior(when - BEGIN)) / sd
    assert ratio.max() < 4.0
    hours = (when - BEGIN) / 3600
    lost = (hours > LOST[0] + 0.1) & (hours < LOST[1])
    statuses = np.array([row["status"] for row in told])
    assert set(statuses[lost]) == {"no_temperature"}
    usual = np.median(sd[~lost, 1])
    assert sd[lost, 1].max() > 20 * usual
    assert sd[-1, 1] < 1.5 * usual
    # the first start has no past; the others lack only the time since the last row
    unknown = np.array([row["unknown_past_px"] for row in told])
    at = [int(np.argmin(np.abs(when - start))) for start in starts]
    assert unknown[0] > 2 * max(unknown[k] for k in at[1:])
    assert all(unknown[k] > 0 for k in at)
    assert unknown[-1] < 0.05
