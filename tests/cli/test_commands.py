"""The commands as users call them: results, errors in one line, exit statuses."""

from __future__ import annotations

import csv
import io
import json
import shutil
import subprocess
import sys

import cv2
import pytest

import thermocald as tc
from tests.commands import call as run
from tests.commands import document, finish
from tests.pictures import write_markers
from tests.recordings import read_rows, write_rows
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.store.database.store import Store


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Twenty-four epochs of a warming camera."""
    folder = tmp_path_factory.mktemp("recording") / "M1"
    tc.simulate("rpi-v2.1-heating", seed=1, epochs=24, out=folder)
    return folder


@pytest.fixture(scope="module")
def store(recording):
    """A store of its epochs."""
    path = recording.with_name("t.db")
    finish("replay", recording, "--store", path)
    return path


def test_a_store_gives_what_is_stored(recording, store):
    """The epochs are exported as they were adjusted, as on the dashboard: not adjusted again."""
    from_store = run("export", store, "--format", "csv")
    direct = run("export", recording, "--format", "csv")
    assert from_store.returncode == direct.returncode == 0
    a, b = (list(csv.DictReader(io.StringIO(d.stdout))) for d in (from_store, direct))
    assert len(a) == len(b) == 24
    assert [r["status"] for r in a] == [r["status"] for r in b] == ["ok"] * 24
    with Store.open(store) as opened:
        kept = opened.series_columns(opened.find_series(), ["c", "sd_c", "Z0", "sigma0"])
    for name, column in kept.items():
        assert [float(row[name]) for row in a] == column.tolist()
    for mine, theirs in zip(a, b, strict=True):
        assert abs(float(mine["c"]) - float(theirs["c"])) < 4 * float(mine["sd_c"])
    assert a[0]["sd_C1"] == ""  # held fixed
    refused = run("export", store, "--free", "c")
    assert (refused.returncode, "stored epochs are not adj" in refused.stderr) == (2, True)


def test_an_interrupted_replay_goes_on(recording, tmp_path):
    store = tmp_path / "t.db"
    half = shutil.copytree(recording, tmp_path / "half")
    for name in ("epochs.csv", "observations.csv"):
        rows = read_rows(half / name)
        write_rows(half / name, [row for row in rows if int(row["epoch"]) <= 12])
    finish("replay", half, "--store", store)
    assert document("check", store)["series"][0]["last_epoch"] == 12
    finish("replay", recording, "--store", store)
    assert document("check", store)["series"][0]["last_epoch"] == 24


@pytest.mark.parametrize("path", ["/proc/self/status", "/proc/1", "/sys", "/dev/null"])
def test_the_system_s_files_are_nothing_to_check(path):
    done = run("check", path)
    assert done.returncode == 1
    assert done.stderr.strip() == (
        f"error: {path}: belongs to the system; give a recording, config.yaml or store"
    )


def test_a_store_below_proc_is_not_sound(tmp_path):
    (tmp_path / "config.yaml").write_text(
        "store: {path: /proc/self/t.db}\nthermometers: [{name: a, driver: mock}]\n"
    )
    done = run("check", tmp_path / "config.yaml")
    assert done.returncode == 2
    assert "store.path: /proc/self/t.db: nothing can be stored there" in done.stderr


def test_export_of_several_series_names_the_option(recording, store, tmp_path):
    other = tmp_path / "M2"
    shutil.copytree(recording, other)
    head = (other / "recording.yaml").read_text()
    (other / "recording.yaml").write_text(head.replace("series: M1", "series: M2"))
    shutil.copy(store, tmp_path / "t.db")
    finish("replay", other, "--store", tmp_path / "t.db")
    done = run("export", tmp_path / "t.db")
    assert done.returncode == 1
    assert "several series fit" in done.stderr
    assert "export selects one with --series CAMERA/SERIES" in done.stderr
    finish("export", tmp_path / "t.db", "--series", "M2")


def test_photographs_of_markers_give_the_camera(tmp_path):
    """Three rendered photographs of a corner field: c, x0, y0 within 4 sd of the truth."""
    sensor = Sensor(1640, 1232, 0.00224)
    model = write_markers(tmp_path, sensor)
    images = [tmp_path / f"{k}.png" for k in range(3)]
    # the folder, and its pixel pitch by option; files for the next command and for people
    out, page = tmp_path / "found.json", tmp_path / "page.html"
    done = finish("calibrate", tmp_path, "--testfield", tmp_path / "field.csv", "--pixel-pitch",
               sensor.pixel_pitch, "--camera-out", out, "--report", page)  # fmt: skip
    written = json.loads(out.read_text())
    c, sd = written["interior"]["c"], written["interior"]["sd_c"]
    assert abs(c - model.interior.c) < 4 * sd
    assert f"written: {out}" in done.stdout.replace("\n", "")
    for words in ("Residuals and coverage", "Made on", "3 of 3 photographs"):
        assert words in page.read_text(encoding="utf-8")
    field = ("--testfield", tmp_path / "field.csv")
    held = document("calibrate", images[0], *field, "--camera", out, "--free", "none")
    assert held["interior"]["c"] == c

    # a copy of a photograph adds no information, and neither does another encoding of it
    (tmp_path / "camera.yaml").write_text(
        f"name: mock\nwidth: {sensor.width}\nheight: {sensor.height}\n"
        f"pixel_pitch: {sensor.pixel_pitch}\n"
    )
    copy = tmp_path / "copy.png"
    copy.write_bytes(images[0].read_bytes())
    smaller = tmp_path / "smaller.jpg"
    cv2.imwrite(str(smaller), cv2.imread(str(images[1]), 0), [cv2.IMWRITE_JPEG_QUALITY, 95])
    (tmp_path / "broken.jpg").write_bytes(b"no image")
    (tmp_path / "empty.jpg").write_bytes(b"")
    added = (copy, smaller, tmp_path / "broken.jpg", tmp_path / "empty.jpg")
    camera = ("--camera", tmp_path / "camera.yaml")
    result = document("calibrate", *images, *added, *field, *camera)
    assert result["status"] == "ok"
    assert [p["status"] for p in result["photographs"][:3]] == ["ok"] * 3
    for name in ("c", "x0", "y0"):
        found, sd = result["interior"][name], result["interior"][f"sd_{name}"]
        assert abs(found - getattr(model.interior, name)) < 4 * sd
        assert found == written["interior"][name]
        assert sd == written["interior"][f"sd_{name}"]
    assert len(result["correlations"]["matrix"]) == 8
    assert result["photographs"][3]["reason"] == f"is a copy of {images[0].name}"
    again, broken, empty = result["photographs"][4:]
    assert again["status"] == broken["status"] == empty["status"] == "bad_image"
    assert "0 bytes" in empty["reason"]
    assert again["reason"].startswith(f"shows the view of {images[1].name}, with the same errors")
    assert broken["reason"].startswith("is not an image")


@pytest.mark.slow
def test_the_demo_ends_with_the_hidden_effect(tmp_path):
    """The estimated drift is within 4 sd of the true one; the files can be read."""
    out = tmp_path / "demo"
    done = document("demo", "--out", out, "--epochs", 12)
    assert (done["ok"], done["targets"] >= 100) == (12, True)
    for row in done["parameters"]:
        difference = row["drift_found_px"] - row["drift_in_px"]
        assert abs(difference) < 4 * row["sd_drift_found_px"]
    finish("check", out / "M1")
    finish("check", out / "demo.db")
    found = done["discovery"]
    assert [e["effect"] for e in found["effects"]] == ["thermal_lag"]
    tau = found["effects"][0]["estimates"]["tau"]
    assert abs(tau["value"] - found["hidden"]["tau_s"]) < 4 * tau["sd"]
    gap = found["gap"]["verify"]
    assert gap["after"]["chi2_reduced"] < 1.1 < gap["before"]["chi2_reduced"]


def test_what_only_some_commands_need_is_imported_by_those():
    """OpenCV, SciPy and Matplotlib are half of the page's memory and of a command's start; SciPy's
    optimiser is 20 MB, and a camera as it is predicted, at a gauge, and in its series is without.
    """
    program = (
        "import sys, thermocald.cli, thermocald.output.dashboard.application\n"
        "thermocald.cli.application()\n"
        "print(*sorted({'cv2', 'matplotlib', 'plotly', 'scipy'} & set(sys.modules)))\n"
        "import thermocald as tc, thermocald.daemon.plan\n"
        "import thermocald.analysis.thermal.gauge, thermocald.analysis.thermal.correction\n"
        "import thermocald.analysis.online.running_series\n"
        "import thermocald.analysis.series.adjusted\n"
        "tc.load_camera\n"
        "heavy = ('scipy.optimize', 'scipy.stats', 'scipy.spatial', 'scipy.integrate')\n"
        "print(*sorted(set(heavy) & set(sys.modules)))"
    )
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
