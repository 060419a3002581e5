"""V4L2 over the ioctls of a fake kernel device; `make hil` uses real kernel drivers."""

from __future__ import annotations

import errno
import sys
import threading
import time
from types import SimpleNamespace

import cv2
import linuxpy.ioctl
import numpy as np
import pytest
from thermocald_drivers.v4l2 import V4l2Camera

from tests.drivers.fakes.v4l2_kernel import FakeCamera, encode
from thermocald import errors
from thermocald.hal import SystemClock, VirtualClock, open_device


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    camera = FakeCamera(tmp_path / "video0")
    monkeypatch.setattr(linuxpy.ioctl, "fcntl", SimpleNamespace(ioctl=camera.ioctl))
    return camera


def camera(kernel, clock=None, **options):
    size = {"width": 64, "height": 48, "pixel_format": "GREY"}
    options = {"device": str(kernel.path), **size, "timeout_s": 0.3, **options}
    return open_device("camera", "v4l2", options, clock or SystemClock())


@pytest.mark.parametrize("pixel_format", ["GREY", "YUYV", "MJPG"])
def test_a_frame_of_each_format(kernel, pixel_format):
    with camera(kernel, pixel_format=pixel_format) as device:
        frame = device.capture()
    assert frame.image.shape == (48, 64)
    assert frame.image.dtype == np.uint8
    assert np.all(frame.image == frame.sequence % 256)
    assert (frame.encoded is not None) == (pixel_format == "MJPG")
    assert not frame.image.flags.writeable


def test_the_frame_is_fresh_and_its_time_the_buffers(kernel):
    with camera(kernel, exposure_s=0.002) as device:
        time.sleep(0.1)  # the queue fills with old frames
        called = time.monotonic()
        frame = device.capture()
    assert frame.monotonic - 0.001 >= called  # exposed after the call
    assert frame.exposure == 0.002
    assert abs(frame.utc - time.time()) < 0.1


# v4l2loopback 0.12: the stamp is right, but its type is not stated
@pytest.mark.parametrize(("flags", "shift"), [(0x2000, -0.05), (0x12000, +0.05), (0, -0.05)])
def test_the_time_is_the_middle_of_the_exposure(kernel, flags, shift):
    kernel.flags = flags
    stamps = []
    kernel.stamp = lambda now: stamps.append(now) or now
    with camera(kernel, exposure_s=0.1) as device:
        frame = device.capture()
    assert frame.monotonic == pytest.approx(stamps[-1] + shift, abs=2e-4)


def test_times_are_on_the_daemons_clock(kernel):
    clock = VirtualClock(utc=1_700_000_000.0, monotonic=500.0)
    with camera(kernel, clock) as device:
        frame = device.capture()
    assert frame.monotonic == pytest.approx(500.0, abs=0.05)
    assert frame.utc == pytest.approx(1_700_000_000.0, abs=0.05)


@pytest.mark.parametrize(
    ("flags", "stamp"),
    [
        (0, lambda _now: 0.0),
        (0, lambda _now: 1_700_000_000.0),
        (0x2000, lambda now: now + 0.15),  # vivid's stamps are up to a frame in the future
    ],
)
def test_where_stamps_tell_nothing_no_frame_is_old_nor_from_the_future(kernel, flags, stamp):
    kernel.flags, kernel.stamp = flags, stamp
    with camera(kernel) as device:
        time.sleep(0.1)  # the queue fills with frames of unknown age
        begin = kernel.made_by(time.monotonic())
        frame = device.capture()
        assert frame.monotonic <= time.monotonic()
    assert frame.sequence >= begin


def test_manual_controls_are_set(kernel):
    controls = {"power_line_frequency": 1}
    with camera(kernel, exposure_s=0.0156, gain=10, controls=controls) as device:
        frame = device.capture()
    assert [kernel.controls[c][4] for c in (0x9A0901, 0x9A0902, 0x980913, 0x980918)] == [
        1, 156, 10, 1,
    ]  # fmt: skip
    assert frame.settings == {
        "exposure_auto": 0.0, "exposure_s": 0.0156, "gain": 10.0, "power_line_frequency": 1.0,
    }  # fmt: skip


