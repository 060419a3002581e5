"""Which readings belong to a frame."""

from __future__ import annotations

import math
import threading
from pathlib import Path

import pytest

from thermocald.acquisition.thermometers import Thermometers, pair_readings
from thermocald.config import parse_config
from thermocald.hal import Reading, VirtualClock


def reading(monotonic: float, **values: float) -> Reading:
    return Reading(values or {"temperature": monotonic}, monotonic, 1.6e9 + monotonic)


@pytest.fixture
def housing():
    """One thermometer that is read every 10 s."""
    document = {"thermometers": [{"name": "housing", "driver": "mock"}]}
    return Thermometers(parse_config(document, Path("config.yaml")), VirtualClock())


HOUSING = reading(9.0, temperature=21.5)
PAIRED = {
    "both keep their own times": (
        {"housing": reading(10.75, temperature=21.5)}, (10.75, {"temperature": 21.5}, 0.75)),
    "several have columns of their own, and the first gives the time": (
        {"housing": HOUSING, "phone": reading(10.0, temperature=30.0, battery=33.0)},
        (9.0, {"housing": 21.5, "phone": 30.0, "phone_battery": 33.0}, -1.0)),
    "without the reference the next one gives the time and nothing is filled in": (
        {"housing": None, "air": reading(10.5, temperature=5.0)}, (10.5, {"air": 5.0}, 0.5)),
    "none was read": ({"housing": None}, (math.nan, {}, math.nan)),
}  # fmt: skip


@pytest.mark.parametrize("case", PAIRED)
def test_readings_become_the_temperatures_of_a_frame(case):
    readings, expected = PAIRED[case]
    utc, temperatures, skew_s = pair_readings(readings, 10.0)
    assert (utc - 1.6e9, skew_s) == pytest.approx(expected[::2], nan_ok=True)
    assert temperatures == expected[1]


def test_the_nearest_reading_is_taken_and_a_stale_one_is_not(housing):
    for at in (0.0, 10.0, 20.0):
        housing.add("housing", reading(at))
    assert housing.nearest("housing", 14.0) == reading(10.0)
    assert housing.nearest("housing", 16.0) == reading(20.0)
    assert housing.nearest("housing", 35.1) is None


def test_a_channel_that_is_missing_is_logged_once_and_in_the_status(housing, caplog):
    for k in range(3):
        housing.add("housing", Reading({"lens": 20.0}, k, k, {"air": "an open wire"}))
    assert caplog.text.count("an open wire") == 1
    assert housing.missing("housing") == ["an open wire"]
    housing.add("housing", Reading({"lens": 20.0, "air": 5.0}, 9.0, 9.0))
    assert housing.missing("housing") == []


def test_a_reading_that_is_being_taken_is_waited_for(housing):
    housing.add("housing", reading(0.0))
    late = threading.Timer(0.05, lambda: housing.add("housing", reading(10.4)))
    late.start()
    _, _, skew_s = housing.around(["housing"], 10.0, patience_s=5.0)
    late.join()
    assert skew_s == reading(10.4).monotonic - 10.0
    _, temperatures, _ = housing.around(["housing"], 40.0, patience_s=0.0)
    assert temperatures == pytest.approx({"temperature": math.nan}, nan_ok=True)
