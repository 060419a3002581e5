"""The first hour of a new user, command by command, with the files that the commands write.

The corner is photographed from its own PDF (`printed_sheets`), the camera drifts by a known amount,
the logger writes as a German one does, or the camera is a phone's on an adb server; ChArUco and
AprilGrid are drawn by their own programs. The result, the drift with its standard deviation, is
compared with the truth.
"""

from __future__ import annotations

import csv
import io
import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.commands import succeed as run
from tests.docs.blocks import blocks
from tests.docs.worlds import put_photographs
from tests.drivers.fakes.adb_server import AdbServer, FakePhone
from tests.photogrammetry.network_cases import looking_at
from tests.photogrammetry.printed_sheets import photograph
from tests.pictures import FOCAL, MODEL, TAKEN, save_photograph
from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor

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
