"""The user's commands on every real recording and on a rendered session.

The 50 s of the real cameras contain no thermal effect, so none may be found. The rendered session
is that of a user with a folder of photographs and a logger.
"""

from __future__ import annotations

import json
import re
import shutil
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

import thermocald as tc
from tests.commands import call
from tests.main_paths import crooked
from tests.marks import mostly_slow
from tests.pictures import FOCAL, MODEL, TAKEN, save_photograph
from tests.recordings import read_rows, write_rows

REAL = ["aviary-cam0", "aviary-cam1", "aviary-cam2", "aviary-cam6"]
SOME = mostly_slow(REAL, "aviary-cam2")


def run(*arguments: object, status: int = 0):
    """Run a command; check its exit status, and that Python gave no warning."""
    done = call(*arguments)
    assert done.returncode == status, done.stderr
    assert "Warning:" not in done.stderr
    return done


def result(*arguments: object):
    """Return the JSON document of a command."""
    return json.loads(run(*arguments, "--json", "-").stdout)


def with_temperature(recording: Path, out: Path, first: int, last: int) -> Path:
    """Copy rows first to last of a recording, 30 s apart, with an invented temperature."""
    shutil.copytree(recording, out)
    heads = read_rows(out / "epochs.csv")[first:last]
    kept = {r["epoch"] for r in heads}
    rng = np.random.default_rng([first, last])
    for k, row in enumerate(heads):
        row["frame_time"] = row["temperature_time"] = f"{1.7e9 + 30.0 * k:.1f}"
        row["temperature"] = f"{22 + 12 * np.sin(k / 16) ** 2 + rng.normal(0, 0.03):.3f}"
    points = [r for r in read_rows(out / "observations.csv") if r["epoch"] in kept]
    write_rows(out / "epochs.csv", heads)
    write_rows(out / "observations.csv", points)
    return out


@pytest.mark.parametrize("camera", SOME)
def test_without_a_temperature(shared, tmp_path, camera):
    """Commands that need a thermometer end with a one-line error; the others give results."""
    recording = shared / "data" / camera
    assert "101" in run("check", recording).stdout
    assert result("replay", recording)["ok"] >= 100
    for command in (("fit", recording, "-o", tmp_path / "m.yaml"), ("discover", recording)):
        refused = run(*command, status=1)
        assert re.search(r"\nerror: .*temperature.*\n$", f"\n{refused.stderr}")
        assert refused.stdout == ""
    assert not (tmp_path / "m.yaml").exists()


@pytest.mark.parametrize("camera", SOME)
def test_a_recording_without_thermal_effects(shared, tmp_path, camera):
    """No drift, no rate and no effect are found."""
    m1 = with_temperature(shared / "data" / camera, tmp_path / "M1", 0, 50)
    m2 = with_temperature(shared / "data" / camera, tmp_path / "M2", 50, 101)
    study = result("study", m1, m2, "--sets", 2000)
    assert [len(camera["series"]) for camera in study["cameras"]] == [2]
    found = result("discover", m1, "--verify", m2)
    names = {e["effect"] for e in found["effects"]}
    assert names <= {"target_displacement", "mount_motion"}, found["verdict"]
    model = tmp_path / "camera.thermal.yaml"
    for name, rate in result("fit", m1, m2, "-o", model)["rates"].items():
        assert abs(rate["value"]) < 4 * rate["sd"], f"{name} {rate}"
    assert result("predict", "--model", model, "--temperature", 28)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """Return a folder of JPEGs with EXIF times, a logger's file and a field; and the truth."""
    folder = tmp_path_factory.mktemp("photographs")
    truth = crooked.write_frames(folder / "frames", 6, seed=4)
    photos = folder / "photos"
    photos.mkdir()
    rows = []
    for k in range(-6, 24):
        moment = datetime.fromtimestamp(1.7e9 + k * 10 / 3, UTC)
        degrees = f"{24 + 0.05 * k * 10 / 3:.2f}".replace(".", ",")
        rows.append(f"{moment:%d.%m.%Y};{moment:%H:%M:%S};{degrees};45,1")
    log = "\n".join(["Datum;Uhrzeit;Temperatur [°C];Feuchte [%]", *rows, ""])
    (folder / "logger.csv").write_text(log)
    for head in read_rows(folder / "frames" / "epochs.csv"):
        moment = datetime.fromtimestamp(float(head["frame_time"]), UTC)
        grey = cv2.imread(str(folder / "frames" / head["frame"]), cv2.IMREAD_GRAYSCALE)
        tags = {TAKEN: f"{moment:%Y:%m:%d %H:%M:%S}", FOCAL: 3.04, MODEL: "bent"}
        save_photograph(photos / Path(head["frame"]).name, tags, grey, quality=95)
    return folder, truth


