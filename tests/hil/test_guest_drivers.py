"""Drivers with real kernel drivers in the guest: v4l2loopback, vivid, i2c-stub, lm75, ftdi_sio."""

from __future__ import annotations

import statistics

import pytest

from tests.hil.one_wire import POWER_ON
from tests.hil.thermal_zone import CELSIUS

STAMP_S = 0.005
TRANSIENT = ("BadReading", "DeviceGone", "DeviceTimeout")


def check(machine, name, *arguments, **steps):
    return machine.python("check.py", name, *arguments, **steps)


def unplugged(machine, device, scenario, argument):
    """Run a scenario while a device is pulled and plugged in again; return its result."""
    return check(machine, scenario, argument, pull=device.pull, plug=device.plug)


def milliseconds(seconds):
    return f"median {1e3 * statistics.median(seconds):.1f} ms, largest {1e3 * max(seconds):.1f} ms"


CASES = ["GREY:linuxpy", "YUYV:linuxpy", "MJPG:linuxpy", "YUYV:opencv"]


@pytest.fixture(scope="module")
def captured(video):
    return check(video, "times", *CASES)


@pytest.mark.parametrize("case", CASES)
def test_v4l2_frames_are_new_and_their_times_right(captured, report, case):
    """Each frame contains its number; the feeder logs when each was written."""
    frames = captured[case]
    numbers = [frame["number"] for frame in frames]
    assert numbers == sorted(set(numbers))
    errors = []
    for frame in frames:
        assert frame["shape"] == [480, 640]
        before, after = frame["written"]
        errors.append(max(before - frame["monotonic"], frame["monotonic"] - after, 0.0))
        assert frame["monotonic"] >= frame["called"]  # exposed after the call
    assert max(errors) < STAMP_S
    report(
        f"v4l2 {case} 640x480: trigger to frame in memory "
        f"{milliseconds([f['took_s'] for f in frames])} (camera at 10 frames/s); "
        f"time stamps off by at most {1e3 * max(errors):.2f} ms"
    )


@pytest.mark.parametrize("backend", ["linuxpy", "opencv"])
def test_v4l2_feeder_that_stalls_and_is_killed(video, backend):
    result = check(video, "stalls", backend)
    stopped = result["stopped"]
    assert stopped["error"] == "DeviceTimeout"
    assert stopped["took_s"] < 2.5  # the driver's 1.5 s instead of OpenCV's 10 s
    assert result["continued"]["error"] is None
    assert result["killed"]["error"] in TRANSIENT
    assert result["again"]["error"] is None


def test_v4l2_faults_of_the_kernel(video, report):
    result = check(video, "vivid")
    assert result["opened"]["error"] is None, result["opened"]["text"]
    assert result["captured"]["value"] == [360, 640]
    settings = result["controls"]["value"]
    assert (settings["brightness"], settings["contrast"]) == (77.0, 100.0)
    assert result["no_control"]["error"] == "WrongDevice"
    assert result["no_size"]["error"] == "WrongDevice"
    assert result["output_node"]["error"] == "WrongDevice"
    assert result["busy"]["error"] == "DeviceDenied"
    # one frame with the error flag is skipped, the next is good
    assert result["inject_v4l2_buf_flag_error"]["value"] == [360, 640]
    fatal = result["inject_fatal_streaming_error"]
    assert fatal["error"] in TRANSIENT, fatal
    assert result["after inject_fatal_streaming_error"]["value"] == [360, 640]
    assert result["unplugged"]["error"] == "DeviceGone"
    assert result["still unplugged"]["error"] == "DeviceGone"
    assert result["plugged"]["error"] is None, result["plugged"]["text"]
    assert result["captured again"]["value"] == [360, 640]
    report(f"v4l2 vivid: an unplug is noticed after {result['unplugged']['took_s'] * 1e3:.0f} ms")


