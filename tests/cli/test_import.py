"""`thermocald import` as a user runs it: EXIF times, a German log, clocks that are wrong."""

from __future__ import annotations

import json
from datetime import UTC, datetime

import numpy as np
import pytest

from tests.commands import succeed
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
from thermocald.errors import DataError, ThermocaldError
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.store.logger.options import log_options
from thermocald.store.logger.temperatures import read_log
from thermocald.store.recording.reader import read_recording
from thermocald.store.recording.testfield_file import write_testfield

pytest.importorskip("PIL.Image")
START = datetime(2026, 6, 14, 10, 0, tzinfo=UTC).timestamp()


def run(*arguments):
    return succeed("import", *arguments)


def photograph(path, local, subsec="", offset="", size=(64, 48), focal=(304, 100), f35=29):
    tags = {MAKE: "RaspberryPi", MODEL: "imx219", TAKEN: local, SUBSECONDS: subsec, OFFSET: offset,
            FOCAL: focal[0] / focal[1], F35: f35}  # fmt: skip
    grey = np.full(size[::-1], 90, np.uint8)
    save_photograph(path, {tag: value for tag, value in tags.items() if value}, grey)


@pytest.fixture
def place(tmp_path):
    """Six photographs every 10 s from 12:00:00.25 in Berlin, a log every 15 s, a field."""
    (tmp_path / "photos").mkdir()
    for i in range(6):
        photograph(tmp_path / "photos" / f"{i}.jpg", f"2026:06:14 12:00:{10 * i:02d}", "250")
    rows = "14.06.2026;11:59:50;20,5\n"
    for i in range(8):
        value = f"{21 + 0.25 * i:.2f}".replace(".", ",")
        rows += f"14.06.2026;12:0{i // 4}:{15 * (i % 4):02d};{value}\n"
    (tmp_path / "log.csv").write_text("Datum;Uhrzeit;Temperatur °C\n" + rows, encoding="latin-1")
    names = [f"T{i}" for i in range(4)]
    points = [[0, 0, 0], [300, 0, 0], [0, 300, 0], [300, 300, 50]]
    write_testfield(tmp_path / "field.csv", TestField.build(names, points, 0.02, 10.0))
    return tmp_path


def arguments(place, *more):
    return (
        place / "photos", "--log", place / "log.csv", "--testfield", place / "field.csv", "--out",
        place / "M1", *more,
    )  # fmt: skip


def test_photographs_and_a_german_log_become_a_recording(place):
    result = run(*arguments(place, "--timezone", "Europe/Berlin"))
    assert "6 epochs" in result.stdout
    assert "guessed" in result.stderr
    recording = read_recording(place / "M1")
    assert recording.columns.frame_time.tolist() == [START + 0.25 + 10 * i for i in range(6)]
    at_frame = recording.columns.at_frame("Temperatur")
    assert at_frame == pytest.approx([21 + (0.25 + 10 * i) / 60 for i in range(6)])
    assert recording.camera.principal_distance == pytest.approx(3.04)
    assert recording.camera.sensor.pixel_pitch == pytest.approx(43.2666 * 3.04 / 29 / 80)
    assert all(e.frame.read_bytes() for e in recording.epochs)


def test_every_reading_of_the_log_is_kept(place):
    """There are nine readings for six photographs; analyses use those in between too."""
    from thermocald.thermal.source import series_input

    run(*arguments(place, "--timezone", "Europe/Berlin"))
    columns = read_recording(place / "M1").columns
    expected = [START - 10, *(START + 15 * i for i in range(8))]
    assert columns.readings.times.tolist() == expected
    assert columns.readings.channels["Temperatur"].tolist() == [
        20.5, *(21 + 0.25 * i for i in range(8))
    ]  # fmt: skip
    (place / "M1" / "observations.csv").write_text(
        "epoch,target,x,y,sx,sy\n" + "".join(f"{e},T0,9,9,1,1\n" for e in range(1, 7))
    )
    source = series_input(read_recording(place / "M1"))
    assert len(source.frame_times) == 6
    within = [t for t in expected if t <= START + 0.25 + 50 + 15]
    assert source.reading_times.tolist() == within
    (place / "M1" / "readings.csv").write_text("time,Temperatur\n5,20\n4,20\n")
    with pytest.raises(ThermocaldError, match=r"readings\.csv, line 3, column time: times must"):
        read_recording(place / "M1")


