"""The daemon without a test field: the thermal model predicts, control points give the pose."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from tests.commands import call
from tests.daemon.conftest import columns_of, make_recording, play, replayed_camera
from tests.recordings import read_rows, write_rows
from thermocald.analysis.thermal.control_points import ControlPoints
from thermocald.analysis.thermal.thermal_camera import load_camera
from thermocald.physics.testfields import demonstration_field, demonstration_model
from thermocald.store.database.store import Store
from thermocald.store.recording.testfield_file import read_testfield


@pytest.fixture
def thermal_model(small_camera, tmp_path):
    """The rendered camera's true model, as a fit would write it."""
    document = yaml.safe_load(small_camera.read_text())
    document["validity"] = {"temperature": [15.0, 60.0]}
    names = ["interior.c", "interior.x0", "interior.y0", "rates.c", "rates.x0", "rates.y0"]
    sds = [4e-4, 5e-4, 5e-4, 4e-6, 4e-6, 4e-6]
    document["covariance"] = {"parameters": names, "matrix": np.diag(np.square(sds)).tolist()}
    path = tmp_path / "camera.thermal.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def test_predicted_epochs_through_a_restart_are_not_taken_for_calibrations(
    daemon, devices, thermal_model
):
    daemon.run(**devices(thermal_model=str(thermal_model), series="gauge"))
    daemon.more(5)
    daemon.kill()
    daemon.start()
    daemon.more(4)
    assert daemon.stop() == 0
    _, words = daemon.stored()
    # epochs that a busy machine deferred are missing if the daemon stops before
    assert {"predicted"} <= set(words) <= {"predicted", "not_calibrated"}
    row = [row for row in daemon.results() if row["status"] == "predicted"][-1]
    assert row["sd_c"] > 0
    assert row["X0"] is None
    assert row["reading_age_s"] < 5
    assert row["opencv"]["fx"] == pytest.approx(row["c"] / 0.00448)
    assert row["opencv"]["sd_fx"] == pytest.approx(row["sd_c"] / 0.00448)
    for command in (["study"], ["fit", "-o", "m.yaml"]):
        done = call(*command, daemon.store)
        assert done.returncode == 1
        assert "nothing in it was calibrated" in " ".join(done.stderr.split())


DAY = 144  # epochs


def gauge_day(folder, recording, model, *parts):
    """Return the columns that a daemon stores of a recorded day in parts of so many epochs."""
    folder.mkdir()
    camera = replayed_camera(recording, name="g", thermometers=["t"], thermal_model=str(model))
    del camera["testfield"]
    for epochs in (*parts, 0):
        play(folder, [camera], epochs).close()
        names = ("epoch", "frame_time", "temperature", "status", "c", "sd_c")
        found = columns_of(folder / "thermocald.db", *names)
        camera["after"] = float(found["frame_time"][-1])
    return found


