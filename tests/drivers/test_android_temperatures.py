"""Outputs of real phones, read through the driver; expected values were read by hand."""

from __future__ import annotations

import re
import time

import pytest
from thermocald_drivers import kernel

from tests.drivers.test_device_outputs import phone_reads
from thermocald.errors import BadReading


def read(server, kind, names, **dumps):
    """Return {name: °C} of the sources `kind:name`, as the driver reads them."""
    sensors = {name: f"{kind}:{name}" for name in names}
    try:
        return dict(phone_reads(server, sensors, **dumps))
    except BadReading:
        return {}


def battery(server, text, **more):
    try:
        return phone_reads(server, {"t": "battery"}, battery=text, **more)["t"]
    except BadReading:
        return None


def dump(shared, number):
    (path,) = (shared / "data/adb").glob(f"{number}_*.txt")
    return path.read_text()


@pytest.mark.parametrize(
    ("number", "celsius"), [("01", 30.9), ("02", 27.5), ("03", None), ("04", 24.2)]
)
def test_battery_of_real_phones(server, shared, number, celsius):
    assert battery(server, dump(shared, number)) == (celsius and pytest.approx(celsius))


A52 = {"AP": 25.6, "BAT": 23.8, "LRB": 24.7, "LRF": 24.7, "LRP": 24.7, "PA": 25.7}
LIVE = {"cpu0-silver-usr": 32.300003}
# number of the file, its part, some of the readings, the number of sensors
DUMPS = [
    ("06", 0, A52, 6),  # without the sensors that are not fitted
    ("07", 0, {}, 0),  # only the cache is printed
    ("08", 0, LIVE | {"maxfg": 25.900002}, 13),  # the cache says 54.600002
    ("10", 0, {"skin": 33.136}, 12),  # vbat and socd are volts and percent
    ("12", 0, LIVE, 1), ("12", 1, LIVE, 1), ("12", 2, {"test temperature sensor": 30.8}, 1),
    ("15", 0, {}, 0),  # a HAL that is not ready
]  # fmt: skip


@pytest.mark.parametrize(("number", "part", "some", "count"), DUMPS)
def test_thermal_service_of_real_phones(server, shared, number, part, some, count):
    text = dump(shared, number).split("\n---\n")[part]
    named = re.findall(r"mName=(\w[^,}\n]*)", text)
    found = read(server, "thermal", {*named, "vbat", "socd"}, thermal=text)
    assert found.items() >= some.items()
    assert len(found) == count


@pytest.mark.parametrize(
    ("text", "celsius"),
    [
        ("voltage: 4\n temperature: 85", None),  # 85 °C or 8.5 °C
        ("present: false\n temperature: 25", None),
        ("present: true\n temperature: 25", None),
        ("(UPDATES STOPPED -- use 'reset' to restart)\n temperature: 250", None),
        ("  voltage: 4352\r\n  temperature: 274\r\n", 27.4),
        ("temperature: 2_5", None),
        ("temperature: ٢٥٠", None),
        ("status: 2 temperature: 268", None),
        ("error: closed", None),
        ("", None),
    ],
)
def test_batteries_of_other_kinds(server, text, celsius):
    assert battery(server, text) == (celsius and pytest.approx(celsius))


def record(value, kind=2, name="battery"):
    return f"\tTemperature{{mValue={value}, mType={kind}, mName={name}, mStatus=0}}\n"


