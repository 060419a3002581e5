"""What cannot be true of a camera is refused or flagged, and the option that mends it is named."""

from __future__ import annotations

import json
import re
from functools import partial

import numpy as np
import pytest

import thermocald as tc
from tests.cli.test_import import arguments, photograph, place, run
from tests.commands import invoke
from thermocald.analysis.camera.photographs import calibrate_observations
from thermocald.errors import DataError
from thermocald.output.printed import calibration_document, calibration_lines
from thermocald.photogrammetry.camera.camera_model import Sensor, project
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.physics.testfields import corner_field, demonstration_model

__all__ = ["place"]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Ten epochs of 3280 × 2464 px with pixels of 0.00112 mm and a lens of 3.04 mm."""
    folder = tmp_path_factory.mktemp("plausible") / "M1"
    tc.simulate("rpi-v2.1-heating", epochs=10, out=folder)
    return folder


@pytest.fixture
def changed(recording, tmp_path):
    """Writes the recording with some text of its recording.yaml replaced."""

    def change(*pairs):
        there = tmp_path / "changed"
        there.mkdir()
        for file in recording.iterdir():
            (there / file.name).write_bytes(file.read_bytes())
        head = there / "recording.yaml"
        text = head.read_text()
        for old, new in pairs:
            assert old in text
            text = text.replace(old, new)
        head.write_text(text)
        return there

    return change


replay, check = partial(invoke, "replay"), partial(invoke, "check")
SIZE = ("width: 3280, height: 2464", "width: 2464, height: 3280")


def test_a_camera_as_it_is_raises_no_doubt(recording):
    assert "in doubt" not in replay(recording).stdout
    assert json.loads(replay(recording, "--json", "-").stdout)["doubts"] == []
    assert json.loads(check(recording, "--json", "-").stdout)["doubts"] == []


@pytest.mark.parametrize(("pitch", "share"), [("0.00056", "0.50"), ("0.00224", "2.00")])
def test_a_wrong_pixel_pitch_is_seen_by_the_focal_length(changed, pitch, share):
    said = replay(changed(("0.00112", pitch))).stdout
    (line,) = re.findall(r"in doubt: .*", said)
    assert f"is {share} of the 3.04 mm" in line
    assert "a pixel pitch of 0.00112 mm would fit" in line
    assert "--pixel-pitch" in line


def test_width_and_height_exchanged_are_refused_by_check_and_flagged_by_replay(changed):
    there = changed(SIZE)
    with pytest.raises(DataError, match=r"2464 × 3280 px.*width and height are exchanged"):
        check(there)
    assert re.search("in doubt: .*width and height are exchanged", replay(there).stdout)


def test_frames_of_another_size_are_refused_by_check(recording, changed):
    pytest.importorskip("PIL")
    there = changed()
    photograph(there / "a.jpg", "", size=(1640, 1232))
    table = (there / "epochs.csv").read_text().splitlines()
    table[1] = table[1].rstrip(",") + ",a.jpg"
    (there / "epochs.csv").write_text("\n".join(table) + "\n")
    with pytest.raises(DataError, match=r"says 3280 × 2464 px, .*a\.jpg has 1640 × 1232 px"):
        check(there)


def test_a_binned_photograph_with_the_sensors_pitch_is_flagged_at_import(place):
    """EXIF: 3.04 mm, 29 mm for 35 mm film: pixels of 0.0567 mm in 80 px of diagonal."""
    more = ("--timezone", "Europe/Berlin", "--pixel-pitch")
    said = run(*arguments(place, *more, "0.02835", "--dry-run")).stderr
    assert "0.02835 mm is 0.50 of the 0.05669 mm" in said
    assert "--pixel-pitch" in said
    assert "EXIF of the photographs" not in run(*arguments(place, *more, "0.055")).stderr


@pytest.mark.parametrize(("focal", "doubts"), [((304, 100), 0), ((608, 100), 1)])
def test_photographs_of_another_focal_length_are_flagged_at_calibrate(tmp_path, focal, doubts):
    pytest.importorskip("PIL")
    field = corner_field("plain", per_side=6, pitch_mm=100.0)
    model = demonstration_model(field)
    rng = np.random.default_rng(5)
    names, measured = [], []
    for k, turn in enumerate((0.0, 0.05, -0.05, 0.1, -0.1)):
        eop = model.exterior.as_array() + np.array([0, 1, 20, 400, 0, 0]) * turn
        points = project(model.sensor, model.interior.as_array(), eop, field.points)
        points = points + rng.normal(0, 0.04, points.shape)
        measured.append(Observations(np.arange(len(field)), points, np.full(points.shape, 0.04)))
        names.append(str(tmp_path / f"{k}.jpg"))
        photograph(tmp_path / f"{k}.jpg", "", focal=focal)
    found = calibrate_observations(
        names, measured, {}, field, model.sensor, AdjustmentSettings(), model.interior.c
    )
    document = calibration_document(found, "camera", model.sensor, assumed=False)
    assert len(document["doubts"]) == doubts
    said = "\n".join(calibration_lines(document))
    assert ("in doubt: the principal distance found" in said) == bool(doubts)
    # what the camera file says comes before EXIF
    document = calibration_document(found, "camera", model.sensor, False, found.interior.c)
    assert document["doubts"] == []


def test_an_image_that_was_cropped_is_asked_about():
    from thermocald.photogrammetry.camera.plausibility import doubts_of_interior

    (said,) = doubts_of_interior(Sensor(1000, 800, 0.002), (3.0, 0.4, -0.1), None)
    assert "206 px from the centre" in said
    assert "cropped" in said
