"""Implausible values are refused with one line, or called doubtful."""

from __future__ import annotations

import csv
import shutil
from html import escape

import numpy as np
import pytest

import thermocald as tc
from tests.commands import call
from thermocald.errors import RecordingError
from thermocald.store.recording.reader import read_recording
from thermocald.store.recording.sense import find_spikes, find_unit_change, interior_doubts

SIZE = "width: 3280, height: 2464"


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """A warming camera before a field of 49 targets, 40 epochs."""
    path = tmp_path_factory.mktemp("sense") / "whole"
    assert (
        call("simulate", "--preset", "rpi-v2.1-heating", "--seed", 1, "--out", path).returncode == 0
    )
    for name in ("epochs.csv", "observations.csv"):
        header, *rows = (path / name).read_text().splitlines()
        rows = [row for row in rows if int(row.split(",")[0]) <= 40]
        if name == "observations.csv":
            some = {row.split(",")[1] for row in rows[:147:3]}
            rows = [row for row in rows if row.split(",")[1] in some]
        (path / name).write_text("\n".join([header, *rows]) + "\n")
    return path


@pytest.fixture
def recording(simulated, tmp_path):
    return shutil.copytree(simulated, tmp_path / "M")


def head(path, old: str, new: str) -> None:
    file = path / "recording.yaml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


def change(path, name: str, **columns) -> None:
    """Replace columns of a table by functions of their values and the row (from 0)."""
    with (path / name).open(newline="") as file:
        names, *rows = csv.reader(file)
    for column, function in columns.items():
        k = names.index(column)
        for i, row in enumerate(rows):
            row[k] = str(function(row[k], i))
    with (path / name).open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([names, *rows])


def scaled(factor: float, shift: float = 0.0):
    return lambda text, _: f"{factor * float(text) + shift:.15g}"


def put(value: str, *rows: int):
    return lambda text, i: value if i in rows else text


OTHER_IMAGES = {
    "width and height exchanged": (
        lambda p: head(p, SIZE, "width: 2464, height: 3280"), "width and height (or x and y)"),
    "a crop": (lambda p: head(p, SIZE, "width: 1920, height: 1080"), "another camera"),
    "points from the centre": (
        lambda p: change(p, "observations.csv", x=scaled(1, -1639.5), y=scaled(1, -1231.5)),
        "from the centre of the image"),
    "points in mm": (
        lambda p: change(p, "observations.csv", x=scaled(0.00112), y=scaled(0.00112)), "in mm"),
    "y upwards from below": (
        lambda p: change(p, "observations.csv", y=scaled(-1)), "lie outside"),
}  # fmt: skip


@pytest.mark.parametrize("name", OTHER_IMAGES)
def test_points_of_another_image_are_refused(recording, name):
    damage, message = OTHER_IMAGES[name]
    damage(recording)
    with pytest.raises(RecordingError, match=r"observations\.csv, line \d+, column x") as caught:
        read_recording(recording)
    assert message in str(caught.value)
    for command in ("check", "replay", "export") if name == "a crop" else ("check",):
        done = call(command, recording)
        assert done.returncode == 1
        assert done.stderr.count("\n") == 1
        assert "Traceback" not in done.stderr


def test_some_gross_errors_off_the_image_are_left_to_the_adjustment(recording):
    """One of them pulls its whole epoch away."""
    rows = (1, 166, 500, 833, 1166)
    change(recording, "observations.csv", x=put("-400", *rows), y=put("9000", *rows))
    assert tc.open(recording).calibrate().ok.all()


def fahrenheit(text: str, i: int) -> str:
    return text if i < 20 else f"{1.8 * float(text) + 32:.4f}"


def exchange_in_the_middle(path) -> None:
    """Points within both images show nothing; the principal point shows the exchange."""
    file = path / "observations.csv"
    header, *rows = file.read_text().splitlines()
    kept = [r for r in rows if float(r.split(",")[2]) < 2460]
    file.write_text("\n".join([header, *kept]) + "\n")
    head(path, SIZE, "width: 2464, height: 3280")


