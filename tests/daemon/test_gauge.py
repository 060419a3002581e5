"""The daemon without a test field: the thermal model predicts, control points give the pose."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from tests.commands import call
from tests.daemon.conftest import fast_run, make_recording, replayed_camera
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


@pytest.fixture
def control_points(tmp_path, small_field):
    """The corners of half the markers of the rendered field, in metres of a national grid."""
    field = read_testfield(small_field)
    path = tmp_path / "gcp.csv"
    with path.open("w", newline="") as out:
        rows = csv.writer(out)
        rows.writerow(["target", "X", "Y", "Z", "sX", "sY", "sZ", "kind", "code"])
        for i, name in enumerate(field.names):
            if i % 8 < 4:  # whole markers
                at = field.points[i] / 1000 + (192_000, 313_000, 138)
                row = [name, *(f"{v:.6f}" for v in at), 2e-4, 2e-4, 2e-4]
                rows.writerow([*row, field.kinds[i], field.codes[i]])
    return path


def test_predicted_epochs_through_a_restart_are_not_taken_for_calibrations(
    daemon, devices, thermal_model
):
    daemon.run(**devices(thermal_model=str(thermal_model), series="gauge"))
    daemon.until(lambda: len(daemon.results()) >= 5)
    daemon.kill()
    daemon.start()
    count = len(daemon.results())
    daemon.until(lambda: len(daemon.results()) >= count + 4)
    assert daemon.stop() == 0
    _, words = daemon.stored()
    # epochs that a busy machine deferred are missing if the daemon stops before
    assert {"predicted"} <= set(words) <= {"predicted", "not_calibrated"}
    row = [row for row in daemon.results() if row["status"] == "predicted"][-1]
    assert row["sd_c"] > 0
    assert row["X0"] is None
    assert row["reading_age_s"] < 5
    camera = row["opencv"]
    assert (camera["width"], camera["height"]) == (820, 616)
    assert camera["fx"] == pytest.approx(row["c"] / 0.00448)
    assert camera["sd_fx"] == pytest.approx(row["sd_c"] / 0.00448)
    done = call("export", daemon.store)
    assert done.returncode == 0, done.stderr
    (last,) = (
        r for r in csv.DictReader(done.stdout.splitlines()) if r["epoch"] == f"{row['epoch']}"
    )
    assert last["status"] == "predicted"
    assert float(last["c"]) == pytest.approx(row["c"])
    for command in (["study"], ["fit", "-o", "m.yaml"]):
        done = call(*command, daemon.store)
        assert done.returncode == 1
        assert "nothing in it was calibrated" in " ".join(done.stderr.split())
        assert "Traceback" not in done.stderr


DAY = 144  # epochs
# a script that ends the process as a kill does, once it has stored an epoch
KILLED_AFTER = """
import os
from thermocald.daemon.store_guard import StoreGuard
append = StoreGuard.append
def killed(guard, row):
    append(guard, row)
    if row.epoch.number == {}:
        os._exit(137)
    return True
StoreGuard.append = killed
"""


def gauge_day(folder, recording, model, forker, kills):
    """Return the columns that daemons store of a recorded day; kills: the last epoch of each."""
    folder.mkdir()
    camera = replayed_camera(recording, name="g", thermometers=["t"], thermal_model=str(model))
    del camera["testfield"]
    thermometer = {"name": "t", "driver": "replay", "recording": str(recording)}
    document = {"cameras": [camera], "thermometers": [thermometer], "frames": {"keep": "none"}}
    for last in (*kills, DAY):
        run = KILLED_AFTER.format(last % DAY) + fast_run(json.dumps(document), 0)
        assert forker.start(folder, script=run).wait(120.0) == (137 if last in kills else 0)
        with Store.open(folder / "thermocald.db") as store:
            names = ["epoch", "frame_time", "temperature", "status", "c", "sd_c"]
            found = store.series_columns(store.find_series(), names)
        camera["after"] = thermometer["after"] = float(found["frame_time"][-1])
    return found


def test_a_day_with_kills_is_predicted_as_a_day_without(tmp_path, forker, thermal_model):
    """The lens follows the housing with a lag, which a killed daemon must not forget."""
    document = yaml.safe_load(thermal_model.read_text())
    lag = {"effect": "thermal_lag", "parameters": {"tau": {"value": 1800.0, "unit": "s"}}}
    thermal_model.write_text(yaml.safe_dump({**document, "effects": [lag]}))
    day = make_recording(
        tmp_path / "day", DAY, per_side=2, interval=600.0,
        temperature_of=lambda k: 25.0 + 8.0 * np.sin(2 * np.pi * k / DAY),
    )  # fmt: skip
    whole = gauge_day(tmp_path / "whole", day, thermal_model, forker, [])
    killed = gauge_day(tmp_path / "killed", day, thermal_model, forker, [1, 60, 61])
    assert (whole["status"] == "predicted").all()
    for name in ("epoch", "frame_time", "temperature", "status"):
        np.testing.assert_array_equal(killed[name], whole[name])
    np.testing.assert_allclose(killed["c"], whole["c"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(killed["sd_c"], whole["sd_c"], rtol=1e-6)
    assert np.ptp(whole["sd_c"]) > 0


@pytest.mark.slow
def test_posed_epochs_are_those_of_the_rendered_camera_and_kept_frames_stand_there_corrected_too(
    daemon, devices, thermal_model, control_points
):
    """Every second frame, and beside it the same frame at T₀ with the row's pose."""
    model = {"thermal_model": str(thermal_model), "control_points": str(control_points)}
    document = devices(series="gauge", **model)
    folder = daemon.folder / "frames"
    frames = {"keep": "every_n", "every_n": 2, "corrected": True, "folder": str(folder)}
    daemon.run("--epochs", "6", **document | {"frames": frames | {"min_free_gb": 0}})
    assert daemon.wait() == 0
    _, words = daemon.stored()
    assert set(words) == {"resected"}
    with Store.open(daemon.store) as store:
        series = store.find_series()
        origin = np.array(series.head.extra["control_origin_mm"])
        epochs = list(store.epochs(series))
    assert origin.tolist() == [192e6, 313e6, 0.0]
    pose = demonstration_model(demonstration_field("markers")).exterior.as_array()
    grid = np.array([192e6, 313e6, 138e3]) - origin
    for one in epochs:
        error = one.result.values[10:] - pose - np.concatenate([np.zeros(3), grid])
        C = one.result.covariance[10:, 10:]
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


