"""Files of loggers as the vendors' programs write them are read right, or called doubtful."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from thermocald.errors import DataError
from thermocald.store.logger.clock import DeviceClock, time_zone
from thermocald.store.logger.dialect import LogOptions
from thermocald.store.logger.temperatures import read_log

START = datetime(2026, 7, 6, 13, 55, tzinfo=UTC)
MOMENTS = [START + timedelta(seconds=60 * i) for i in range(12)]
CELSIUS = [21.5 + 0.1 * i for i in range(12)]
NEAR = (MOMENTS[0].timestamp(), MOMENTS[-1].timestamp())


def read(path, head, row, unit="", zone="UTC"):
    """Read a log of a head and one row per moment, °C and number."""
    rows = [row(m, t, i) for i, (m, t) in enumerate(zip(MOMENTS, CELSIUS, strict=True))]
    path.write_bytes("\r\n".join([*head, *rows, ""]).encode())
    options = LogOptions(clock=DeviceClock(zone=time_zone(zone)), unit=unit or None)
    return read_log(path, options, NEAR)


DIALECTS = {
    "Onset, twelve hours": (
        ["#,Date-Time (UTC),Ch: 1 - Temperature   (°C )"],
        lambda m, t, i: f"{i + 1},{m:%m/%d/%Y %I:%M:%S %p},{t:.2f}"),
    "Ruuvi": (["Date,Temperature (°C),Humidity (%),RSSI (dBm)"],
              lambda m, t, i: f"{m:%Y-%m-%dT%H:%M:%S.000Z},{t:.2f},50.1,-60"),
    "Tinytag": (["Record,Date,Time,Temperature"],
                lambda m, t, i: f"{i + 1},{m:%d %b %Y},{m:%H:%M:%S},{t:.2f} °C"),
    "InfluxDB in ns": (["name,time,value"],
                       lambda m, t, i: f"temp,{int(m.timestamp())}000000000,{t:.2f}"),
    "InfluxDB in µs": (["name,time,value"],
                       lambda m, t, i: f"temp,{int(m.timestamp())}000000,{t:.2f}"),
    "HOBOconnect, in Eastern standard time": (
        ["#,Date-Time (EST),Temperature (°F)"],
        lambda m, t, i: f"{i + 1},{m - timedelta(hours=5):%m/%d/%Y %H:%M:%S},{1.8 * t + 32:.2f}"),
    "a zone above the table": (
        ["Elitech RC-5", "Time zone: UTC+08:00", "No.;Time;Temperature(°C)"],
        lambda m, t, i: f"{i + 1};{m + timedelta(hours=8):%Y-%m-%d %H:%M:%S};{t:.2f}"),
    "a compact date": (
        ["No.,Date,Time,Temp °C"], lambda m, t, i: f"{i + 1},{m:%Y%m%d},{m:%H:%M:%S},{t:.2f}"),
    "Excel in French": (
        ["Date (UTC);Température"],
        lambda m, t, i: f"{m.day} juil. {m:%Y %H:%M:%S};{t:.2f}".replace(".", ",").replace(
            "juil,", "juil.")),
    "Campbell TOA5, a mean": (
        ['"TOA5","river","CR1000X"', '"TIMESTAMP","RECORD","BattV_Min","AirT_Avg","AirT_Max"',
         '"TS","RN","Volts","Deg C","Deg C"', '"","","Min","Avg","Max"'],
        lambda m, t, i: f'"{m:%Y-%m-%d %H:%M:%S}",{i},12.7,{t:.2f},{t + 1:.2f}'),
    "least, most and mean": (
        ["time,T max °C,T min °C,T avg °C"],
        lambda m, t, i: f"{int(m.timestamp())},{t + 0.5:.2f},{t - 0.5:.2f},{t:.2f}"),
}  # fmt: skip


@pytest.mark.parametrize("name", DIALECTS)
def test_it_is_read_without_a_question(tmp_path, name):
    found = read(tmp_path / "log.csv", *DIALECTS[name])
    assert found.times.tolist() == [m.timestamp() for m in MOMENTS]
    (values,) = found.channels.values()
    assert np.abs(values - CELSIUS).max() < 0.006
    assert not [note for note in found.notes if "doubtful" in note]


@pytest.mark.parametrize(
    ("head", "offset_h", "zone"),
    [
        ("Zeit (MEZ)", 1, "Europe/Berlin"),
        ("timestamp_utc", 0, "Europe/Berlin"),
        ("Time (EST/EDT)", -4, "America/New_York"),
        ("Time (CST/CDT)", -5, "America/Chicago"),
        ("Time (CST)", 8, "Asia/Shanghai"),
        ("Time, GMT-03:30", -3.5, "Europe/Berlin"),
        ("Time zone: (UTC+01:00) Berlin, Rome\r\nTime", 2, "Europe/Berlin"),
    ],
)
def test_the_zone_in_the_head_of_the_times_is_theirs(tmp_path, head, offset_h, zone):
    def row(m, t, i):
        return f"{m + timedelta(hours=offset_h):%Y-%m-%d %H:%M:%S};{t:.2f}"

    found = read(tmp_path / "log.csv", [f"{head};T °C"], row, zone=zone)
    assert found.times.tolist() == [m.timestamp() for m in MOMENTS]
    used = "(CST)" not in head and "Berlin" not in head
    assert used == any("gives the time zone" in note for note in found.notes)


@pytest.mark.parametrize("head", ["time;RH %;T °C", "time;T °F"])
def test_another_head_below_is_refused(tmp_path, head):
    """A file of two logs: below the second head the columns are others."""

    def row(m, t, i):
        below = f"{head}\r\n" if i == 6 else ""
        return f"{below}{m:%Y-%m-%d %H:%M:%S};{t:.2f}"

    heads = ["time;T °C", *(f"2026-07-06 13:{i}:00;21.4" for i in range(30, 45))]
    with pytest.raises(DataError, match="line 23: another head begins here"):
        read(tmp_path / "log.csv", heads, row)
    found = read(tmp_path / "log.csv", heads, lambda m, t, i: row(m, t, i).replace(head, heads[0]))
    assert len(found.times) == 27


def test_a_row_that_is_cut_off_is_left_out(tmp_path):
    path = tmp_path / "log.csv"
    read(path, ["time,T °C"], lambda m, t, i: f"{int(m.timestamp())},{t:.2f}")
    path.write_bytes(path.read_bytes()[:-5])  # of 22.60 is left 22
    found = read_log(path)
    assert found.times.tolist() == [m.timestamp() for m in MOMENTS[:-1]]
    assert "the last row is cut off" in found.notes[-1]


def test_rows_without_seconds_are_doubtful(tmp_path):
    found = read(
        tmp_path / "log.csv",
        ["time,T °C"],
        lambda m, t, i: f"{START + timedelta(seconds=60 * (i // 6)):%Y-%m-%d %H:%M},{t}",
    )
    assert "doubtful: 10 rows with the time of the row before" in found.notes[-1]
    assert "the times have no seconds" in found.notes[-1]


@pytest.mark.parametrize("head", ["temp", "T1", "Sensor 1", "value"])
def test_fahrenheit_without_a_unit_is_doubtful(tmp_path, head):
    def row(m, t, i):
        return f"{int(m.timestamp())},{1.8 * t + 32:.2f}"

    found = read(tmp_path / "log.csv", [f"time,{head}"], row)
    (note,) = [note for note in found.notes if "doubtful" in note]
    assert "70.7 is taken as °C; if it is °F, it is 21.5 °C: give --unit" in note
    found = read(tmp_path / "log.csv", [f"time,{head}"], row, "degF")
    assert not [note for note in found.notes if "doubtful" in note]
    assert next(iter(found.channels.values()))[0] == pytest.approx(21.5)


@pytest.mark.parametrize("value", ["85.00", "0.0", "127.94", "-40.0", "125.00", "-45.00"])
def test_a_log_of_nothing_but_what_is_no_measurement_is_doubtful(tmp_path, value):
    found = read(
        tmp_path / "log.csv", ["time,temp °C"], lambda m, t, i: f"{int(m.timestamp())},{value}"
    )
    (note,) = [note for note in found.notes if "doubtful" in note]
    assert f"all 12 readings are {float(value):g} °C" in note


@pytest.mark.parametrize("factor", [1000, 10])
def test_thousandths_and_tenths_are_refused(tmp_path, factor):
    with pytest.raises(DataError, match="Another unit"):
        read(
            tmp_path / "log.csv",
            ["time,temp"],
            lambda m, t, i: f"{int(m.timestamp())},{round(factor * t)}",
        )


@pytest.mark.parametrize("head", ["Pt100 mV", "Sensor Ohm", "T W/m²", "Delta T K", "T diff", "dT"])
def test_a_column_of_another_quantity_is_no_temperature(tmp_path, head):
    def row(m, t, i):
        return f"{int(m.timestamp())};{t:.2f}"

    with pytest.raises(DataError, match="which column is the temperature"):
        read(tmp_path / "log.csv", [f"time;{head}"], row)
    found = read(
        tmp_path / "log.csv", [f"time;{head};T °C"], lambda m, t, i: f"{row(m, 2, i)};{t:.2f}"
    )
    assert list(found.channels) == ["T"]


def test_hours_without_am_and_pm_are_doubtful(tmp_path):
    found = read(
        tmp_path / "log.csv",
        ["time,T °C"],
        lambda m, t, i: f"{m - timedelta(minutes=60):%d.%m.%Y %I:%M},{t}",
    )
    (note,) = [note for note in found.notes if "doubtful" in note]
    assert "run back 1 time, the first by 43140 s" in note


def test_rows_before_the_clock_was_set_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"line 4, column 'time': is 26 years after the row before"):
        read(
            tmp_path / "log.csv",
            ["time,T °C"],
            lambda m, t, i: f"{m.replace(year=2026 if i > 1 else 2000):%Y-%m-%d %H:%M},{t}",
        )


def test_a_time_of_unknown_form_is_shown(tmp_path):
    with pytest.raises(DataError, match=r"as in 2026-06-14 12:00:00; .*'time': 13:55; 'T °C': 21"):
        read(tmp_path / "log.csv", ["time,T °C"], lambda m, t, i: f"{m:%H:%M},{t}")


def test_the_minus_of_scandinavian_spreadsheets_is_one(tmp_path):
    found = read(
        tmp_path / "log.csv",
        ["time;T °C"],
        lambda m, t, i: f"{m:%Y-%m-%d %H:%M};−{t:.1f}".replace(".", ","),
    )
    assert found.channels["T"] == pytest.approx(-np.array(CELSIUS))
