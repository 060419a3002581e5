"""`thermocald testfield` as a user runs it."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from tests.commands import document, invoke, succeed
from tests.photogrammetry import network_cases as cases
from tests.pictures import ORIENTATION, save_photograph
from thermocald.errors import GeometryError, UsageError
from thermocald.photogrammetry import camera_files
from thermocald.photogrammetry.targets.image_file import decode_grey
from thermocald.store.recording.testfield_file import read_testfield


def test_a_printed_field_is_not_overwritten(tmp_path):
    folder = tmp_path / "not" / "there" / "yet"
    command = ("testfield", "print", "--paper", "200x150", "--flat", "--out", folder)
    succeed(*command)
    before = (folder / "testfield.csv").read_bytes()
    with pytest.raises(UsageError, match="--force"):
        invoke(*command, "--first-code", 9)
    assert (folder / "testfield.csv").read_bytes() == before
    succeed(*command, "--first-code", 9, "--force")
    assert (folder / "testfield.csv").read_bytes() != before


def test_check_says_before_printing_what_a_flat_field_is_good_for(tmp_path):
    result = succeed("testfield", "check", "--flat", "--json", tmp_path / "found.json")
    told = " ".join(result.stdout.split())
    assert told.startswith("NOT ENOUGH: a series of a fixed camera gets no result")
    assert "A flat sheet also gives a drift: photograph it in ten poses" in told
    assert "the principal distance is not determined" in told
    found = json.loads((tmp_path / "found.json").read_text())
    assert not found["calibrates"]
    assert document("testfield", "check")["calibrates"]
    assert any("correlate at" in reason for reason in found["weak"])


def test_check_from_a_place(sheet):
    field = sheet[0] / "testfield.csv"
    found = document("testfield", "check", field, "--from", 700, 150, 400, "--roll", 20)
    assert found["epoch"]["sd_c"] is None  # a plane: nothing finite to say
    assert found["station"]["X0"] == 700
    with pytest.raises(GeometryError, match="visible from there"):
        invoke("testfield", "check", field, "--from", 200, 150, -400, "--at", 200, 150, -900)


def test_survey_writes_the_field_and_everything_about_it(sheet, tmp_path):
    folder, truth, model, scale = sheet
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
    printed = " ".join(result.stdout.split())
    assert "datum: inner constraints over" in printed
    assert "again.jpg: shows the view of 3.jpg, with the same errors" in printed
    assert "broken.jpg: is not an image" in printed
    surveyed = read_testfield(out)
    known = truth.points[[truth.index[name] for name in surveyed.names]]
    moved, _ = cases.onto(surveyed.points, known)
    # JPEG: these errors come from the image, not from the program
    assert np.sqrt(np.mean((moved - known) ** 2)) < 490 / 20_000
    told = json.loads((tmp_path / "survey.json").read_text())
    # the ruler's error is common to all targets: a camera's calibration reads the shape's
    stated = np.array([t["sd_X"] for t in sorted(told["targets"], key=lambda t: t["target"])])
    assert surveyed.scale is not None
    order = np.argsort(surveyed.names)
    assert surveyed.sigmas[order, 0] == pytest.approx(stated, rel=0.03)
    assert surveyed.shape_sigmas.mean() < surveyed.sigmas.mean()
    assert (len(told["targets"]), len(told["stations"])) == (len(surveyed), 8)
    first = told["targets"][0]
    assert np.sqrt(np.diag(first["covariance"])) == pytest.approx(
        [first["sd_X"], first["sd_Y"], first["sd_Z"]]
    )
    assert told["relative_accuracy"] < 1 / 20_000
    assert told["camera"]["c"] == pytest.approx(model.interior.c, rel=2e-4)
    found = camera_files.read(camera_file)
    assert found.model.interior.c == told["camera"]["c"]
    assert found.covariance[0, 0] == pytest.approx(told["camera"]["sd_c"] ** 2)


def test_survey_with_a_known_camera_held(sheet, tmp_path):
    folder, _, model, (a, b, length) = sheet
    camera_files.write(model, tmp_path / "camera.xml", "metashape")
    (tmp_path / "distances.csv").write_text(f"a,b,length,sigma\n{a},{b},{length},0.02\n")
    found = document(
        "testfield", "survey", *sorted((folder / "photos").glob("*.jpg")), "--distances",
        tmp_path / "distances.csv", "--camera", tmp_path / "camera.xml", "--hold-camera", "--out",
        tmp_path / "s.csv",
    )  # fmt: skip
    camera = found["camera"]
    assert (camera["free"], camera["sd_c"], camera["c"]) == ([], 0.0, model.interior.c)
    # without a nominal field: the coded targets alone
    assert all(row["target"].startswith("R") for row in found["targets"])
    command = ("testfield", "survey", folder / "photos", "--out", tmp_path / "s.csv")
    with pytest.raises(GeometryError, match="nowhere"):
        invoke(*command, "--scale", a, "nowhere", 9)
    with pytest.raises(GeometryError, match="are they in mm, and between these targets"):
        invoke(*command, "--scale", "R65", "R71", 100, "--field", folder / "testfield.csv")


def test_a_turned_camera_does_not_turn_its_picture(tmp_path):
    """The orientation in EXIF is for display, not the sensor's: if OpenCV rotated the image, the
    principal point would rotate with it.
    """
    path = tmp_path / "turned.jpg"
    save_photograph(path, {ORIENTATION: 6})
    assert cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).shape == (64, 48)  # the block is understood
    assert decode_grey(path).shape == (48, 64)
