"""The android drivers with the real adb server and a real adbd (Debian's), over TCP."""

from __future__ import annotations

import statistics
import threading
import time

import pytest

from tests.hil.bars import number_of
from tests.hil.frames import heating
from thermocald.errors import (
    DeviceGone,
    DeviceTimeout,
    PermanentDeviceError,
)
from thermocald.hal import SystemClock, VirtualClock, open_device

WIDTH, HEIGHT, EPOCHS = 640, 480, 12


@pytest.fixture(scope="module")
def subject():
    return heating(WIDTH, HEIGHT, EPOCHS)


def camera(phone, **more):
    options = {"serial": phone.serial, "width": WIDTH, "height": HEIGHT, "timeout_s": 8.0, **more}
    return open_device("camera", "android", options, SystemClock())


def thermometer(phone, **more):
    return open_device("thermometer", "android", {"serial": phone.serial, **more}, SystemClock())


def test_a_heating_series(phone, subject, report):
    """Frame numbers, temperatures and times are right; photographs are deleted from the phone."""
    images, temperatures = subject
    phone.load(images)
    phone.say("shutter_lag", "0.12")
    took, read, errors, offsets = [], [], [], []
    sensors = {"temperature": "battery"}
    with camera(phone, delete=True) as device, thermometer(phone, sensors=sensors) as sensor:
        compare = device.clock_offset
        device.clock_offset = lambda: offsets.append(compare()) or offsets[-1]
        for epoch in range(EPOCHS):
            tenths = round(temperatures[epoch] * 10)
            phone.say("dumpsys.battery", f"  voltage: 4100\n  temperature: {tenths}\n")
            begin = time.monotonic()
            frame = device.capture()
            took.append(time.monotonic() - begin)
            begin = time.monotonic()
            reading = sensor.read()
            read.append(time.monotonic() - begin)
            assert number_of(frame.image) == epoch + 1
            assert reading.values == {"temperature": tenths / 10}
            # the middle of 0.01 s; on a busy machine, clocks are compared less exactly than 5 ms
            errors.append(frame.utc - (phone.exposures()[epoch + 1] + 0.005))
            assert abs(errors[-1]) < max(0.005, offsets[-1][2] + 0.001)
    uncertainty = max(offset[2] for offset in offsets)
    assert list(phone.camera_folder.iterdir()) == []
    activities = (phone.state / "activities").read_text().splitlines()
    assert sum("STILL_IMAGE_CAMERA" in line for line in activities) == 1
    report(
        f"android (adbd 34, {WIDTH}x{HEIGHT}): trigger to frame in memory median "
        f"{statistics.median(took):.2f} s (shutter lag 0.12 s, file written for 0.3 s), "
        f"times wrong by at most {1e3 * max(map(abs, errors)):.1f} ms (clocks compared to "
        f"{1e3 * uncertainty:.1f} ms); read to value median "
        f"{1e3 * statistics.median(read):.0f} ms"
    )


def test_a_pulled_cable_is_plugged_in_again(phone, subject):
    """adbd is killed during a capture, which gives no truncated frame."""
    phone.load(subject[0][:2])
    phone.say("write_lag", "30")
    device = camera(phone, timeout_s=5.0)
    device.open()
    killer = threading.Timer(0.8, phone.pull)
    killer.start()
    with pytest.raises((DeviceGone, DeviceTimeout)):
        device.capture()
    killer.join()
    device.close()
    with pytest.raises(DeviceGone):
        device.open()
    phone.unsay("write_lag")
    phone.plug()
    device.open()
    assert number_of(device.capture().image) == 2
    device.close()


def test_warm_up_by_processor_load(phone):
    """Real processes on the phone end at the limit, and with the lease."""
    programme = [{"seconds": 1000, "hold_c": 38.0}]
    options = {"serial": phone.serial, "limit_c": 42, "programme": programme, "processes": 2}
    clock = VirtualClock()

    def running():
        # adbd's own command line also contains the command; count only the loops' shells
        count = "pgrep -fc '^sh -c [t]hermocald_load'"
        return phone.adb("-s", phone.serial, "shell", count).strip()

    def end(within_s):
        deadline = time.monotonic() + within_s
        while (still := running()) != "0" and time.monotonic() < deadline:
            time.sleep(0.2)
        return still == "0"

    with open_device("output", "android_load", {**options, "lease_s": 4}, clock) as output:
        output.emit({})
        assert running() == "2"
        phone.say("dumpsys.battery", "  voltage: 4100\n  temperature: 425\n")
        with pytest.raises(PermanentDeviceError, match="reached the limit"):
            output.emit({})
        assert end(within_s=2)  # of a lease of 4 s
    phone.say("dumpsys.battery", "  voltage: 4100\n  temperature: 300\n")
    output = open_device("output", "android_load", {**options, "lease_s": 2}, clock)
    output.open()
    output.emit({})
    assert running() == "2"
    assert end(within_s=10)  # without renewal the load ends by itself
    output.close()