def test_a_day_with_restarts_is_predicted_as_a_day_without(tmp_path, thermal_model):
    """The lens follows the housing with a lag, which a restarted daemon must not forget."""
    document = yaml.safe_load(thermal_model.read_text())
    lag = {"effect": "thermal_lag", "parameters": {"tau": {"value": 1800.0, "unit": "s"}}}
    thermal_model.write_text(yaml.safe_dump({**document, "effects": [lag]}))
    day = make_recording(
        tmp_path / "day", DAY, per_side=2, interval=600.0,
        temperature_of=lambda k: 25.0 + 8.0 * np.sin(2 * np.pi * k / DAY),
    )  # fmt: skip
    whole = gauge_day(tmp_path / "whole", day, thermal_model)
    parts = gauge_day(tmp_path / "parts", day, thermal_model, 1, 59, 1)
    assert (whole["status"] == "predicted").all()
    assert len(whole["epoch"]) == DAY
    for name in ("epoch", "frame_time", "temperature", "status"):
        np.testing.assert_array_equal(parts[name], whole[name])
    np.testing.assert_allclose(parts["c"], whole["c"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(parts["sd_c"], whole["sd_c"], rtol=1e-6)
    assert np.ptp(whole["sd_c"]) > 0


@pytest.mark.slow
def test_posed_epochs_are_those_of_the_rendered_camera_and_kept_frames_stand_there_corrected_too(
    daemon, devices, thermal_model, small_field, tmp_path
):
    """Every second frame, and beside it the same frame at T₀ with the row's pose.

    The control points are the corners of half the markers, in metres of a national grid.
    """
    field, grid = read_testfield(small_field), np.array([192e6, 313e6, 138e3])
    metres = ((field.points + grid) / 1000).round(6).tolist()
    write_rows(tmp_path / "gcp.csv", [
        {"target": name, "X": X, "Y": Y, "Z": Z, "sX": 2e-4, "sY": 2e-4, "sZ": 2e-4,
         "kind": field.kinds[i], "code": field.codes[i]}
        for i, (name, (X, Y, Z)) in enumerate(zip(field.names, metres, strict=True)) if i % 8 < 4
    ])  # fmt: skip
    model = {"thermal_model": str(thermal_model), "control_points": str(tmp_path / "gcp.csv")}
    frames, folder = {"every_n": 2, "corrected": True}, daemon.frames
    daemon.run("--epochs", "6", **devices(series="gauge", **model), keep="every_n", frames=frames)
    assert daemon.wait() == 0
    assert set(daemon.stored()[1]) == {"resected"}
    with Store.open(daemon.store) as store:
        series = store.find_series()
        epochs = list(store.epochs(series))
    assert series.head.extra["control_origin_mm"] == [192e6, 313e6, 0.0]
    pose = demonstration_model(demonstration_field("markers")).exterior.as_array()
    pose[3:] += 0.0, 0.0, 138e3
    for one in epochs:
        error, C = one.result.values[10:] - pose, one.result.covariance[10:, 10:]
        assert error @ np.linalg.solve(C, error) < 30
    kept = sorted(p.name for p in folder.rglob("*.*"))
    numbers = ("0000002", "0000004", "0000006")
    assert kept == sorted(f"{n}{tail}" for n in numbers for tail in ("-corrected.jpg", ".png"))
    with Image.open(next(folder.rglob("0000006-corrected.jpg"))) as image:
        told = json.loads(image.info["comment"])
        assert image.size == (820, 616)
    row = daemon.results()[-1]
    assert (row["epoch"], row["status"]) == (6, "resected")
    assert told["pose"]["omega"] == pytest.approx(row["omega"])
    assert told["pose"]["sd_X0"] == pytest.approx(row["sd_X0"])
    assert told["opencv"]["sd_fx"] == pytest.approx(row["opencv"]["sd_fx"])
    assert told["pose"]["origin_mm"] == [192e6, 313e6, 0.0]
    # on a busy machine, deferred frames are stored as well
    assert {f"{n}.png" for n in numbers} <= {e.epoch.frame.name for e in epochs if e.epoch.frame}


@pytest.fixture
def river(tmp_path):
    """The example's gauge under a bridge, in a folder where its files can be damaged."""
    examples = Path(__file__).resolve().parents[2] / "examples"
    return Path(shutil.copytree(examples / "river", tmp_path / "river"))


def few(folder: Path) -> None:
    write_rows(folder / "gcp.csv", read_rows(folder / "gcp.csv")[:3])


def symmetric(folder: Path) -> None:
    """Four points in a rectangle, which a turn by 180° puts on each other."""
    camera = load_camera(folder / "camera.thermal.yaml").at(20.0)
    control = ControlPoints.read(folder / "gcp.csv", "m")
    corners = [[-4e3, 1e4, 0.0], [4e3, 1e4, 9e2], [4e3, 16e3, 0.0], [-4e3, 16e3, 9e2]]
    corners = np.add(corners, [0.0, 0.0, 139e3])
    seen = camera.project(corners, control.pose(camera).values[10:])
    table = np.column_stack([(corners + control.origin) / 1000, np.full((4, 3), 0.01), seen])
    names = read_rows(folder / "gcp.csv")[0]
    rows = [(f"g{i}", *row, 1, 1) for i, row in enumerate(table.tolist())]
    write_rows(folder / "gcp.csv", [dict(zip(names, row, strict=True)) for row in rows])


def small_frame(folder: Path) -> None:
    frame = folder / "photographs/20240506-060000.jpg"
    Image.open(frame).resize((410, 308)).save(frame)


@pytest.mark.parametrize(
    ("name", "damage", "status", "words"),
    [("bridge", None, 0, "10 control points, 10 within the reference frame, sigma0"),
     ("bank", None, 0, "the interior orientation alone"),
     ("bridge", symmetric, 0, "doubtful: the control points fit as well with g2, g3, g0, g1 named"),
     ("bridge", small_frame, 2, "has 410×308 px, the camera's frames 820×616 px"),
     ("bridge", few, 0, "warning: the control points give no pose")],
)  # fmt: skip
def test_check_says_what_the_control_points_are_worth(river, name, damage, status, words):
    if damage:
        damage(river)
    done = call("check", river / f"{name}.yaml")
    assert words in " ".join((done.stdout + done.stderr).split())
    assert done.returncode == status


def test_the_check_of_a_session_needs_a_test_field(daemon, devices, thermal_model):
    daemon.configure(**devices(thermal_model=str(thermal_model)))
    done = call("session", "start", "--series", "M7", "--epochs", "2", folder=daemon.folder)
    assert "camera 'one': the check needs its `testfield`" in done.stderr