def test_a_camera_that_does_not_obey(kernel):
    kernel.obeys = lambda control, value: 128 if control == 0x980913 else value
    with pytest.raises(errors.WrongDevice, match="gain was set to 10 and is 128"):
        camera(kernel, gain=10).open()
    with camera(kernel, gain=10, strict=False) as device:
        assert device.capture().settings["gain"] == 128.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"exposure_s": 2.0}, r"takes 3 … 2047 in steps of 1"),
        ({"controls": {"zoom": 1}}, "no control 'zoom'; it has auto_exposure"),
        ({"focus": 0}, "no control 0x009a090a"),
        ({"width": 1920, "height": 1080}, "asked for 1920×1080 GREY, the camera gives 64×48 GREY"),
        ({"card": "C920"}, r"this is 'Fake Webcam'"),
    ],
)
def test_what_the_camera_cannot_do(kernel, options, message):
    with pytest.raises(errors.WrongDevice, match=message):
        camera(kernel, **options).open()


AUTO_FOCUS, FOCUS, ZOOM, STABILISE = 0x9A090C, 0x9A090A, 0x9A090D, 0x9A0916
AUTO_EXPOSURE, EXPOSURE, GAIN = 0x9A0901, 0x9A0902, 0x980913


@pytest.fixture
def focusing(kernel):
    """A camera that focuses automatically: its position drifts in the automatic mode."""
    kernel.controls |= {
        AUTO_FOCUS: ["Focus, Automatic Continuous", 0, 1, 1, 1],
        FOCUS: ["Focus, Absolute", 0, 255, 5, 35],
        ZOOM: ["Zoom, Absolute", 100, 500, 1, 120],
        STABILISE: ["Image Stabilization", 0, 1, 1, 1],
    }
    return kernel


def test_what_is_not_configured_is_locked_as_it_is(focusing):
    with camera(focusing) as device:
        frame = device.capture()
        assert device.warnings() == []
    values = {number: control[4] for number, control in focusing.controls.items()}
    assert (values[AUTO_FOCUS], values[FOCUS], values[ZOOM], values[STABILISE]) == (0, 35, 120, 0)
    assert (values[AUTO_EXPOSURE], values[EXPOSURE], values[GAIN]) == (1, 250, 64)
    assert frame.settings == {
        "exposure_auto": 0.0, "exposure_s": 0.025, "gain": 64.0, "focus_auto": 0.0, "focus": 35.0,
        "zoom_absolute": 120.0, "image_stabilization": 0.0,
    }  # fmt: skip
    assert frame.exposure == 0.025


@pytest.mark.parametrize(
    ("control", "value", "name"),
    [(FOCUS, 40, "focus_absolute"), (ZOOM, 130, "zoom_absolute"), (AUTO_FOCUS, 1, "focus_auto"),
     (EXPOSURE, 300, "exposure_time"), (GAIN, 65, "gain"), (STABILISE, 1, "image_stab")],
)  # fmt: skip
def test_a_lock_that_does_not_hold_gives_no_frame(focusing, control, value, name):
    with camera(focusing) as device:
        device.capture()
        focusing.controls[control][4] = value
        with pytest.raises(errors.BadReading, match=f"{name}.* was set to .* and is {value}"):
            device.capture()


def test_after_a_plug_the_same_values_are_set_again(focusing):
    device = camera(focusing)
    with device:
        device.capture()
    for control, default in ((AUTO_FOCUS, 1), (FOCUS, 0), (AUTO_EXPOSURE, 3), (EXPOSURE, 156)):
        focusing.controls[control][4] = default
    with device:
        settings = device.capture().settings
    assert (settings["focus"], settings["exposure_s"]) == (35.0, 0.025)


def test_an_automatic_mode_that_cannot_be_switched_off(focusing):
    focusing.obeys = lambda control, value: 1 if control == AUTO_FOCUS else value
    with pytest.raises(errors.WrongDevice, match="to let it change, set focus: auto"):
        camera(focusing).open()
    with camera(focusing, focus="auto") as device:
        focusing.controls[FOCUS][4] = 60
        frame = device.capture()
        assert device.warnings() == [
            "focus: auto lets the camera change it; every change alters the calibration"
        ]
    assert (frame.settings["focus_auto"], frame.settings["focus"]) == (1.0, 60.0)


