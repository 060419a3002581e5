"""Phones through adbutils against an adb server on loopback; `make hil` uses a real adbd."""

from __future__ import annotations

import socket
import threading
import time

import numpy as np
import pytest
from thermocald_drivers.android import exif, exposure_start
from thermocald_drivers.android_phone import AdbPhone

from tests.drivers.fakes.adb_server import AdbServer, FakePhone, photograph, wait_little
from thermocald import errors
from thermocald.hal import SystemClock, VirtualClock, open_device

SERIAL = "0A1B2C3D4E"
FOCUS = """  android.lens.focusDistance (80007): float[1]
        [0.25 ]
"""


@pytest.fixture
def server(monkeypatch):
    wait_little(monkeypatch)
    server = AdbServer()
    server.phones[SERIAL] = FakePhone(media_camera=FOCUS, shoot=shoot())
    yield server
    server.close()


@pytest.fixture
def phone(server):
    return server.phones[SERIAL]


def shoot(count=1, delay=0.0, writing_s=0.0, **tags):
    """Return a camera app that writes `count` photographs per trigger."""

    def action(phone):
        time.sleep(delay)
        for k in range(count):
            name = f"IMG_{len(phone.files):04d}_{k}.jpg"
            when = phone.now()
            tags.setdefault("subsecond", f"{int(when % 1 * 1000):03d}")
            phone.add(name, photograph(when, **tags), writing_s)
            tags.pop("subsecond")

    return action


def options(server, **more):
    return {"serial": SERIAL, "port": server.port, "start_server": False, "timeout_s": 5.0, **more}


def camera(server, **more):
    more = {"width": 96, "height": 64, **more}
    return open_device("camera", "android", options(server, **more), SystemClock())


def thermometer(server, **more):
    return open_device("thermometer", "android", options(server, **more), SystemClock())


def test_a_photograph(server, phone):
    phone.add("IMG_old.jpg", b"old")
    with camera(server) as device:
        frame = device.capture()
    expected = np.add.outer(np.arange(64), np.arange(96))
    assert np.max(np.abs(frame.image.astype(int) - expected)) <= 3
    assert frame.encoded[:2] == b"\xff\xd8"
    assert frame.exposure == pytest.approx(1 / 60, rel=1e-4)
    assert phone.awake
    assert sum("STILL_IMAGE_CAMERA" in c for c in phone.commands) == 1


@pytest.mark.parametrize(
    ("trigger", "command"),
    [
        ({"trigger": "camera"}, "input keyevent 27"),
        ({"trigger": "volume"}, "input keyevent 24"),
        ({"trigger": "tap", "tap": [540, 2000]}, "input tap 540 2000"),
    ],
)
def test_triggers_of_the_vendors(server, phone, trigger, command):
    phone.trigger = command
    with camera(server, **trigger) as device:
        device.capture()
        device.capture()
    assert phone.commands.count(command) == 2
    assert sum("STILL_IMAGE_CAMERA" in c for c in phone.commands) == 1  # the app stays open


@pytest.mark.parametrize("offset", [0.0, 37.25, -7200.0])
def test_the_time_is_exifs_with_the_phones_clock_compared(server, phone, offset):
    phone.clock_offset = offset
    exposed = []

    def action(phone):
        time.sleep(0.15)  # a shutter lag that the trigger's time lacks
        exposed.append(time.time())
        shoot()(phone)
        exposed.append(time.time())

    phone.shoot = action
    with camera(server) as device:
        frame = device.capture()
    before, after = exposed
    assert before - 0.005 < frame.utc - 1 / 120 < after + 0.005


