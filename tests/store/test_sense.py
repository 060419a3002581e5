"""Implausible values are refused with one line, or called doubtful."""

from __future__ import annotations

import re
import shutil
from html import escape

import numpy as np
import pytest

import thermocald as tc
from tests.commands import call
from tests.recordings import read_rows, write_rows
from tests.store.test_bad_recordings import refused
from thermocald.store.recording.reader import read_recording
from thermocald.store.recording.sense import find_spikes, find_unit_change, interior_doubts


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """A warming camera before a field of 49 targets, 40 epochs."""
    path = tmp_path_factory.mktemp("sense") / "whole"
    tc.simulate("rpi-v2.1-heating", seed=1, out=path)
    some = {row["target"] for row in read_rows(path / "observations.csv")[:147:3]}
    for name in ("epochs.csv", "observations.csv"):
        rows = [row for row in read_rows(path / name) if int(row["epoch"]) <= 40]
        write_rows(path / name, [row for row in rows if row.get("target", min(some)) in some])
    return path


@pytest.fixture
def recording(simulated, tmp_path):
    return shutil.copytree(simulated, tmp_path / "M")


def head(old: str, new: str):
    """Return what changes the head of a recording."""

    def damage(path) -> None:
        text = (path / "recording.yaml").read_text()
        assert old in text
        (path / "recording.yaml").write_text(text.replace(old, new))

    return damage


def size(width: int, height: int):
    return head("width: 3280, height: 2464", f"width: {width}, height: {height}")


def change(name: str, **columns):
    """Return what replaces columns of a table by functions of their values and the row (from 0)."""

    def damage(path) -> None:
        rows = read_rows(path / name)
        for i, row in enumerate(rows):
            row |= {column: str(new(row[column], i)) for column, new in columns.items()}
        write_rows(path / name, rows)

    return damage


def scaled(factor: float, shift: float = 0.0):
    return lambda text, _: f"{factor * float(text) + shift:.15g}"


def put(value: str, *rows: int):
    return lambda text, i: value if i in rows else text


def observed(kept):
    """Return what keeps the observations that `kept` returns of all."""

    def damage(path) -> None:
        write_rows(path / "observations.csv", kept(read_rows(path / "observations.csv")))

    return damage


OTHER_IMAGES = {
    "width and height exchanged": (size(2464, 3280), "width and height "),
    "a crop": (size(1920, 1080), "another camera"),
    "points from the centre": (
        change("observations.csv", x=scaled(1, -1639.5), y=scaled(1, -1231.5)),
        "from the centre of the image"),
    "points in mm": (
        change("observations.csv", x=scaled(0.00112), y=scaled(0.00112)), "in mm"),
    "y upwards from below": (change("observations.csv", y=scaled(-1)), "lie outside"),
}  # fmt: skip


@pytest.mark.parametrize("name", OTHER_IMAGES)
def test_points_of_another_image_are_refused_in_one_line(recording, name):
    damage, message = OTHER_IMAGES[name]
    damage(recording)
    for command in ("check", "replay", "export"):
        done = call(command, recording)
        assert (done.returncode, done.stderr.count("\n")) == (1, 1)
        assert re.search(r"observations\.csv, line \d+, column x.*" + message, done.stderr)


def test_some_gross_errors_off_the_image_are_left_to_the_adjustment(recording):
    """One of them pulls its whole epoch away."""
    rows = (1, 166, 500, 833, 1166)
    change("observations.csv", x=put("-400", *rows), y=put("9000", *rows))(recording)
    assert tc.open(recording).calibrate().ok.all()


def exchange_in_the_middle(path) -> None:
    """Points within both images show nothing; the principal point shows the exchange."""
    observed(lambda rows: [row for row in rows if float(row["x"]) < 2460])(path)
    size(2464, 3280)(path)


def repeated(rows):
    return [row for row in rows if row["epoch"] != "18"] + [
        {**row, "epoch": "18"} for row in rows if row["epoch"] == "17"
    ]


def times(function):
    return change("epochs.csv", frame_time=function, temperature_time=function)


def temperature(function):
    return change("epochs.csv", temperature=function)


