"""V4L2 over the ioctls of a fake kernel device; `make hil` uses real kernel drivers."""

from __future__ import annotations

import sys
import threading
import time

import cv2
import numpy as np
import pytest
from thermocald_drivers.v4l2 import V4l2Camera

from tests.drivers.fakes import v4l2_kernel as v4l2
from thermocald import errors
from thermocald.hal import VirtualClock

DRIVER = ("camera", "v4l2")


# v4l2loopback 0.12: the stamp is right, but its type is not stated
@pytest.mark.parametrize(
    ("flags", "shift", "pixel_format"),
    [(0x2000, -0.05, "GREY"), (0x12000, +0.05, "YUYV"), (0, -0.05, "MJPG")],
)
def test_a_fresh_frame_at_the_middle_of_its_exposure(bench, fake, flags, shift, pixel_format):
    fake.flags, stamps = flags, []
    fake.stamp = lambda now: stamps.append(now) or now
    with bench.device(exposure_s=0.1, pixel_format=pixel_format) as device:
        time.sleep(0.1)  # the queue fills with old frames
        called = time.monotonic()
        frame = device.capture()
    assert frame.monotonic == pytest.approx(stamps[-1] + shift, abs=2e-4)
    assert frame.monotonic - 0.05 >= called - 1e-3  # the exposure began after the call
    assert frame.exposure == 0.1
    assert np.array_equal(frame.image, np.full((48, 64), frame.sequence % 256, np.uint8))
    assert (frame.encoded is not None) == (pixel_format == "MJPG")


@pytest.mark.parametrize(
    ("flags", "stamp"),
    # vivid's stamps are up to a frame in the future
    [(0, lambda _: 0.0), (0, lambda _: 1_700_000_000.0), (0x2000, lambda now: now + 0.15)],
)
def test_where_stamps_tell_nothing_no_frame_is_old_nor_from_the_future(bench, fake, flags, stamp):
    fake.flags, fake.stamp = flags, stamp
    bench.clock = VirtualClock(utc=1_700_000_000.0, monotonic=500.0)
    with bench.device() as device:
        time.sleep(0.1)  # the queue fills with frames of unknown age
        begin = fake.made_by(time.monotonic())
        called = time.monotonic()
        frame = device.capture()
        took = time.monotonic() - called
    assert frame.sequence >= begin
    # on the daemon's clock, which stands still; the exposure is 25 ms
    assert 500.0 - took - 0.02 <= frame.monotonic <= 500.0
    assert frame.utc - frame.monotonic == pytest.approx(1_700_000_000.0 - 500.0)


def test_manual_controls_are_set(bench, fake):
    for control in (v4l2.AUTO_FOCUS, v4l2.FOCUS, v4l2.ZOOM, v4l2.STABILISE):  # a simple camera
        del fake.controls[control]
    controls = {"power_line_frequency": 1}
    with bench.device(exposure_s=0.0156, gain=10, controls=controls) as device:
        frame = device.capture()
    stated = {"exposure_auto": 0.0, "exposure_s": 0.0156, "gain": 10.0, "power_line_frequency": 1.0}
    assert frame.settings == stated
    controls = v4l2.AUTO_EXPOSURE, v4l2.EXPOSURE, v4l2.GAIN, v4l2.FREQUENCY
    assert [fake.values[c] for c in controls] == [1, 156, 10, 1]
    fake.obeys = lambda control, value: 128 if control == v4l2.GAIN else value
    with pytest.raises(errors.WrongDevice, match="gain was set to 10 and is 128"):
        bench.device(gain=10).open()
    with bench.device(gain=10, strict=False) as device:
        assert device.capture().settings["gain"] == 128.0


def test_auto_by_name_leaves_it_to_the_camera_with_a_warning(bench, fake):
    auto = {"focus": "auto", "exposure_s": "auto"}
    for options in (auto, {}, auto):
        with bench.device(**options) as device:
            modes = fake.values[v4l2.AUTO_FOCUS], fake.values[v4l2.AUTO_EXPOSURE]
            assert modes == ((1, 3) if options else (0, 1))
            if options:
                fake.values = {v4l2.FOCUS: 60}
            frame = device.capture()
    assert frame.exposure is None
    assert (frame.settings["focus_auto"], frame.settings["focus"]) == (1.0, 60.0)
    assert device.warnings() == [
        f"{name}: auto lets the camera change it; every change alters the calibration"
        for name in ("exposure_s", "focus")
    ]
    fake.obeys = lambda control, value: 1 if control == v4l2.AUTO_FOCUS else value
    with pytest.raises(errors.WrongDevice, match="to let it change, set focus: auto"):
        bench.device().open()


