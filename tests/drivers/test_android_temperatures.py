"""What real phones print; the expected values were read from the files by hand."""

from __future__ import annotations

import pytest
from thermocald_drivers import android_thermometer
from thermocald_drivers.android_thermometer import thermalservice
from thermocald_drivers.kernel import is_temperature, raw_zones, zone_scales


def battery(text, unit=""):
    """°C, or None."""
    found = android_thermometer.battery(text, unit)
    return None if found is None else pytest.approx(found[0] * found[1])


def dump(shared, number):
    (path,) = (shared / "data/adb").glob(f"{number}_*.txt")
    return path.read_text()


@pytest.mark.parametrize(
    ("number", "celsius"), [("01", 30.9), ("02", 27.5), ("03", None), ("04", 24.2)]
)
def test_battery_of_real_phones(shared, number, celsius):
    assert battery(dump(shared, number)) == celsius


@pytest.mark.parametrize("text", ["", "error: closed", "temperature: hot", "  level: 83\n"])
def test_a_battery_that_says_nothing(text):
    assert battery(text) is None


def test_a_battery_near_freezing_point_is_in_tenths_or_degrees():
    for number in (0, 26, 70, -30):
        text = f"  voltage: 3812\n  temperature: {number}\n"
        assert battery(text) is None
        assert battery(text, "tenths") == number / 10
    assert battery("  voltage: 3812\n  temperature: -43\n") == -4.3
    assert battery("  voltage: 3812\n  temperature: 71\n") == 7.1


def test_samsung_a52_without_the_sensors_that_are_not_fitted(shared):
    assert thermalservice(dump(shared, "06")) == {
        "AP": 25.6, "BAT": 23.8, "LRB": 24.7, "LRF": 24.7, "LRP": 24.7, "PA": 25.7,
    }  # fmt: skip


def test_a_cache_is_never_taken(shared):
    assert thermalservice(dump(shared, "07")) == {}  # shield: only the cache is printed
    live = thermalservice(dump(shared, "08"))
    assert live["cpu0-silver-usr"] == 32.300003  # the cache says 54.600002
    assert live["maxfg"] == 25.900002
    assert len(live) == 13


def test_volts_and_percents_are_no_temperatures(shared):
    live = thermalservice(dump(shared, "10"))
    assert "vbat" not in live
    assert "socd" not in live
    assert live["skin"] == 33.136
    assert len(live) == 12


def test_malformed_records_are_left_out(shared):
    missing, invalid, emulator = dump(shared, "12").split("\n---\n")
    assert thermalservice(missing) == {"cpu0-silver-usr": 32.300003}
    assert thermalservice(invalid) == {"cpu0-silver-usr": 32.300003}
    assert thermalservice(emulator) == {"test temperature sensor": 30.8}


def test_a_hal_that_is_not_ready(shared):
    assert thermalservice(dump(shared, "15")) == {}


@pytest.mark.parametrize(
    ("text", "celsius"),
    [
        ("voltage: 13\n temperature: 26", 26.0),  # a TV board: whole volts, whole degrees
        ("voltage: 4\n temperature: 268", 26.8),
        ("voltage: 4\n temperature: 85", None),  # 85 °C or 8.5 °C
        ("voltage: 4312\n temperature: 26", None),  # 2.6 °C, or 26 °C of boards with mV
        ("present: false\n temperature: 25", None),
        ("present: true\n temperature: 25", None),
        ("(UPDATES STOPPED -- use 'reset' to restart)\n temperature: 250", None),
        ("  voltage: 4352\r\n  temperature: 274\r\n", 27.4),
        ("temperature: 25000", None),
        ("temperature: 2_5", None),
        ("temperature: ٢٥٠", None),
        ("status: 2 temperature: 268", None),
    ],
)
def test_batteries_of_other_kinds(text, celsius):
    assert battery(text) == celsius


def test_the_battery_in_a_stated_unit():
    assert battery("voltage: 4\n temperature: 85", "tenths") == 8.5
    assert battery("temperature: 25000", "thousandths") == 25.0
    assert battery("temperature: 850", "tenths") is None  # hotter than any battery


def record(value, kind=2, name="battery"):
    return f"\tTemperature{{mValue={value}, mType={kind}, mName={name}, mStatus=0}}\n"


LIVE = "Current temperatures from HAL:\n"


@pytest.mark.parametrize("kind", [-1, 6, 7, 8, 20])
def test_types_whose_unit_is_not_degrees(kind):
    assert thermalservice(LIVE + record(46.7, kind)) == {}


