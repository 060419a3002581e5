"""EXIF and the proof that focus and exposure stayed where they were."""

from __future__ import annotations

import pytest
from thermocald_drivers.photograph import exif, exposure_start, focus_state, lock_verdict

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
    assert told.utc == WHEN + 0.25 + shift
    assert told.resolution_s == 0.001


def test_whole_seconds_are_coarse():
    assert exposure_start(exif(make(WHEN, subsecond=None)), "").resolution_s == 1.0
    assert exposure_start({"time": "0000:00:00 00:00:00"}, "") is None
    assert exposure_start({}, "") is None


def test_focus_out_of_the_camera_service():
    assert focus_state(DUMP % "INACTIVE") == {
        "af_state": "INACTIVE",
        "focus_distance_dioptres": 0.25,
    }
    assert focus_state("Camera service dump\n") == {}


FIRST = {"exposure_s": 0.01, "iso": 100, "subject_distance_m": 1.5}


@pytest.mark.parametrize(
    ("now", "verdict", "why"),
    [
        (FIRST, True, ""),
        (FIRST | {"iso": 125}, False, "iso was 100 and is 125"),
        (FIRST | {"exposure_s": 0.02}, False, "exposure_s"),
        (FIRST | {"subject_distance_m": 1.6}, False, "subject_distance_m"),
        (FIRST | {"af_state": "PASSIVE_SCAN"}, False, "autofocus"),
    ],
)
def test_the_verdict(now, verdict, why):
    told, reason = lock_verdict(FIRST, now)
    assert told is verdict
    assert why in reason


def test_what_cannot_be_told_is_not_called_locked():
    bare = {"exposure_s": 0.01, "iso": 100}
    assert lock_verdict(bare, bare)[0] is None
    assert lock_verdict({}, {})[0] is None
