"""The driver picamera2 with a stand-in of its library, and metadata of real cameras."""

from __future__ import annotations

import json
import sys
import threading
import time

import numpy as np
import pytest
from thermocald_drivers.picamera import Picamera2Camera, sensor_temperature

from tests.drivers.fakes import picamera2_stand_in
from thermocald import errors
from thermocald.hal import SystemClock, open_device


@pytest.fixture
def pi(monkeypatch):
    camera = type("Camera", (picamera2_stand_in.StandIn,), {"instances": []})
    monkeypatch.setitem(sys.modules, "picamera2", picamera2_stand_in.module(camera))
    return camera


def camera(**options):
    options = {"width": 96, "height": 64, "exposure_s": 0.004, "timeout_s": 1.0, **options}
    return open_device("camera", "picamera2", options, SystemClock())


def test_the_grey_plane_as_the_sensor_gave_it(pi):
    with camera() as device:
        called = time.monotonic()
        frame = device.capture()
    assert np.array_equal(frame.image, np.add.outer(np.arange(64), np.arange(96)) % 251)
    assert frame.encoded is None
    assert frame.exposure == 0.004
    assert called <= frame.monotonic <= time.monotonic()
    assert pi.instances[0].requests_out == 0
    assert pi.instances[0].closed


def test_manual_controls(pi):
    pi.camera_controls = {"LensPosition": (0, 32, 1)}
    pi.extra = {"LensPosition": 2.0}
    with camera(gain=2.0, focus_dioptres=2.0) as device:
        device.capture()
    controls = pi.instances[0].configuration["controls"]
    assert controls["AeEnable"] is False
    assert controls["AwbEnable"] is False
    assert (controls["ExposureTime"], controls["AnalogueGain"]) == (4000, 2.0)
    assert (controls["AfMode"], controls["LensPosition"]) == (0, 2.0)


@pytest.fixture
def focusing(pi):
    """A camera with a focusing lens, such as the Camera Module 3."""
    pi.camera_controls = {"LensPosition": (0.0, 32.0, 1.0)}
    pi.standing = {"LensPosition": 1.5, "ColourGains": (1.75, 1.5)}
    return pi


def test_what_is_not_configured_is_locked_as_it_is(focusing):
    with camera() as device:
        frame = device.capture()
        assert device.warnings() == []
    controls = focusing.instances[0].configuration["controls"]
    assert (controls["AfMode"], controls["LensPosition"]) == (0, 1.5)
    assert (controls["AwbEnable"], controls["ColourGains"]) == (False, (1.75, 1.5))
    assert frame.settings == {
        "exposure_auto": 0.0, "white_balance_auto": 0.0, "exposure_s": 0.004, "gain": 1.0,
        "focus_dioptres": 1.5, "focus_auto": 0.0, "colour_gain_red": 1.75, "colour_gain_blue": 1.5,
    }  # fmt: skip


def test_the_temperature_of_the_sensor_is_stored_once_it_was_measured(pi):
    with camera() as device:
        stored = []
        for celsius in (0.0, 31.0):
            pi.extra = {"SensorTemperature": celsius}
            stored.append(device.capture().settings.get("sensor_temperature_c"))
    assert stored == [None, 31.0]


def test_every_real_metadata_and_its_temperature(shared):
    lines = (shared / "data/libcamera/picamera2_metadata_real.jsonl").read_text().splitlines()
    believed = [sensor_temperature(json.loads(line)) for line in lines]
    # imx219 ×2: none; imx708: −20.0 (clamp), 65, 45; imx477: 0.0 (stuck), 29, none; ov5647: none
    assert believed == [None, None, None, 65.0, 45.0, None, 29.0, None, None]


@pytest.mark.parametrize(
    ("value", "celsius"),
    [(29.0, 29.0), (-3.0, -3.0), (-20.0, None), (80.0, None), (255.0, None),
     (float("nan"), None), (1e300, None), ("29.0", None), (True, None), (None, None)],
)  # fmt: skip
def test_a_sensor_temperature_that_means_unknown(value, celsius):
    assert sensor_temperature({"SensorTemperature": value}) == celsius


def test_after_it_was_closed_the_same_values_are_set_again(focusing):
    device = camera()
    with device:
        device.capture()
    focusing.standing = {"LensPosition": 4.0, "ColourGains": (1.0, 1.0)}
    with device:
        assert device.capture().settings["focus_dioptres"] == 1.5


