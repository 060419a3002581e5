"""Random configurations and logger files: refused with one line, or right.

Few examples here, thousands in the slow suite.
"""

from __future__ import annotations

import contextlib
import copy
import math
import re
from datetime import UTC, datetime, timedelta, timezone
from functools import reduce
from operator import getitem
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from thermocald.config import Config, load_config, parse_config
from thermocald.errors import ConfigurationError, ThermocaldError
from thermocald.hal import load_driver
from thermocald.store.logger.clock import DeviceClock, time_zone
from thermocald.store.logger.options import LogOptions
from thermocald.store.logger.temperatures import read_log

FEW = {"max_examples": 25, "deadline": None, "derandomize": True,
       "suppress_health_check": [HealthCheck.function_scoped_fixture]}  # fmt: skip
AMOUNTS = pytest.mark.parametrize(
    "amount",
    [
        pytest.param(FEW, id="few"),
        pytest.param({**FEW, "max_examples": 2000}, id="many", marks=pytest.mark.slow),
    ],
)


def one_line(error: ThermocaldError) -> None:
    """Check that a refusal can be read by a person."""
    assert len(str(error).splitlines()) == 1
    assert "Traceback" not in str(error)
    assert len(str(error)) < 1000


# --- configurations ----------------------------------------------------------------------

SHIPPED = Path(__file__).parents[1] / "config.yaml"
NUMBERS = st.sampled_from(
    [0, -1, 1, 0.5, 1e308, -1e308, 5e-324, 2**63, 10**400, math.nan, math.inf, -0.0, 1e-300]
)
TEXTS = st.one_of(
    st.text(max_size=12),
    st.sampled_from(
        ["", " ", "yes", "null", "1e3", "0x18", "/dev/null", "..", "a\0b", "°C", "a/b"]
    ),
)
VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, TEXTS),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=6), inner, max_size=3)
    ),
    max_leaves=5,
)


def places(document, path=()):
    """Return all places of a document that hold a value."""
    items = document.items() if isinstance(document, dict) else enumerate(document)
    for key, value in items:
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from places(value, (*path, key))


WHOLE = load_config(SHIPPED, load_driver).model_dump(mode="json", by_alias=True)
PLACES = list(places(WHOLE))


@AMOUNTS
def test_any_value_anywhere_in_a_configuration(amount):
    @settings(**amount)
    @given(st.lists(st.tuples(st.sampled_from(PLACES), VALUES), min_size=1, max_size=3))
    def check(changes):
        document = copy.deepcopy(WHOLE)
        for path, value in changes:
            with contextlib.suppress(LookupError, TypeError):  # removed by an earlier change
                reduce(getitem, path[:-1], document)[path[-1]] = value
        try:
            config = parse_config(document, SHIPPED, load_driver=load_driver)
        except ConfigurationError as error:
            one_line(error)
            return
        again = config.model_dump(mode="json", by_alias=True)
        # as text: an option that is no finite number, which its driver refuses, is null in JSON
        first, second = (
            re.sub(r"-?\b(nan|inf)\b", "None", repr(c))
            for c in (config, parse_config(again, SHIPPED, load_driver=load_driver))
        )
        assert first == second
        for number in numbers(config):
            assert math.isfinite(number)

    check()


def numbers(config: Config):
    """Return all numbers that the program reads itself; a driver checks its own options."""
    stack = [config.model_dump(exclude={"cameras", "thermometers", "outputs"})]
    while stack:
        value = stack.pop()
        if isinstance(value, dict | list | tuple):
            stack += value.values() if isinstance(value, dict) else value
        elif isinstance(value, float):
            yield value


# --- logger files ------------------------------------------------------------------------

