"""Times of loggers: zones, the hours that daylight saving repeats or skips, forms of a date."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from tests.store.test_logger import BERLIN, HOBO, TIMES, logged, read
from thermocald.errors import DataError, UsageError
from thermocald.store.logger.clock import DeviceClock, clock_error, parse_moment, time_zone
from thermocald.store.logger.photographs import find_photographs


def at(*times: str) -> str:
    """Return a log of the morning on which clocks are put back."""
    return "time;temp\n" + "".join(f"2026-10-25 {time};20,5\n" for time in times)


def test_the_hour_that_comes_twice(tmp_path):
    twice = at("01:50", "02:20", "02:50", "02:20", "02:50", "03:10")
    with pytest.raises(DataError, match=r"line 3: 2026-10-25 02:20:00 exists twice .*--ambiguous"):
        logged(tmp_path, twice)
    start = datetime(2026, 10, 24, 23, 50, tzinfo=UTC).timestamp()
    found = logged(tmp_path, twice, clock=replace(BERLIN, ambiguous="order")).times
    assert ((found - start) / 60).tolist() == [0, 30, 60, 90, 120, 140]
    once = at("01:50", "02:20", "02:50", "03:10")
    with pytest.raises(DataError, match="order of the rows does not show"):
        logged(tmp_path, once, clock=replace(BERLIN, ambiguous="order"))
    for chosen, minutes in (("later", [0, 90, 120, 140]), ("earlier", [0, 30, 60, 140])):
        found = logged(tmp_path, once, clock=replace(BERLIN, ambiguous=chosen)).times
        assert ((found - start) / 60).tolist() == minutes


@pytest.mark.parametrize("form", [
    "%Y-%m-%d %H:%M:%S", "%m/%d/%Y %I:%M:%S %p", "%d.%m.%Y %H:%M:%S:25", "%Y-%m-%d %H:%M:%S+02:00",
])  # fmt: skip
def test_seconds_count_from_their_minute_also_in_the_hour_that_comes_twice(tmp_path, form):
    """The minutes of such an hour are written alike, but are two."""
    zone = time_zone("+02:00") if form.endswith("+02:00") else BERLIN.zone
    times = datetime(2026, 10, 24, 23, 50, 7, tzinfo=UTC).timestamp() + 20.0 * np.arange(600)
    rows = [f"{datetime.fromtimestamp(t, zone):{form}};21.5" for t in times]
    clock = replace(BERLIN, ambiguous="order")
    found = logged(tmp_path, "\n".join(["time;T °C", *rows, ""]), clock=clock)
    assert np.array_equal(found.times, times + (0.25 if form.endswith("25") else 0.0))


def test_the_hour_that_does_not_exist_names_the_fixed_zone(tmp_path):
    data = "time;temp\n2026-03-29 01:50;20,5\n2026-03-29 02:20;20,5\n"
    with pytest.raises(DataError, match=r"does not exist in Europe/Berlin.*\+01:00"):
        logged(tmp_path, data)
    winter = logged(tmp_path, data, clock=DeviceClock(time_zone("+01:00")))
    assert np.diff(winter.times) == 1800


def test_a_clock_that_was_ahead_was_later():
    texts = {"+00:03:12": 192, "-00:03:12": -192, "12:30": 750, "+4.5": 4.5, "-2s": -2}
    for text, seconds in texts.items():
        clock = DeviceClock(UTC, clock_error(text))
        assert clock.utc([datetime(1970, 1, 2)], str) == 86400 - seconds


NOON_IN_BERLIN = (
    "Sun Jun 14 12:00:00 CEST 2026", "So 14. Jun 12:00:00 CEST 2026", "2026-06-14 12:00 MESZ",
    "Sun Jun 14 12:00:00 PM CEST 2026", "Sun 14 Jun 11:00:00 BST 2026",
    "dom 14 giu 2026, 12:00:00, CEST",
)  # fmt: skip


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2026:06:14 12:00:01", datetime(2026, 6, 14, 12, 0, 1)),
        ("06.14.26 12:00:03,5", datetime(2026, 6, 14, 12, 0, 3, 500000)),
        ("20260614_120001", datetime(2026, 6, 14, 12, 0, 1)),
        ("6/14/2026 12:02 AM", datetime(2026, 6, 14, 0, 2)),
        ("6/14/2026 12:02 p. m.", datetime(2026, 6, 14, 12, 2)),
        ("2026-06-30 24:00", datetime(2026, 7, 1)),
        ("Sun Jun 14 12:00:00 2026", datetime(2026, 6, 14, 12)),
        *((text, datetime(2026, 6, 14, 10, tzinfo=UTC)) for text in NOON_IN_BERLIN),
    ],
)
def test_moments(text, expected):
    found = parse_moment(text, "mdy")
    assert found == expected
    assert (found.utcoffset() is None) == (expected.utcoffset() is None)


NONE = [
    *((clock_error, text, UsageError, r"HH:MM:SS")
      for text in ("three", "1:2:3:4", "+", "00:03:12 ahead")),
    *((time_zone, text, UsageError, "time zone")
      for text in ("Europe/Nowhere", "CEST!", "+99:00", "../../etc/passwd", "")),
    *((parse_moment, text, ValueError, r".")
      for text in ("2026-13-01 12:00", "25:00:00", "tomorrow", "", "2026-06-14 12",
                   "2026-06-14 24:00:01", "9999-12-31 24:00")),
    (find_photographs, [], DataError, "no photographs are given"),
]  # fmt: skip


@pytest.mark.parametrize(("parse", "text", "error", "words"), NONE)
def test_what_is_none_is_refused(parse, text, error, words):
    with pytest.raises(error, match=words):
        parse(text)


@pytest.mark.parametrize(("head", "offset_h", "zone"), [
    ("Zeit (MEZ)", 1, "Europe/Berlin"), ("timestamp_utc", 0, "Europe/Berlin"),
    ("Time (EST/EDT)", -4, "America/New_York"), ("Time (CST/CDT)", -5, "America/Chicago"),
    ("Time (CST)", 8, "Asia/Shanghai"), ("Time, GMT-03:30", -3.5, "Europe/Berlin"),
    ("Time zone: (UTC+01:00) Berlin, Rome\nTime", 2, "Europe/Berlin"),
])  # fmt: skip
def test_the_zone_in_the_head_of_the_times_is_theirs(tmp_path, head, offset_h, zone):
    rows = [f"{datetime.fromtimestamp(t + 3600 * offset_h, UTC):%Y-%m-%d %X};21.5" for t in TIMES]
    found = read(tmp_path, f"{head};T °C", rows, clock=DeviceClock(time_zone(zone)))
    assert found.times.tolist() == TIMES
    used = "(CST)" not in head and "Berlin" not in head
    assert used == any("gives the time zone" in note for note in found.notes)


def test_a_zone_that_is_given_for_the_logger_overrules_that_of_its_head(tmp_path):
    clock = DeviceClock(time_zone("+03:00"), forced=True)
    forced = read(tmp_path, HOBO, "{i},{b:%m/%d/%Y %H:%M:%S},{t:.2f}", clock=clock)
    assert [time + 3600 for time in forced.times] == TIMES
    assert any("is used instead" in note for note in forced.notes)
