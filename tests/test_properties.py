"""Random configurations, recordings and logger files: refused with one line, or
right, or reported as doubtful. Few examples here, thousands in the slow suite.
"""

from __future__ import annotations

import contextlib
import copy
import math
import re
import shutil
import time
from datetime import UTC, datetime, timedelta, timezone
from functools import reduce
from operator import getitem
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

import thermocald as tc
from thermocald.config import Config, load_config, parse_config
from thermocald.errors import ConfigurationError, ThermocaldError
from thermocald.files import dump_yaml
from thermocald.hal import load_driver
from thermocald.store.logger.clock import DeviceClock, time_zone
from thermocald.store.logger.dialect import LogOptions
from thermocald.store.logger.temperatures import read_log

FEW = {"max_examples": 40, "deadline": None, "derandomize": True,
       "suppress_health_check": [HealthCheck.function_scoped_fixture]}  # fmt: skip
AMOUNTS = pytest.mark.parametrize(
    "amount",
    [
        pytest.param(FEW, id="few"),
        pytest.param({**FEW, "max_examples": 2000}, id="many", marks=pytest.mark.slow),
    ],
)


_RECORDINGS_S = 200.0  # at most


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


@AMOUNTS
def test_any_key_in_a_configuration(amount, tmp_path):
    """An unknown key is an error that names it, wherever it is."""
    mappings = [(), ("store",), ("frames",), ("dashboard",), ("logging",), ("calibration",)]

    @settings(**amount)
    @given(st.sampled_from(mappings), st.text(min_size=1, max_size=8), VALUES)
    def check(path, key, value):
        document = copy.deepcopy(WHOLE)
        at = reduce(getitem, path, document)
        assume(key not in at)
        at[key] = value
        file = tmp_path / "config.yaml"
        try:
            file.write_text(dump_yaml(document), encoding="utf-8")
        except (UnicodeError, OverflowError):
            assume(False)
        with pytest.raises(ConfigurationError) as caught:
            load_config(file, load_driver)
        one_line(caught.value)

    check()


# --- recordings --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A recording of 12 epochs, its tables, and its calibration."""
    path = tmp_path_factory.mktemp("recorded") / "M"
    tc.simulate("rpi-v2.1-heating", seed=5, out=path)
    tables = {}
    for name in ("epochs.csv", "observations.csv", "testfield.csv"):
        header, *rows = [line.split(",") for line in (path / name).read_text().splitlines()]
        if name != "testfield.csv":
            rows = [row for row in rows if int(row[0]) <= 12]
        tables[name] = (header, rows)
        write(path / name, header, rows)
    return path, tables, tc.open(path).calibrate()


def write(path: Path, header: list[str], rows: list[list[str]]) -> None:
    path.write_text("".join(",".join(row) + "\n" for row in [header, *rows]))


def times(factor: float, shift: float = 0.0):
    return lambda text: f"{float(text) * factor + shift:.15g}" if text else text


MEANINGS = st.one_of(
    st.sampled_from([1e3, 1e-3, 1e6, 1e9, 0.5, 2.0, -1.0, 1 / 60, 25.4, 0.00112, 1e-300]).map(
        times
    ),
    st.sampled_from([1.8, 1.0]).map(lambda f: times(f, 32.0 if f > 1 else 273.15)),
    st.sampled_from(["85.0", "0", "-1", "1e308", "1e-300", "-127.0", "", "nan", "1e5", "4e9"]).map(
        lambda value: lambda _: value
    ),
)
COLUMNS = [
    ("observations.csv", "x"), ("observations.csv", "y"), ("observations.csv", "sx"),
    ("observations.csv", "sy"), ("epochs.csv", "frame_time"), ("epochs.csv", "temperature_time"),
    ("epochs.csv", "temperature"), ("testfield.csv", "X"), ("testfield.csv", "Z"),
    ("testfield.csv", "sY"),
]  # fmt: skip
SPANS = st.tuples(st.floats(0, 1), st.sampled_from([0.0, 0.01, 0.1, 0.5, 1.0]))
HEADS = st.one_of(
    st.none(),
    st.tuples(
        st.sampled_from(["width", "height", "pixel_pitch", "principal_distance", "interval"]),
        st.sampled_from([0.5, 2.0, 10.0, 0.1, 1e300, 1e-300, -1.0]),
    ),
)


