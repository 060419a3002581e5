"""hwmon, iio and thermal zones in a sysfs tree, and each of their faults."""

from __future__ import annotations

import pytest

from tests.drivers.fakes.sysfs import Sysfs
from thermocald.acquisition.device_loop import Link
from thermocald.errors import (
    BadReading,
    DeviceGone,
    WrongDevice,
)
from thermocald.hal import VirtualClock, open_device


@pytest.fixture
def sysfs(tmp_path):
    return Sysfs(tmp_path)


def thermometer(driver, sysfs, **options):
    return open_device("thermometer", driver, {"sysfs": str(sysfs.root), **options}, VirtualClock())


# lm-sensors issue 100: some folders have only temp2 and temp4
IT87 = {"temp2_input": "51000", "temp4_input": "31000", "temp4_label": "board"}
READ = [
    ("hwmon", "amdgpu", {"temp1_input": "28000", "temp1_crit": "80000"}, {}, {"temperature": 28.0}),
    ("hwmon", "it87", IT87, {}, {"temp2": 51.0, "board": 31.0}),
    ("hwmon", "it87", IT87, {"channels": {"lens": "board"}}, {"lens": 31.0}),
    ("hwmon", "it87", IT87, {"channels": {"lens": "temp2"}}, {"lens": 51.0}),
    ("hwmon", "it87", {"temp1_input": "85000"}, {}, {"temperature": 85.0}),
    ("hwmon", "w1_slave_temp", {"temp1_input": "85000"}, {}, "power-on"),
    ("hwmon", "lm90", {"temp1_input": "21000", "temp1_fault": "1"}, {}, "fault"),
    *(("hwmon", "lm75", {"temp1_input": text}, {}, f"{text} is not a whole number of 1/1000 °C")
      for text in ("31.5", "31.0")),
    *(("hwmon", "lm75", {"temp1_input": text}, {}, "not a number") for text in ("", "٢٨٠٠٠")),
    # bmp280 family: raw only; ABI: (raw + offset) * scale in m°C
    ("iio", "tmp006", {"in_temp_ambient_raw": "731", "in_temp_scale": "31.25",
                       "in_temp_offset": "10"}, {}, {"temperature": 741 * 31.25 / 1000}),
    ("iio", "bme280", {"in_temp_input": "21530", "in_temp_raw": "1", "in_temp_scale": "1"}, {},
     {"temperature": 21.53}),
    ("iio", "adc", {"in_temp_raw": "731"}, {}, "scale"),
    ("zone", "cpu-thermal", "48312", {}, {"temperature": 48.312}),
    ("zone", "gpu-thermal", "-274000", {}, "outside"),  # THERMAL_TEMP_INVALID
    ("zone", "camera-therm-usr", "-40000", {}, "absent sensor"),
    ("zone", "soc", "310", {"unit": "tenths"}, {"temperature": 31.0}),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "name", "files", "options", "expected"), READ)
def test_what_the_kernel_says_is_read_rightly_or_refused(
    sysfs, kind, name, files, options, expected
):
    if kind == "zone":
        sysfs.zone(0, name, files)
        device = thermometer("thermal_zone", sysfs, zone=name, **options)
    else:
        getattr(sysfs, kind)(0, name, **files)
        device = thermometer(kind, sysfs, chip=name, **options)
    with device:
        if isinstance(expected, dict):
            assert device.read().values == expected
            return
        with pytest.raises(BadReading, match=expected):
            device.read()


@pytest.mark.parametrize("name", ["it87", "cpu_thermal"])
def test_an_input_that_was_missing_is_read_when_it_is_there(sysfs, name):
    clock = VirtualClock()
    options = {"sysfs": str(sysfs.root), "chip": name}
    if name == "it87":
        sysfs.hwmon(0, name, temp2_input="51000")
        options["channels"] = {"lens": "temp1"}
        problem = "no input temp1; there is temp2"
    else:
        sysfs.hwmon(0, name)
        problem = "no temperature input is there"
    link = Link("thermometer", name, open_device("thermometer", "hwmon", options, clock), clock)
    read = []
    assert not link.do(lambda: read.append(link.device.read()))
    assert (link.state, problem in link.why) == ("out", True)
    sysfs.hwmon(0, name, temp1_input="21000")
    clock.sleep_until(clock.monotonic() + 20.0)
    assert link.do(lambda: read.append(link.device.read()))
    assert list(read[0].values.values()) == [21.0]


def test_an_input_that_is_missing_does_not_take_the_others_along(sysfs):
    sysfs.hwmon(0, "it87", temp2_input="51000")
    channels = {"lens": "temp1", "board": "temp2"}
    with thermometer("hwmon", sysfs, chip="it87", channels=channels) as device:
        reading = device.read()
        assert (reading.values, *reading.missing) == ({"board": 51.0}, "lens")
        sysfs.hwmon(0, "it87", temp1_input="21000")
        assert device.read().values == {"lens": 21.0, "board": 51.0}


def test_a_number_handed_on_to_another_chip_is_noticed(sysfs):
    folder = sysfs.hwmon(3, "lm75", temp1_input="21000")
    with thermometer("hwmon", sysfs, chip="lm75") as device:
        (folder / "name").write_text("cpu_thermal\n")
        with pytest.raises(DeviceGone, match="'cpu_thermal' now"):
            device.read()


def test_two_chips_of_one_name_need_the_address(sysfs):
    sysfs.hwmon(0, "lm75", "1-0048", temp1_input="21000")
    sysfs.hwmon(1, "lm75", "1-0049", temp1_input="22000")
    with pytest.raises(WrongDevice, match="set chip: 1-0048, 1-0049"):
        thermometer("hwmon", sysfs, chip="lm75").open()
    with thermometer("hwmon", sysfs, chip="1-0049") as device:
        assert device.read().values == {"temperature": 22.0}


def test_a_zone_that_showed_its_unit_may_pass_through_zero(sysfs):
    read = []
    sysfs.zone(0, "outside", "2100")
    with thermometer("thermal_zone", sysfs, zone="outside") as device:
        for number in ("2100", "700", "0", "-300"):
            sysfs.zone(0, "outside", number)
            read.append(device.read().values["temperature"])
    assert read == [2.1, 0.7, 0.0, -0.3]


def test_two_inputs_of_one_label_are_two_channels(sysfs):
    labels = {"temp1_label": "Diode", "temp2_label": "Diode", "temp3_label": "Board"}
    inputs = {"temp1_input": "20000", "temp2_input": "21000", "temp3_input": "22000"}
    sysfs.hwmon(0, "chip", **labels, **inputs)
    with thermometer("hwmon", sysfs, chip="chip") as device:
        assert device.read().values == {"temp1": 20.0, "temp2": 21.0, "Board": 22.0}


@pytest.mark.parametrize("label", [b"Temp \xb0C", b"\xff\xfe", b"Gr\xc3", b"\xed\xb3\xa9", b"\x80"])
def test_a_label_that_is_no_text_is_read(sysfs, label):
    files = {"temp1_input": "20000", "temp1_label": "x", "temp2_input": "21000"}
    sysfs.hwmon(0, "chip", **files)
    next(sysfs.root.rglob("temp1_label")).write_bytes(label)
    with thermometer("hwmon", sysfs, chip="chip") as device:
        assert list(device.read().values.values()) == [20.0, 21.0]