RIVER = Path(__file__).resolve().parents[2] / "examples" / "river"


@pytest.fixture
def river(tmp_path):
    """The example's gauge under a bridge, in a folder where its files can be damaged."""
    shutil.copytree(RIVER, tmp_path / "river")
    return tmp_path / "river"


def test_check_says_what_the_control_points_are_worth(river):
    done = call("check", river / "bridge.yaml")
    assert done.returncode == 0, done.stderr
    assert "camera bridge: 10 control points, 10 within the reference frame, sigma0" in done.stdout
    assert "the interior orientation alone" in call("check", river / "bank.yaml").stdout


def test_check_doubts_names_that_a_symmetry_leaves_untested(river):
    """Four points in a rectangle, which a turn by 180° puts on each other."""
    file, camera = river / "gcp.csv", load_camera(river / "camera.thermal.yaml").at(20.0)
    control = ControlPoints.read(file, "m")
    corners = [[-4e3, 1e4, 0.0], [4e3, 1e4, 9e2], [4e3, 16e3, 0.0], [-4e3, 16e3, 9e2]]
    corners = np.add(corners, [0.0, 0.0, 139e3])
    seen = camera.project(corners, control.pose(camera).values[10:])
    table = np.column_stack([(corners + control.origin) / 1000, np.full((4, 3), 0.01), seen])
    rows = [",".join(map(str, (f"g{i}", *row, 1, 1))) for i, row in enumerate(table.tolist())]
    file.write_text("\n".join([file.read_text().splitlines()[0], *rows]) + "\n")
    said = call("check", river / "bridge.yaml").stdout
    assert "doubtful: the control points fit as well with g2, g3, g0, g1 named g0, g1" in said


def test_a_reference_frame_of_another_size_and_clicks_of_another_image_are_said(river):
    frame = river / "photographs/20240506-060000.jpg"
    Image.open(frame).resize((410, 308)).save(frame)
    done = call("check", river / "bridge.yaml")
    assert done.returncode == 2
    assert "has 410×308 px, the camera's frames 820×616 px" in " ".join(done.stderr.split())


@pytest.mark.parametrize(
    ("rows", "scale", "words"),
    [(slice(0, 10), 10.0, "0 control points have x, y within the frame"),
     (slice(0, 2), 1.0, "2 control points have x, y within the frame"),
     (slice(0, 3), 1.0, "warning: the control points give no pose")],
)  # fmt: skip
def test_control_points_that_give_no_pose_are_said_before_the_start(river, rows, scale, words):
    head, *lines = (river / "gcp.csv").read_text().splitlines()
    kept = [line.split(",") for line in lines[rows]]
    kept = [[*one[:7], *(str(scale * float(v)) for v in one[7:9]), *one[9:]] for one in kept]
    (river / "gcp.csv").write_text("\n".join([head, *map(",".join, kept)]) + "\n")
    done = call("check", river / "bridge.yaml")
    assert "Traceback" not in done.stderr
    assert words in " ".join((done.stdout + done.stderr).split())


def test_the_check_of_a_session_needs_a_test_field(daemon, devices, thermal_model):
    daemon.configure(**devices(thermal_model=str(thermal_model)))
    done = call("session", "start", "--series", "M7", "--epochs", "2", folder=daemon.folder)
    assert "camera 'one': the check needs its `testfield`" in done.stderr