@pytest.mark.slow
def test_any_other_meaning_of_a_recording(recorded, tmp_path):
    """A column in another unit or with other values, in all rows or some: the calibration agrees
    with the original, or the recording is refused, or a doubt is reported.
    """
    source, tables, right = recorded
    folder = tmp_path / "M"
    tried: list[int] = []

    end = time.monotonic() + _RECORDINGS_S

    # each costs a series
    @settings(**{**FEW, "max_examples": 343})
    @given(st.sampled_from(COLUMNS), MEANINGS, SPANS, HEADS)
    def check(place, meaning, span, head):
        if time.monotonic() > end:
            return
        tried.append(1)
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(source, folder)
        name, column = place
        header, rows = tables[name]
        k = header.index(column)
        first = round(span[0] * len(rows))
        stop = first + max(1, round(span[1] * len(rows)))
        changed = [
            [*row[:k], meaning(row[k]), *row[k + 1 :]] if first <= i < stop else row
            for i, row in enumerate(rows)
        ]
        write(folder / name, header, changed)
        if head is not None:
            text = (folder / "recording.yaml").read_text()
            found = re.search(rf"{head[0]}: ([\d.]+)", text)
            value = float(found[1]) * head[1]
            stated = (
                str(int(value)) if head[0] in ("width", "height") and abs(value) < 1e9 else value
            )
            (folder / "recording.yaml").write_text(
                text.replace(found[0], f"{head[0]}: {stated}", 1)
            )
        try:
            series = tc.open(folder)
            epochs = series.calibrate()
        except ThermocaldError as error:
            one_line(error)
            return
        if not epochs.ok.all() or series.doubts(epochs):
            return
        if np.nanmedian(epochs.sigma0) > 5.0 * np.nanmedian(right.sigma0):
            return  # printed as: the image points' scatter over the stated one
        pitch = series.head.camera.sensor.pixel_pitch / 0.00112
        values, sds = np.median(epochs.values, axis=0), np.median(epochs.sd, axis=0)
        assert 0.8 < values[0] / 3.04 < 1.25
        for i in range(3):
            true = float(np.median(right.values[:, i])) * pitch
            allowed = 8.0 * max(sds[i], np.median(right.sd[:, i]) * pitch) + 0.1 * abs(pitch - 1.0)
            assert abs(values[i] - true) < max(allowed, 0.01)

    check()
    assert len(tried) > 8  # else nothing was shown


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
    comma = log["comma"] and log["separator"] != ","

    def number(value: float, unit: str) -> str:
        shown = {"C": value, "F": 1.8 * value + 32.0, "K": value + 273.15}[unit]
        return f"{shown:.2f}".replace(".", ",") if comma else f"{shown:.2f}"

    names = HEADERS[log["unit"]]
    header = ["Date Time", names[log["header"] % len(names)]]
    header += ["Humidity %"] * log["humidity"] + ["Setpoint (°C)"] * log["setpoint"]
    lines = [f"Logger no. 7{log['separator']}firmware 2"] * log["preamble"]
    lines.append(log["separator"].join(header))
    for i, moment in enumerate(moments):
        seconds = int(moment.timestamp())
        when = {"unix": str(seconds), "ms": str(1000 * seconds)}.get(
            log["date"], moment.astimezone(zone).strftime(log["date"])
        )
        unit = log["unit"]
        if log["switch"] is not None and i >= log["switch"]:
            unit = "C" if unit == "F" else "F"
        value = number(log["spike"] if i in log["spikes"] else celsius[i], unit)
        cells = [when, log["word"] if i in log["missing"] else value]
        cells += ["55"] * log["humidity"] + [number(40.0, "C")] * log["setpoint"]
        lines.append(log["separator"].join(cells))
    if log["footer"]:
        lines.append(
            log["separator"].join(["Average", number(22.0, log["unit"]), *[""] * (len(header) - 2)])
        )
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