@pytest.mark.parametrize(
    "moved", [{"LensPosition": 2.0}, {"ColourGains": (1.0, 1.5)}, {"LensPosition": None}]
)
def test_a_lock_that_does_not_hold_gives_no_frame(focusing, moved):
    with camera() as device:
        device.capture()
        focusing.extra = moved
        with pytest.raises(errors.BadReading, match=f"{next(iter(moved))} was set to"):
            device.capture()


def test_auto_only_by_name_and_with_a_warning(focusing):
    with camera(focus_dioptres="auto", exposure_s="auto", colour_gains="auto") as device:
        focusing.extra = {"LensPosition": 5.0}
        frame = device.capture()
        warned = [text.partition(":")[0] for text in device.warnings()]
    assert warned == ["exposure_s", "focus_dioptres", "colour_gains"]
    controls = focusing.instances[0].configuration["controls"]
    assert (controls["AeEnable"], controls["AwbEnable"], controls["AfMode"]) == (True, True, 2)
    assert "ExposureTime" not in controls
    assert (frame.settings["focus_auto"], frame.settings["focus_dioptres"]) == (1.0, 5.0)


def test_the_stanza_has_size_and_lens_position(focusing):
    (found,) = Picamera2Camera.attached()
    assert found.options == {
        "camera": 0, "model": "imx219", "width": 96, "height": 64, "focus_dioptres": 1.0,
        "exposure_s": 0.02, "gain": 1.0,
    }  # fmt: skip
    assert focusing.instances[0].closed
    focusing.busy = True
    (found,) = Picamera2Camera.attached()
    assert found.options["model"] == "imx219"


def test_the_time_is_the_middle_of_the_exposure(pi):
    with camera(exposure_s=0.1) as device:
        frame = device.capture()
    stamp = pi.instances[-1].given["SensorTimestamp"] * 1e-9
    boot = time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic()
    assert frame.monotonic == pytest.approx(stamp - boot - 0.05, abs=0.002)


def test_old_frames_are_thrown_away(pi):
    pi.stale = 3
    with camera() as device:
        called = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        device.capture()
    assert pi.instances[-1].given["SensorTimestamp"] - 4_000_000 >= called


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"ExposureTime": 1_064_891}, "ExposureTime was set to 4000 and is 1064891"),
        ({"AnalogueGain": 4.0}, "AnalogueGain was set to 1 and is 4"),
        ({"AnalogueGain": None}, "is None"),
    ],
)
def test_a_camera_that_does_not_obey(pi, extra, message):
    pi.extra = extra
    if extra.get("ExposureTime"):
        pi.extra = {**extra, "SensorTimestamp": time.clock_gettime_ns(time.CLOCK_BOOTTIME) + 10**10}
    with camera() as device, pytest.raises(errors.BadReading, match=message):
        device.capture()


def test_a_capture_that_hangs_and_the_camera_opened_again(pi):
    pi.hang = threading.Event()
    device = camera(timeout_s=0.2)
    device.open()
    begin = time.monotonic()
    with pytest.raises(errors.DeviceTimeout, match=r"a capture hangs, given up after 0\.2 s"):
        device.capture()
    assert time.monotonic() - begin < 1.0
    assert pi.instances[0].closed
    with pytest.raises(errors.DeviceGone):
        device.capture()
    pi.hang.set()
    pi.hang = None
    device.open()
    device.capture()
    device.close()
    assert len(pi.instances) == 2


def test_a_partial_frame(pi):
    pi.cut = True
    with camera() as device, pytest.raises(errors.BadReading, match="partial frame"):
        device.capture()
    assert pi.instances[0].requests_out == 0


@pytest.mark.parametrize(
    ("knobs", "options", "error", "message"),
    [
        ({"cameras": ()}, {}, errors.DeviceNotFound, "ribbon cable"),
        ({"busy": True}, {}, errors.DeviceDenied, "another program"),
        ({}, {"model": "imx477"}, errors.WrongDevice, "this is 'imx219', not 'imx477'"),
        ({}, {"width": 64}, errors.WrongDevice, "another interior orientation"),  # scaled
        ({}, {"focus_dioptres": 1.0}, errors.WrongDevice, "cannot be focused"),
    ],
)
def test_a_camera_that_cannot_be_opened_is_given_back(pi, knobs, options, error, message):
    for name, value in knobs.items():
        setattr(pi, name, value)
    with pytest.raises(error, match=message):
        camera(**options).open()
    assert all(one.closed for one in pi.instances)
