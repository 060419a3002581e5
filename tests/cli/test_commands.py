"""The commands as users call them: results, errors in one line, exit statuses."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import cv2
import pytest

from tests.commands import call, document, finish, refuse
from tests.pictures import FOCAL, save_photograph, write_markers
from tests.recordings import read_rows, write_rows
from tests.store.small import change, create_small_series, small_epoch, small_result
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.store.database.store import Store


def test_an_interrupted_replay_goes_on(world, tmp_path):
    store = tmp_path / "t.db"
    half = shutil.copytree(world / "short", tmp_path / "half")
    for name in ("epochs.csv", "observations.csv"):
        rows = read_rows(half / name)
        write_rows(half / name, [row for row in rows if int(row["epoch"]) <= 12])
    for recording, last in ((half, 12), (world / "short", 24)):
        finish("replay", recording, "--store", store)
        assert document("check", store)["series"][0]["last_epoch"] == last


@pytest.mark.parametrize("path", ["/proc/self/status", "/proc/1", "/sys", "/dev/null"])
def test_the_system_s_files_are_nothing_to_check(path):
    said = f"error: {path}: belongs to the system; give a recording, config.yaml or store"
    assert refuse("check", path, status=1) == said


@pytest.mark.parametrize(("store", "why"), [
    ("/proc/self/t.db", "store.path: /proc/self/t.db: nothing can be stored there"),
    ("~nobody-of-this-name/t.db", "nobody-of-this-name/t.db: its folder does not exist; make it"),
    (f"{'x' * 250}.db", "its name is too long"),
    ("none/t.db", "none/t.db: its folder does not exist; make it"),
    ("config.yaml.d", "config.yaml.d: is a folder, not a store"),
])  # fmt: skip
def test_a_store_that_run_refuses_is_not_sound(tmp_path, store, why):
    (tmp_path / "config.yaml.d").mkdir()
    devices = "thermometers: [{name: a, driver: mock}]"
    (tmp_path / "config.yaml").write_text(f"store: {{path: {store}}}\n{devices}\n")
    status = 1 if store.startswith("config") else 2
    assert why in refuse("check", tmp_path / "config.yaml", status=status)


@pytest.mark.parametrize(("name", "folder"), [("config", ""), ("gauge7", "/gauge7")])
def test_a_folder_that_systemd_makes_need_not_exist(tmp_path, name, folder):
    if Path("/var/lib/thermocald").exists():
        pytest.skip("thermocald is installed here")
    for store, status in ((f"/var/lib/thermocald{folder}", 0), ("/var/lib/thermocald/other", 2)):
        (tmp_path / f"{name}.yaml").write_text(
            f"store: {{path: {store}/t.db}}\nthermometers: [{{name: a, driver: mock}}]\n"
        )
        said = call("check", tmp_path / f"{name}.yaml")
        assert said.returncode == status
        assert ("systemd will make" in said.stdout) == (status == 0)


def test_a_store_of_two_series_tells_them_and_their_fields_apart(world, tmp_path):
    other, store = shutil.copytree(world / "short", tmp_path / "M2"), tmp_path / "t.db"
    head = (other / "recording.yaml").read_text()
    (other / "recording.yaml").write_text(head.replace("series: M1", "series: M2"))
    shutil.copy(world / "thermocald.db", store)
    finish("replay", other, "--store", store)
    said = refuse("export", store, status=1)
    assert "several series fit" in said
    assert "export selects one with --series CAMERA/SERIES" in said
    finish("export", store, "--series", "M2")
    field = (other / "testfield.csv").read_text()
    X = next(row.split(",")[1] for row in field.splitlines()[1:])
    (other / "testfield.csv").write_text(field.replace(f",{X},", f",{float(X) + 1.0},", 1))
    assert "M2 with another test field; use" in refuse("replay", other, "--store", store, status=1)
    assert "stored epochs are not adj" in refuse("export", store, "--series", "M2", "--free", "c")


def test_photographs_of_markers_give_the_camera(tmp_path):
    """Three rendered photographs of a corner field: c, x0, y0 within 4 sd of the truth."""
    sensor = Sensor(1640, 1232, 0.00224)
    model = write_markers(tmp_path, sensor)
    images = [tmp_path / f"{k}.png" for k in range(3)]
    # the folder, and its pixel pitch by option; files for the next command and for people
    out, page = tmp_path / "found.json", tmp_path / "page.html"
    field = ("--testfield", tmp_path / "field.csv")
    done = finish("calibrate", tmp_path, *field, "--pixel-pitch", sensor.pixel_pitch,
                  "--camera-out", out, "--report", page)  # fmt: skip
    interior = json.loads(out.read_text())["interior"]
    for name in ("c", "x0", "y0"):
        assert abs(interior[name] - getattr(model.interior, name)) < 4 * interior[f"sd_{name}"]
    assert f"written: {out}" in done.stdout.replace("\n", "")
    for words in ("Residuals and coverage", "Made on", "3 of 3 photographs"):
        assert words in page.read_text(encoding="utf-8")
    held = document("calibrate", images[0], *field, "--camera", out, "--free", "none")
    assert held["interior"]["c"] == interior["c"]

    # a copy of a photograph adds no information, and neither does another encoding of it
    camera = tmp_path / "camera.yaml"
    camera.write_text("name: mock\nwidth: 1640\nheight: 1232\npixel_pitch: 0.00224\n")
    added = [tmp_path / name for name in ("copy.png", "smaller.jpg", "broken.jpg", "empty.jpg")]
    added[0].write_bytes(images[0].read_bytes())
    picture = cv2.imread(str(images[1]), 0)
    cv2.imwrite(str(added[1]), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])
    added[2].write_bytes(b"no image")
    added[3].write_bytes(b"")
    result = document("calibrate", *images, *added, *field, "--camera", camera)
    for name in ("c", "x0", "y0"):
        assert result["interior"][name] == interior[name]
        assert result["interior"][f"sd_{name}"] == interior[f"sd_{name}"]
    assert len(result["correlations"]["matrix"]) == 8
    *measured, copy, again, broken, empty = result["photographs"]
    assert [p["status"] for p in measured] == ["ok"] * 3
    assert copy["reason"] == f"is a copy of {images[0].name}"
    assert again["status"] == broken["status"] == empty["status"] == "bad_image"
    assert again["reason"].startswith(f"shows the view of {images[1].name}, with the same errors")
    assert broken["reason"].startswith("is not an image")
    assert "0 bytes" in empty["reason"]

    # EXIF states another focal length, unless the camera file states the principal distance
    folder = tmp_path / "zoomed"
    folder.mkdir()
    for image in images:
        grey = cv2.imread(str(image), 0)
        save_photograph(folder / f"{image.stem}.jpg", {FOCAL: 6.08}, grey, quality=95)
    said = finish("calibrate", folder, *field).stdout
    assert "pixel pitch is not known" in " ".join(said.split())
    doubted = document("calibrate", folder, *field, "--pixel-pitch", sensor.pixel_pitch)
    assert "the principal distance is" in doubted["doubts"][0]
    assert document("calibrate", folder, *field, "--camera", out)["doubts"] == []


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


@pytest.fixture
def store_path(tmp_path):
    path = tmp_path / "s.db"
    with Store.open(path, "append", durable=False) as store:
        series = create_small_series(store)
        for k in (1, 2, 5):
            store.append(series, small_epoch(k), small_result(k))
    return path


def test_a_backup_is_made_beside_a_writer_verified_and_old_ones_go(store_path, tmp_path):
    folder = tmp_path / "backups"
    folder.mkdir()
    # the last one by a clock that was set back since
    for name in ("s-20200101T000000Z.db", "s-mine.db", "s-20990101T000000Z.db"):
        (folder / name).write_bytes(b"older, or not ours to delete")
    with Store.open(store_path, "append") as writer:
        series = writer.find_series()
        writer.append(series, small_epoch(6))  # in the -wal file
        done = document("backup", store_path, folder, "--keep", "1")
    assert done["epochs"] == 4
    assert [p.rsplit("/", 1)[1] for p in done["deleted"]] == ["s-20200101T000000Z.db"]
    assert len(list(folder.glob("*.db"))) == 3
    with Store.open(folder / done["backup"].rsplit("/", 1)[1], "append") as restored:
        assert restored.last_epoch(restored.find_series()) == 6
        assert restored._db.execute("PRAGMA journal_mode").fetchone() == ("wal",)


def test_a_folder_is_made_for_the_store_of_a_configuration(store_path, tmp_path):
    config = tmp_path / "config.yaml"
    config.write_text(f"thermometers: [{{name: t, driver: mock}}]\nstore: {{path: {store_path}}}\n")
    finish("backup", "--config", config, f"{tmp_path}/backups/", "--keep", "2")
    assert len(list((tmp_path / "backups").glob("s-*Z.db"))) == 1


def test_a_damaged_store_is_not_backed_up_and_check_names_the_place(store_path, tmp_path):
    change(store_path, "UPDATE epoch SET c = c * 1.0001 WHERE number = 2")
    for to in ("new/", "new/copy.db"):
        assert "epoch 2" in refuse("backup", store_path, f"{tmp_path}/{to}", status=1)
        assert list((tmp_path / "new").iterdir()) == []
    done = call("check", store_path)
    assert done.returncode == 1
    assert "damaged: rpi/M1, epoch 2" in done.stdout
    assert "rpi/M1: epochs 3 to 4 are missing (2)" in done.stdout


def test_a_backup_is_never_written_over(store_path, tmp_path):
    (tmp_path / "there.db").write_text("mine")
    assert call("backup", store_path, tmp_path / "there.db").returncode == 1
    assert (tmp_path / "there.db").read_text() == "mine"
    assert call("backup", store_path, tmp_path / "away/there.db").returncode == 2
    assert call("backup", tmp_path / "none.db", f"{tmp_path}/new/").returncode == 1
    assert not (tmp_path / "new").exists()
    os.mkfifo(tmp_path / "pipe")
    assert call("backup", store_path, tmp_path / "pipe").returncode == 1
    assert (tmp_path / "pipe").is_fifo()