def test_photographs_and_a_logger(photographs, undrawn, tmp_path):
    """The drift is recovered; import, replay, study, fit and predict work."""
    folder, truth = photographs
    m1, store = tmp_path / "M1", tmp_path / "m1.db"
    taken = run(
        "import", folder / "photos", "--log", folder / "logger.csv", "--timezone", "UTC",
        "--testfield", folder / "frames" / "testfield.csv", "--pixel-pitch", 0.00224, "--out", m1,
    )  # fmt: skip
    assert "6 epochs" in taken.stdout
    # the frames are measured once
    assert result("replay", m1, "--store", store)["ok"] == 6
    run("export", store, "-o", tmp_path / "rows.csv", "--exterior", "series")
    rows = read_rows(tmp_path / "rows.csv")
    for name in ("c", "x0", "y0"):
        values, sds = (np.array([float(r[f"{p}{name}"]) for r in rows]) for p in ("", "sd_"))
        error = values - truth[name]
        assert abs(error - error.mean()).max() < 5 * np.median(sds), name
    page = tmp_path / "study.html"
    run("study", store, "--report", page)
    assert "px" in page.read_text(encoding="utf-8")
    model = tmp_path / "camera.thermal.yaml"
    run("fit", store, "-o", model)
    run("predict", "--model", model, "--temperature", 26)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """Return a warm-up and its fit."""
    folder = tmp_path_factory.mktemp("odd")
    tc.simulate("rpi-v2.1-heating", seed=5, epochs=60, out=folder / "plain")
    return folder / "plain", *rate_of_c(folder / "plain", folder / "camera.yaml")


def rate_of_c(recording: Path, out: Path) -> tuple[float, float, str]:
    """Fit; return the rate of c and its standard deviation, µm/K, and the printed text."""
    done = run("fit", recording, "-o", out)
    line = next(line for line in done.stdout.splitlines() if line.strip().startswith("c:"))
    words = line.replace("−", "-").split()
    return float(words[1]), float(words[3]), done.stdout + done.stderr


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_odd_epochs_do_not_harm_the_others(plain, tmp_path):
    """Few targets in every third, five of one time, a thermometer that says nothing."""
    recording, whole, sd, _ = plain
    odd = shutil.copytree(recording, tmp_path / "odd")
    points = read_rows(odd / "observations.csv")
    kept = [r for k, r in enumerate(points) if int(r["epoch"]) % 3 != 0 or k % 16 == 0]
    write_rows(odd / "observations.csv", kept)
    heads = read_rows(odd / "epochs.csv")
    for row in heads:
        row["board_temperature"] = ""
    for row in heads[11:15]:  # the rate between them is not infinite
        row["frame_time"] = heads[10]["frame_time"]
    write_rows(odd / "epochs.csv", heads)
    part, sd_part, _ = rate_of_c(odd, tmp_path / "camera.yaml")
    assert abs(part - whole) < 2 * np.hypot(sd, sd_part)
    assert sd_part < 2.5 * sd  # each alone: 1.5 times
    assert "board_temperature" not in (tmp_path / "camera.yaml").read_text()
    run("discover", odd)


def test_exchanged_names_of_targets(plain, tmp_path):
    """They are reported by each command, and do not affect the camera."""
    recording, whole, sd, of_plain = plain
    exchanged = shutil.copytree(recording, tmp_path / "exchanged")
    rows = read_rows(exchanged / "observations.csv")
    for row in rows:
        row["target"] = {"x22": "y37", "y37": "x22"}.get(row["target"], row["target"])
    write_rows(exchanged / "observations.csv", rows)
    found, sd_found, of_fit = rate_of_c(exchanged, tmp_path / "camera.yaml")
    assert abs(found - whole) < sd
    assert sd_found < 1.5 * sd
    done = [run(command, exchanged) for command in ("check", "replay")]
    for text in (of_fit, *(one.stdout + one.stderr for one in done)):
        exchange = r"x22 4\d\d px, y37 4\d\d px off; their names look exchanged"
        assert re.search(exchange, " ".join(text.split()))
    assert "elsewhere" not in of_plain
