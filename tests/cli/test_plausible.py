"""Implausible camera data are refused or flagged, and the option that corrects them is named."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

import thermocald as tc
from tests.cli.test_import import arguments, photograph, place, run
from tests.commands import invoke
from tests.pictures import FOCAL, TAKEN, from_five_places, save_photograph
from thermocald.analysis.camera.photographs import calibrate_observations
from thermocald.photogrammetry.camera.camera_model import CameraSpec, Sensor
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.physics.scene import Scene
from thermocald.physics.testfields import corner_field, demonstration_field, demonstration_model
from thermocald.results import Calibration
from thermocald.store.recording.testfield_file import write_testfield

__all__ = ["place"]


def test_a_wrong_pixel_pitch_is_seen_by_the_focal_length(tmp_path):
    tc.simulate("rpi-v2.1-heating", epochs=10, out=tmp_path / "M1")
    head = tmp_path / "M1" / "recording.yaml"
    head.write_text(head.read_text().replace("0.00112", "0.00224"))
    for command in ("replay", "check"):
        (line,) = re.findall(r"doubtful: .*", invoke(command, tmp_path / "M1").output)
        assert "2 times the stated 3.04 mm" in line
        assert "Pixels of 0.00112 mm would fit (--pixel-pitch" in line


def test_a_binned_photograph_with_the_sensors_pitch_is_flagged_at_import(place):
    """EXIF: 3.04 mm, 29 mm for 35 mm film: pixels of 0.0567 mm in 80 px of diagonal."""
    more = ("--timezone", "Europe/Berlin", "--pixel-pitch")
    said = run(*arguments(place, *more, "0.02835", "--dry-run")).stderr
    assert "0.02835 mm is 0.50 of the 0.05669 mm" in said
    assert "--pixel-pitch" in said
    assert "EXIF of the photographs" not in run(*arguments(place, *more, "0.055")).stderr


@pytest.mark.parametrize(("focal", "doubts"), [((304, 100), 0), ((608, 100), 1)])
def test_photographs_of_another_focal_length_are_flagged_at_calibrate(
    tmp_path, undrawn, focal, doubts
):
    pytest.importorskip("PIL")
    field = corner_field("plain", per_side=6, pitch_mm=100.0)
    model = demonstration_model(field)
    names = [str(tmp_path / f"{k}.jpg") for k in range(5)]
    for name in names:
        photograph(Path(name), "", focal=focal)
    found = calibrate_observations(
        names, from_five_places(field, model), {}, field,
        CameraSpec("", model.sensor, model.interior.c), AdjustmentSettings(),
    )  # fmt: skip
    calibration = Calibration(**vars(found), file=CameraSpec("camera", model.sensor))
    assert len(calibration.as_dict()["doubts"]) == doubts
    said = str(calibration)
    assert ("doubtful: the principal distance is" in said) == bool(doubts)
    assumed = replace(calibration, pitch_assumed=True)
    assert "pixel pitch is not known" in str(assumed)
    assert "pixel pitch is not known" in assumed.page()
    small = replace(found.photographs[0], rms_px=0.00123)
    assert "0.0012 px" in str(replace(calibration, photographs=(small,)))
    # the camera file has priority over EXIF
    stated = CameraSpec("camera", model.sensor, found.interior.c)
    assert replace(calibration, file=stated).as_dict()["doubts"] == []


def test_binned_photographs_are_flagged_at_import_where_exif_knows_the_focal_length_alone(tmp_path):
    """820 px of a sensor of 3280 with the sensor's own pitch: a quarter of c is found."""
    pytest.importorskip("PIL.Image")
    field = demonstration_field("markers")
    model = demonstration_model(field)
    sensor = Sensor(820, 616, 0.00448)
    pixels = Scene(sensor, field).render(
        model.interior.as_array(), model.exterior.as_array(), None, [1], 1.0
    )
    (tmp_path / "photos").mkdir()
    rows = ["time,temperature"]
    for i in range(2):
        tags = {TAKEN: f"2026:06:14 12:00:{10 * i:02d}", FOCAL: 3.04}
        save_photograph(tmp_path / "photos" / f"{i}.jpg", tags, pixels, quality=95)
        rows.append(f"2026-06-14T12:00:{10 * i:02d},{20 + i}")
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    write_testfield(tmp_path / "field.csv", field)
    given = (tmp_path / "photos", "--log", tmp_path / "log.csv", "--timezone", "UTC",
             "--testfield", tmp_path / "field.csv", "--json", "-")  # fmt: skip
    for pitch, doubts in (("0.00112", 1), ("0.00448", 0)):
        result = run(*given, "--out", tmp_path / pitch, "--pixel-pitch", pitch)
        notes = json.loads(result.stdout)["notes"]
        flagged = [note for note in notes if "0.25 times the stated 3.04 mm" in note]
        assert len(flagged) == doubts, notes
        assert ("Pixels of 0.00448 mm would fit (--pixel-pitch" in result.stderr) == bool(doubts)