def test_a_dry_run_shows_all_and_writes_nothing(place):
    before = sorted(place.iterdir())
    result = run(place / "photos", "--log", place / "log.csv", "--timezone", "Europe/Berlin",
                 "--dry-run", "--json", "-")  # fmt: skip
    assert sorted(place.iterdir()) == before
    document = json.loads(result.stdout)
    assert document["with_temperature"] == 6
    assert "2026-06-14T10:00:00.250Z" in result.stderr
    assert (
        "cp1252 (assumed; set --encoding to change), columns separated by semicolon"
        in result.stderr
    )


def test_clock_errors_and_zones_of_each_device(place):
    """A camera 3 min 12 s ahead that writes its zone, a logger on winter time."""
    for i in range(6):
        photograph(
            place / "photos" / f"{i}.jpg", f"2026:06:14 13:03:{12 + 4 * i:02d}", "", "+03:00"
        )
    run(*arguments(place, "--log-timezone", "+02:00", "--camera-clock", "+00:03:12"))
    recording = read_recording(place / "M1")
    assert recording.columns.frame_time.tolist() == [START + 4 * i for i in range(6)]


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ((), "has no time zone: give it with --timezone"),
        (("--timezone", "Europe/Berlin", "--camera-clock", "+05:00:00"), "5.0 h apart"),
        (("--timezone", "Mars"), "time zone 'Mars'"),
        (("--timezone", "UTC", "--pixel-pitch", 0.002, "--unit", "R"), "--unit R"),
        (("--timezone", "UTC", "--temperature-column", "T"), "there is no column 'T'"),
        (("--timezone", "UTC", "--encoding", "greek8bit"), "--encoding greek8bit: is unknown"),
        (("--timezone", "UTC", "--encoding", "hex"), "--encoding hex: is unknown"),
    ],
)
def test_what_is_not_certain_is_refused_and_nothing_is_written(place, more, reason):
    before = sorted(place.iterdir())
    with pytest.raises(ThermocaldError, match=reason):
        run(*arguments(place, *more))
    assert sorted(place.iterdir()) == before


def test_photographs_that_do_not_belong_together_are_refused(place):
    photograph(place / "photos" / "9.jpg", "2026:06:14 12:01:10", size=(48, 64))
    with pytest.raises(ThermocaldError, match=r"9\.jpg: has 48 × 64 px"):
        run(*arguments(place, "--timezone", "Europe/Berlin"))
    (place / "photos" / "9.jpg").write_bytes(b"\xff\xd8no picture")
    with pytest.raises(ThermocaldError, match=r"9\.jpg: is not a picture"):
        run(*arguments(place, "--timezone", "Europe/Berlin"))
    photograph(place / "photos" / "9.jpg", "")
    with pytest.raises(ThermocaldError, match=r"9\.jpg: EXIF holds no time.*--times name"):
        run(*arguments(place, "--timezone", "Europe/Berlin"))


@pytest.mark.parametrize(
    "name", ["IMG_20260614_12000{}", "2026-06-14 12.00.0{}", "PXL_20260614_10000{}000.MP"]
)
def test_times_from_names(place, name):
    for i in range(6):
        (place / "photos" / f"{i}.jpg").rename(place / "photos" / f"{name.format(i)}.jpg")
    run(*arguments(place, "--timezone", "Europe/Berlin", "--times", "name"))
    recording = read_recording(place / "M1")
    assert recording.columns.frame_time.tolist() == [START + i for i in range(6)]


def test_points_take_no_time_for_utc_that_does_not_say_so(tmp_path):
    from thermocald.analysis.thermal.correction import row_blocks
    from thermocald.store.logger.clock import device_clock

    (tmp_path / "points.csv").write_text("time,x,y\n2026-06-14T12:00:30,5,6\n")
    for zone, first in (("UTC", START + 7200), ("Europe/Berlin", START)):
        block = next(row_blocks(tmp_path / "points.csv", ("x", "y"), device_clock(zone)))
        assert (block.times.tolist(), block.values.tolist()) == ([first + 30], [[5, 6]])
    with pytest.raises(ThermocaldError, match=r"points\.csv, line 2.*--timezone"):
        next(row_blocks(tmp_path / "points.csv", ("x", "y"), device_clock(None)))


def log_of(place, values, head="Time;Temperature", step=15):
    """A log of values from 11:59:45 in Berlin on, every `step` s."""
    rows = "".join(
        f"2026-06-14 {11 + (3585 + step * i) // 3600}:{(3585 + step * i) // 60 % 60:02d}:"
        f"{(3585 + step * i) % 60:02d};{value}\n"
        for i, value in enumerate(values)
    )
    (place / "log.csv").write_text(f"{head}\n{rows}", encoding="utf-8")


