"""What is wrong below a driver is one error of the contract, and is over with its cause."""

from __future__ import annotations

import errno
import time
from contextlib import nullcontext
from typing import get_args

import pytest
from thermocald_drivers.mock import Kind

from tests.drivers.fakes.adb_server import photograph, shoot
from tests.drivers.fakes.chips import CHIPS
from tests.drivers.fakes.smbus import Chip
from tests.drivers.fakes.v4l2_kernel import encode
from tests.drivers.test_contract import use
from thermocald import errors
from thermocald.hal import VirtualClock, open_device


def refuse_pin(*_args):
    """Deny as the kernel does /dev/gpiochip0 to a user outside the group."""
    raise PermissionError(errno.EACCES, "Permission denied", "/dev/gpiochip0")


NO_PIN = [({"pin": refuse_pin}, {}, errors.DeviceDenied, r"GPIO .*group gpio")]
# {driver: [(attributes of its fake, options, error, message)]}
NOT_OPENED = {
    ("camera", "v4l2"): [
        ({}, {"exposure_s": 2.0}, errors.WrongDevice, "takes 3 … 2047 in steps of 1"),
        ({}, {"controls": {"zoom": 1}}, errors.WrongDevice, "no control 'zoom'; it has auto_exp"),
        ({}, {"white_balance_k": 4600}, errors.WrongDevice, "no control 0x0098091a"),
        ({}, {"gain": "auto"}, errors.WrongDevice, "no automatic mode"),
        ({}, {"width": 1920, "height": 1080}, errors.WrongDevice,
         "asked for 1920×1080 GREY, the camera gives 64×48 GREY"),
        ({}, {"card": "C920"}, errors.WrongDevice, "this is 'Fake Webcam'"),
        ({}, {"device": "/dev/none"}, errors.DeviceNotFound, "group video"),
        ({"capture_device": False}, {}, errors.WrongDevice, "not a capture device"),
        *(({"errors": {call: number}}, {}, error, None) for call, number, error in (
            ("S_FMT", errno.EBUSY, errors.DeviceDenied),
            ("STREAMON", errno.EBUSY, errors.DeviceDenied),
            ("QUERYCAP", errno.EACCES, errors.DeviceDenied),
            ("STREAMON", errno.EIO, errors.BadReading))),
    ],
    ("camera", "picamera2"): [
        ({"cameras": ()}, {}, errors.DeviceNotFound, "ribbon cable"),
        ({"busy": True}, {}, errors.DeviceDenied, "another program"),
        ({}, {"model": "imx477"}, errors.WrongDevice, "this is 'imx219', not 'imx477'"),
        ({}, {"width": 64}, errors.WrongDevice, "another interior orientation"),  # scaled
        ({"camera_controls": {}}, {"focus_dioptres": 1.0}, errors.WrongDevice,
         "cannot be focused"),
    ],
    ("camera", "android"): [
        ({"free_kb": 10_000}, {}, errors.PermanentDeviceError, "storage is full"),
        ({"stays_locked": True}, {}, errors.DeviceDenied, "screen is locked"),
        ({"state": "unauthorized"}, {}, errors.DeviceDenied, "Allow USB debugging"),
        ({"state": "offline"}, {}, errors.DeviceGone, "re-plug"),
        ({"state": "no permissions (user?); see [x]"}, {}, errors.DeviceDenied, "udev"),
        ({"state": "bootloader"}, {}, errors.DeviceGone, "boot"),
        ({"state": "offline\n0A1B2C3D4E\tdevice"}, {}, errors.WrongDevice,
         "2 devices have this serial number"),
        ({}, {"serial": "X"}, errors.DeviceNotFound, r"adb lists 0A1B2C3D4E \(device\)"),
        ({}, {"port": 9}, errors.DeviceNotFound, "adb start-server"),
    ],
    **{("thermometer", chip): [
        ({"chips": {}}, {}, errors.DeviceNotFound, "dtparam=i2c_arm=on"),
        ({"error": errno.EBUSY}, {}, errors.DeviceDenied, "a kernel driver"),
        ({"open_error": errno.ENOENT}, {}, errors.DeviceNotFound, None),
        ({"open_error": errno.EACCES}, {}, errors.DeviceDenied, None),
        # another chip: every register reads 0xFF
        ({"chips": dict.fromkeys(range(128), Chip())}, {},
         (errors.WrongDevice, errors.BadReading), None),
    ] for chip in CHIPS},
    ("thermometer", "serial"): [
        ({}, {"port": "/dev/ttyNONE"}, errors.DeviceNotFound,
         "^fluke-1522 on /dev/ttyNONE: No such file or directory; check .* dialout$"),
    ],
    ("output", "jsonl"): [({}, {"path": "/none/x.jsonl"}, errors.DeviceNotFound, "No such file")],
    ("output", "led"): NO_PIN,
    ("output", "relay"): NO_PIN,
    ("output", "mqtt"): [
        ({"refuse": 5}, {}, errors.DeviceDenied, "check username"),
        ({"refuse": 3}, {}, errors.DeviceGone, "Server unavailable"),  # it only starts: asked again
        ({"answer_connect": False}, {"timeout_s": 0.3}, errors.DeviceTimeout, "no answer"),
    ],
}  # fmt: skip
JPEG = b"\xff\xd8" + b"\x55" * 300 + b"\xff\xd9"


def first(count):
    """Return the first bytes of a frame."""
    return {"encode": lambda image, fourcc: encode(image, fourcc)[:count]}


def of_metadata(**wrong):
    return {"extra": {"SensorTimestamp": 2**62, **wrong}}


