"""Further outputs of devices, by family: what they must be read as, or that they must not.

Through the drivers as they are, like `test_device_outputs`. Sources: drivers of the kernel, the
BatteryService and thermal HAL of Android, C. Petrich's survey of DS18B20 clones, Arduino libraries.
"""

from __future__ import annotations

import pytest

from tests.drivers.fakes.sysfs import Sysfs, w1_crc
from tests.drivers.test_device_outputs import battery, onewire, phone_reads, serial
from thermocald.errors import BadReading
from thermocald.hal import VirtualClock, open_device

REFUSE = "refuse"


def result(read):
    try:
        return read()
    except BadReading:
        return REFUSE


# --- 1-wire ------------------------------------------------------------------


def w1(pad: str, milli: int, verdict: str = "YES") -> str:
    data = bytes.fromhex(pad)
    crc = w1_crc(data)
    text = " ".join(f"{b:02x}" for b in [*data, crc])
    return f"{text} : crc={crc:02x} {verdict}\n{text} t={milli}\n"


W1 = {
    "power-on at 10 bits": ("28", w1("50054b463fff0c10", 85000), REFUSE),
    "power-on at 11 bits": ("28", w1("50054b465fff0c10", 85000), REFUSE),
    "power-on of a DS1822": ("22", w1("50054b467fff0c10", 85000), REFUSE),
    "power-on of a DS28EA00": ("42", w1("50054b467fffff10", 85000), REFUSE),
    "power-on of a clone with other user bytes": ("28", w1("5005550055ff7f20", 85000), REFUSE),
    "127.94, a failed conversion": ("28", w1("ff074b467fff0110", 127937), REFUSE),
    "all ones": ("28", w1("ffffffffffffffff", -62, "NO").replace("c9", "ff", 1), REFUSE),
    "an empty file": ("28", "", REFUSE),
    "a changed byte": ("28", w1("4b014b467fff0510", 20687).replace("05 10", "06 10"), REFUSE),
    "the kernel says no": ("28", w1("4b014b467fff0510", 20687, "NO"), REFUSE),
    "just below power-on": ("28", w1("4f054b467fff0110", 84937), 84.937),
    "a frost": ("28", w1("5eff4b467fff0210", -10125), -10.125),
    "the coldest": ("28", w1("90fc4b467fff1010", -55000), -55.0),
    "t of another reading": ("28", w1("4b014b467fff0510", 20625), REFUSE),
    "DS18S20 with a remainder": ("10", w1("2d00ffffffff0410", 22500), 22.5),
    "DS18S20 in a frost": ("10", w1("ceffffffffff0c10", -25000), -25.0),
    "MAX31850 open circuit": ("3b", w1("71014000f0fffffe", 23000), REFUSE),
    "MAX31850 sound": ("3b", w1("70014000f0fffffe", 23000), 23.0),
}  # fmt: skip


@pytest.mark.parametrize("case", W1)
def test_onewire(case, tmp_path):
    family, text, expected = W1[case]
    assert result(lambda: onewire(None, tmp_path, text, {"family": family})) == expected


# --- sysfs -------------------------------------------------------------------

