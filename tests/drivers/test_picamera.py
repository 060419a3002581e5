"""The driver picamera2 with a stand-in of its library, and metadata of real cameras."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest
from thermocald_drivers.picamera import Picamera2Camera, frame_settings

DRIVER = ("camera", "picamera2")


def test_a_frame_is_the_fresh_grey_plane_at_the_middle_of_its_exposure(bench, fake):
    fake.stale, fake.camera_controls, fake.standing = 3, {}, {}  # a lens of fixed focus
    with bench.device(exposure_s=0.1) as device:
        called = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        frame = device.capture()
    assert np.array_equal(frame.image, np.add.outer(np.arange(64), np.arange(96)) % 251)
    assert frame.encoded is None
    assert frame.exposure == pytest.approx(0.1)
    (one,) = fake.instances
    assert one.requests_out == 0
    assert one.closed
    stamp = one.given["SensorTimestamp"]
    assert stamp - 100_000_000 >= called
    boot = time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic()
    assert frame.monotonic == pytest.approx(stamp * 1e-9 - boot - 0.05, abs=0.002)


def test_manual_controls(bench, fake):
    with bench.device(gain=2.0, focus_dioptres=2.0) as device:
        device.capture()
    controls = fake.instances[-1].configuration["controls"]
    assert (controls["AeEnable"], controls["AfMode"], controls["LensPosition"]) == (False, 0, 2.0)
    assert (controls["ExposureTime"], controls["AnalogueGain"]) == (4000, 2.0)


def test_auto_only_by_name_and_with_a_warning(bench, fake):
    with bench.device(focus_dioptres="auto", exposure_s="auto", colour_gains="auto") as device:
        fake.extra = {"LensPosition": 5.0}
        frame = device.capture()
        warned = [text.partition(":")[0] for text in device.warnings()]
    assert warned == ["exposure_s", "focus_dioptres", "colour_gains"]
    controls = fake.instances[0].configuration["controls"]
    assert (controls["AeEnable"], controls["AwbEnable"], controls["AfMode"]) == (True, True, 2)
    assert "ExposureTime" not in controls
    assert (frame.settings["focus_auto"], frame.settings["focus_dioptres"]) == (1.0, 5.0)


def test_the_stanza_has_size_and_lens_position(fake):
    (found,) = Picamera2Camera.attached()
    assert found.options == {
        "camera": 0, "model": "imx219", "width": 96, "height": 64, "focus_dioptres": 1.0,
        "exposure_s": 0.02, "gain": 1.0,
    }  # fmt: skip
    assert fake.instances[0].closed
    fake.busy = True
    (found,) = Picamera2Camera.attached()
    assert found.options["model"] == "imx219"


def test_the_temperature_of_the_sensor_is_stored_once_it_was_measured(bench, fake, shared):
    with bench.device() as device:
        stored = []
        for celsius in (0.0, 31.0):
            fake.extra = {"SensorTemperature": celsius}
            stored.append(device.capture().settings.get("sensor_temperature_c"))
    assert stored == [None, 31.0]
    lines = (shared / "data/libcamera/picamera2_metadata_real.jsonl").read_text().splitlines()
    believed = [frame_settings(json.loads(line)).get("sensor_temperature_c") for line in lines]
    # imx219 ×2: none; imx708: −20.0 (clamp), 65, 45; imx477: 0.0 (stuck), 29, none; ov5647: none
    assert believed == [None, None, None, 65.0, 45.0, None, 29.0, None, None]
    unknown = (-20.0, 80.0, 255.0, float("nan"), 1e300, "29.0", True, None)
    for value in (29.0, -3.0, *unknown):
        expected = None if value in unknown else value
        found = frame_settings({"SensorTemperature": value})
        assert found.get("sensor_temperature_c") == expected, value
