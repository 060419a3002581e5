"""What real phones print; the expected values were read from the files by hand."""

from __future__ import annotations

import pytest
from thermocald_drivers.android_temperatures import (
    battery,
    thermal_zones,
    thermalservice,
    zone_scale,
)


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


def test_a_battery_at_freezing_point_with_a_voltage_is_cold():
    assert battery("  voltage: 3812\n  temperature: 0\n") == 0.0
    assert battery("  voltage: 3812\n  temperature: -43\n") == -4.3


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
    ("raw", "celsius"), [(37000, 37.0), (370, 37.0), (37, 37.0), (36, 36.0), (-5500, -5.5)]
)
def test_zones_mix_their_units(raw, celsius):
    assert raw * zone_scale(raw) == pytest.approx(celsius)


def test_lines_of_zones():
    text = "cpu-0-0 37000\nbattery 370\ngpu usr 36\nbroken \ncat: x: Permission denied\n"
    assert thermal_zones(text) == {"cpu-0-0": 37000.0, "battery": 370.0, "gpu usr": 36.0}
