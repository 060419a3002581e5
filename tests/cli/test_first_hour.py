"""The first hour of a new user, command by command, with the files that the commands write.

The corner is photographed from its own PDF (`printed_sheets`), the camera drifts by a known amount,
the logger writes as a German one does, or the camera is a phone's on an adb server; ChArUco and
AprilGrid are drawn by their own programs. The result, the drift with its standard deviation, is
compared with the truth.
"""

from __future__ import annotations

import csv
import io
import json
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from tests.commands import succeed as run
from tests.docs.blocks import blocks
from tests.docs.worlds import put_photographs
from tests.drivers.fakes.adb_server import AdbServer, FakePhone
from tests.photogrammetry import board_images
from tests.photogrammetry.network_cases import looking_at
from tests.photogrammetry.printed_sheets import photograph
from tests.pictures import FOCAL, MODEL, TAKEN, save_photograph
from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor
from thermocald.store.recording.testfield_file import read_testfield

pytest.importorskip("PIL.Image")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

SENSOR = Sensor(1640, 1232, 0.00224)
COLD = InteriorOrientation(3.05, 0.02, -0.01, A1=-2e-3)
RATE_C, RATE_X0 = 0.2e-3, -0.4e-3
"""The true rates of the camera, mm/K."""
EPOCHS = 12
START = datetime(2026, 6, 14, 12, 0, 0)


def camera_at(temperature):
    warm = temperature - 20.0
    drifted = InteriorOrientation(
        COLD.c + RATE_C * warm, COLD.x0 + RATE_X0 * warm, COLD.y0, A1=COLD.A1
    )
    return CameraModel(SENSOR, drifted)


def temperature_of(epoch):
    return 20.0 + 15.0 * np.sin(np.pi * epoch / (EPOCHS - 1))


def write_photograph(file, grey, moment, model="imx219", **tags):
    """Write a JPEG with EXIF to a path or a buffer; tags: further EXIF tags."""
    told = {MODEL: model, TAKEN: moment.strftime("%Y:%m:%d %H:%M:%S"), FOCAL: 3.04}
    more = {int(number, 16): value for number, value in tags.items()}
    save_photograph(file, told | more, grey, format="JPEG", quality=95)


def write_log(path):
    rows = []
    for k in range(-1, EPOCHS + 1):
        value = f"{temperature_of(min(max(k, 0), EPOCHS - 1)):.3f}".replace(".", ",")
        moment = START + timedelta(seconds=10 * k)
        rows.append(f"{moment:%d.%m.%Y};{moment:%H:%M:%S};{value};45,1\n")
    path.write_text("Logger 17\nDatum;Uhrzeit;Temperatur °C;Feuchte %\n" + "".join(rows), "latin-1")


def exported(recording):
    """Return the rows of a recording's export with one exterior orientation."""
    return list(
        csv.DictReader(run("export", recording, "--exterior", "series").stdout.splitlines())
    )


def require_drift(first, last, warm):
    for name, rate in (("c", RATE_C), ("x0", RATE_X0), ("y0", 0.0)):
        drift = float(last[name]) - float(first[name])
        sd = float(np.hypot(float(last[f"sd_{name}"]), float(first[f"sd_{name}"])))
        assert 0 < sd < 0.2 * abs(RATE_C * 15)
        assert drift == pytest.approx(rate * warm, abs=max(5 * sd, 2e-5)), (name, drift, sd)


@pytest.fixture(scope="module")
def corner(tmp_path_factory):
    """A printed corner, mounted as its PDF shows, surveyed from eight photographs; its sheets."""
    place = tmp_path_factory.mktemp("first-hour")
    checked = run("testfield", "check", "--paper", "A3")
    assert checked.stdout.startswith("good: every image")
    printed = run("testfield", "print", "--paper", "A3", "--out", place / "field")
    a, b, nominal = re.search(
        r"measure (\w+) to (\w+) \(nominal ([\d.]+) mm", printed.stdout
    ).groups()
    sheets, middle = put_photographs(place, "survey")
    run(
        "testfield", "survey", place / "survey", "--field", place / "field" / "testfield.csv",
        "--scale", a, b, nominal, "--scale-sd", 0.2, "--pixel-pitch", SENSOR.pixel_pitch, "--out",
        place / "surveyed.csv",
    )  # fmt: skip
    return place, sheets, middle