def test_auto_by_name_switches_it_on(focusing):
    with camera(focusing):
        pass
    assert focusing.controls[AUTO_FOCUS][4] == 0
    with camera(focusing, focus="auto", exposure_s="auto") as device:
        assert focusing.controls[AUTO_FOCUS][4] == 1
        assert focusing.controls[AUTO_EXPOSURE][4] == 3
        assert device.capture().exposure is None
    with pytest.raises(errors.WrongDevice, match="no automatic mode"):
        camera(focusing, gain="auto").open()


def test_a_camera_that_rounds_its_own_value_is_locked_at_what_it_takes(focusing):
    """It reports 37 while it focuses automatically, and can be set in steps of 5."""

    def obeys(control, value):
        if control == AUTO_FOCUS and value == 0:
            focusing.controls[FOCUS][4] = 0  # loses its position
        return value // 5 * 5 if control == FOCUS else value

    focusing.controls[FOCUS][4], focusing.obeys = 37, obeys
    with camera(focusing) as device:
        assert device.capture().settings["focus"] == 35.0
    with camera(focusing) as device:
        assert device.capture().settings["focus"] == 35.0


def test_the_stanza_has_the_current_values(focusing, tmp_path):
    node = tmp_path / "sys/class/video4linux/video0"
    node.mkdir(parents=True)
    (node / "name").write_text("Fake Webcam\n")
    (node / "index").write_text("0\n")
    (found,) = V4l2Camera.attached(str(tmp_path / "sys"), str(tmp_path))
    assert found.options == {
        "device": str(focusing.path), "width": 1920, "height": 1080, "pixel_format": "MJPG",
        "exposure_s": 0.025, "gain": 64, "focus": 35,
    }  # fmt: skip
    assert focusing.controls[AUTO_FOCUS][4] == 1  # nothing was set


def test_a_stalled_camera(kernel):
    with camera(kernel) as device:
        device.capture()
        kernel.stalled = True
        begin = time.monotonic()
        with pytest.raises(errors.DeviceTimeout, match=r"no new frame in 0\.3 s"):
            device.capture()
        assert time.monotonic() - begin < 0.6
        kernel.stalled = False
        device.capture()


@pytest.mark.parametrize(
    ("knobs", "error", "message"),
    [
        *(({"errors": {call: number}}, error, None) for call, number, error in (
            ("S_FMT", errno.EBUSY, errors.DeviceDenied),
            ("STREAMON", errno.EBUSY, errors.DeviceDenied),
            ("QUERYCAP", errno.EACCES, errors.DeviceDenied),
            ("STREAMON", errno.EIO, errors.BadReading))),
        ({"capture_device": False}, errors.WrongDevice, "not a capture device"),
        ({}, errors.DeviceNotFound, "group video"),
    ],
)  # fmt: skip
def test_what_is_busy_denied_no_camera_or_not_there(kernel, knobs, error, message):
    device = camera(kernel)
    for name, value in knobs.items():
        setattr(kernel, name, value)
    if not knobs:
        kernel.path.unlink()
    with pytest.raises(error, match=message):
        device.open()


@pytest.mark.parametrize(
    ("knob", "value", "message"),
    [
        # the node belongs to root until udev has handled it
        ("errors", {"QUERYCAP": errno.EACCES}, "Permission denied"),
        # v4l2loopback without its source no longer captures; /dev/video0 may be another camera
        ("capture_device", False, "not a capture device"),
    ],
)
def test_what_is_wrong_after_a_plug_is_tried_again(kernel, knob, value, message):
    device, usual = camera(kernel), getattr(kernel, knob)
    with device:
        setattr(kernel, knob, value)
    with pytest.raises(errors.TransientDeviceError, match=message):
        device.open()
    setattr(kernel, knob, usual)
    with device:
        device.capture()


def test_a_single_broken_frame_is_skipped(kernel):
    with camera(kernel) as device:
        sequence = device.capture().sequence
        kernel.broken = set(range(sequence + 1, sequence + 5))
        assert device.capture().sequence >= sequence + 5


def first(count):
    """Return the first bytes of a frame."""
    return {"encode": lambda image, fourcc: encode(image, fourcc)[:count]}


JPEG = b"\xff\xd8" + b"\x55" * 300 + b"\xff\xd9"