@pytest.mark.parametrize(
    ("trips", "offset", "half"),
    [
        # (s, half of the round trip s): the common interval is narrower than the shortest
        ([(0.020, 0.025), (-0.015, 0.018), (0.004, 0.006), (-0.001, 0.0045)], 0.0005, 0.0025),
        ([(0.0, 0.0015)], 0.0, 0.0015),  # close enough at once
        ([(0.0, 0.02), (3600.0, 0.01)], 3600.0, 0.01),  # the clock is set meanwhile: the shortest
    ],
)
def test_the_phones_clock_lies_where_all_round_trips_overlap(trips, offset, half):
    one = AdbPhone(clock=VirtualClock(), serial=SERIAL, port=1, timeout_s=1.0)
    left = list(trips)

    def ask():
        middle, half_trip = left.pop(0) if len(left) > 1 else left[0]
        return middle, "+0000", half_trip

    one._ask_clock = ask
    assert one.clock_offset() == (pytest.approx(offset), "+0000", pytest.approx(half))


@pytest.mark.parametrize(
    ("knob", "value"), [("shoot", shoot(subsecond=None)), ("clock_offset", 3600.0)]
)
def test_without_fractions_or_with_a_clock_that_was_set_it_is_the_triggers(
    server, phone, knob, value
):
    with camera(server) as device:
        setattr(phone, knob, value)
        called = time.time()
        frame = device.capture()
    assert abs(frame.utc - called) < 1.0


def test_a_file_that_grows_is_awaited(server, phone):
    phone.shoot = shoot(writing_s=0.4)
    with camera(server, timeout_s=3.0) as device:
        frame = device.capture()
    assert frame.encoded.endswith(b"\xff\xd9")