HWMON = {
    "sht3x": ({"temp1_input": "21437"}, 21.437),
    "a frost": ({"temp1_input": "-8250"}, -8.25),
    "an input that is not connected": ({"temp1_input": "0"}, REFUSE),
    "an open diode": ({"temp1_input": "127875"}, REFUSE),
    "a shorted diode": ({"temp1_input": "-128000"}, REFUSE),
    "a fault flag": ({"temp1_input": "25000", "temp1_fault": "1"}, REFUSE),
    "no fault": ({"temp1_input": "25000", "temp1_fault": "0"}, 25.0),
    "an overflow": ({"temp1_input": "2147483647"}, REFUSE),
    "no number": ({"temp1_input": ""}, REFUSE),
}
IIO = {
    "tmp117 before its first conversion": (
        {"in_temp_raw": "-32768", "in_temp_scale": "7.812500"}, REFUSE),
    "tmp117": ({"in_temp_raw": "2944", "in_temp_scale": "7.812500"}, 23.0),
    "bme280": ({"in_temp_input": "23040"}, 23.04),
    "si7020": (
        {"in_temp_raw": "6480", "in_temp_offset": "-4368", "in_temp_scale": "10.725585"},
        pytest.approx(22.652, abs=1e-3)),
    "mpu6050": (
        {"in_temp_raw": "-4720", "in_temp_offset": "12420", "in_temp_scale": "2.941176"},
        pytest.approx(22.647, abs=1e-3)),
    "dht11": ({"in_temp_input": "22000"}, 22.0),
    "max31856 with an open wire": (
        {"in_temp_raw": "3000", "in_temp_scale": "7.8125", "fault_oc": "1"}, REFUSE),
    "max31856": (
        {"in_temp_raw": "3000", "in_temp_scale": "7.8125", "fault_oc": "0", "fault_ovuv": "0"},
        23.4375),
    "max31865 over-voltage": (
        {"in_temp_raw": "8960", "in_temp_offset": "-8192", "in_temp_scale": "31.25",
         "fault_ovuv": "1"}, REFUSE),
    "max31865": (
        {"in_temp_raw": "8960", "in_temp_offset": "-8192", "in_temp_scale": "31.25"}, 24.0),
    "max31865 open": (
        {"in_temp_raw": "32767", "in_temp_offset": "-8192", "in_temp_scale": "31.25"}, REFUSE),
    "a raw number alone": ({"in_temp_raw": "23000"}, REFUSE),
}  # fmt: skip
ZONES = {
    "thousandths": ("48312", {}, 48.312),
    "whole degrees of an Allwinner kernel": ("45", {}, REFUSE),
    "whole degrees, stated": ("45", {"unit": "degC"}, 45.0),
    "tenths": ("412", {}, REFUSE),
    "tenths, stated": ("412", {"unit": "tenths"}, 41.2),
    "a frost in thousandths": ("-5200", {}, -5.2),
    "near zero in thousandths": ("900", {}, REFUSE),
    "near zero, stated": ("900", {"unit": "thousandths"}, 0.9),
    "zero": ("0", {}, REFUSE),
    "not fitted": ("-40000", {}, REFUSE),
    "invalid": ("-274000", {}, REFUSE),
}


def chip_reads(driver, files, folder):
    getattr(Sysfs(folder), driver)(0, "chip", **files)
    stanza = {"chip": "chip", "sysfs": str(folder)}
    with open_device("thermometer", driver, stanza, VirtualClock()) as device:
        return result(lambda: device.read().values["temperature"])


@pytest.mark.parametrize("case", HWMON)
def test_hwmon(case, tmp_path):
    files, expected = HWMON[case]
    assert chip_reads("hwmon", files, tmp_path) == expected


@pytest.mark.parametrize("case", IIO)
def test_iio(case, tmp_path):
    files, expected = IIO[case]
    assert chip_reads("iio", files, tmp_path) == expected


@pytest.mark.parametrize("case", ZONES)
def test_thermal_zone(case, tmp_path):
    number, options, expected = ZONES[case]
    Sysfs(tmp_path).zone(0, "soc_thermal", number)
    stanza = {"zone": "soc_thermal", "sysfs": str(tmp_path), **options}
    with open_device("thermometer", "thermal_zone", stanza, VirtualClock()) as device:
        assert result(lambda: device.read().values["temperature"]) == expected


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


# --- phones ------------------------------------------------------------------


def dump(**fields) -> str:
    lines = [f"  {name.replace('_', ' ')}: {value}" for name, value in fields.items()]
    return "\n".join(["Current Battery Service state:", *lines, "  technology: Li-ion", ""])


BATTERY = {
    "tenths": (dump(present="true", voltage=4063, temperature=326), 32.6),
    "a frost": (dump(present="true", voltage=3650, temperature=-74), -7.4),
    "whole degrees where volts are whole": (dump(present="true", voltage=13, temperature=26), 26.0),
    "the mains, 12 V and 0": (dump(present="true", voltage=12000, temperature=0), REFUSE),
    "the mains, 5 V and 0": (dump(present="true", voltage=5000, temperature=0), REFUSE),
    "0 V": (dump(present="true", voltage=0, temperature=250), 25.0),
    "hotter than any battery": (dump(present="true", voltage=4000, temperature=850), REFUSE),
    "thousandths": (dump(present="true", voltage=4000, temperature=25600), REFUSE),
    "not reported": (dump(present="true", voltage=4000, temperature=-2147483648), REFUSE),
    "words": (dump(present="true", voltage=4000, temperature="unknown"), REFUSE),
    "frozen": ("  (UPDATES STOPPED -- use 'reset' to restart)\n" + dump(temperature=250), REFUSE),
    "maxima of its life": (
        dump(voltage=4063, temperature=301) + "  mSavedBatteryMaxTemp: 490\n", 30.1),
    "no permission": ("Permission Denial: can't dump BatteryService from pid=1\n", REFUSE),
}  # fmt: skip


