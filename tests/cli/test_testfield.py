"""`thermocald testfield` and `thermocald camera` as a user runs them."""

from __future__ import annotations

import json
from functools import partial

import cv2
import numpy as np
import pytest

from tests.commands import document, succeed
from tests.commands import invoke as run
from tests.photogrammetry import network_cases as cases
from tests.pictures import ORIENTATION, save_photograph
from thermocald.errors import GeometryError, ThermocaldError, UsageError
from thermocald.photogrammetry import camera_files
from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.targets.image_file import decode_grey
from thermocald.physics.scene import Scene
from thermocald.store.recording.testfield_file import read_testfield


def test_a_printed_field_is_not_overwritten(tmp_path):
    folder = tmp_path / "not" / "there" / "yet"
    printed = partial(run, "testfield", "print", "--paper", "200x150", "--flat", "--out", folder)
    printed()
    before = (folder / "testfield.csv").read_bytes()
    with pytest.raises(UsageError, match="--force"):
        printed("--first-code", 9)
    assert (folder / "testfield.csv").read_bytes() == before
    printed("--first-code", 9, "--force")
    assert (folder / "testfield.csv").read_bytes() != before


@pytest.mark.parametrize(
    ("arguments", "calibrates"), [((), True), (("--paper", "A4"), True), (("--flat",), False)]
)
def test_check_says_before_printing_whether_a_series_gets_a_result(tmp_path, arguments, calibrates):
    """The same bounds as the adjustment's, on what `print` would draw."""
    result = run("testfield", "check", *arguments, "--json", tmp_path / "found.json")
    assert ("NOT ENOUGH" in result.stdout) is not calibrates
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["calibrates"] is calibrates
    if not calibrates:
        assert any("correlate at" in reason for reason in found["weak"])


def photograph(folder, truth):
    """Write eight rendered photographs of a field to a new folder; return the camera."""
    model = CameraModel(Sensor(1640, 1232, 0.00224), InteriorOrientation(3.05, 0.02, -0.01, -2e-3))
    scene = Scene(model.sensor, truth)
    folder.mkdir()
    for i, station in enumerate(cases.convergent_stations(truth.points, 8, distance=440.0)):
        frame = scene.render(model.interior.as_array(), station.as_array(), seed=i)
        cv2.imwrite(str(folder / f"{i}.jpg"), frame, [cv2.IMWRITE_JPEG_QUALITY, 95])
    return model


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """A printed A3 sheet, a little bent, as JPEG photographs in a folder."""
    folder = tmp_path_factory.mktemp("survey")
    sheet = ("--paper", "A3", "--flat", "--landscape", "--diameter", 12)
    run("testfield", "print", *sheet, "--out", folder)
    nominal = read_testfield(folder / "testfield.csv")
    points = nominal.points.copy()
    points[:, 2] = 3e-5 * (points[:, 0] - 200) ** 2
    truth = TestField.build(
        nominal.names, points, 0.0, nominal.diameters, nominal.kinds, nominal.codes
    )
    model = photograph(folder / "photos", truth)
    a, b = "R65", next(n for n, p in zip(truth.names, points, strict=True)
                       if n.startswith("R") and p[0] > 300 and p[1] < 80)  # fmt: skip
    length = np.linalg.norm(points[truth.index[a]] - points[truth.index[b]])
    return folder, truth, model, (a, b, f"{length:.4f}")


def test_survey_writes_the_field_and_everything_about_it(photographs, tmp_path):
    folder, truth, model, scale = photographs
    out, camera_file = tmp_path / "surveyed.csv", tmp_path / "camera.json"
    # what cannot be read, and what would count twice
    broken, again = tmp_path / "broken.jpg", tmp_path / "again.jpg"
    broken.write_bytes(b"no image")
    smaller = [cv2.IMWRITE_JPEG_QUALITY, 85]
    cv2.imwrite(str(again), cv2.imread(str(folder / "photos" / "3.jpg"), 0), smaller)
    result = succeed(
        "testfield", "survey", folder / "photos", broken, again, "--field",
        folder / "testfield.csv", "--scale", *scale, "--scale-sd", 0.01, "--pixel-pitch", 0.00224,
        "--out", out, "--camera-out", camera_file, "--json", tmp_path / "survey.json",
    )  # fmt: skip
    assert "datum: inner constraints over" in result.stdout
    printed = " ".join(result.stdout.split())
    assert "again.jpg: shows the view of 3.jpg, with the same errors" in printed
    assert "broken.jpg: is not an image" in printed
    surveyed = read_testfield(out)
    known = truth.points[[truth.index[name] for name in surveyed.names]]
    moved, _ = cases.onto(surveyed.points, known)
    # JPEG: these errors come from the image, not from the program
    assert np.sqrt(np.mean((moved - known) ** 2)) < 490 / 20_000
    told = json.loads((tmp_path / "survey.json").read_text())
    assert told["format"] == "thermocald-survey/1"
    assert len(told["targets"]) == len(surveyed)
    assert len(told["stations"]) == 8
    first = told["targets"][0]
    assert np.sqrt(np.diag(first["covariance"])) == pytest.approx(
        [first["sd_X"], first["sd_Y"], first["sd_Z"]]
    )
    assert told["relative_accuracy"] < 1 / 20_000
    assert told["camera"]["c"] == pytest.approx(model.interior.c, rel=2e-4)
    found = camera_files.read(camera_file)
    assert found.model.interior.c == told["camera"]["c"]
    assert found.covariance[0, 0] == pytest.approx(told["camera"]["sd_c"] ** 2)