@pytest.mark.parametrize(
    "other",
    [{MAKE: "Canon"}, {MODEL: "imx477"}, {FOCAL: 6.0}, {SERIAL: "B2"},
     dict.fromkeys((MAKE, MODEL, SERIAL, FOCAL)), {MODEL: ""}],
)  # fmt: skip
def test_the_photograph_of_another_camera_is_refused(place, other):
    for i in range(6):
        tags = {MAKE: "RaspberryPi", MODEL: "imx219", SERIAL: "A1", FOCAL: 3.04, F35: 29,
                TAKEN: f"2026:06:14 12:00:{10 * i:02d}", **(other if i == 3 else {})}  # fmt: skip
        known = {tag: value for tag, value in tags.items() if value is not None}
        save_photograph(place / "photos" / f"{i}.jpg", known, np.full((48, 64), 90 + i, np.uint8))
    with pytest.raises(ThermocaldError, match=r"3\.jpg is of .*a recording has one camera"):
        run(*arguments(place, "--timezone", "Europe/Berlin"))
    assert not (place / "M1").exists()


def test_a_copy_of_a_photograph_is_left_out(place):
    for of, copy in (("2.jpg", "2 (1).jpg"), ("4.jpg", "IMG_9.jpeg")):
        (place / "photos" / copy).write_bytes((place / "photos" / of).read_bytes())
    result = run(*arguments(place, "--timezone", "Europe/Berlin"))
    assert "6 epochs" in result.stdout
    assert "photographs: 2.jpg is a copy of 2 (1).jpg: left out" in result.stderr
    assert "photographs: IMG_9.jpeg is a copy of 4.jpg: left out" in result.stderr


@pytest.mark.parametrize(
    ("taken", "words"),
    [
        (["2000:01:01 00:00:05"], "1.jpg: was taken at 2026-06-14T10:00:10.250Z, years"),
        (["2026:06:14 12:00:00"] * 6, "0.jpg: all photographs have its time"),
    ],
)
def test_a_camera_whose_clock_was_not_set_writes_nothing(place, taken, words):
    for i, moment in enumerate(taken):
        path = place / "photos" / f"{i}.jpg"
        photograph(path, moment)
        path.write_bytes(path.read_bytes() + bytes([i]))  # not a copy
    with pytest.raises(ThermocaldError, match=words):
        run(*arguments(place, "--timezone", "Europe/Berlin"))
    assert not (place / "M1").exists()


def test_two_photographs_of_one_time_are_told(place):
    photograph(place / "photos" / "3a.jpg", "2026:06:14 12:00:30", "250", focal=(305, 100))
    result = run(*arguments(place, "--timezone", "Europe/Berlin"))
    assert "doubtful: 1 photograph with the time of another one, the first 3.jpg and 3a.jpg" in (
        result.stderr
    )


def test_what_the_logger_did_not_measure_is_left_empty(place):
    log_of(place, [21.0, 21.1, 85.0, 21.2, -40.0, 21.4, 21.5, 21.6], "Time;Temp °C")
    result = run(*arguments(place, "--timezone", "Europe/Berlin"))
    assert "doubtful: 2 readings of 'Temp °C' given without a measurement" in result.stderr
    at_frame = read_recording(place / "M1").columns.at_frame("Temp")
    assert (at_frame > 20).all()  # between the readings on both sides
    assert (at_frame < 22).all()


@pytest.mark.parametrize(
    ("later", "words"),
    [
        (lambda v: 1.8 * v + 32, "from °C to °F"),
        (lambda v: v + 273.15, "from °C to K"),
        (lambda v: 10 * v, "to tenths"),
    ],
)
@pytest.mark.parametrize("back", [False, True])
def test_a_unit_that_changes_midway_is_refused(tmp_path, later, words, back):
    values = [21.0, 21.1, 21.1, 21.2, 21.3, 21.4, 21.5, 21.6]
    mixed = [v if i < 4 else round(later(v), 2) for i, v in enumerate(values)]
    log_of(tmp_path, mixed[::-1] if back else mixed)
    where = "log.csv, line 6, column 'Temperature': the unit seems to change"
    with pytest.raises(DataError, match=f"{where}{'' if back else f' {words}'}.*--unit"):
        read_log(tmp_path / "log.csv", log_options(timezone="Europe/Berlin"))


def test_a_unit_that_is_stated_is_taken(place):
    log_of(place, [20.0, 20.0, 20.1, 20.0, 68.0, 68.1, 68.0, 68.0])
    result = run(*arguments(place, "--timezone", "Europe/Berlin", "--unit", "degC"))
    assert "doubtful" in result.stderr
    assert read_recording(place / "M1").columns.at_frame("Temperature").max() > 60