START = datetime(2026, 2, 27, 21, 58, 20, tzinfo=UTC)  # through midnight and a month's end
DATES = [
    "%Y-%m-%d %H:%M:%S", "%d.%m.%Y %H:%M:%S", "%Y/%m/%d %H:%M:%S", "%Y-%m-%dT%H:%M:%S",
    "%d/%m/%Y %H:%M:%S", "%m/%d/%Y %I:%M:%S %p", "%d %b %Y %H:%M:%S", "unix", "ms",
]  # fmt: skip
HEADERS = {
    "C": ["Temp (°C)", "Temperature", "T_housing degC", "Sensor 1", "Temperatur °C", "temp_c"],
    "F": ["Temp (°F)", "Temperature, F", "TempF", "degF temp"],
    "K": ["T [K]", "Temperature (K)"],
}
LOGS = st.fixed_dictionaries(
    {
        "date": st.sampled_from(DATES),
        "unit": st.sampled_from("CCCFK"),
        "header": st.integers(0, 5),
        "separator": st.sampled_from([",", ";", "\t", "|"]),
        "comma": st.booleans(),
        "encoding": st.sampled_from(["utf-8", "utf-8-sig", "latin-1", "utf-16"]),
        "end": st.sampled_from(["\n", "\r\n"]),
        "step": st.sampled_from([1, 10, 60, 300]),
        "zone_h": st.sampled_from([0, 1, -5, 9]),
        "preamble": st.integers(0, 3),
        "footer": st.booleans(),
        "humidity": st.booleans(),
        "setpoint": st.booleans(),
        "missing": st.sets(st.integers(0, 59), max_size=5),
        "word": st.sampled_from(["", "NaN", "---", "unavailable", "-127.0", "error"]),
        "spikes": st.sets(st.sampled_from([0, 7, 20, 21, 40, 59]), max_size=3),
        "spike": st.sampled_from([85.0, 0.0, -40.0, 127.94]),
        "switch": st.sampled_from([None, None, None, 10, 30, 50]),
        "seed": st.integers(0, 10**6),
    }
)


def written(log: dict, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The file of a logger; true times (60,) s and °C."""
    rng = np.random.default_rng(log["seed"])
    celsius = 22.0 + np.cumsum(rng.normal(0.02, 0.05, 60))
    moments = [START + timedelta(seconds=log["step"] * i) for i in range(60)]
    zone = timezone(timedelta(hours=log["zone_h"]))
    point = "," if log["comma"] and log["separator"] != "," else "."

    def number(value: float, unit: str) -> str:
        shown = {"C": value, "F": 1.8 * value + 32.0, "K": value + 273.15}[unit]
        return f"{shown:.2f}".replace(".", point)

    names = HEADERS[log["unit"]]
    rows = [["Logger no. 7", "firmware 2"]] * log["preamble"]
    more = ["Humidity %"] * log["humidity"] + ["Setpoint (°C)"] * log["setpoint"]
    rows.append(["Date Time", names[log["header"] % len(names)], *more])
    more = ["55"] * log["humidity"] + [number(40.0, "C")] * log["setpoint"]
    for i, moment in enumerate(moments):
        seconds = int(moment.timestamp())
        when = {"unix": str(seconds), "ms": str(1000 * seconds)}.get(
            log["date"], moment.astimezone(zone).strftime(log["date"])
        )
        unit = log["unit"]
        if log["switch"] is not None and i >= log["switch"]:
            unit = "C" if unit == "F" else "F"
        value = number(log["spike"] if i in log["spikes"] else celsius[i], unit)
        rows.append([when, log["word"] if i in log["missing"] else value, *more])
    if log["footer"]:
        rows.append(["Average", number(22.0, log["unit"]), *[""] * len(more)])
    lines = [log["separator"].join(cells) for cells in rows]
    path.write_bytes(log["end"].join([*lines, ""]).encode(log["encoding"], errors="replace"))
    return np.array([m.timestamp() for m in moments]), celsius


@AMOUNTS
def test_any_file_of_a_logger(amount, tmp_path):
    """Each reading is right and at the right time, or missing, or the file is refused."""
    path = tmp_path / "log.csv"
    read = []

    @settings(**amount)
    @given(LOGS)
    def check(log):
        true_times, celsius = written(log, path)
        clock = DeviceClock(zone=time_zone(f"{log['zone_h']:+03d}:00"))
        near = (float(true_times[0]), float(true_times[-1]))
        try:
            found = read_log(path, LogOptions(clock=clock), near)
        except ThermocaldError as error:
            one_line(error)
            return
        assert log["switch"] is None, found.notes
        read.append(1)
        row = np.searchsorted(true_times, found.times)
        assert np.array_equal(true_times[row], found.times)
        (values,) = found.channels.values()
        known = np.isfinite(values)
        assert np.abs(values[known] - celsius[row][known]).max() < 0.02
        expected = {*range(60)} - log["missing"] - log["spikes"]
        assert set(row[known].tolist()) == expected

    check()
    assert len(read) > amount["max_examples"] // 5  # else nothing was shown