def test_survey_with_a_known_camera_held(photographs, tmp_path):
    folder, _, model, scale = photographs
    camera_files.write(model, tmp_path / "camera.xml", "metashape")
    (tmp_path / "distances.csv").write_text(
        f"a,b,length,sigma\n{scale[0]},{scale[1]},{scale[2]},0.02\n"
    )
    found = document(
        "testfield", "survey", *sorted((folder / "photos").glob("*.jpg")), "--distances",
        tmp_path / "distances.csv", "--camera", tmp_path / "camera.xml", "--hold-camera", "--out",
        tmp_path / "s.csv",
    )  # fmt: skip
    assert found["camera"]["free"] == []
    assert found["camera"]["sd_c"] == 0.0
    assert found["camera"]["c"] == model.interior.c
    # without a nominal field: the coded targets alone
    assert all(row["target"].startswith("R") for row in found["targets"])


@pytest.mark.parametrize(
    ("arguments", "error", "reason"),
    [
        (["PHOTOS"], UsageError, "the scale is missing"),
        (["PHOTOS", "--scale", "R65", "R65", "100"], UsageError, "is not a distance"),
        (["PHOTOS", "--scale", "R65", "R71", "-3"], UsageError, "is not a distance"),
        (["NOWHERE", "--scale", "R65", "R71", "100"], UsageError, "no such file"),
        (["PHOTOS", "--scale", "R65", "X", "100"], GeometryError, "X"),
        (["PHOTOS", "--scale", "R65", "R71", "100", "--hold-camera"], UsageError, "needs --camera"),
        (["CSV", "--scale", "R65", "R71", "100"], ThermocaldError, "is not an image"),
    ],
)
def test_wrong_surveys_are_refused_and_write_nothing(
    photographs, tmp_path, arguments, error, reason
):
    folder = photographs[0]
    places = {"PHOTOS": folder / "photos", "NOWHERE": folder / "no.jpg",
              "CSV": folder / "testfield.csv"}  # fmt: skip
    out = tmp_path / "out.csv"
    with pytest.raises(error, match=reason):
        run("testfield", "survey", *(places.get(a, a) for a in arguments), "--out", out)
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_file_of_distances_is_named_by_its_line(photographs, tmp_path):
    (tmp_path / "d.csv").write_text("a,b,length,sigma\nR65,R71,100,0.1\nR65,R75,much,0.1\n")
    with pytest.raises(UsageError, match=r"d\.csv, line 3, column length"):
        run("testfield", "survey", photographs[0] / "photos", "--distances", tmp_path / "d.csv",
            "--out", tmp_path / "o.csv")  # fmt: skip


def test_check_json_from_a_place(photographs):
    field = photographs[0] / "testfield.csv"
    found = document("testfield", "check", field, "--from", 700, 150, 400, "--roll", 20)
    assert found["format"] == "thermocald-testfield-check/1"
    assert found["epoch"]["sd_c"] is None  # a plane: nothing finite to say
    assert found["series"]["sd_c"] > 0
    assert found["station"]["X0"] == 700
    assert len(found["visible"]) + len(found["hidden"]) == found["targets"]
    with pytest.raises(GeometryError, match="visible from there"):
        run("testfield", "check", photographs[0] / "testfield.csv", "--from", 200, 150, -400,
            "--at", 200, 150, -900)  # fmt: skip


def test_a_turned_camera_does_not_turn_its_picture(tmp_path):
    """The orientation in EXIF is for display, not the sensor's: if OpenCV rotated the image, the
    principal point would rotate with it.
    """
    path = tmp_path / "turned.jpg"
    save_photograph(path, {ORIENTATION: 6})
    assert cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).shape == (64, 48)  # the block is understood
    assert decode_grey(path).shape == (48, 64)