@pytest.mark.parametrize("case", BATTERY)
def test_battery(case, server, tmp_path):
    text, expected = BATTERY[case]
    assert result(lambda: battery(server, tmp_path, text, {})) == expected


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


# --- serial lines ------------------------------------------------------------

C = r"(?P<temperature>[-+]?[\d.,]+)"
SERIAL = {
    "JSON": ('{"id":4,"temp":21.56,"unit":"C"}', rf'.*"temp":{C},"unit":"C".*', {}, 21.56),
    "JSON without its sensor": ('{"temp":null}', rf'.*"temp":{C}.*', {}, REFUSE),
    "CSV": ("2026-06-14T10:00:00Z,4,21.56,55", rf"[^,]+,\d+,{C},\d+", {}, 21.56),
    "NMEA": ("$WIXDR,C,19.5,C,AIR*19", rf"\$WIXDR,C,{C},C,AIR\*(?P<checksum>..)",
             {"checksum": "nmea"}, 19.5),
    "NMEA, damaged": ("$WIXDR,C,18.5,C,AIR*19", rf"\$WIXDR,C,{C},C,AIR\*(?P<checksum>..)",
                      {"checksum": "nmea"}, REFUSE),
    "Fahrenheit": ("T=70.7F", rf"T={C}F", {"unit": "F"}, pytest.approx(21.5)),
    "Fahrenheit where Celsius is wanted": ("T=70.7F", rf"T={C}C", {}, REFUSE),
    "DallasTemperature, unplugged, in Fahrenheit": ("T=-196.60", rf"T={C}", {"unit": "F"}, REFUSE),
    "kelvin": ("294.65 K", rf"{C} K", {"unit": "K"}, pytest.approx(21.5)),
    "0 K": ("0.00 K", rf"{C} K", {"unit": "K"}, REFUSE),
    "a decimal comma": ("Temp: 21,5 C", rf"Temp: {C} C", {}, 21.5),
    "thousands": ("Temp: 1,021.5 C", rf"Temp: {C} C", {}, REFUSE),
    "two points": ("Temp: 21.5.1 C", rf"Temp: {C} C", {}, REFUSE),
    "zero": ("Temp: 0.00 C", rf"Temp: {C} C", {}, REFUSE),
    "zero, stated": ("Temp: 0.00 C", rf"Temp: {C} C", {"refuse_c": []}, 0.0),
    "AHT20, all zeros": ("Temp: -50.00 C", rf"Temp: {C} C", {}, REFUSE),
    "HDC1080, all ones": ("Temp: 125.00 C", rf"Temp: {C} C", {}, REFUSE),
    "SHT31, all ones": ("Temp: 130.00 C", rf"Temp: {C} C", {}, REFUSE),
    "SI7021, all ones": ("Temp: 128.86 C", rf"Temp: {C} C", {}, REFUSE),
    "MAX6675, open": ("Temp: nan C", r"Temp: (?P<temperature>\S+) C", {}, REFUSE),
    "MAX31865, open": ("Temp: 988.79 C", rf"Temp: {C} C", {}, REFUSE),
    "BME280, unwired": ("Temp: -145.75 C", rf"Temp: {C} C", {}, REFUSE),
    "overflow": ("Temp: ovf C", r"Temp: (?P<temperature>\S+) C", {}, REFUSE),
}  # fmt: skip


@pytest.mark.parametrize("case", SERIAL)
def test_serial(case, tmp_path):
    text, pattern, options, expected = SERIAL[case]
    stanza = {"pattern": pattern, **options}
    assert result(lambda: serial(None, tmp_path, text, stanza)) == expected
