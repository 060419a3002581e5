"""A camera's settings are locked as they are, and a frame of which one moved is rejected."""

from __future__ import annotations

import pytest

from tests.drivers.fakes import v4l2_kernel as v4l2
from tests.drivers.fakes.adb_server import FOCUS, shoot
from thermocald.errors import BadReading

ANDROID, PI, V4L2 = (("camera", name) for name in ("android", "picamera2", "v4l2"))
FOCUS_MOVED = FOCUS.replace("0.25", "0.31")
SCANS = f"{FOCUS}android.control.afState (1): byte[1]\n [PASSIVE_SCAN ]\n"
SETTINGS = {
    V4L2: {"exposure_auto": 0.0, "exposure_s": 0.025, "gain": 64.0, "focus_auto": 0.0,
           "focus": 35.0, "zoom_absolute": 120.0, "image_stabilization": 0.0},
    PI: {"exposure_auto": 0.0, "white_balance_auto": 0.0, "exposure_s": 0.004, "gain": 1.0,
         "focus_dioptres": 1.5, "focus_auto": 0.0, "colour_gain_red": 1.75,
         "colour_gain_blue": 1.5},
}  # fmt: skip
# {driver: [(attributes of its fake, message)]}
MOVED = {
    V4L2: [
        ({"values": {control: value}}, f"{name}.* was set to .* and is {value}")
        for control, value, name in (
            (v4l2.FOCUS, 40, "focus_absolute"), (v4l2.ZOOM, 130, "zoom_absolute"),
            (v4l2.AUTO_FOCUS, 1, "focus_auto"), (v4l2.EXPOSURE, 300, "exposure_time"),
            (v4l2.GAIN, 65, "gain"), (v4l2.STABILISE, 1, "image_stab"))],
    PI: [
        ({"extra": {name: value}}, f"{name} was set to")
        for name, value in (
            ("LensPosition", 2.0), ("ColourGains", (1.0, 1.5)), ("LensPosition", None))],
    ANDROID: [
        ({"media_camera": FOCUS_MOVED}, "focus_distance_dioptres was 0.25 and is 0.31"),
        ({"media_camera": SCANS}, "autofocus is at work"),
        ({"shoot": shoot(zoom=2.0)}, "digital_zoom was 1.0 and is 2.0"),
        ({"shoot": shoot(distance=2.0)}, "subject_distance_m was 1.5 and is 2.0"),
        ({"shoot": shoot(size=(48, 32))},
         "the photograph has 48×32 px, not 96×64; set the camera app"),
    ],
}  # fmt: skip


def forget(fake, driver):
    """Set the settings that a camera has after it was plugged in."""
    if driver == V4L2:
        fake.values = {v4l2.AUTO_FOCUS: 1, v4l2.FOCUS: 0, v4l2.AUTO_EXPOSURE: 3, v4l2.EXPOSURE: 156}
    else:
        controls = fake.instances[-1].configuration["controls"]
        assert [controls[n] for n in ("AeEnable", "AwbEnable", "AfMode")] == [False, False, 0]
        fake.standing = {"LensPosition": 4.0, "ColourGains": (1.0, 1.0)}


@pytest.mark.parametrize("driver", SETTINGS, ids="-".join)
def test_what_is_not_configured_is_locked_as_it_is_also_after_a_plug(driver, bench):
    device = bench.device()
    for _ in range(2):
        with device:
            frame = device.capture()
            assert device.warnings() == []
        assert frame.settings == SETTINGS[driver]
        forget(bench.fake, driver)
    assert frame.exposure == SETTINGS[driver]["exposure_s"]


@pytest.mark.parametrize(
    ("driver", "change", "message"),
    [(driver, *row) for driver, rows in MOVED.items() for row in rows],
)
def test_a_lock_that_does_not_hold_gives_no_frame(driver, bench, change, message):
    with bench.device() as device:
        device.capture()
        with bench.broken(change), pytest.raises(BadReading, match=message):
            device.capture()
        device.capture()