HAL = """HAL Ready: true
Cached temperatures:
	Temperature{mValue=61.0, mType=3, mName=skin, mStatus=0}
HAL connection:
	ThermalHAL AIDL 3 connected: yes
Current temperatures from HAL:
%sCurrent cooling devices from HAL:
	CoolingDevice{mValue=0, mType=2, mName=thermal-cpufreq-0}
Temperature static thresholds from HAL:
	TemperatureThreshold{mType=3, mName=skin, mHotThrottlingThresholds=[NaN, 39.0, 43.0]}
"""
RECORDS = [
    (record(33.25, 3, "skin"), {"skin": 33.25}),
    (record(31.5, 3, "back cover"), {"back cover": 31.5}),
    (record(75.0, 13, "lmh-dcvs-00"), {}),  # a limit
    (record(33250.0, 3, "skin"), {}),  # millidegrees
    (record(-40.0, 15, "camera"), {}),  # not fitted
    *((record(value), {}) for value in ("NaN", "0.0", "-3.4028235E38")),  # invalid, or not fitted
    (record(3.9, 6, "vbat"), {}),  # a voltage
    *((record(46.7, kind), {}) for kind in (-1, 7, 8, 20)),  # their unit is not degrees
    *((record(value), {}) for value in ("2_5.0", "Infinity", "٢٥", "")),
    # a name with a line end does not hide the other sensors
    (record(42.0, -1, "soc\n") + record(31.0, 3, "skin\n") + record(25.0),
     {"skin": 31.0, "battery": 25.0}),
    ((record(25.0) + "Cached temperatures:\n" + record(55.0, 0, "cpu")).replace("\n", "\r\n"),
     {"battery": 25.0}),
    (record(25.0) + record(31.0, 3), {}),  # one name for two sensors
]  # fmt: skip


@pytest.mark.parametrize(("text", "expected"), RECORDS)
def test_records_of_the_thermal_service(server, text, expected):
    names = {"battery", "cpu", *re.findall(r"mName=(\w[^,}\n]*)", text)} - {"soc"}
    assert read(server, "thermal", names, thermal=HAL % text) == expected


WARM, COLD = "pm_tz 30500\n", "pm_tz 5200\n"
OTHERS = ["soc", "socd", "pm8150b-ibat-lvl0", "pm8150b-vbat-lvl0", "pm8150l-bcl-lvl0", "vbat",
          "pm8150l-vph-lvl0", "smpl_gm", "soft_ocp_gpu", "batoilo", "battery_cycle",
          "USB2-MINUS-QI", "FLASH_LED_REDUCE", "ibat-high", "vdroop1"]  # fmt: skip
ZONES = [
    ("cpu-0-0-usr 37000", 37.0), ("foo 370", 37.0), ("foo -5500", -5.5),
    ("foo 37", None),  # 37 °C or 3.7 °C
    ("foo 900", None),  # 90 °C or 0.9 °C
    ("foo 1003", None),  # 100.3 °C or 1.003 °C
    ("tsens_tz_sensor5 309", 30.9), ("tsens_tz_sensor5 110", 11.0),
    ("tsens_tz_sensor5 1003", 100.3), ("tsens_tz_sensor5 45", None), ("battery 370", 37.0),
    ("battery 85", 8.5), ("battery 45", None), ("battery 25500", 25.5), ("mtktsbattery 900", 0.9),
    ("mtktsbattery 31000", 31.0), ("mtktsAP 45", 45.0), ("pa_therm0 30", 30.0),
    ("xo_therm_buf 31", 31.0), ("pa_therm1 -40", None),  # not fitted
    ("foo -274000", None), ("foo 0", None),
    # among others: in the unit of its neighbours
    ("foo 37\n" + WARM, 37.0), ("tsens_tz_sensor5 45\n" + WARM, 45.0),
    ("tsens_tz_sensor5 45\n" + COLD, None),  # 45 °C under load or 4.5 °C at rest
    (f"chg_temp 7\n{WARM}xo_therm 31", 7.0),
    *((f"{name} 25000", None) for name in OTHERS),  # of other quantities
    *((f"{name} 25000", 25.0) for name in ("soc-thermal", "soc_max", "VIRTUAL-SKIN", "mtktspa")),
    ("gpu 36000\r\nbroken \ncat: x: Permission denied\nx 2_5", 36.0),
    ("gpu 36000\ngpu 45000", None),  # one name for two
]  # fmt: skip


@pytest.mark.parametrize(("text", "celsius"), ZONES)
def test_the_unit_of_a_zone(server, text, celsius):
    name = text.split()[0]
    found = read(server, "zone", [name], zones=text + "\n").get(name)
    assert found == (celsius and pytest.approx(celsius))


def test_a_line_of_blanks_takes_no_time():
    begin = time.monotonic()
    text = "x" + " " * 20_000 + "\r\n\rgpu 36000\r\r\n"
    assert kernel.raw_zones(text) == {"gpu": 36000}
    assert time.monotonic() - begin < 1.0