def test_imported_photographs_of_the_printed_corner_show_the_drift(corner):
    place, sheets, middle = corner
    (place / "photos").mkdir()
    stand = middle + 660.0 * np.array([1.0, 0.95, 0.85]) / np.linalg.norm([1.0, 0.95, 0.85])
    station = looking_at(stand, middle, np.pi / 2 + 0.3)
    for k in range(EPOCHS):
        frame = photograph(sheets, camera_at(temperature_of(k)), station, seed=100 + k, finer=2)
        moment = START + timedelta(seconds=10 * k)
        write_photograph(place / "photos" / f"IMG_{k:03d}.jpg", frame, moment)
    write_log(place / "logger.csv")
    told = run(
        "import", place / "photos", "--log", place / "logger.csv", "--timezone", "Europe/Berlin",
        "--testfield", place / "surveyed.csv", "--pixel-pitch", SENSOR.pixel_pitch, "--out",
        place / "M1",
    )  # fmt: skip
    assert f"known for {EPOCHS} of {EPOCHS} photographs" in told.stderr
    replayed = run("replay", place / "M1", "--exterior", "series", "--json", "-")
    document = json.loads(replayed.stdout)
    assert document["epochs"] == EPOCHS
    rows = exported(place / "M1")
    assert [r["status"] for r in rows] == ["ok"] * EPOCHS
    assert (
        float(rows[0]["frame_time"]) == (START - timedelta(hours=2)).replace(tzinfo=UTC).timestamp()
    )
    hot = EPOCHS // 2
    require_drift(rows[0], rows[hot], temperature_of(hot) - temperature_of(0))
    run("study", place / "M1", "--report", place / "study.html")
    assert (place / "study.html").stat().st_size > 50_000


class Handset(FakePhone):
    """A phone in front of the corner, whose app takes the images of its warming camera."""

    def __init__(self, frames):
        super().__init__(shoot=Handset.take)
        self.frames, self.taken, self.course = frames, 0, {}
        self.warm(0)

    def warm(self, k):
        tenths = round(10 * temperature_of(k))
        self.battery = f"  voltage: 4100\n  temperature: {tenths}\n"
        self.thermal = (
            "Current temperatures from HAL:\n"
            f"\tTemperature{{mValue={tenths / 10 + 4}, mType=3, mName=skin, mStatus=0}}\n"
        )

    def take(self):
        k = min(self.taken, len(self.frames) - 1)
        now = self.now()
        moment, fraction = datetime.fromtimestamp(int(now), UTC), f"{int(now % 1 * 1000):03d}"
        data = io.BytesIO()
        write_photograph(data, self.frames[k], moment, "Phone 4a",
                         **{"0x829A": 1 / 60, "0x8827": 100, "0x9206": 0.7, "0x9291": fraction,
                            "0x9011": "+00:00"})  # fmt: skip
        self.add(f"IMG_{len(self.course):04d}.jpg", data.getvalue())
        self.course[now] = k
        self.taken += 1
        self.warm(self.taken)


def test_a_phone_before_the_printed_corner_shows_the_drift(corner, monkeypatch):
    """The commands and the configuration of the tutorial, with a phone on an adb server of ours."""
    place, sheets, middle = corner
    stand = middle + 660.0 * np.array([1.0, 0.9, 0.9]) / np.linalg.norm([1.0, 0.9, 0.9])
    station = looking_at(stand, middle, np.pi / 2 - 0.2)
    frames = [
        photograph(sheets, camera_at(temperature_of(k)), station, seed=200 + k, finer=2)
        for k in range(EPOCHS)
    ]
    server = AdbServer()
    try:
        page = Path(__file__).parents[2] / "docs/tutorial/phone.md"
        (text,) = [b.text for b in blocks(page) if b.language == "yaml"]
        config = yaml.safe_load(text)
        camera, thermometer = config["cameras"][0], config["thermometers"][0]
        phone = server.phones[camera["serial"]] = Handset(frames)
        mine = {"port": server.port, "start_server": False}
        camera |= {"width": SENSOR.width, "height": SENSOR.height, "period_s": 4.0, **mine,
                   "principal_distance_mm": 3.04,
                   "sensor": {"width_px": SENSOR.width, "height_px": SENSOR.height,
                              "pixel_pitch_mm": SENSOR.pixel_pitch}}  # fmt: skip
        thermometer |= mine
        (place / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
        monkeypatch.chdir(place)
        run("check", "config.yaml", "--probe")
        phone.taken = 0
        phone.warm(0)
        run("session", "start", "--camera", "phone-1", "--series", "M1", "--start", "cold",
            "--epochs", EPOCHS)  # fmt: skip
    finally:
        server.close()
    assert (place / "phone-1-M1.html").stat().st_size > 50_000
    rows = exported("phone-1-M1")
    assert len(rows) == EPOCHS
    assert sum(r["status"] == "ok" for r in rows) >= EPOCHS - 1
    # the frame is the last one taken before the phone's time of exposure
    taken = np.array(sorted(phone.course))
    known = [phone.course[taken[np.abs(taken - float(r["frame_time"])).argmin()]] for r in rows]
    hot = max(range(len(rows)), key=lambda i: temperature_of(known[i]))
    warm = temperature_of(known[hot]) - temperature_of(known[0])
    assert warm > 10
    assert abs(float(rows[hot]["temperature"]) - temperature_of(known[hot])) < 4
    require_drift(rows[0], rows[hot], warm)
    told = run("study", "cold=phone-1-M1", "--report", "phone.html")
    assert "principal point moved" in " ".join(told.stdout.split())


def board_photographs(place, sheet, field, name, temperatures):
    """Ten poses of one board at each of two temperatures."""
    middle = field.points.mean(axis=0)
    reach = 1.35 * float(np.ptp(field.points, axis=0).max())
    rng = np.random.default_rng(5)
    for temperature in temperatures:
        folder = place / f"{name}-{temperature:.0f}"
        folder.mkdir()
        for i in range(10):
            azimuth, tilt = 2 * np.pi * i / 10, 0.25 + 0.4 * (i % 3) / 2
            direction = np.array(
                [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)]
            )
            where = middle + reach * rng.uniform(0.9, 1.15) * direction
            aim = middle + np.array([*rng.uniform(-0.1, 0.1, 2) * reach, 0.0])
            station = looking_at(where, aim, (i % 4) * np.pi / 2)
            frame = photograph([sheet], camera_at(temperature), station, seed=i)
            cv2.imwrite(str(folder / f"{i}.png"), frame)
    return [place / f"{name}-{t:.0f}" for t in temperatures]