MJPG, SOON = {"pixel_format": "MJPG"}, {"timeout_s": 0.3}
NOT_USED = {
    ("camera", "v4l2"): [
        ({"stamp": lambda _now: 1.7e9}, {}, errors.WrongDevice, "monotonic clock"),
        ({"broken": range(1000)}, {}, errors.BadReading, r"only broken|as broken"),
        (first(1000), {}, errors.BadReading, "partial frame"),
        (first(200), MJPG, errors.BadReading, "partial frame"),
        ({"encode": lambda *_: JPEG}, MJPG, errors.BadReading, "broken JPEG"),
        ({"stalled": True}, SOON, errors.DeviceTimeout, r"no new frame in 0\.3 s"),
    ],
    ("camera", "picamera2"): [
        (of_metadata(ExposureTime=1_064_891), {}, errors.BadReading,
         "ExposureTime was set to 4000 and is 1064891"),
        (of_metadata(AnalogueGain=4.0), {}, errors.BadReading, "AnalogueGain was set to 1 and is"),
        (of_metadata(AnalogueGain=None), {}, errors.BadReading, "is None"),
        ({"cut": True}, {}, errors.BadReading, "partial frame"),
        ({"hang_s": 0.6}, {}, errors.DeviceTimeout, r"a capture hangs, given up after 0\.4 s"),
    ],
    ("camera", "android"): [
        ({"shoot": lambda phone: phone.add("IMG_1.jpg", photograph(time.time())[:-300])}, SOON,
         errors.BadReading, "partial photograph, IMG_1"),
        ({"shoot": shoot(count=2)}, {}, errors.BadReading, "2 new photographs"),
        ({"shoot": lambda phone: phone.add("IMG_1.heic", b"ftypheic")}, SOON,
         errors.BadReading, "it stored IMG_1.heic but no JPEG; set the camera"),
        ({"shoot": lambda phone: phone.add("IMG_1.jpg", photograph(time.time() - 20.0))}, {},
         errors.BadReading, "taken 20 s before the trigger"),
        ({"shoot": None}, SOON, errors.DeviceTimeout, "the camera app is open"),
        ({"shoot": shoot(size=(48, 32))}, SOON, errors.WrongDevice, "has 48×32 px, not 96×64"),
        ({"cut_transfer": True}, {}, errors.DeviceGone, "broke off"),
        ({"hang_s": 0.6}, SOON, errors.DeviceTimeout, r"no answer in 0\.3 s"),
    ],
    **{("thermometer", chip): [
        ({"error": number}, {}, error, "0x.. on /dev/i2c-1") for number, error in (
            (errno.EREMOTEIO, errors.DeviceGone), (errno.ENXIO, errors.DeviceGone),
            (errno.ETIMEDOUT, errors.DeviceTimeout), (errno.EIO, errors.BadReading),
            (errno.EBUSY, errors.TransientDeviceError), (errno.EACCES, errors.TransientDeviceError))
    ] for chip in CHIPS},
    ("output", "mqtt"): [({"acknowledge": False}, SOON, errors.DeviceTimeout, "acknowledgement")],
}  # fmt: skip


def rows(table):
    return [
        pytest.param(driver, *row, id=f"{driver[1]}-{k}")
        for driver, of_it in table.items()
        for k, row in enumerate(of_it)
    ]


COLUMNS = ("driver", "wrong", "options", "error", "message")


@pytest.mark.parametrize(COLUMNS, rows(NOT_OPENED))
def test_what_keeps_a_device_from_being_opened(bench, wrong, options, error, message):
    device = bench.device(**options)
    with bench.broken(wrong), pytest.raises(error, match=message):
        device.open()
    assert all(one.closed for one in getattr(bench.fake, "instances", ()))
    if not wrong:
        return
    with device:
        pass
    # after a plug a camera's node may be root's until udev has handled it, or another camera's
    seen = errors.TransientDeviceError if bench.driver[1] == "v4l2" else errors.DeviceError
    with bench.broken(wrong), pytest.raises(seen):
        device.open()


@pytest.mark.parametrize(COLUMNS, rows(NOT_USED))
def test_what_makes_a_device_fail(bench, wrong, options, error, message):
    device, (kind, name) = bench.device(**options), bench.driver
    with device:
        begin = time.monotonic()
        with bench.broken(wrong), pytest.raises(error, match=message):
            use(kind, device)
        assert time.monotonic() - begin < 2.0
        if name == "picamera2" and "hang_s" in wrong:
            assert bench.fake.instances[-1].closed
    with device:
        use(kind, device)
    assert not any(one.requests_out for one in getattr(bench.fake, "instances", ()))


ERRORS = {"timeout": errors.DeviceTimeout, "unplugged": errors.DeviceGone, "stuck": None}


@pytest.mark.parametrize("fault", get_args(Kind))
@pytest.mark.parametrize("kind", ["thermometer", "output"])
def test_a_fault_on_demand(kind, fault):
    options, values = {"faults": [{"kind": fault, "at": 2, "count": 3}]}, []
    clock = VirtualClock()
    fails_with = ERRORS.get(fault, errors.BadReading)
    with open_device(kind, "mock", options, clock) as mock:
        for call in range(1, 7):
            fails = fails_with and 2 <= call < 5
            with pytest.raises(fails_with) if fails else nullcontext():
                values.append(use(kind, mock))
            clock.sleep_until(clock.monotonic() + 20.0)
    if kind == "output":  # one that fails keeps nothing
        assert len(mock.results) == (6 if fault == "stuck" else 3)
    elif fault == "stuck":  # the value is repeated, with new times
        assert [v.values == values[0].values for v in values] == [True] * 4 + [False] * 2
        assert len({v.monotonic for v in values}) == 6
