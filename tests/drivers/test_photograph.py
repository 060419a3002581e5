"""EXIF and the proof that focus and exposure stayed where they were."""

from __future__ import annotations

import pytest
from thermocald_drivers.android import exif, exposure_start, focus_state

from tests.drivers.fakes.adb_server import photograph as make
from thermocald.errors import BadReading

WHEN = 1_605_956_400.0
DUMP = """    android.control.afState (10020): byte[1]
        [%s ]
      android.lens.focusDistance (80007): float[1]
        [0.25 ]
"""


def test_tags():
    tags = exif(make(WHEN, distance=1.5))
    assert tags["exposure_s"] == pytest.approx(1 / 60, rel=1e-4)
    assert (tags["iso"], tags["subject_distance_m"]) == (100, 1.5)
    assert (tags["width"], tags["height"], tags["model"]) == (96, 64, "Phone 4a")


@pytest.mark.parametrize("data", [b"", b"\xff\xd8\xff\xd9", b"GIF89a"])
def test_no_photograph(data):
    with pytest.raises(BadReading, match="not a photograph"):
        exif(data)


@pytest.mark.parametrize(
    ("photo_zone", "phone_zone", "shift"),
    [(None, "", 0), (None, "+0000", 0), ("+01:00", "+0000", -3600), (None, "-0330", 12600)],
)
def test_the_instant_and_its_zone(photo_zone, phone_zone, shift):
    told = exposure_start(exif(make(WHEN, zone=photo_zone)), phone_zone)
    assert told == (WHEN + 0.25 + shift, 0.001)


def test_whole_seconds_are_coarse():
    assert exposure_start(exif(make(WHEN, subsecond=None)), "")[1] == 1.0
    assert exposure_start({"time": "0000:00:00 00:00:00"}, "") is None
    assert exposure_start({}, "") is None


def test_focus_out_of_the_camera_service():
    assert focus_state(DUMP % "INACTIVE") == {
        "af_state": "INACTIVE",
        "focus_distance_dioptres": 0.25,
    }
    assert focus_state("Camera service dump\n") == {}