@pytest.mark.parametrize("kind", ["charuco", "aprilgrid"])
def test_the_owner_of_a_board_finds_the_drift_between_cold_and_warm(tmp_path, kind):
    """The difference of calibrations from a flat board in ten poses, cold and warm."""
    if kind == "charuco":
        sheet = board_images.charuco_sheet(11, 8, 30.0, 22.5, "DICT_5X5_250", False)
        run(
            "testfield", "import", "--charuco", "11x8", "--square", 30, "--marker", 22.5,
            "--dictionary", "DICT_5X5_250", "--sigma", 0.02, "--out", tmp_path / "board.csv",
        )  # fmt: skip
    else:
        sheet = board_images.aprilgrid_sheet(6, 6, 40.0, 0.3)
        (tmp_path / "target.yaml").write_text(
            "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 6\ntagSize: 0.04\ntagSpacing: 0.3\n"
        )
        run("testfield", "import", tmp_path / "target.yaml", "--sigma", 0.02, "--out",
            tmp_path / "board.csv")  # fmt: skip
    field = read_testfield(tmp_path / "board.csv")
    (tmp_path / "camera.yaml").write_text(
        "name: rpi\nwidth: 1640\nheight: 1232\npixel_pitch: 0.00224\nprincipal_distance: 3.04\n"
    )
    found, inputs = [], []
    for folder in board_photographs(tmp_path, sheet, field, kind, (20.0, 50.0)):
        told = run(
            "calibrate", *sorted(folder.glob("*.png")), "--testfield", tmp_path / "board.csv",
            "--camera", tmp_path / "camera.yaml", "--json", "-",
        )  # fmt: skip
        found.append(json.loads(told.stdout))
        temperature = folder.name.rpartition("-")[2]
        folder.with_suffix(".json").write_text(told.stdout)
        inputs.append(f"{temperature}={folder.with_suffix('.json')}")
    cold, hot = found
    fitted = run("fit", *inputs, "-o", tmp_path / "camera.thermal.yaml", "--json", "-")
    for name, rate in json.loads(fitted.stdout)["rates"].items():
        expected = {"c": RATE_C, "x0": RATE_X0, "y0": 0.0}[name]
        assert abs(rate["value"] - expected) < max(4 * rate["sd"], 5e-5 / 30), name
    assert cold["status"] == hot["status"] == "ok"
    for name, rate in (("c", RATE_C), ("x0", RATE_X0), ("y0", 0.0)):
        drift = hot["interior"][name] - cold["interior"][name]
        sd = float(np.hypot(hot["interior"][f"sd_{name}"], cold["interior"][f"sd_{name}"]))
        assert 0 < sd < 3e-4
        assert drift == pytest.approx(30.0 * rate, abs=max(4 * sd, 5e-5)), (name, drift, sd)