def repeat_epoch(path) -> None:
    file = path / "observations.csv"
    header, *rows = file.read_text().splitlines()
    others = [row for row in rows if not row.startswith("18,")]
    copied = ["18," + row.partition(",")[2] for row in rows if row.startswith("17,")]
    file.write_text("\n".join([header, *others, *copied]) + "\n")


DOUBTS = {
    "a principal distance of another lens": (
        lambda p: head(p, "principal_distance: 3.04", "principal_distance: 6.0"),
        "0.507 times"),
    "the pixels of a binned mode": (
        lambda p: head(p, "pixel_pitch: 0.00112", "pixel_pitch: 0.00224"), "2 times"),
    "the size of a larger mode": (
        lambda p: head(p, SIZE, "width: 6560, height: 4928"), "off the centre of 6560 × 4928"),
    "another field": (
        lambda p: change(p, "testfield.csv", X=lambda t, i: 37.0 * ((i * 7) % 41)),
        "can be calibrated"),
    "width and height exchanged": (
        exchange_in_the_middle,
        "px off the centre of 2464 × 3280 px: width and height look exchanged"),
    "some epochs of one time": (
        lambda p: change(p, "epochs.csv", frame_time=put("1600000100.0", *range(10, 20))),
        "10 epochs have the time of another one, the first 11 and 12"),
    "times in minutes": (
        lambda p: change(p, "epochs.csv", frame_time=scaled(1 / 60),
                         temperature_time=scaled(1 / 60)), "every 0.167 s"),
    "a name that no store keeps": (
        lambda p: head(p, "{name: rpi", "{name: a/rpi"), "no store accepts it"),
    "an hour as the interval": (
        lambda p: head(p, "interval: 10.0", "interval: 3600"), "every 10 s"),
    "a file that is cut off": (
        lambda p: (p / "observations.csv").write_text(
            (p / "observations.csv").read_text().partition("\n17,")[0] + "\n"),
        "epochs have no observations: is the file cut off?"),
    "an epoch twice": (repeat_epoch, "1 epoch with the image points of another one: epoch 18"),
    "85.00 of a DS18B20": (
        lambda p: change(p, "epochs.csv", temperature=put("85.0", 12, 30, 31)),
        "3 readings given without a measurement, the first 85 °C at reading 13"),
    "a thermometer in another time zone": (
        lambda p: change(p, "epochs.csv", temperature_time=scaled(1, 3600)),
        "read 3600 s after their frames"),
    "°F from the beginning": (
        lambda p: change(p, "epochs.csv", temperature=scaled(1.8, 32)), "are they °F?"),
    "nothing but 85.00": (
        lambda p: change(p, "epochs.csv", board_temperature=lambda *_: "85.0"),
        "board_temperature: all 40 readings are 85 °C"),
    "°C, then °F": (lambda p: change(p, "epochs.csv", temperature=fahrenheit), "from °C to °F"),
    "a reading that leaps": (
        lambda p: change(p, "epochs.csv", temperature=put("71.3", 12)), "leaping away and back"),
}  # fmt: skip


REPLAYED = ("the pixels of a binned mode", "85.00 of a DS18B20")


@pytest.mark.parametrize("name", DOUBTS)
def test_what_is_doubtful_is_told(recording, name):
    damage, message = DOUBTS[name]
    damage(recording)
    checked = call("check", recording)
    assert checked.returncode == 0
    assert "a doubtful recording" in checked.stdout
    (line,) = [text for text in checked.stdout.splitlines() if message in text]
    assert line.startswith("  doubtful: ")
    if name in REPLAYED:
        replayed = call("replay", recording)
        assert replayed.returncode == 0
        assert message in replayed.stderr


def test_a_whole_recording_has_no_doubts(recording):
    assert tc.open(recording).doubts() == []
    assert "doubtful" not in call("check", recording).stdout + call("replay", recording).stderr


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


@pytest.mark.parametrize(
    "values",
    [
        wave(),
        np.r_[wave(30), wave(30) + 40.0],  # carried into the sun
        np.r_[np.full(20, 20.0), 20.0 + 65.0 * (1 - np.exp(-np.arange(60) / 3.0))],  # a kettle
        np.linspace(20.0, 120.0, 60),  # through 85 °C
        np.full(40, 85.0),  # at 85 °C
        np.r_[np.full(20, 78.0), np.full(20, 85.0), np.full(20, 77.0)],  # a processor's limit
        np.r_[np.full(20, 6.0), np.full(30, 0.0)],  # melting snow
        np.r_[np.full(9, np.nan), wave(20)],
        np.full(9, np.nan),
        np.empty(0),
    ],
)
def test_what_was_measured_is_no_spike(values):
    assert find_spikes(values) == []