SOON = {"timeout_s": 0.3}
REFUSED = {
    "never ends": (
        {"shoot": lambda phone: phone.add("IMG_1.jpg", photograph(time.time())[:-300])}, SOON,
        errors.BadReading, "partial photograph, IMG_1"),
    "two": ({"shoot": shoot(count=2)}, {}, errors.BadReading, "2 new photographs"),
    "none": ({"shoot": None}, SOON, errors.DeviceTimeout, "the camera app is open"),
    "smaller": (
        {"shoot": shoot(size=(48, 32))}, {}, errors.WrongDevice, "has 48×32 px, not 96×64"),
    "broken off": ({"cut_transfer": True}, {}, errors.DeviceGone, "broke off"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_a_photograph_that_is_none(server, phone, case):
    knobs, options, error, message = REFUSED[case]
    with camera(server, **options) as device:
        for name, value in knobs.items():
            setattr(phone, name, value)
        with pytest.raises(error, match=message):
            device.capture()


def test_delete_only_when_told(server, phone):
    with camera(server) as device:
        device.capture()
    assert len(phone.files) == 1
    with camera(server, delete=True) as device:
        device.capture()
    assert len(phone.files) == 1


def test_pending_files_and_raw_copies_are_not_photographs(server, phone):
    def action(phone):
        phone.add(".pending-1-IMG.jpg", b"half")
        phone.add("IMG_2.dng", b"raw")
        shoot()(phone)

    phone.shoot = action
    with camera(server) as device:
        assert device.capture().encoded[:2] == b"\xff\xd8"


def test_exposure_that_moved_is_flagged_or_refused(server, phone):
    for refuse in (False, None, True):
        phone.shoot = shoot()
        with camera(server, refuse_unlocked=refuse) as device:
            device.capture()
            phone.shoot = shoot(iso=200)
            if refuse:
                with pytest.raises(errors.BadReading, match="iso was 100 and is 200"):
                    device.capture()
            else:
                assert device.capture().settings["iso"] == 200.0
                assert any("refuse_unlocked" in w for w in device.warnings()) == (refuse is False)


FOCUS_MOVED = FOCUS.replace("0.25", "0.31")


@pytest.mark.parametrize(
    ("change", "tags", "why"),
    [({"media_camera": FOCUS_MOVED}, {}, "focus_distance_dioptres was 0.25 and is 0.31"),
     ({}, {"zoom": 2.0}, "digital_zoom was 1.0 and is 2.0"),
     ({}, {"distance": 2.0}, "subject_distance_m was 1.5 and is 2.0"),
     ({}, {"size": (48, 32)}, "the photograph has 48×32 px, not 96×64; set the camera app"),
     ({"media_camera": FOCUS + "android.control.afState (1): byte[1]\n [PASSIVE_SCAN ]\n"}, {},
      "autofocus is at work")],
)  # fmt: skip
def test_a_phone_that_is_changed_gives_no_frame_until_it_is_set_back(
    server, phone, change, tags, why
):
    phone.shoot = shoot(distance=1.5)
    with camera(server) as device:
        assert device.capture().settings["focus_distance_dioptres"] == 0.25
        for name, value in change.items():
            setattr(phone, name, value)
        phone.shoot = shoot(**{"distance": 1.5, **tags})
        with pytest.raises(errors.BadReading, match=why):
            device.capture()
        phone.media_camera, phone.shoot = FOCUS, shoot(distance=1.5)
        device.capture()


def test_what_a_phone_does_not_report_is_in_the_warnings(server, phone):
    phone.media_camera = ""
    with camera(server) as device:
        assert device.warnings() == []
        device.capture()
        assert "cannot be checked" in device.warnings()[0]


def test_a_phone_that_cannot_be_used(server, phone):
    phone.free_kb = 10_000
    with pytest.raises(errors.PermanentDeviceError, match="storage is full"):
        camera(server).open()
    phone.stays_locked = True
    with pytest.raises(errors.DeviceDenied, match="screen is locked"):
        camera(server).open()


def test_a_phone_that_fell_asleep_is_woken(server, phone):
    with camera(server) as device:
        phone.awake = False
        device.capture()
    assert phone.awake


TWICE = f"{SERIAL}\toffline\n{SERIAL}\tdevice\n"


@pytest.mark.parametrize(
    ("listing", "error", "message"),
    [
        ("unauthorized", errors.DeviceDenied, "Allow USB debugging"),
        ("offline", errors.DeviceGone, "re-plug"),
        ("no", errors.DeviceDenied, "udev"),
        ("bootloader", errors.DeviceGone, "boot"),
        ("", errors.DeviceNotFound, "adb lists none"),
        (TWICE, errors.WrongDevice, "2 devices have this serial number"),
    ],
)
def test_what_the_server_lists(server, listing, error, message):
    server.listing = listing if listing in ("", TWICE) else f"{SERIAL}\t{listing}\n"
    for device in (camera(server), thermometer(server)):
        with pytest.raises(error, match=message):
            device.open()


def test_a_phone_that_hangs(server, phone):
    with camera(server, timeout_s=0.3) as device:
        phone.hang = threading.Event()
        begin = time.monotonic()
        with pytest.raises(errors.DeviceTimeout):
            device.capture()
        assert time.monotonic() - begin < 1.5


def test_no_server():
    with socket.create_server(("127.0.0.1", 0)) as unused:
        port = unused.getsockname()[1]
    settings = {"serial": SERIAL, "port": port, "start_server": False}
    with pytest.raises(errors.DeviceNotFound, match="adb start-server"):
        open_device("thermometer", "android", settings, SystemClock()).open()


def test_temperatures(server, phone, shared):
    phone.thermal = next((shared / "data/adb").glob("06_*")).read_text()
    phone.zones = "cpu-0-0 37000\nbattery 370\n"
    sensors = {"temperature": "battery", "ap": "thermal:AP", "soc": "zone:cpu-0-0"}
    sensors["usb"] = "thermal:USB"
    with thermometer(server, sensors=sensors) as device:
        reading = device.read()
    assert reading.values == {"temperature": 28.7, "ap": 25.6, "soc": 37.0}
    (missing,) = reading.missing.items()
    assert missing == ("usb", f"phone {SERIAL}: thermal:USB: the phone does not report it")


@pytest.mark.parametrize(
    ("source", "numbers", "celsius"),
    [
        ("zone:cpu", (37000, 900), [37.0, 0.9]),  # and not 90 °C
        ("zone:tsens_tz_sensor5", (309, 45, 0), [30.9, 4.5, 0.0]),
        ("battery", (55, 92, 61, 24, 5, 45), [None, 9.2, 6.1, 2.4, 0.5, 4.5]),  # in a frost
    ],
)
def test_a_unit_that_was_certain_once_is_kept(server, phone, source, numbers, celsius):
    found = []
    with thermometer(server, sensors={"soc": source}) as device:
        for number in numbers:
            phone.zones = f"{source.partition(':')[2]} {number}\n"
            phone.battery = f"present: true\nvoltage: 3900\ntemperature: {number}\n"
            try:
                found.append(round(device.read().values["soc"], 9))
            except errors.BadReading:
                found.append(None)
    assert found == celsius


def test_a_zone_of_unknown_unit_asks_for_the_option(server, phone):
    phone.zones = "tsens_tz_sensor5 45\n"
    sensors = {"soc": "zone:tsens_tz_sensor5"}
    asked = r"unit of 45 is unknown; set units: \{soc: degC\}"
    device = thermometer(server, sensors=sensors)
    with device, pytest.raises(errors.BadReading, match=asked):
        device.read()
    with thermometer(server, sensors=sensors, units={"soc": "tenths"}) as device:
        assert device.read().values == {"soc": 4.5}


def load(server, clock, **more):
    programme = [{"seconds": 1000, "hold_c": 38.0}]
    settings = options(server, limit_c=42, programme=programme, hysteresis_k=1.0, **more)
    return open_device("output", "android_load", settings, clock)


def heat(phone, celsius):
    phone.battery = f"  voltage: 4000\n  temperature: {round(celsius * 10)}\n"


def test_warm_up_by_load_which_the_limit_stops_for_good(server, phone):
    with load(server, VirtualClock()) as output:
        for celsius, heating in ((28.7, True), (38.6, False), (37.0, True)):
            heat(phone, celsius)
            output.emit({})
            assert bool(phone.load) == heating
    assert not phone.load  # closing stops it
    with load(server, VirtualClock()) as output:
        output.emit({})
        assert phone.load
        heat(phone, 42.0)
        with pytest.raises(errors.PermanentDeviceError, match=r"42\.00 °C reached the limit"):
            output.emit({})
        assert not phone.load
        heat(phone, 20.0)
        output.emit({})
        assert not phone.load


def test_the_load_is_a_lease_that_is_renewed(server, phone):
    clock = VirtualClock()
    with load(server, clock, lease_s=30, processes=2) as output:
        output.emit({})
        started = [c for c in phone.commands if c.startswith("timeout 30 ")]
        assert len(started) == 2
        clock.advance(10)
        output.emit({})
        assert len([c for c in phone.commands if c.startswith("timeout 30 ")]) == 2
        clock.advance(10)
        output.emit({})
        assert len([c for c in phone.commands if c.startswith("timeout 30 ")]) == 4


# EXIF, and that focus and exposure did not change

WHEN = 1_605_956_400.0


@pytest.mark.parametrize("data", [b"", b"\xff\xd8\xff\xd9", b"GIF89a"])
def test_what_is_no_photograph(data):
    with pytest.raises(errors.BadReading, match="not a photograph"):
        exif(data)


@pytest.mark.parametrize(
    ("photo_zone", "phone_zone", "shift"),
    [(None, "", 0), (None, "+0000", 0), ("+01:00", "+0000", -3600), (None, "-0330", 12600)],
)
def test_the_instant_and_its_zone(photo_zone, phone_zone, shift):
    told = exposure_start(exif(photograph(WHEN, zone=photo_zone)), phone_zone)
    assert told == (WHEN + 0.25 + shift, 0.001)


def test_whole_seconds_are_coarse():
    assert exposure_start(exif(photograph(WHEN, subsecond=None)), "")[1] == 1.0
    assert exposure_start({"time": "0000:00:00 00:00:00"}, "") is None
    assert exposure_start({}, "") is None
