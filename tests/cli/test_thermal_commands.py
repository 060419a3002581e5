"""`fit`, `predict`, `correct` and imported cameras on the command line, and their wrong use."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
import yaml
from PIL import Image

import thermocald as tc
from tests.commands import answer as run
from tests.commands import document, succeed
from tests.pictures import MODEL, TAKEN, save_photograph
from tests.recordings import read_rows, write_rows, write_table


def times_of(misfits):
    return np.loadtxt(misfits / "M3" / "epochs.csv", delimiter=",", skiprows=1, usecols=1)


@pytest.mark.parametrize(
    ("name", "values", "option"),
    [
        ("second_heat_source", {"channel": "board_temperature", "c": 2e-5, "x0": 8e-5, "y0": -5e-5},
         "channel=board_temperature,x0,y0,c"),
        ("target_displacement",
         {"time": 905.0, "targets": ("x33", "y52"), "dX": 0.15, "dY": -0.1, "dZ": 0.2},
         "targets=x33+y52"),
    ],
)  # fmt: skip
def test_an_effect_that_needs_a_name(misfits, tmp_path, name, values, option):
    heated = {"model": misfits / "true.yaml", "programme": misfits / "programme.yaml"}
    tc.simulate(**heated, effects={name: values}, seed=4, out=tmp_path / "M1")
    given = ("-o", tmp_path / "m.yaml", "--effect", f"{name}:{option}")
    (found,) = document("fit", tmp_path / "M1", *given)["effects"]
    for key in set(values) - {"channel", "time", "targets"}:
        estimate = found["parameters"][key]
        assert abs(estimate["value"] - values[key]) < 4 * estimate["sd"], key


@pytest.mark.parametrize("series", ["M3", "binned", "swapped"])
def test_a_model_is_tested_on_another_series(misfits, series):
    """Also if pixels were binned, or another thermometer is listed first."""
    test = ("--test", misfits / series)
    (found,) = document("predict", "--model", misfits / "model.yaml", *test)["series"]
    assert found["rms_px"] < 1.1 * found["floor_px"]
    assert 0.93 < found["coverage"] < 0.97


def test_correct_takes_the_noise_of_the_thermometer_from_the_model(misfits, tmp_path):
    """The estimate of the fit is used, not a typical value."""
    (tmp_path / "points.csv").write_text(f"time,x,y\n{times_of(misfits)[20]:.3f},500,400\n")
    model = yaml.safe_load((misfits / "model.yaml").read_text())
    sds = []
    for noise in (0.03, 0.3):
        for one in model["fitted_on"]:
            one["thermometer_sd_K"] = noise
        (tmp_path / "cam.yaml").write_text(yaml.safe_dump(model, sort_keys=False))
        given = ("--log", misfits / "M3", "--model", tmp_path / "cam.yaml")
        out = tmp_path / "out.csv"
        done = succeed("correct", tmp_path / "points.csv", *given, "--out", out)
        assert "1 point corrected" in done.stdout
        sds.append(float(read_rows(out)[0]["sd_x"]))
    assert sds[1] > 5 * sds[0]


def test_the_model_s_own_thermometer_is_taken_from_a_log(misfits, tmp_path):
    """Its column is used wherever it is, unless another is named."""
    rows = read_rows(misfits / "M3" / "epochs.csv")
    columns = ("temperature_time", "board_temperature", "temperature")
    swapped = [[row[name] for name in columns] for row in rows]
    write_table(tmp_path / "log.csv", ("time", *columns[1:]), swapped)
    (tmp_path / "p.csv").write_text(f"time,x,y\n{swapped[39][0]},500,400\n")

    def moved(*log):
        given = ("--model", misfits / "model.yaml", "--extrapolate", "--log", *log)
        _, row = succeed("correct", tmp_path / "p.csv", *given, "-o", "-").stdout.splitlines()
        return float(row.split(",")[3])

    first = moved(misfits / "M3" / "epochs.csv")
    assert moved(tmp_path / "log.csv") == pytest.approx(first, abs=1e-3)
    other = moved(tmp_path / "log.csv", "--temperature-column", "board_temperature")
    assert abs(other - first) > 0.1


def test_a_model_is_valid_where_frames_were_taken(misfits, tmp_path):
    """Its range began with a log an hour before the first frame, 15 K lower."""
    shutil.copytree(misfits / "M3", tmp_path / "M1")
    columns = ("temperature_time", "temperature", "board_temperature")
    taken = [[float(row[k]) for k in columns] for row in read_rows(tmp_path / "M1" / "epochs.csv")]
    before = [[taken[0][0] - 30.0 * k, 5.0, 5.0] for k in range(20, 0, -1)]
    write_table(tmp_path / "M1" / "readings.csv", ("time", *columns[1:]), before + taken)
    succeed("fit", tmp_path / "M1", "--output", tmp_path / "m.yaml")
    low, _ = yaml.safe_load((tmp_path / "m.yaml").read_text())["validity"]["temperature"]
    assert low > min(T for _, T, _ in taken) - 0.2


def test_a_series_in_fahrenheit_is_doubted(misfits, tmp_path):
    warm = shutil.copytree(misfits / "M3", tmp_path / "warm")
    rows = read_rows(warm / "epochs.csv")
    for row in rows:
        row["temperature"] = f"{1.8 * float(row['temperature']) + 32:.3f}"
    write_rows(warm / "epochs.csv", rows)
    said = succeed("predict", "--model", misfits / "model.yaml", "--test", warm).stderr
    assert "if it is in fahrenheit, convert it" in said


@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_images_are_corrected_and_keep_what_exif_says(misfits, tmp_path, kind):
    """At the start and in the heat, binned by 8; one that is unreadable has its line.

    So has one of another folder that would replace a corrected image of its name, one without
    an ending and one with NUL in its name, which ended in tracebacks.
    """
    grey = np.random.default_rng(1).integers(0, 255, (308, 410), np.uint8)
    for name in "ab":
        tags = {MODEL: "imx219", TAKEN: "2026:06:14 12:00:00"}
        save_photograph(tmp_path / f"{name}.{kind}", tags, grey)
    (tmp_path / f"c.{kind}").write_bytes(b"no picture")
    shutil.copytree(tmp_path, tmp_path / "more")
    shutil.copy(tmp_path / f"a.{kind}", tmp_path / "bare")
    listed = ((0, "a"), (40, "c"), (45, "b"), (46, "more/b"))
    rows = [f"{times_of(misfits)[k]:.2f},{n}.{kind}" for k, n in listed]
    rows += [f"{times_of(misfits)[47]:.2f},{name}" for name in ("bare", "a\0")]
    (tmp_path / "i.csv").write_text("\n".join(["time,image", *rows, ""]))

    def correct(out, size="410x308"):
        return run(
            "correct", tmp_path / "i.csv", "--model", misfits / "model.yaml", "--log",
            misfits / "M3", "--size", size, "--out", out, "--json", "-",
        )  # fmt: skip

    result = correct(tmp_path / "out")
    assert "4 of 6 rows were not corrected: lines 3, 5, 6, 7" in str(result.exception)
    told = json.loads(result.stdout)
    assert told["refused"][1]["reason"].endswith(f"b.{kind} is the corrected image of line 4")
    assert "is not an image" in told["refused"][0]["reason"]
    cold, hot = told["images"]
    assert hot["temperature"] > cold["temperature"] + 5
    for found in (cold, hot):
        # per coordinate, as for points and as what is left over
        assert found["largest_correction_px"] >= 2**0.5 * found["rms_correction_px"] > 0.02
        assert 0 < found["rms_left_over_px"] < 0.02
    with Image.open(tmp_path / "out" / f"b.{kind}") as written:
        assert written.getexif()[MODEL] == "imx219"
        assert written.getexif().get_ifd(0x8769)[TAKEN] == "2026:06:14 12:00:00"
        assert np.asarray(written).shape == (308, 410)
    assert "would be overwritten" in str(correct(tmp_path).exception)
    assert "no row was corrected" in str(correct(tmp_path / "new", "820x616").exception)
    assert not (tmp_path / "new").exists()


def test_rows_of_standard_input_are_corrected_as_they_come(misfits):
    """Each is answered before the next is sent; one that cannot be corrected is reported."""
    first, second, last = times_of(misfits)[[40, 41, -1]]
    command = [sys.executable, "-m", "thermocald", "correct", "-", "--model",
               misfits / "model.yaml", "--log", misfits / "M3" / "epochs.csv"]  # fmt: skip
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        bufsize=1,
    ) as process:  # fmt: skip
        process.stdin.write(f"time,x,y,who\n{first:.2f},500,400,a\n")
        answers = [process.stdout.readline(), process.stdout.readline()]
        for row in ("soon,500,400,b", f"{second:.2f},9999,400,c", f"{second:.2f},5",
                    f"{last + 9e4:.2f},500,400,d", f'{second:.2f},500,400,"12 inch',
                    "2026-06-14T12:00:30,500,400,z",
                    f"{second:.2f},600,400,e"):  # fmt: skip
            process.stdin.write(row + "\n")
        answers.append(process.stdout.readline())
        process.stdin.close()
        told = process.stderr.read()
        assert process.stdout.read() == ""
    assert process.returncode == 1
    assert answers[0].startswith("time,x,y,who,dx,dy,sd_x")
    assert [answer.split(",")[3] for answer in answers[1:]] == ["a", "e"]
    for line, reason in ((3, "'soon' is not a time"), (4, "lies outside"), (5, "has 2 fields"),
                         (6, "outside the temperature log"), (7, "a quote that is not closed"),
                         (8, "no time zone: add")):  # fmt: skip
        assert f"line {line}: not corrected: " in told
        assert reason in told
    assert "6 of 8 rows were not corrected: lines 3, 4, 5, 6, 7, 8" in told