DOUBTS = {
    "a unit in a name": (
        lambda folder: [path.write_text(path.read_text().replace("board_temperature", "board [F]"))
                        for path in (folder / "recording.yaml", folder / "epochs.csv")],
        "board [F]: its name states degF, recording.yaml degC"),
    "a principal distance of another lens": (
        head("principal_distance: 3.04", "principal_distance: 6.0"), "0.507 times"),
    "the pixels of a binned mode": (
        head("pixel_pitch: 0.00112", "pixel_pitch: 0.00224"), "2 times"),
    "the size of a larger mode": (size(6560, 4928), "off the centre of 6560 × 4928"),
    "another field": (
        change("testfield.csv", X=lambda t, i: 37.0 * ((i * 7) % 41)), "can be calibrated"),
    "width and height exchanged": (
        exchange_in_the_middle,
        "px off the centre of 2464 × 3280 px: width and height look exchanged"),
    "some epochs of one time": (
        change("epochs.csv", frame_time=put("1600000100.0", *range(10, 20))),
        "10 epochs have the time of another one, the first 11 and 12"),
    "times in minutes": (times(scaled(1 / 60)), "every 0.167 s"),
    "a name that no store keeps": (head("{name: rpi", "{name: a/rpi"), "no store accepts it"),
    "an hour as the interval": (head("interval: 10.0", "interval: 3600"), "every 10 s"),
    "a file that is cut off": (
        observed(lambda rows: [row for row in rows if int(row["epoch"]) < 17]),
        "epochs have no observations: is the file cut off?"),
    "an epoch twice": (
        observed(repeated), "1 epoch with the image points of another one: epoch 18"),
    "85.00 of a DS18B20": (
        temperature(put("85.0", 12, 30, 31)),
        "3 readings given without a measurement, the first 85 °C at reading 13"),
    "a thermometer in another time zone": (
        change("epochs.csv", temperature_time=scaled(1, 3600)), "read 3600 s after their frames"),
    "°F from the beginning": (temperature(scaled(1.8, 32)), "are they °F?"),
    "nothing but 85.00": (
        change("epochs.csv", board_temperature=lambda *_: "85.0"),
        "board_temperature: all 40 readings are 85 °C"),
    "°C, then °F": (
        temperature(lambda text, i: text if i < 20 else scaled(1.8, 32)(text, i)),
        "from °C to °F"),
    "a reading that leaps": (temperature(put("71.3", 12)), "leaping away and back"),
}  # fmt: skip


@pytest.mark.parametrize("name", DOUBTS)
def test_what_is_doubtful_is_told(recording, name):
    damage, message = DOUBTS[name]
    damage(recording)
    checked = call("check", recording)
    assert checked.returncode == 0
    assert "a doubtful recording" in checked.stdout
    (line,) = [text for text in checked.stdout.splitlines() if message in text]
    assert line.startswith("  doubtful: ")
    if name in ("the pixels of a binned mode", "85.00 of a DS18B20"):
        assert message in call("replay", recording).stderr


def test_a_whole_recording_has_no_doubts(recording):
    assert tc.open(recording).doubts() == []
    assert "doubtful" not in call("check", recording).stdout + call("replay", recording).stderr
    camera = read_recording(recording).camera
    for c in (2.6, 3.04, 3.6):  # lenses near what is stated
        assert interior_doubts(camera, c, 0.1, -0.1) == []
    assert len(interior_doubts(camera, 4.0, 0.9, 0.0)) == 2


def wave(n: int = 60) -> np.ndarray:
    rng = np.random.default_rng(4)
    return 24.0 + 6.0 * np.sin(np.arange(n) / 9.0) + rng.normal(0, 0.03, n)


@pytest.mark.parametrize("value", [85.0, 127.94, 0.0, -40.0, -45.0, 125.0, 130.0, -46.85])
def test_what_a_thermometer_gives_unmeasured_is_found(value):
    runs, thirds = list(range(7, 30)), list(range(0, 60, 3))
    for rows in ([0], [20], [20, 21], [59], [5, 30, 31, 32], runs, runs[:1] + runs[20:], thirds):
        values = wave()
        values[rows] = value
        assert [i for s in find_spikes(values) for i in range(s.first, s.stop)] == rows
        assert not any(s.measured for s in find_spikes(values))


MEASURED = [
    wave(), np.full(40, 85.0), np.full(9, np.nan), np.empty(0), np.r_[np.full(9, np.nan), wave(20)],
    np.r_[wave(30), wave(30) + 40.0],  # carried into the sun
    np.r_[np.full(20, 20.0), 20.0 + 65.0 * (1 - np.exp(-np.arange(60) / 3.0))],  # a kettle
    np.linspace(20.0, 120.0, 60),  # through 85 °C
    np.r_[np.full(20, 78.0), np.full(20, 85.0), np.full(20, 77.0)],  # a processor's limit
    np.r_[np.full(20, 6.0), np.full(30, 0.0)],  # melting snow
]  # fmt: skip


