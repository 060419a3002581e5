"""Phones through adbutils against an adb server on loopback; `make hil` uses a real adbd."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from thermocald_drivers.android import exif, exposure_start, focus_state
from thermocald_drivers.android_phone import AdbPhone

from tests.drivers.fakes.adb_server import FOCUS, photograph, shoot
from tests.drivers.laboratory import check_readings
from thermocald import errors
from thermocald.hal import VirtualClock

DRIVER = ("camera", "android")
THERMOMETER = pytest.mark.parametrize("driver", [("thermometer", "android")])
LOAD = pytest.mark.parametrize("driver", [("output", "android_load")])


@pytest.mark.parametrize(
    ("trigger", "command"),
    [({"trigger": "camera"}, "input keyevent 27"), ({"trigger": "volume"}, "input keyevent 24"),
     ({"trigger": "tap", "tap": [540, 2000]}, "input tap 540 2000")],
)  # fmt: skip
def test_photographs_by_the_triggers_of_the_vendors(bench, fake, trigger, command):
    fake.trigger = command
    fake.add("IMG_old.jpg", b"old")
    with bench.device(**trigger) as device:
        for _ in range(2):
            fake.awake = False
            frame = device.capture()
            assert fake.awake
    assert np.max(np.abs(frame.image - np.add.outer(np.arange(64.0), np.arange(96)))) <= 3
    assert frame.encoded[:2] == b"\xff\xd8"
    assert frame.exposure == pytest.approx(1 / 60, rel=1e-4)
    assert fake.commands.count(command) == 2
    assert len(fake.files) == 3  # they are deleted only when told


@pytest.mark.parametrize("offset", [0.0, 37.25, -7200.0])
def test_the_time_is_exifs_with_the_phones_clock_compared(bench, fake, offset):
    exposed, fake.clock_offset = [], -1.0

    def with_lag(fake):
        time.sleep(0.15)  # of the shutter, which the trigger's time lacks
        exposed.append(time.time())
        shoot()(fake)
        exposed.append(time.time())

    fake.shoot = with_lag
    with bench.device() as device:
        fake.clock_offset = offset  # it is set at any time
        frame = device.capture()
    before, after = exposed
    assert before - 0.005 < frame.utc - 1 / 120 < after + 0.005


def test_without_fractions_or_in_another_zone_it_is_the_triggers(bench, fake):
    fake.shoot = shoot(subsecond=None)
    with bench.device() as device:
        for fake.date in ("%.9f +0000", "%d.%%N +0000", "%.9f +0100", "%.9f +0000 late mark"):
            if "mark" in fake.date:  # it is that of the file, 2 s after it was complete
                fake.shoot = lambda fake: fake.add("IMG_2.jpg", photograph(fake.now() + 2.0))
            time.sleep((0.6 - time.time()) % 1)  # s that a whole second would be off
            called = time.time()
            assert called - 0.2 < device.capture().utc < time.time()
    assert sum("STILL_IMAGE_CAMERA" in c for c in fake.commands) == 1  # the app stays open


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
    one = AdbPhone(clock=VirtualClock(), serial="X", port=1, timeout_s=1.0)
    left = list(trips)

    def ask():
        middle, half_trip = left.pop(0) if len(left) > 1 else left[0]
        return middle, "+0000", half_trip

    one._ask_clock = ask
    assert one.clock_offset() == (pytest.approx(offset), "+0000", pytest.approx(half))


@pytest.mark.parametrize(  # nothing, Samsung's trailer, a video, the gain map of Ultra HDR
    "after", [b"", b"Image_UTC_DataSEFT", b"\0\0\0\x18ftypmp42", photograph(0.0, size=(32, 16))]
)
def test_a_file_that_grows_is_awaited_among_files_that_are_no_photographs(bench, fake, after):
    whole = photograph(time.time()) + after

    def action(fake):
        fake.add(".pending-1-IMG.jpg", b"half")
        fake.add("IMG_2.dng", b"raw")
        fake.add("Bob's 照片.JPG", photograph(0.0, size=(48, 32)))  # a preview, which is replaced
        threading.Timer(0.1, fake.add, ("Bob's 照片.JPG", whole, 0.4)).start()

    fake.shoot = action
    with bench.device(delete=True) as device:
        assert device.capture().encoded == whole
    assert sorted(fake.files) == [".pending-1-IMG.jpg", "IMG_2.dng"]


@pytest.mark.parametrize("refuse", [False, None, True])
def test_exposure_that_moved_is_flagged_or_refused(bench, fake, refuse):
    fake.media_camera, fake.shoot = "", shoot(distance=None)
    with bench.device(refuse_unlocked=refuse, delete=True) as device:
        device.capture()
        assert any("cannot be checked" in w for w in device.warnings())  # the focus
        fake.shoot = shoot(iso=200)
        if refuse:
            with pytest.raises(errors.BadReading, match="iso was 100 and is 200"):
                device.capture()
        else:
            assert device.capture().settings["iso"] == 200.0
        assert any("refuse_unlocked" in w for w in device.warnings()) == (refuse is False)
    assert not fake.files  # the refused one is deleted too


@THERMOMETER
def test_temperatures(bench, fake, shared):
    fake.thermal = next((shared / "data/adb").glob("06_*")).read_text()
    fake.zones = "cpu-0-0 37000\nbattery 370\n"
    sensors = {"temperature": "battery", "ap": "thermal:AP", "soc": "zone:cpu-0-0"}
    sensors["usb"] = "thermal:USB"
    with bench.device(sensors=sensors) as device:
        reading = device.read()
    assert reading.values == {"temperature": 28.7, "ap": 25.6, "soc": 37.0}
    (missing,) = reading.missing.items()
    assert missing == ("usb", "phone 0A1B2C3D4E: thermal:USB: the phone does not report it")


ASKED = r"unit of 45 is unknown; set units: \{soc: degC\}"


@THERMOMETER
@pytest.mark.parametrize(
    ("source", "units", "steps"),
    [
        ("zone:cpu", {}, [(37000, 37.0), (900, 0.9)]),  # and not 90 °C
        ("zone:tsens_tz_sensor5", {}, [(45, ASKED), (309, 30.9), (45, 4.5), (0, 0.0)]),
        ("zone:tsens_tz_sensor5", {"soc": "tenths"}, [(45, 4.5)]),
        # in a frost
        ("battery", {}, [(55, "unknown unit"), (92, 9.2), (61, 6.1), (24, 2.4), (5, 0.5)]),
    ],
)
def test_a_unit_that_was_certain_once_is_kept(bench, fake, source, units, steps):
    def put(number):
        fake.zones = f"{source.partition(':')[2]} {number}\n"
        fake.battery = f"present: true\nvoltage: 3900\ntemperature: {number}\n"

    with bench.device(sensors={"soc": source}, units=units) as device:
        check_readings(device, put, steps)


@LOAD
def test_warm_up_by_load_which_the_limit_stops_for_good(bench, fake):
    bench.options |= {"hysteresis_k": 1.0, "lease_s": 30, "processes": 2}
    bench.clock = clock = VirtualClock()
    with bench.device() as output:
        for celsius, heating in ((28.7, True), (38.6, False), (37.0, True)):
            fake.battery = f"  voltage: 4000\n  temperature: {celsius * 10:.0f}\n"
            output.emit({})
            assert fake.load == heating
    assert not fake.load  # closing stops it
    fake.commands.clear()
    with bench.device() as output:
        for processes in (2, 2, 4):  # the load is a lease that is renewed
            output.emit({})
            assert sum(c.startswith("timeout 30 ") for c in fake.commands) == processes
            clock.sleep_until(clock.monotonic() + 10)
        fake.battery = "  voltage: 4000\n  temperature: 420\n"
        with pytest.raises(errors.PermanentDeviceError, match=r"42\.00 °C reached the limit"):
            output.emit({})
        assert not fake.load
        fake.battery = "  voltage: 4000\n  temperature: 200\n"
        output.emit({})
        assert not fake.load


WHEN = 1_605_956_400.25


def test_the_instant_of_a_photograph_and_its_zone():
    for photo_zone, phone_zone, shift in (
        (None, "", 0), (None, "+0000", 0), ("+01:00", "+0000", -3600), (None, "-0330", 12600),
    ):  # fmt: skip
        told = exposure_start(exif(photograph(WHEN, zone=photo_zone)), phone_zone)
        assert told == (WHEN + shift, 0.001)
    assert exposure_start(exif(photograph(WHEN, subsecond=None)), "")[1] == 1.0
    assert exposure_start({"time": "0000:00:00 00:00:00"}, "") is None
    assert exposure_start({}, "") is None
    assert focus_state(FOCUS.replace("0.25", "1.5e+01")) == {"focus_distance_dioptres": 15.0}
    for damaged in (0.0, -0.02, 1e9, "1/60"):
        assert "exposure_s" not in exif(photograph(WHEN, exposure=damaged))
    for data in (b"", b"\xff\xd8\xff\xd9", b"GIF89a"):
        with pytest.raises(errors.BadReading, match="not a photograph"):
            exif(data)