def unit_change(values: np.ndarray) -> tuple[int, str] | None:
    return find_unit_change(np.arange(len(values)) * 60.0, values)


@pytest.mark.parametrize("rise", [9.0, 15.0, 25.0, 35.0, 60.0])
def test_a_camera_that_is_carried_changes_no_unit(rise):
    assert unit_change(np.r_[wave(30), wave(60)[30:] + rise]) is None
    settling = 0.6 * rise * np.exp(-np.arange(30) / 2.0)
    assert unit_change(np.r_[wave(30), wave(60)[30:] + rise - settling]) is None


def test_lenses_near_what_is_stated_are_not_doubted(recording):
    camera = read_recording(recording).camera
    for c in (2.6, 3.04, 3.6):
        assert interior_doubts(camera, c, 0.1, -0.1) == []
    assert len(interior_doubts(camera, 4.0, 0.9, 0.0)) == 2


@pytest.mark.parametrize("rows", [[0], [0, 1, 2], [39]])
@pytest.mark.parametrize("column", ["frame_time", "temperature_time"])
def test_a_clock_that_was_not_set_is_refused(recording, column, rows):
    value = "85.0" if rows[0] == 0 else "3.2e9"
    change(recording, "epochs.csv", **{column: put(value, *rows)})
    with pytest.raises(RecordingError, match=rf"column {column}: is 5\d years after the row"):
        read_recording(recording)


def test_a_spike_beside_a_change_of_the_unit_hides_neither():
    values = np.r_[wave(30), 1.8 * wave(60)[30:] + 32]
    values[[27, 33]] = 85.0, 185.0
    assert unit_change(values) == (30, "from °C to °F")
    assert find_spikes(values)[0][:2] == (27, 28)


def test_a_study_a_fit_and_a_discovery_of_the_doubtful_say_so(recording, tmp_path, undrawn):
    """Doubts are in the text, in `doubts` of the JSON, and in the notes of the report."""
    messages = []
    for name in ("a principal distance of another lens", "85.00 of a DS18B20", "an epoch twice",
                 "an hour as the interval"):  # fmt: skip
        DOUBTS[name][0](recording)
        messages.append(DOUBTS[name][1])
    series = tc.open(recording)
    results = (tc.study(series, sets=20), tc.fit(series), tc.discover(series))
    results[0].report(tmp_path / "study.html")
    results[2].report(tmp_path / "discovery.html")
    results[1].report(tmp_path / "fit.html")
    pages = [
        (tmp_path / f"{kind}.html").read_text().replace("\xa0", " ")
        for kind in ("study", "fit", "discovery")
    ]
    for message in messages:
        for k, (result, page) in enumerate(zip(results, pages, strict=True)):
            (told,) = (text for text in result.as_dict()["doubts"] if message in text)
            assert told.startswith("M1: ") == (k == 0)  # a study tells its series by their names
            assert [line for line in result.lines() if "doubtful" in line and message in line]
            assert escape(message) in page


def test_two_series_of_which_one_is_doubtful(recording, simulated):
    """The doubt names the series."""
    DOUBTS["85.00 of a DS18B20"][0](recording)
    shutil.copytree(simulated, recording.parent / "N")
    change(recording.parent / "N", "epochs.csv", frame_time=scaled(1, 1e5),
           temperature_time=scaled(1, 1e5))  # fmt: skip
    rng = np.random.default_rng(3)
    change(recording.parent / "N", "observations.csv",
           x=lambda t, _: f"{float(t) + rng.normal(0, 0.05):.4f}")  # fmt: skip
    one, other = tc.open(recording), tc.open(recording.parent / "N")
    (told,) = tc.fit(one, other).as_dict()["doubts"]
    assert told.startswith(f"{recording}: temperature: 3 readings")