def test_a_camera_that_rounds_its_own_value_is_locked_at_what_it_takes(bench, fake):
    """It reports 37 while it focuses automatically, and can be set in steps of 5."""

    def obeys(control, value):
        if control == v4l2.AUTO_FOCUS and value == 0:
            fake.controls[v4l2.FOCUS][4] = 0  # loses its position
        return value // 5 * 5 if control == v4l2.FOCUS else value

    fake.controls[v4l2.FOCUS][4], fake.obeys = 37, obeys
    for _ in range(2):
        with bench.device() as device:
            assert device.capture().settings["focus"] == 35.0


def test_the_stanza_has_the_current_values(fake, tmp_path):
    node = tmp_path / "sys/class/video4linux/video0"
    node.mkdir(parents=True)
    (node / "name").write_text("Fake Webcam\n")
    (node / "index").write_text("0\n")
    (found,) = V4l2Camera.attached(str(tmp_path / "sys"), str(tmp_path))
    assert found.options == {
        "device": str(fake.path), "width": 1920, "height": 1080, "pixel_format": "MJPG",
        "exposure_s": 0.025, "gain": 64, "focus": 35,
    }  # fmt: skip
    assert fake.controls[v4l2.AUTO_FOCUS][4] == 1  # nothing was set


def test_a_single_broken_frame_is_skipped(bench, fake):
    with bench.device() as device:
        sequence = device.capture().sequence
        fake.broken = set(range(sequence + 1, sequence + 5))
        assert device.capture().sequence >= sequence + 5


def test_by_serial_number(bench, fake, tmp_path):
    by_id = tmp_path / "v4l/by-id"
    by_id.mkdir(parents=True)
    device = bench.device(device=None, serial="8A3F", dev=str(tmp_path))
    with pytest.raises(errors.DeviceNotFound, match=r"8A3F"):
        device.open()
    (by_id / "usb-046d_HD_Pro_Webcam_C920_8A3F-video-index0").symlink_to(fake.path)
    (by_id / "usb-046d_HD_Pro_Webcam_C920_8A3F-video-index1").symlink_to(tmp_path / "video1")
    with device:
        device.capture()
    (by_id / "usb-046d_HD_Pro_Webcam_C920_18A3F-video-index0").symlink_to(fake.path)
    with pytest.raises(errors.WrongDevice, match="several match"):
        device.open()


class Capture:
    """cv2.VideoCapture of a good camera; `stall` blocks a read as a dead camera does."""

    def __init__(self) -> None:
        self.released, self.good, self.size, self.stall = False, True, (64, 48), threading.Event()
        self.stall.set()
        self.isOpened, self.set = lambda: True, lambda *_: None

    def get(self, name):
        known = {cv2.CAP_PROP_POS_MSEC: time.monotonic() * 1e3}
        known[cv2.CAP_PROP_FRAME_WIDTH], known[cv2.CAP_PROP_FRAME_HEIGHT] = self.size
        return known.get(name, -1)

    def read(self):
        self.stall.wait()
        return self.good, np.full((1, 48 * 64), 77, np.uint8)

    def release(self):
        self.released = True


def test_opencv_where_linuxpy_is_missing(bench, monkeypatch):
    capture = Capture()
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: capture)
    monkeypatch.setitem(sys.modules, "linuxpy.video.device", None)
    with bench.device() as device:
        called = time.monotonic()
        frame = device.capture()
        capture.good = False
        with pytest.raises(errors.DeviceGone, match="no frame"):
            device.capture()
    assert np.all(frame.image == 77)
    assert frame.monotonic >= called
    assert capture.released
    capture.size = (32, 24)
    with pytest.raises(errors.WrongDevice, match="gives 32×24"):
        bench.device(backend="opencv").open()
    # OpenCV waits 10 s for a dead camera; the driver does not, and releases it afterwards
    capture.size, capture.released = (64, 48), False
    with bench.device(backend="opencv") as device:
        capture.stall.clear()
        begin = time.monotonic()
        with pytest.raises(errors.DeviceTimeout, match=r"no new frame in 0\.5 s"):
            device.capture()
    assert time.monotonic() - begin < 2.0
    assert not capture.released
    capture.stall.set()
    deadline = time.monotonic() + 2.0
    while not capture.released and time.monotonic() < deadline:
        time.sleep(0.01)
    assert capture.released
