"""Further outputs of devices: labels of the kernel, zones and the thermal service of phones.

Through the drivers as they are, like `test_device_outputs`. Sources: drivers of the kernel, the
thermal HAL of Android.
"""

from __future__ import annotations

import pytest

from tests.drivers.fakes.sysfs import Sysfs
from tests.drivers.test_device_outputs import phone_reads
from thermocald.errors import BadReading
from thermocald.hal import VirtualClock, open_device

REFUSE = "refuse"


def result(read):
    try:
        return read()
    except BadReading:
        return REFUSE


# --- sysfs -------------------------------------------------------------------


def test_a_zone_that_showed_its_unit_may_pass_through_zero(tmp_path):
    sysfs, read = Sysfs(tmp_path), []
    sysfs.zone(0, "outside", "2100")
    stanza = {"zone": "outside", "sysfs": str(tmp_path)}
    with open_device("thermometer", "thermal_zone", stanza, VirtualClock()) as device:
        for number in ("2100", "700", "0", "-300"):
            sysfs.zone(0, "outside", number)
            read.append(device.read().values["temperature"])
    assert read == [2.1, 0.7, 0.0, -0.3]


def test_two_inputs_of_one_label_are_two_channels(tmp_path):
    labels = {"temp1_label": "Diode", "temp2_label": "Diode", "temp3_label": "Board"}
    inputs = {"temp1_input": "20000", "temp2_input": "21000", "temp3_input": "22000"}
    Sysfs(tmp_path).hwmon(0, "chip", **labels, **inputs)
    stanza = {"chip": "chip", "sysfs": str(tmp_path)}
    with open_device("thermometer", "hwmon", stanza, VirtualClock()) as device:
        assert device.read().values == {"temp1": 20.0, "temp2": 21.0, "Board": 22.0}


@pytest.mark.parametrize("label", [b"Temp \xb0C", b"\xff\xfe", b"Gr\xc3", b"\xed\xb3\xa9", b"\x80"])
def test_a_label_that_is_no_text_is_read(tmp_path, label):
    files = {"temp1_input": "20000", "temp1_label": "x", "temp2_input": "21000"}
    Sysfs(tmp_path).hwmon(0, "chip", **files)
    next(tmp_path.rglob("temp1_label")).write_bytes(label)
    stanza = {"chip": "chip", "sysfs": str(tmp_path)}
    with open_device("thermometer", "hwmon", stanza, VirtualClock()) as device:
        assert list(device.read().values.values()) == [20.0, 21.0]


# --- phones ------------------------------------------------------------------

HAL = """HAL Ready: true
Cached temperatures:
	Temperature{{mValue=61.0, mType=3, mName=skin, mStatus=0}}
HAL connection:
	ThermalHAL AIDL 3 connected: yes
Current temperatures from HAL:
{}
Current cooling devices from HAL:
	CoolingDevice{{mValue=0, mType=2, mName=thermal-cpufreq-0}}
Temperature static thresholds from HAL:
	TemperatureThreshold{{mType=3, mName=skin, mHotThrottlingThresholds=[NaN, 39.0, 43.0]}}
"""
THERMAL = {
    "skin": ("Temperature{mValue=33.25, mType=3, mName=skin, mStatus=0}", {"skin": 33.25}),
    "a limit": ("Temperature{mValue=75.0, mType=13, mName=lmh-dcvs-00, mStatus=0}", REFUSE),
    "millidegrees": ("Temperature{mValue=33250.0, mType=3, mName=skin, mStatus=0}", REFUSE),
    "not fitted": ("Temperature{mValue=-40.0, mType=15, mName=camera, mStatus=0}", REFUSE),
    "invalid": ("Temperature{mValue=-3.4028235E38, mType=3, mName=skin, mStatus=0}", REFUSE),
    "NaN": ("Temperature{mValue=NaN, mType=2, mName=battery, mStatus=0}", REFUSE),
    "zero": ("Temperature{mValue=0.0, mType=2, mName=battery, mStatus=0}", REFUSE),
    "a voltage": ("Temperature{mValue=3.9, mType=6, mName=vbat, mStatus=0}", REFUSE),
    "a spaced name": (
        "Temperature{mValue=31.5, mType=3, mName=back cover, mStatus=2}", {"back cover": 31.5}),
}  # fmt: skip


@pytest.mark.parametrize("case", THERMAL)
def test_thermal_service(case, server):
    line, expected = THERMAL[case]
    name = line.partition("mName=")[2].partition(",")[0]
    text = HAL.format(f"\t{line}")
    found = result(lambda: phone_reads(server, {name: f"thermal:{name}"}, thermal=text))
    assert found == expected


PHONE_ZONES = """cpu-0-0-usr 38200
gpuss-0-usr 36100
battery 31000
lmh-dcvs-00 75000
pm6150-vbat-lvl0 4012
pm6150l-bcl-lvl1 0
bcl-cycle 12
soc 87
quiet-therm-adc 32100
dock_therm -40960
ibat-high 2000
"""


def test_zones_of_a_phone(server):
    wanted = {line.split()[0]: f"zone:{line.split()[0]}" for line in PHONE_ZONES.splitlines()}
    assert phone_reads(server, wanted, zones=PHONE_ZONES) == {
        "cpu-0-0-usr": 38.2, "gpuss-0-usr": 36.1, "battery": 31.0, "quiet-therm-adc": 32.1,
    }  # fmt: skip
