"""`fit`, `predict`, `correct` and imported cameras on the command line, and their wrong use."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

from tests.commands import answer as run
from tests.commands import succeed
from tests.pictures import MODEL, TAKEN, save_photograph
from tests.recordings import read_rows, write_rows, write_table
from thermocald.errors import ThermocaldError
from thermocald.physics.device import CameraDevice, Programme
from thermocald.physics.heat import Course
from thermocald.physics.model import ModelEffect
from thermocald.physics.simulation import Simulation
from thermocald.physics.testfields import demonstration_field, demonstration_model
from thermocald.store.recording.testfield_file import write_testfield


def simulated(seed=1, effect=None, epochs=90, interval=20.0, series="M1", kind="plain", name="rpi"):
    """A camera heated by a lamp for a quarter of an hour, and its board at intervals."""
    field = demonstration_field(kind)
    model = demonstration_model(field)
    if effect is not None:
        model = model.with_effect(effect)
    device = CameraDevice(name, model.sensor)
    lamp = Course.steps([0, 100, 900, 1e4], [0.0, 10.0, 0.0])
    board = Course.polygon([0, 350, 700, 1200, 1e4], [0.5, 3.0, 0.8, 4.0, 1.0])
    programme = Programme(
        series, epochs, interval, {"ambient": Course.constant(23.0)},
        {"housing": lamp, "board": board},
    )  # fmt: skip
    return Simulation(replace(model, camera=name), device, field, programme, seed)


def with_head(source, out, change):
    """The recording with another head; `change` is given the head to alter."""
    shutil.copytree(source, out)
    head = yaml.safe_load((out / "recording.yaml").read_text())
    change(head)
    (out / "recording.yaml").write_text(yaml.safe_dump(head, sort_keys=False))


def other_sensor(source, out, width, height, pitch, image_point):
    """The recording as a camera of another sensor would have made it."""
    size = {"width": width, "height": height, "pixel_pitch": pitch}
    with_head(source, out, lambda head: head["camera"].update(size))
    rows, names = read_rows(source / "observations.csv"), ("x", "y", "sx", "sy")
    for row in rows:
        numbers = image_point(*(float(row[name]) for name in names))
        row |= {name: f"{n:.5f}" for name, n in zip(names, numbers, strict=True)}
    write_rows(out / "observations.csv", rows)


def with_columns(source, out, order):
    """The recording with its temperature columns in another order, or fewer."""

    def change(head):
        head["temperatures"] = {name: head["temperatures"][name] for name in order}

    with_head(source, out, change)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("thermal")
    simulated(1).write(path / "M1")
    simulated(2, series="M2").write(path / "M2")
    simulated(3, name="other", epochs=30, interval=60.0).write(path / "other")
    other_sensor(path / "M2", path / "binned", 1640, 1232, 0.00224,
                 lambda x, y, sx, sy: ((x - 0.5) / 2, (y - 0.5) / 2, sx / 2, sy / 2))  # fmt: skip
    other_sensor(path / "M2", path / "crop", 3600, 2464, 0.00112,
                 lambda x, y, sx, sy: (x - 140, y - 232, sx, sy))  # fmt: skip
    with_columns(path / "M2", path / "swapped", ("board_temperature", "temperature"))
    with_columns(path / "M2", path / "board", ("board_temperature",))
    succeed("fit", path / "M1", "-o", path / "cam.yaml")
    return path


def times_of(folder):
    return np.loadtxt(folder / "M1" / "epochs.csv", delimiter=",", skiprows=1, usecols=1)


# --- effects by name ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("effect", "option", "keys"),
    [
        (
            ModelEffect("second_heat_source",
                        {"channel": "board_temperature", "c": 2e-5, "x0": 8e-5, "y0": -5e-5}),
            "second_heat_source:channel=board_temperature,x0,y0,c", ("c", "x0", "y0"),
        ),
        (
            ModelEffect("target_displacement", {"time": 905.0, "targets": ("x33", "y52"),
                                                "dX": 0.15, "dY": -0.1, "dZ": 0.2}),
            "target_displacement:targets=x33+y52", ("dX", "dY", "dZ"),
        ),
    ],
    ids=["second_heat_source", "target_displacement"],
)  # fmt: skip
def test_an_effect_that_needs_a_name(tmp_path, effect, option, keys):
    simulated(4, effect).write(tmp_path / "M1")
    result = succeed(
        "fit", tmp_path / "M1", "-o", tmp_path / "m.yaml", "--effect", option, "--json", "-"
    )
    (found,) = json.loads(result.stdout)["effects"]
    for key in keys:
        estimate = found["parameters"][key]
        assert abs(estimate["value"] - effect.values[key]) < 4 * estimate["sd"], key


@pytest.mark.parametrize(
    ("effect", "says"),
    [
        ("thermal_lagg", "did you mean 'thermal_lag'?"),
        ("thermal_lag:taw=3", "thermal_lag has no parameter 'taw'; did you mean 'tau'?"),
        ("thermal_lag:tau=fast", "tau=fast is not a number"),
        ("thermal_lag:", "no parameter after the colon; there are: tau"),
        ("thermal_lag:tau", "tau has no value; give tau=VALUE"),
        ("thermal_lag:tau=-3", "negative"),
        ("second_heat_source", "give it, as in --effect second_heat_source:channel="),
        ("second_heat_source:channel=bord_temperature", "did you mean 'board_temperature'?"),
        ("target_displacement:targets=x33+y521", "has no target 'y521'; did you mean 'y52'?"),
        ("radial_distortion_drift:A4", "has no parameter 'A4'"),
        ("creep --effect creep:x0", "given twice"),
    ],
)
def test_a_wrong_effect_is_named(folder, effect, says):
    result = run("fit", folder / "M1", "-o", folder / "no.yaml", "--effect", *effect.split())
    assert isinstance(result.exception, ThermocaldError), result.exception
    assert says in str(result.exception)
    assert not (folder / "no.yaml").exists()


# --- testing a model on another series ---------------------------------------------------------


@pytest.mark.parametrize("series", ["M2", "binned", "swapped"])
def test_a_model_is_tested_on_another_series(folder, series):
    """Also if pixels were binned, or another thermometer is listed first."""
    test = ("--test", folder / series, "--json", "-")
    result = succeed("predict", "--model", folder / "cam.yaml", *test)
    (found,) = json.loads(result.stdout)["series"]
    assert found["rms_px"] < 1.1 * found["floor_px"]
    assert 0.93 < found["coverage"] < 0.97


def test_correct_takes_the_noise_of_the_thermometer_from_the_model(folder, tmp_path):
    """The estimate of the fit is used, not a typical value."""
    times = times_of(folder)
    points = tmp_path / "points.csv"
    points.write_text(f"time,x,y\n{times[20]:.3f},500,400\n")
    model = yaml.safe_load((folder / "cam.yaml").read_text())
    sds = []
    for noise in (0.03, 0.3):
        for one in model["fitted_on"]:
            one["thermometer_sd_K"] = noise
        (tmp_path / "cam.yaml").write_text(yaml.safe_dump(model, sort_keys=False))
        succeed("correct", points, "--log", folder / "M1" / "epochs.csv",
                   "--model", tmp_path / "cam.yaml", "--out", tmp_path / "out.csv")  # fmt: skip
        sds.append(float(np.genfromtxt(tmp_path / "out.csv", delimiter=",", names=True)["sd_x"]))
    assert sds[1] > 5 * sds[0]


# --- wrong use ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("predict", "--test", "{other}"), "belongs to one camera"),
        (("predict", "--test", "{crop}"), "a crop"),
        (("predict", "--test", "{board}"), "has no temperature column 'temperature'"),
        (("predict", "--log", "{other}/epochs.csv"), "the images are of other"),
        (("correct", "{points}", "--log", "{other}/epochs.csv"), "the images are of other"),
        (("correct", "{points}", "--log", "{M1}/epochs.csv", "--size", "1920x1080"), "a crop"),
        (("correct", "{points}", "--log", "{M1}/epochs.csv", "--size", "big"), "WIDTHxHEIGHT"),
        (("correct", "{images}", "--log", "{M1}/epochs.csv"), "--out is missing"),
        (("correct", "{images}", "--log", "{M1}/epochs.csv", "--out", "{new}"), "has 640×480 px"),
        (("correct", "{late}", "--log", "{M1}/epochs.csv", "--out", "{new}"), "outside the temp"),
        (("correct", "{points}", "--log", "{fahrenheit}"), "fahrenheit.csv: 89 looks like"),
        (("correct", "{points}", "--log", "{hot}"), "set `extrapolate`"),
        (("correct", "{images}", "--log", "{hot}", "--out", "{new}"), "set `extrapolate`"),
        (("correct", "{elsewhere}", "--log", "{M1}/epochs.csv"), "of another camera, or binned"),
        (("correct", "{no_y}", "--log", "{M1}/epochs.csv"), "no column 'y'"),
        (("correct", "{five}", "--log", "{M1}/epochs.csv"), "line 2: column x: 'five' is not a n"),
        (("correct", "{points}", "--log", "{one_reading}"), "readings at 1 time"),
        (("correct", "{points}", "--log", "{backwards}"), "outside the temperature log"),
        (("correct", "{points}", "--log", "{no_time}"), "rows with a time"),
        (("predict",), "give one of"),
        (("predict", "--temperature", "30", "--channel", "board"), "write NAME=°C"),
        (("predict", "--temperature", "88"), "if it is in fahrenheit, convert it"),
        (("predict", "--temperature", "305"), "if it is in kelvin, convert it"),
        (("predict", "--temperature", "-40"), "set `extrapolate`"),
        (("predict", "--log", "{fahrenheit}"), "fahrenheit.csv: 89 looks like fahrenheit"),
        (("predict", "--test", "{nothing}"), "does not exist"),
    ],
)
def test_wrong_use_is_refused(folder, tmp_path, arguments, says):
    begin, *_, end = times_of(folder)
    files = {
        "points": f"time,x,y\n{begin + 60:.1f},500,400\n",
        "images": f"time,image\n{begin + 60:.1f},small.png\n",
        "late": f"time,image\n{end + 9e4:.1f},small.png\n",
        "elsewhere": f"time,x,y\n{begin + 60:.1f},5000,5\n",
        "no_y": f"time,x\n{begin + 60:.1f},5\n",
        "five": f"time,x,y\n{begin + 60:.1f},five,5\n",
        "one_reading": f"time,t\n{begin:.1f},20\n",
        "backwards": "time,t\n9,20\n5,20\n",
        "no_time": "when,t\n9,20\n",
        "fahrenheit": f"time,air\n{begin:.1f},86\n{end:.1f},92\n",
        "hot": f"time,air\n{begin:.1f},160\n{end:.1f},170\n",
    }
    places = {n: folder / n for n in ("M1", "other", "crop", "board", "nothing")} | {
        "new": tmp_path / "new"
    }
    for name, text in files.items():
        places[name] = tmp_path / f"{name}.csv"
        places[name].write_text(text)
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((480, 640), np.uint8))
    given = [a.format(**places) for a in arguments]
    result = run(*given, "--model", folder / "cam.yaml")
    assert isinstance(result.exception, ThermocaldError), result.exception
    assert says in str(result.exception)
    if "--size" in arguments or "--channel" in arguments:
        assert "warning" not in result.stderr  # the model's would hide the error


@pytest.mark.parametrize(
    ("second", "says"),
    [
        ("other", "belongs to one camera"),
        ("swapped", "put the same one first"),  # another thermometer is the reference
        ("binned", "fit series of one resolution"),
    ],
)
def test_what_is_no_series_of_one_camera_is_not_fitted_together(folder, tmp_path, second, says):
    result = run("fit", folder / "M1", folder / second, "-o", tmp_path / "no.yaml")
    assert says in str(result.exception)


def test_the_model_s_own_thermometer_is_taken_from_a_log(folder, tmp_path):
    """Its column is used wherever it is, unless another is named."""
    rows = read_rows(folder / "M1" / "epochs.csv")
    columns = ("temperature_time", "board_temperature", "temperature")
    swapped = [[row[name] for name in columns] for row in rows]
    write_table(tmp_path / "log.csv", ("time", *columns[1:]), swapped)
    (tmp_path / "p.csv").write_text(f"time,x,y\n{swapped[39][0]},500,400\n")

    def moved(*log):
        run("correct", tmp_path / "p.csv", "--model", folder / "cam.yaml", "--out",
            tmp_path / "o.csv", "--extrapolate", "--log", *log)  # fmt: skip
        return np.genfromtxt(tmp_path / "o.csv", delimiter=",", names=True)["dx"]

    first = moved(folder / "M1" / "epochs.csv")
    assert moved(tmp_path / "log.csv") == pytest.approx(first, abs=1e-3)
    other = moved(tmp_path / "log.csv", "--temperature-column", "board_temperature")
    assert abs(other - first) > 0.1


def test_a_model_is_valid_where_frames_were_taken(folder, tmp_path):
    """Its range began with a log an hour before the first frame, 15 K lower."""
    shutil.copytree(folder / "M1", tmp_path / "M1")
    columns = ("temperature_time", "temperature", "board_temperature")
    taken = [[float(row[k]) for k in columns] for row in read_rows(tmp_path / "M1" / "epochs.csv")]
    before = [[taken[0][0] - 30.0 * k, 5.0, 5.0] for k in range(20, 0, -1)]
    write_table(tmp_path / "M1" / "readings.csv", ("time", *columns[1:]), before + taken)
    run("fit", tmp_path / "M1", "--output", tmp_path / "m.yaml")
    low, _ = yaml.safe_load((tmp_path / "m.yaml").read_text())["validity"]["temperature"]
    assert low > min(T for _, T, _ in taken) - 0.2


def test_what_is_outside_is_said(folder, tmp_path):
    """Far outside by name, and a recording in fahrenheit, with which the model is tested."""
    shutil.copytree(folder / "M2", tmp_path / "warm")
    rows = read_rows(tmp_path / "warm" / "epochs.csv")
    for row in rows:
        row["temperature"] = f"{1.8 * float(row['temperature']) + 32:.3f}"
    write_rows(tmp_path / "warm" / "epochs.csv", rows)
    for given, words in (
        (("--temperature", -40, "--extrapolate"), "standard deviations are widened"),
        (("--test", tmp_path / "warm"), "if it is in fahrenheit, convert it"),
    ):
        assert words in succeed("predict", "--model", folder / "cam.yaml", *given).stderr


# --- images ------------------------------------------------------------------------------------


def correct_images(folder, source, out, *more):
    """Images at the start and in the heat, as a camera of 8 × 8 binned pixels takes them."""
    times = times_of(folder)
    (source / "i.csv").write_text(f"time,image\n{times[0]:.2f},a.png\n{times[45]:.2f},b.png\n")
    return run("correct", source / "i.csv", "--model", folder / "cam.yaml", "--log",
               folder / "M1" / "epochs.csv", "--size", "410x308", "--out", out, *more)  # fmt: skip


@pytest.fixture
def two_images(tmp_path):
    image = np.random.default_rng(1).integers(0, 255, (308, 410), np.uint8)
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), image)
    return tmp_path


def test_images_are_corrected_and_said_how_much_and_never_overwritten(folder, two_images):
    result = correct_images(folder, two_images, two_images / "out", "--json", "-")
    document = json.loads(result.stdout)
    cold, hot = document["images"]
    assert hot["temperature"] > cold["temperature"] + 5
    for found in (cold, hot):
        # per coordinate, as for points and as what is left over
        assert found["largest_correction_px"] >= 2**0.5 * found["rms_correction_px"] > 0.02
        assert 0 < found["rms_left_over_px"] < 0.02
    assert {p.name for p in (two_images / "out").iterdir()} == {"a.png", "b.png"}
    again = correct_images(folder, two_images, two_images)
    assert "would be overwritten" in str(again.exception)


@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_corrected_images_keep_what_exif_says(folder, tmp_path, kind):
    """An unreadable image is reported with its line; the other one is corrected."""
    image_module = pytest.importorskip("PIL.Image")
    grey = np.random.default_rng(1).integers(0, 255, (308, 410), np.uint8)
    tags = {MODEL: "imx219", TAKEN: "2026:06:14 12:00:00"}
    save_photograph(tmp_path / f"a.{kind}", tags, grey)
    (tmp_path / f"b.{kind}").write_bytes(b"no picture")
    times = times_of(folder)
    rows = f"{times[40]:.2f},b.{kind}\n{times[45]:.2f},a.{kind}\n"
    (tmp_path / "i.csv").write_text(f"time,image\n{rows}")
    result = run("correct", tmp_path / "i.csv", "--model", folder / "cam.yaml", "--log",
                 folder / "M1" / "epochs.csv", "--size", "410x308", "--out", tmp_path / "out",
                 "--json", "-")  # fmt: skip
    assert "1 of 2 rows were not corrected: line 2" in str(result.exception)
    assert "is not an image" in json.loads(result.stdout)["refused"][0]["reason"]
    with image_module.open(tmp_path / "out" / f"a.{kind}") as written:
        told = written.getexif()
        assert told[MODEL] == "imx219"
        assert told.get_ifd(0x8769)[TAKEN] == "2026:06:14 12:00:00"
        assert np.asarray(written).shape == (308, 410)


# --- rows that come in -------------------------------------------------------------------------


def test_rows_of_standard_input_are_corrected_as_they_come(folder):
    """Each is answered before the next is sent; one that cannot be corrected is reported."""
    times = times_of(folder)
    command = [sys.executable, "-m", "thermocald", "correct", "-", "--model", folder / "cam.yaml",
               "--log", folder / "M1" / "epochs.csv"]  # fmt: skip
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        bufsize=1,
    ) as process:  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        answers = []
        process.stdin.write(f"time,x,y,who\n{times[40]:.2f},500,400,a\n")
        answers += [process.stdout.readline(), process.stdout.readline()]
        for row in ("soon,500,400,b", f"{times[41]:.2f},9999,400,c", f"{times[41]:.2f},5",
                    f"{times[-1] + 9e4:.2f},500,400,d"):  # fmt: skip
            process.stdin.write(row + "\n")
        process.stdin.write(f"{times[41]:.2f},600,400,e\n")
        answers.append(process.stdout.readline())
        process.stdin.close()
        told = process.stderr.read()
        assert process.stdout.read() == ""
    assert process.returncode == 1
    assert answers[0].startswith("time,x,y,who,dx,dy,sd_x")
    assert [answer.split(",")[3] for answer in answers[1:]] == ["a", "e"]
    for line, reason in ((3, "'soon' is not a time"), (4, "lies outside"), (5, "has 2 fields"),
                         (6, "outside the temperature log")):  # fmt: skip
        assert f"line {line}: not corrected: " in told
        assert reason in told
    assert "4 of 6 rows were not corrected: lines 3, 4, 5, 6" in told


# --- cameras of other programs as initial values -----------------------------------------------


def test_a_file_without_pixel_pitch_asks_for_it(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 3280 2464 2700 2700 1640 1232\n")
    (tmp_path / "a.png").write_bytes(b"")
    arguments = ("calibrate", tmp_path / "a.png", "--testfield", tmp_path / "f.csv", "--camera",
                 tmp_path / "cameras.txt")  # fmt: skip
    write_testfield(tmp_path / "f.csv", demonstration_field("markers"))
    assert "--pixel-pitch" in str(run(*arguments).exception)
    given = run(*arguments, "--pixel-pitch", 0.00112)
    assert "no photograph" in str(given.exception)  # the camera was taken