@pytest.mark.parametrize("value", ["NaN", "2_5.0", "Infinity", "٢٥", "", "0.0"])
def test_values_that_are_not_temperatures(value):
    assert thermalservice(LIVE + record(value)) == {}


def test_a_name_with_a_newline_does_not_hide_the_rest():
    text = LIVE + record(42.0, -1, "soc\n") + record(31.0, 3, "skin\n") + record(25.0)
    assert thermalservice(text) == {"skin": 31.0, "battery": 25.0}


def test_the_section_ends_at_the_next_heading():
    text = LIVE + record(25.0) + "Cached temperatures:\n" + record(55.0, 0, "cpu")
    assert thermalservice(text.replace("\n", "\r\n")) == {"battery": 25.0}


def test_one_name_for_two_sensors_is_none():
    assert thermalservice(LIVE + record(25.0) + record(31.0, 3)) == {}


def zone(name, raw, **others):
    zones = {name: raw, **others}
    scale = zone_scales(zones, {}).get(name)
    return None if scale is None else pytest.approx(raw * scale)


@pytest.mark.parametrize(
    ("name", "raw", "celsius"),
    [
        ("cpu-0-0-usr", 37000, 37.0),
        ("foo", 370, 37.0),
        ("foo", -5500, -5.5),
        ("foo", 37, None),  # 37 °C or 3.7 °C
        ("foo", 900, None),  # 90 °C or 0.9 °C
        ("foo", 1003, None),  # 100.3 °C or 1.003 °C
        ("tsens_tz_sensor5", 309, 30.9),
        ("tsens_tz_sensor5", 110, 11.0),
        ("tsens_tz_sensor5", 1003, 100.3),
        ("tsens_tz_sensor5", 45, None),
        ("battery", 370, 37.0),
        ("battery", 85, 8.5),
        ("battery", 45, None),
        ("battery", 25500, 25.5),
        ("mtktsbattery", 900, 0.9),
        ("mtktsbattery", 31000, 31.0),
        ("mtktsAP", 45, 45.0),
        ("pa_therm0", 30, 30.0),
        ("xo_therm_buf", 31, 31.0),
        ("pa_therm1", -40, None),  # not fitted
        ("foo", -274000, None),
        ("foo", 0, None),
    ],
)
def test_the_unit_of_a_zone_by_itself(name, raw, celsius):
    assert zone(name, raw) == celsius


def test_the_unit_of_a_zone_among_others():
    warm, cold = {"pm_tz": 30500}, {"pm_tz": 5200}
    assert zone("foo", 37, **warm) == 37.0
    assert zone("tsens_tz_sensor5", 45, **warm) == 45.0
    assert zone("tsens_tz_sensor5", 45, **cold) is None  # 45 °C under load or 4.5 °C at rest
    assert zone("chg_temp", 7, **warm, xo_therm=31) == 7.0  # as its neighbours are written


def test_a_unit_found_before_is_kept():
    assert zone_scales({"tsens_tz_sensor5": 45}, {"tsens_tz_sensor5": 0.1}) == {
        "tsens_tz_sensor5": 0.1
    }


@pytest.mark.parametrize(
    "name",
    ["soc", "socd", "pm8150b-ibat-lvl0", "pm8150b-vbat-lvl0", "pm8150l-bcl-lvl0", "vbat",
     "pm8150l-vph-lvl0", "smpl_gm", "soft_ocp_gpu", "batoilo", "battery_cycle", "USB2-MINUS-QI",
     "FLASH_LED_REDUCE", "ibat-high", "vdroop1"],
)  # fmt: skip
def test_zones_of_other_quantities(name):
    assert not is_temperature(name)
    assert zone(name, 25000) is None


@pytest.mark.parametrize(
    "name", ["soc-thermal", "soc_max", "battery", "cpu-0-0-usr", "VIRTUAL-SKIN", "mtktspa", "maxfg"]
)
def test_zones_of_temperatures(name):
    assert is_temperature(name)


def test_lines_of_zones():
    text = "cpu-0-0 37000\r\nbattery 370\ngpu usr 36\nbroken \ncat: x: Permission denied\nx 2_5\n"
    assert raw_zones(text) == {"cpu-0-0": 37000, "battery": 370, "gpu usr": 36}
    assert raw_zones("cpu 30000\ncpu 45000\ngpu 1\ngpu 1\n") == {"gpu": 1}
