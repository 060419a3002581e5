"""hwmon, iio and thermal zones in a sysfs tree, and each of their faults."""

from __future__ import annotations

import pytest

from thermocald.errors import BadReading, DeviceGone, DeviceNotFound, WrongDevice
from thermocald.hal import VirtualClock, open_device


def thermometer(driver, sysfs, **options):
    return open_device("thermometer", driver, {"sysfs": str(sysfs.root), **options}, VirtualClock())


# lm-sensors issue 100: some folders have only temp2 and temp4
IT87 = {"temp2_input": "51000", "temp4_input": "31000", "temp4_label": "board"}
SAME = {"temp1_input": "20000", "temp1_label": "Diode", "temp2_input": "21000",
        "temp2_label": "Diode", "temp3_input": "22000", "temp3_label": "Board"}  # fmt: skip


@pytest.mark.parametrize(
    ("files", "channels", "expected"),
    [
        ({"temp1_input": "28000", "temp1_crit": "80000"}, {}, {"temperature": 28.0}),
        (IT87, {}, {"temp2": 51.0, "board": 31.0}),
        (IT87, {"lens": "board", "air": "temp2"}, {"lens": 31.0, "air": 51.0}),
        (SAME, {}, {"temp1": 20.0, "temp2": 21.0, "Board": 22.0}),
    ],
)
def test_channels_are_inputs_or_their_labels(sysfs, files, channels, expected):
    sysfs.hwmon(0, "it87", **files)
    with thermometer("hwmon", sysfs, chip="it87", channels=channels) as device:
        assert device.read().values == expected
    if "temp2_label" in files:  # no text
        for label in (b"Temp \xb0C", b"\xff\xfe", b"Gr\xc3", b"\xed\xb3\xa9", b"\x80"):
            (sysfs.root / "class/hwmon/hwmon0/temp1_label").write_bytes(label)
            with thermometer("hwmon", sysfs, chip="it87") as device:
                assert list(device.read().values.values()) == [20.0, 21.0, 22.0]


@pytest.mark.parametrize(
    ("files", "channels", "problem"),
    [({"temp2_input": "51000"}, {"lens": "temp1"}, "no input temp1; there is temp2"),
     ({}, {}, "no temperature input is there")],
)  # fmt: skip
def test_an_input_that_was_missing_is_read_when_it_is_there(sysfs, files, channels, problem):
    sysfs.hwmon(0, "it87", **files)
    device = thermometer("hwmon", sysfs, chip="it87", channels=channels)
    with pytest.raises(DeviceNotFound, match=problem):  # the daemon looks for it again
        device.open()
    sysfs.hwmon(0, "it87", temp1_input="21000")
    with device:
        assert list(device.read().values.values()) == [21.0]


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


# (options, [(number, °C)])
UNITS = {
    "may pass through zero": ({}, [("2100", 2.1), ("700", 0.7), ("0", 0.0), ("-300", -0.3)]),
    **{f"switches to {after}, {options}": (options, [
        ("45000", 45.0), ("45200", 45.2), (after, None), (after, None), ("45100", 45.1)])
       for after in ("45", "450", "46", "447") for options in ({}, {"unit": "thousandths"})},
}  # fmt: skip


@pytest.mark.parametrize("case", UNITS)
def test_the_unit_of_a_zone_that_showed_it(sysfs, case):
    options, numbers = UNITS[case]
    sysfs.zone(0, "skin", "45000")
    device = thermometer("thermal_zone", sysfs, zone="skin", **options)
    device.open()
    for number, celsius in numbers:
        sysfs.zone(0, "skin", number)
        if celsius is None:
            with pytest.raises(BadReading):
                device.read()
            device.close()  # as the daemon does after each fault
            device.open()
        else:
            assert device.read().values == {"temperature": celsius}
    device.close()
