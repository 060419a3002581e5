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


def test_frame_and_reading_keep_their_own_times():
    paired = pair_readings({"housing": reading(10.75, temperature=21.5)}, 10.0)
    assert paired.utc == 1.6e9 + 10.75
    assert paired.temperatures == {"temperature": 21.5}
    assert paired.skew_s == 0.75


def test_several_thermometers_have_columns_of_their_own_and_the_first_gives_the_time():
    paired = pair_readings(
        {
            "housing": reading(9.0, temperature=21.5),
            "phone": reading(10.0, temperature=30.0, battery=33.0),
        },
        10.0,
    )
    assert paired.temperatures == {"housing": 21.5, "phone": 30.0, "phone_battery": 33.0}
    assert paired.skew_s == -1.0


def test_without_the_reference_the_next_one_gives_the_time_and_nothing_is_filled_in():
    paired = pair_readings({"housing": None, "air": reading(10.5, temperature=5.0)}, 10.0)
    assert paired.temperatures == {"air": 5.0}
    assert paired.skew_s == 0.5
    nothing = pair_readings({"housing": None}, 10.0)
    assert math.isnan(nothing.utc)
    assert nothing.temperatures == {}


def test_the_nearest_reading_is_taken_and_a_stale_one_is_not(housing):
    for at in (0.0, 10.0, 20.0):
        housing.add("housing", reading(at))
    assert housing.nearest("housing", 14.0) == reading(10.0)
    assert housing.nearest("housing", 16.0) == reading(20.0)
    assert housing.nearest("housing", 35.1) is None


def test_a_reading_that_is_being_taken_is_waited_for(housing):
    housing.add("housing", reading(0.0))
    late = threading.Timer(0.05, lambda: housing.add("housing", reading(10.4)))
    late.start()
    paired = housing.around(["housing"], 10.0, patience_s=5.0)
    late.join()
    assert paired.skew_s == reading(10.4).monotonic - 10.0
    (missing,) = housing.around(["housing"], 40.0, patience_s=0.0).temperatures.values()
    assert math.isnan(missing)