def test_i2c(machine, i2c_bus, report):
    result = check(machine, "i2c", i2c_bus)
    assert result["kernel"]["values"] == [{"temperature": 25.062}] * 20  # truncated to 1/1000
    assert result["registers"]["values"] == [{"temperature": 25.0625}] * 20
    assert result["kernel cold"]["value"] == {"temperature": pytest.approx(-25.062, abs=1e-3)}
    assert result["kernel has it"]["error"] == "DeviceDenied"
    assert result["nobody"]["error"] == "DeviceNotFound"
    assert result["no bus"]["error"] == "DeviceNotFound"
    assert result["unbound"]["error"] == "DeviceGone"
    assert result["bound"]["value"] == {"temperature": 25.062}
    for name, driver in (("kernel", "hwmon (lm75 in the kernel)"), ("registers", "lm75")):
        report(f"{driver}: read to value {milliseconds(result[name]['took_s'])}")


def test_thermometers_of_the_kernel(machine, i2c_bus, report):
    result = check(machine, "kernel", i2c_bus)
    assert result["iio"]["values"] == [{"temperature": 25.08}] * 20
    assert result["iio unbound"]["error"] == "DeviceGone"
    assert result["bme280"]["values"] == [{"temperature": pytest.approx(25.08, abs=0.005)}] * 20
    assert result["thermal_zone"]["values"] == [{"temperature": CELSIUS}] * 20
    report(f"iio (bmp280 in the kernel): read to value {milliseconds(result['iio']['took_s'])}")
    took = result["thermal_zone"]["took_s"]
    report(f"thermal_zone (ACPI firmware): read to value {milliseconds(took)}")


def test_serial(machine, instrument, report):
    instrument.celsius = -12.375
    result = check(machine, "serial_line", instrument.port)
    assert result["values"] == [{"temperature": -12.375}] * 20
    report(f"serial (ftdi_sio): read to value {milliseconds(result['took_s'])}")


def test_serial_unplugged_and_plugged_again(machine, instrument):
    result = unplugged(machine, instrument, "serial_unplug", instrument.port)
    assert result["before"]["value"] == {"temperature": 21.25}
    assert result["pulled"]["error"] == "DeviceGone"
    assert result["gone"]["error"] == "DeviceGone"
    assert result["back"]["value"] == {"temperature": 21.25}


def test_ds18b20(machine, wire, report):
    """The kernel's w1_therm converts two probes one after the other."""
    names = [probe.name for probe in wire.probes]
    result = check(machine, "ds18b20", *names)
    assert result["opened"]["error"] is None, result["opened"]["text"]
    for reading in result["readings"]:
        assert reading["value"][0] == {"field": 21.5, "air": -10.125}
    took = [reading["took_s"] for reading in result["readings"]]
    assert min(took) > 2 * 0.75
    report(f"ds18b20 (w1_therm, ds2490), two probes: read to values {milliseconds(took)}")


def test_ds18b20_with_wrong_readings(machine, wire):
    """A disturbed line, and a probe that lost its power and has not converted since."""
    disturbed, restarted = wire.probes
    disturbed.damage = 1
    restarted.converts, restarted.scratchpad = False, POWER_ON
    names = [probe.name for probe in wire.probes]
    (first,) = check(machine, "ds18b20", *names, "count=1")["readings"]
    assert first["error"] == "BadReading"
    assert "CRC" in first["text"]  # Linux 6.1 returns nothing, earlier ones the bytes
    restarted.converts = True
    (second,) = check(machine, "ds18b20", *names, "count=1")["readings"]
    values, missing = second["value"]
    assert values == {"air": -10.125}
    assert "CRC" in missing["field"]
    disturbed.damage, restarted.converts = 0, False
    restarted.scratchpad = POWER_ON
    (third,) = check(machine, "ds18b20", *names, "count=1")["readings"]
    values, missing = third["value"]
    assert values == {"field": 21.5}
    assert "power-on value" in missing["air"]


def test_ds18b20_unplugged_and_plugged_again(machine, wire):
    result = unplugged(machine, wire, "ds18b20_unplug", wire.probes[0].name)
    assert result["before"]["value"] == {"temperature": 21.5}
    assert result["pulled"]["error"] in TRANSIENT
    assert result["gone"]["error"] == "DeviceGone"
    assert result["back"]["value"] == {"temperature": 21.5}