@pytest.mark.parametrize(
    ("knobs", "pixel_format", "error", "message"),
    [
        ({"stamp": lambda _now: 1.7e9}, "GREY", errors.WrongDevice, "monotonic clock"),
        ({"broken": range(1000)}, "GREY", errors.BadReading, r"only broken|as broken"),
        (first(1000), "GREY", errors.BadReading, "partial frame"),
        (first(200), "MJPG", errors.BadReading, "partial frame"),
        (first(0), "MJPG", errors.BadReading, "partial frame"),
        ({"encode": lambda *_: JPEG}, "MJPG", errors.BadReading, "broken JPEG"),
    ],
)
def test_a_frame_that_is_none(kernel, knobs, pixel_format, error, message):
    for name, value in knobs.items():
        setattr(kernel, name, value)
    device = camera(kernel, pixel_format=pixel_format)
    with device, pytest.raises(error, match=message):
        device.capture()


def test_by_serial_number(kernel, tmp_path):
    by_id = tmp_path / "v4l/by-id"
    by_id.mkdir(parents=True)
    device = camera(kernel, device=None, serial="8A3F", dev=str(tmp_path))
    with pytest.raises(errors.DeviceNotFound, match=r"8A3F"):
        device.open()
    (by_id / "usb-046d_HD_Pro_Webcam_C920_8A3F-video-index0").symlink_to(kernel.path)
    (by_id / "usb-046d_HD_Pro_Webcam_C920_8A3F-video-index1").symlink_to(tmp_path / "video1")
    with device:
        device.capture()
    (by_id / "usb-046d_HD_Pro_Webcam_C920_18A3F-video-index0").symlink_to(kernel.path)
    with pytest.raises(errors.WrongDevice, match="several match"):
        device.open()


class FakeCapture:
    """cv2.VideoCapture of a good camera; `stall` blocks a read as a dead camera does."""

    stall: threading.Event | None = None
    good = True
    size = (64, 48)

    def __init__(self, _path, _backend):
        self.properties = {cv2.CAP_PROP_FRAME_WIDTH: 0, cv2.CAP_PROP_FRAME_HEIGHT: 0}
        self.released = False
        FakeCapture.last = self

    def isOpened(self):
        return True

    def set(self, name, value):
        self.properties[name] = value

    def get(self, name):
        if name == cv2.CAP_PROP_POS_MSEC:
            return time.monotonic() * 1e3
        if name in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT):
            return self.size[name == cv2.CAP_PROP_FRAME_HEIGHT]
        return self.properties.get(name, -1)

    def read(self):
        if self.stall is not None:
            self.stall.wait()
        return self.good, np.full((1, 48 * 64), 77, np.uint8)

    def release(self):
        self.released = True


@pytest.fixture
def opencv(kernel, monkeypatch):
    capture = type("Capture", (FakeCapture,), {})
    monkeypatch.setattr(cv2, "VideoCapture", capture)
    return capture


def test_opencv_where_linuxpy_is_missing(opencv, kernel, monkeypatch):
    monkeypatch.setitem(sys.modules, "linuxpy.video.device", None)
    with camera(kernel) as device:
        called = time.monotonic()
        frame = device.capture()
    assert np.all(frame.image == 77)
    assert frame.monotonic >= called
    assert FakeCapture.last.released


def test_opencv_that_stalls_is_left_behind(opencv, kernel):
    """OpenCV waits 10 s for a dead camera; the driver does not, and releases it afterwards."""
    opencv.stall = threading.Event()
    device = camera(kernel, backend="opencv")
    device.open()
    begin = time.monotonic()
    with pytest.raises(errors.DeviceTimeout, match=r"no new frame in 0\.3 s"):
        device.capture()
    device.close()
    assert time.monotonic() - begin < 1.0
    assert not FakeCapture.last.released
    opencv.stall.set()
    deadline = time.monotonic() + 2.0
    while not FakeCapture.last.released and time.monotonic() < deadline:
        time.sleep(0.01)
    assert FakeCapture.last.released


def test_opencv_that_gets_nothing_more(opencv, kernel):
    with camera(kernel, backend="opencv") as device:
        opencv.good = False
        with pytest.raises(errors.DeviceGone, match="no frame"):
            device.capture()


def test_opencv_of_another_size(opencv, kernel):
    opencv.size = (32, 24)
    with pytest.raises(errors.WrongDevice, match="gives 32×24"):
        camera(kernel, backend="opencv").open()