def test_what_was_measured_is_no_spike():
    for values in MEASURED:
        assert find_spikes(values) == []


def unit_change(values: np.ndarray) -> tuple[int, str] | None:
    return find_unit_change(np.arange(len(values)) * 60.0, values)


@pytest.mark.parametrize("rise", [9.0, 15.0, 25.0, 35.0, 60.0])
def test_a_camera_that_is_carried_changes_no_unit(rise):
    assert unit_change(np.r_[wave(30), wave(60)[30:] + rise]) is None
    settling = 0.6 * rise * np.exp(-np.arange(30) / 2.0)
    assert unit_change(np.r_[wave(30), wave(60)[30:] + rise - settling]) is None


WARM, ROOM, COLD = (np.linspace(*ends, 20) for ends in ((27, 35.9), (20.1, 22.3), (4.0, 6.2)))
# readings, others, hours between them, the change of their unit
NIGHTS = [
    (WARM, COLD, 14, None),  # 35.9 °F would be 2.2 °C
    (ROOM, WARM + 21, 14, None),  # 22.3 °C would be 72 °F
    (10 * COLD // 1, COLD.round(1), 14, "from tenths"),
    (COLD + 21, COLD / 2, 14, None),  # 27.2 are no tenths
    (1.8 * ROOM + 32, ROOM, 14, "from °F to °C"), (ROOM, 1.8 * ROOM + 35, 14, "from °C to °F"),
    (1.8 * COLD + 32, COLD[::-1], 0, "from °F to °C"), (ROOM, ROOM + 273.15, 0, "from °C to K"),
]  # fmt: skip


@pytest.mark.parametrize(("first", "second", "hours", "unit"), NIGHTS)
def test_a_night_changes_the_temperature_and_a_setting_the_unit(first, second, hours, unit):
    times = np.arange(40) * 60.0 + np.repeat([0.0, 3600.0 * hours], 20)
    found = find_unit_change(times, np.round([*first, *second], 1))
    assert found == (None if unit is None else (20, unit))


def test_a_spike_beside_a_change_of_the_unit_hides_neither():
    values = np.r_[wave(30), 1.8 * wave(60)[30:] + 32]
    values[[27, 33]] = 85.0, 185.0
    assert unit_change(values) == (30, "from °C to °F")
    assert find_spikes(values)[0][:2] == (27, 28)


@pytest.mark.parametrize(("value", "rows"), [("85", [0]), ("85", [0, 1, 2]), ("3.2e9", [39])])
@pytest.mark.parametrize("column", ["frame_time", "temperature_time"])
def test_a_clock_that_was_not_set_is_refused(recording, column, value, rows):
    change("epochs.csv", **{column: put(value, *rows)})(recording)
    refused(recording, rf"column {column}: is 5\d years after the row")


def test_a_study_a_fit_and_a_discovery_of_the_doubtful_say_so(recording, tmp_path, undrawn):
    """Doubts are in the text, in `doubts` of the JSON, and in the notes of the report."""
    messages = []
    for name in ("a principal distance of another lens", "85.00 of a DS18B20", "an epoch twice",
                 "an hour as the interval"):  # fmt: skip
        DOUBTS[name][0](recording)
        messages.append(DOUBTS[name][1])
    series = tc.open(recording)
    results = (tc.study(series, sets=20), tc.fit(series), tc.discover(series))
    for k, result in enumerate(results):
        result.report(tmp_path / f"{k}.html")
        page = (tmp_path / f"{k}.html").read_text().replace("\xa0", " ")
        for message in messages:
            (told,) = (text for text in result.as_dict()["doubts"] if message in text)
            assert told.startswith("M1: ") == (k == 0)  # a study tells its series by their names
            assert [line for line in result.lines() if "doubtful" in line and message in line]
            assert escape(message) in page


def test_of_two_series_the_doubtful_is_named(recording, simulated):
    DOUBTS["85.00 of a DS18B20"][0](recording)
    other = shutil.copytree(simulated, recording.parent / "N")
    times(scaled(1, 1e5))(other)
    change("observations.csv", x=lambda text, i: f"{float(text) + 0.05 * np.sin(i):.4f}")(other)
    (told,) = tc.fit(tc.open(recording), tc.open(other)).as_dict()["doubts"]
    assert told.startswith(f"{recording}: temperature: 3 readings")
