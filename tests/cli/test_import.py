"""`thermocald import` as a user runs it: EXIF times, a German log, clocks that are wrong."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime

import numpy as np
import pytest

from tests.commands import invoke
from tests.pictures import (
    F35,
    FOCAL,
    MAKE,
    MODEL,
    OFFSET,
    SERIAL,
    SUBSECONDS,
    TAKEN,
    save_photograph,
)
from thermocald.errors import ThermocaldError
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.physics.scene import Scene
from thermocald.physics.testfields import demonstration_field, demonstration_model
from thermocald.store.recording.reader import read_recording
from thermocald.store.recording.testfield_file import write_testfield

pytest.importorskip("PIL.Image")
START = datetime(2026, 6, 14, 10, 0, tzinfo=UTC).timestamp()
BERLIN = ("--timezone", "Europe/Berlin")


def photograph(path, local, subsec="", offset="", size=(64, 48), focal=3.04, tags=None):
    """Save a grey photograph; tags: further ones of EXIF, in place of the usual."""
    usual = {MAKE: "RaspberryPi", MODEL: "imx219", TAKEN: local, SUBSECONDS: subsec, OFFSET: offset,
            FOCAL: focal, F35: 29, SERIAL: "A1"}  # fmt: skip
    grey = np.full(size[::-1], 90, np.uint8)
    written = usual | (tags or {})
    save_photograph(path, {tag: value for tag, value in written.items() if value}, grey)


@pytest.fixture
def place(world, tmp_path):
    """Six photographs every 10 s from 12:00:00.25 in Berlin, a German log every 15 s."""
    (tmp_path / "photos").mkdir()
    for i in range(6):
        photograph(tmp_path / "photos" / f"{i}.jpg", f"2026:06:14 12:00:{10 * i:02d}", "250")
    shutil.copy(world / "logger.csv", tmp_path / "log.csv")
    shutil.copy(world / "M1" / "testfield.csv", tmp_path / "field.csv")
    return tmp_path


def run(place, *more):
    """Import the photographs as M1; return the result."""
    return invoke("import", place / "photos", "--log", place / "log.csv", "--testfield",
                  place / "field.csv", "--out", place / "M1", *more)  # fmt: skip


def test_photographs_and_a_german_log_become_a_recording(place):
    """All eight readings are kept for six photographs: analyses use those in between too.

    A photograph long after the log has no reading.
    """
    photograph(place / "photos" / "late.jpg", "2026:06:14 12:10:00")
    result = run(place, *BERLIN)
    assert "7 epochs" in result.stdout
    assert "guessed" in result.stderr
    recording = read_recording(place / "M1")
    columns = recording.columns
    assert columns.frame_time[:6].tolist() == [START + 0.25 + 10 * i for i in range(6)]
    assert np.isnan(columns.temperature_time).tolist() == [False] * 6 + [True]
    assert columns.readings.times.tolist() == [START + 15 * i for i in range(8)]
    kept = columns.readings.channels["Temperatur"].tolist()
    assert kept == [21 + 0.25 * i for i in range(8)]
    assert recording.camera.principal_distance == pytest.approx(3.04)
    assert recording.camera.sensor.pixel_pitch == pytest.approx(43.2666 * 3.04 / 29 / 80)
    assert all(e.frame.read_bytes() for e in recording.epochs)
    (place / "M1" / "readings.csv").write_text("time,Temperatur\n5,20\n4,20\n")
    with pytest.raises(ThermocaldError, match=r"readings\.csv, line 3, column time: times must"):
        read_recording(place / "M1")


def test_a_dry_run_shows_all_and_writes_nothing(place):
    before = sorted(place.iterdir())
    result = run(place, *BERLIN, "--dry-run", "--json", "-")
    assert sorted(place.iterdir()) == before
    assert json.loads(result.stdout)["with_temperature"] == 6
    assert "2026-06-14T10:00:00.250Z" in result.stderr
    assert "cp1252 (assumed; set --encoding to change), columns separated by semi" in result.stderr


def test_clock_errors_and_zones_of_each_device(place):
    """A camera 3 min 12 s ahead that writes its zone, a logger on winter time."""
    for i in range(6):
        taken = f"2026:06:14 13:03:{12 + 4 * i:02d}"
        photograph(place / "photos" / f"{i}.jpg", taken, "", "+03:00")
    run(place, "--log-timezone", "+02:00", "--camera-clock", "+00:03:12")
    times = read_recording(place / "M1").columns.frame_time
    assert times.tolist() == [START + 4 * i for i in range(6)]


@pytest.mark.parametrize("name", [
    "IMG_20260614_12000{}", "2026-06-14 12.00.0{}", "PXL_20260614_10000{}000.MP",
    f"f_{START // 10:.0f}{{}}.0",
])  # fmt: skip
def test_times_from_names(place, name):
    for i in range(6):
        (place / "photos" / f"{i}.jpg").rename(place / "photos" / f"{name.format(i)}.jpg")
    run(place, *BERLIN, "--times", "name")
    times = read_recording(place / "M1").columns.frame_time
    assert times.tolist() == [START + i for i in range(6)]


IN_TIME = ("2026:06:14 12:00:30", "250")
NOTHING = dict.fromkeys((MAKE, MODEL, SERIAL, FOCAL), "")
OF_ANOTHER = r"3\.jpg is of .*a recording has one camera"


def third(*moment, **given):
    """Return a function that replaces the photograph 3.jpg in a folder."""
    return lambda folder: photograph(folder / "3.jpg", *(moment or IN_TIME), **given)


def stop_the_clock(folder):
    for path in folder.iterdir():
        photograph(path, "2026:06:14 12:00:00")
        path.write_bytes(path.read_bytes() + path.name.encode())  # not a copy


@pytest.mark.parametrize(("change", "more", "reason"), [
    (None, "", "has no time zone: give it with --timezone"),
    (None, "--timezone Europe/Berlin --camera-clock +05:00:00", "5 h apart"),
    (None, "--timezone Mars", "time zone 'Mars'"),
    (None, "--timezone UTC --pixel-pitch 0.002 --unit R", "--unit R"),
    (None, "--timezone UTC --temperature-column T", "there is no column 'T'"),
    (None, "--timezone UTC --encoding greek8bit", "--encoding greek8bit: is unknown"),
    (None, "--timezone UTC --encoding hex", "--encoding hex: is unknown"),
    (third(size=(48, 64)), "--timezone UTC", r"3\.jpg: has 48 × 64 px"),
    (lambda f: (f / "3.jpg").write_bytes(b"\xff\xd8no"), "--timezone UTC", "is not a picture"),
    *(
        (third(no), "--timezone UTC", r"3\.jpg: EXIF holds no time.*--times name")
        for no in ("", "0000:00:00 00:00:00", "    :  :     :  :  ")
    ),
    (third("2000:01:01 00:00:05"), "--timezone UTC", r"0\.jpg: was taken at .*Z, years"),
    (third(tags={MAKE: "Canon"}), "--timezone UTC", OF_ANOTHER),
    (third(tags={MODEL: "imx477"}), "--timezone UTC", OF_ANOTHER),
    (third(tags={SERIAL: "B2"}), "--timezone UTC", OF_ANOTHER),
    (third(focal=6.0), "--timezone UTC", OF_ANOTHER),
    (third(tags={MODEL: ""}), "--timezone UTC", OF_ANOTHER),
    (third(tags=NOTHING), "--timezone UTC", OF_ANOTHER),
    (stop_the_clock, "--timezone UTC", r"0\.jpg: all photographs have its time"),
])  # fmt: skip
def test_what_is_not_certain_is_refused_and_nothing_is_written(place, change, more, reason):
    if change is not None:
        change(place / "photos")
    before = sorted(place.iterdir())
    with pytest.raises(ThermocaldError, match=reason):
        run(place, *more.split())
    assert sorted(place.iterdir()) == before


def test_a_copy_of_a_photograph_is_left_out_and_two_of_one_time_are_told(place):
    for of, copy in (("2.jpg", "2 (1).jpg"), ("4.jpg", "IMG_9.jpeg")):
        (place / "photos" / copy).write_bytes((place / "photos" / of).read_bytes())
    photograph(place / "photos" / "3a.jpg", *IN_TIME, focal=3.05)
    result = run(place, *BERLIN)
    assert "7 epochs" in result.stdout
    assert "photographs: 2.jpg is a copy of 2 (1).jpg: left out" in result.stderr
    assert "photographs: IMG_9.jpeg is a copy of 4.jpg: left out" in result.stderr
    doubt = "doubtful: 1 photograph with the time of another one, the first 3.jpg and 3a.jpg"
    assert doubt in result.stderr


def test_a_unit_that_is_stated_is_taken_though_it_seems_to_change(place):
    log = (place / "log.csv").read_text("latin-1")
    (place / "log.csv").write_text(log.replace(";22,", ";72,"), "latin-1")
    with pytest.raises(ThermocaldError, match="the unit seems to change"):
        run(place, *BERLIN)
    assert "doubtful" in run(place, *BERLIN, "--unit", "degC").stderr
    readings = read_recording(place / "M1").columns.readings
    assert readings.channels["Temperatur"].max() == 72.75


def test_a_binned_photograph_with_the_sensors_pitch_is_flagged(place):
    """EXIF: 3.04 mm, 29 mm for 35 mm film: pixels of 0.0567 mm in 80 px of diagonal."""
    said = run(place, *BERLIN, "--dry-run", "--pixel-pitch", "0.02835").stderr
    assert "0.02835 mm is 0.50 of the 0.05669 mm" in said
    assert "--pixel-pitch" in said
    sound = run(place, *BERLIN, "--dry-run", "--pixel-pitch", "0.055").stderr
    assert "EXIF of the photographs" not in sound


def test_binned_photographs_are_flagged_where_exif_knows_the_focal_length_alone(place):
    """820 px of a sensor of 3280 with the sensor's own pitch: a quarter of c is found."""
    field = demonstration_field("markers")
    model = demonstration_model(field)
    scene = Scene(Sensor(820, 616, 0.00448), field)
    iop, eop = model.interior.as_array(), model.exterior.as_array()
    pixels = scene.render(iop, eop, None, [1], 1.0)
    for i in range(6):
        tags = {TAKEN: f"2026:06:14 12:00:{10 * i:02d}", FOCAL: 3.04}
        save_photograph(place / "photos" / f"{i}.jpg", tags, pixels, quality=95)
    write_testfield(place / "field.csv", field)
    for pitch, doubts in (("0.00112", 1), ("0.00448", 0)):
        said = run(place, *BERLIN, "--out", place / pitch, "--pixel-pitch", pitch).stderr
        assert said.count("0.25 times the stated 3.04 mm") == doubts
        assert said.count("Pixels of 0.00448 mm would fit (--pixel-pitch") == doubts
