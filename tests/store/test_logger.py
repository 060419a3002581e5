"""Dialects, units and times of loggers: right, or refused with the option that decides."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from thermocald.errors import DataError, UsageError
from thermocald.numbers import stated_unit
from thermocald.store.logger.clock import DeviceClock, clock_error, parse_moment, time_zone
from thermocald.store.logger.options import LogOptions, log_options
from thermocald.store.logger.photographs import find_photographs
from thermocald.store.logger.temperatures import read_log
from thermocald.store.recording.reader import interpolate_readings

BERLIN = DeviceClock(time_zone("Europe/Berlin"))
START = datetime(2026, 7, 6, 13, 55, tzinfo=UTC)
MOMENTS = [START + timedelta(seconds=60 * i) for i in range(12)]
TIMES = [moment.timestamp() for moment in MOMENTS]
CELSIUS = [21.5 + 0.1 * i for i in range(12)]


def logged(folder, data, near=None, **options):
    path = folder / "log.csv"
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return read_log(path, LogOptions(**{"clock": BERLIN, **options}), near)


def rows_of(row: str, celsius=CELSIUS) -> list[str]:
    """Return a row per moment: m in UTC, b in Berlin, e in New York, s since 1970; t °C, f °F."""
    return [
        row.format(m=m, b=m + timedelta(hours=2), e=m - timedelta(hours=5), s=int(m.timestamp()),
                   t=t, c=f"{t:.2f}".replace(".", ","), f=1.8 * t + 32, k=t + 273.15, i=i + 1,
                   d10=m.replace(tzinfo=None) + timedelta(hours=10), d=round(10 * t),
                   day=m.timestamp() / 86400 + 25569 + 2 / 24)
        for i, (m, t) in enumerate(zip(MOMENTS, celsius, strict=True))
    ]  # fmt: skip


def read(folder, head, row, *below, encoding="utf-8-sig", **options):
    """Read a log of lines: its head, a row per moment, some below; of the photographs' time."""
    rows = row if isinstance(row, list) else rows_of(row)
    text = "\r\n".join([*head.split("\n"), *rows, *below, ""]).removeprefix("\r\n")
    return logged(folder, text.encode(encoding), (TIMES[0], TIMES[-1]), **options)


HOBO = '"Plot Title: x"\n"#","Date Time, GMT+02:00","Temp, °C (LGR S/N: 1, LBL: housing)"'
# as in vendors' manuals and programs: the head, a row, lines below
LOGS = {
    "Berlin, German": ("Datum;Uhrzeit;Temperatur °C;F %", "{b:%d.%m.%Y};{b:%H:%M:%S};{c};40,1"),
    "tabs": ("time\ttemperature", "{b:%Y-%m-%d %H:%M:%S}\t{c}"),
    "quoted decimal commas": ("time,temperature", '{b:%Y-%m-%d %H:%M:%S},"{c}"'),
    "the minus of spreadsheets": ("time;T;Feuchte", "{b:%Y-%m-%d %H:%M};{c};−5,5"),
    "offset in the times": ("time;temperature", "{b:%Y-%m-%d %H:%M:%S}+0200;{t:.2f}"),
    "milliseconds": ("time,temp", "{s}000,{t:.2f}"),
    "InfluxDB in ns": ("name,time,value", "temp,{s}000000000,{t:.2f}"),
    "InfluxDB in µs": ("name,time,value", "temp,{s}000000,{t:.2f}"),
    "InfluxDB, annotated": (  # _start is that of the query
        "#group,true,false,false\n#datatype,dateTime,dateTime,double\n,_start,_time,_value",
        ",2026-06-14T00:00:00Z,{m:%Y-%m-%dT%H:%M:%SZ},{t:.2f}"),
    "InfluxDB, a table of each field": (
        ",_time,_value,_field", [
            *rows_of(",{m:%Y-%m-%dT%H:%M:%SZ},950,pressure"),
            *rows_of(",{m:%Y-%m-%dT%H:%M:%SZ},{t:.2f},box")]),
    "NumPy, savetxt": ("# time temp", "{s:.18e} {t:.18e}"),
    "USGS, a column of zones": (
        "datetime\ttz_cd\tWater temp", "{e:%Y-%m-%d %H:%M}\tEST\t{t:.2f}", "Mean\t\t22.0"),
    "DWD": ("MESS_DATUM;PP_10;TT_10;TD_10", "{b:%Y%m%d%H%M};-999;{t:.2f};13.4"),
    "NOAA, tenths and a code": ("DATE,TMP", '"{m:%Y-%m-%dT%H:%M:%SZ}","+0{d},1"'),
    "Excel in Korean": ("날짜;온도", "{b:%Y-%m-%d} 오후 {b:%I:%M:%S};{t:.2f}"),
    "HOBOware in Swedish": ("#,Datum Tid,Temp", "{i},{b:%m/%d/%y %I:%M:%S} em,{t:.2f}"),
    "each line begins with a mark of UTF-16": ("\ufeffZeit;T °C", "\ufeff{b:%d.%m.%Y %X};{c}"),
    "R leaves out the time of midnight": ("time (UTC+10:00),T °C", [
        row.replace(" 00:00:00", "") for row in rows_of("{d10},{t:.2f}")]),
    "pressures with a mark of thousands": ("Zeit;hPa;T °C", "{b:%d.%m.%Y %X};1.013;{c}"),
    "Windows in Hungarian": ("Dátum;Temp", "{b:%Y. %m. %d. %H:%M:%S};{c}"),
    "spaces, as a shell writes vcgencmd": ("", "{b:%Y-%m-%d %H:%M:%S}  temp={t:.2f}'C"),
    "commas, as a shell writes vcgencmd": ("", "{m:%Y-%m-%dT%H:%M:%S}Z,temp={t:.2f}'C"),
    "a shell's date in German": ("", "Mo {m.day}. Jul {m:%H:%M:%S} UTC {m.year};{t:.2f}"),
    "HOBO": (HOBO, "{i},{b:%m/%d/%y %I:%M:%S %p},{t:.2f}"),
    "HOBOconnect, in Eastern standard time": (
        "#,Date-Time (EST),Temperature (°F)", "{i},{e:%m/%d/%Y %H:%M:%S},{f:.2f}"),
    "Tinytag": ("Record,Date,Time,Temperature", "{i},{b:%d %b %Y},{b:%H:%M:%S},{t:.2f} °C"),
    # EL-USB: day first, the logger's data in the first row only, constant alarm levels
    "Lascar EasyLog": (
        "garden,Time,Celsius(°C),High Alarm,Low Alarm,Serial Number",
        [row + ",1001" * (i == 0) for i, row in enumerate(
            rows_of("{i},{b:%d/%m/%Y %H:%M:%S},{t:.2f},30.0,0.0"))]),
    # Comfort Software: statistics below the rows
    "Testo": (
        "Datum/Zeit;Temperatur[°C];Feuchte[%rF]", "{b:%d.%m.%Y %H:%M:%S};{c};45,1",
        "", "Minimum;21,50;45,0", "Maximum;22,60;45,1", "Mittelwert;22,05;#DIV/0!", "12 Werte;;"),
    "months as words": ("Timestamp,Temperature (C)", '"{b:%b %d, %Y %I:%M %p}",{t:.2f}'),
    # T&D Thermo Recorder: the time again as a spreadsheet's day number
    "T&D Ondotori": ('"Date/Time","Date/Time","No.1"\n"","","Temp.(C)"',
                     '"{b:%Y/%m/%d %H:%M:%S}","{day:.7f}","{t:.2f}"'),
    # Maxim OneWireViewer: the unit in a column
    "Thermochron iButton": (
        "Part Number: DS1922L\nMission Start: Sun Jun 14 11:58 CEST 2026\n\nDate/Time,Unit,Value",
        "{b:%d/%m/%y %I:%M:%S %p},C,{t:.2f}"),
    "LogTag, rows that end with a separator": (
        "Index;Date;Time;Temperature", "{i};{b:%d-%b-%Y};{b:%H:%M:%S};{c};"),
    "kelvin": ("time,T [K]", "{b:%Y-%m-%d %H:%M},{k:.2f}"),
    "a column of units": ("Time,Temp,Temp Unit", "{b:%Y-%m-%d %H:%M},{f:.2f},F°"),
    "a zone above the table": (
        "Elitech RC-5\nTime zone: UTC-05:00\nNo.;Time;Temperature(°C)",
        "{i};{e:%Y-%m-%d %H:%M:%S};{t:.2f}"),
    "a compact date": ("No.,Date,Time,Temp °C", "{i},{b:%Y%m%d},{b:%H:%M:%S},{t:.2f}"),
    "Excel in French": ("Date (UTC);Température", "{m.day} juil. {m:%Y %H:%M:%S};{c}"),
    "Campbell TOA5, a mean": (
        'TOA5,river\n"TIMESTAMP","V_Min","AirT_Avg","AirT_Max"\nTS,Volts,Deg C,Deg C\n,Min,Avg,Max',
        '"{b:%Y-%m-%d %H:%M:%S}",12.7,{t:.2f},{f:.2f}'),
    "hours of 14 digits": ("time;T °C", "{b:%Y%m%d%H%M%S};{t:.2f}"),
    "days of a spreadsheet": ("Datum;T °C", "{day:.5f};{t:.2f}"),
    "ThingSpeak": ("created_at,entry_id,field1", "{m:%Y-%m-%d %H:%M:%S} UTC,{i},{t:.2f}"),
    "Chinese dates below a logger's name": (
        "设备名称,RC-5\n序号,时间,温度(℃),湿度(%RH)",
        "{i},{b.year}年{b.month}月{b.day}日 {b:%H:%M:%S},{t:.2f},45"),
    "a remark between the rows": (
        "time,T °C", [*rows_of("{s},{t:.2f}")[:6], "# battery", *rows_of("{s},{t:.2f}")[6:]]),
    "a remark of several lines": ("time,T °C,note", '{s},{t:.2f},"box\nopened"'),
    # after a power cut, the end of a row and sometimes of its line is missing
    "NULs after a power cut": ("time,T °C", [
        "178334610\0\0\0" + row if i == 5 else row for i, row in enumerate(rows_of("{s},{t:.2f}"))],
        "1783346600,2" + 512 * "\0"),
    "a sensor's number": ("SensorId,Sensor,Time,Value", "123.4,1,{m:%Y-%m-%dT%H:%M:%SZ},{t:.2f}"),
    "a head that is narrower than the rows": (
        "No.  Time  Temp.", "{i}\t{b:%d/%m/%Y %X}\t{t:.2f} °C"),
    "Almemo, short dates": ("DATUM:;UHRZEIT:;00: °C", "{b:%d.%m.%y};{b:%X};{c}"),
    "a column of offsets": ("time,offset,T °C", "{e:%Y-%m-%d %X},-05:00,{t:.2f}"),
    "a word of 12 hours in German": ("Zeit;T °C", "{b:%d.%m.%Y %I:%M:%S} nachm.;{c}"),
    "no number of an old C library": ("time,T °C", [
        *rows_of("{s},{t:.2f}")[:6], "1783346400,-1.#IND", *rows_of("{s},{t:.2f}")[6:]]),
}  # fmt: skip
SAID = {
    "Testo": "4 rows without a time: left out (line 15: 'Minimum')",
    "HOBOconnect, in Eastern standard time": "is converted from degF, the unit in its head",
    "kelvin": "is converted from K",
}
"""What is passed over or converted."""


@pytest.mark.parametrize("name", LOGS)
def test_a_log_is_read_without_a_question(tmp_path, name):
    found = read(tmp_path, *LOGS[name][:2], *LOGS[name][2:])
    (values,) = found.channels.values()
    assert found.times.tolist() == TIMES
    assert np.abs(values - CELSIUS).max() < 0.006
    for words in ("guessed", SAID.get(name, "")):
        assert any(words in note for note in found.notes)
    assert not [note for note in found.notes if "doubtful" in note]


def test_sensors_below_one_another_are_channels(tmp_path):
    """As Home Assistant writes them; a humidity is no channel, a word no reading."""
    sensors = {"box_temperature": 21.5, "humidity": 45.0, "air": 19.5, "cpu": 70.0}
    rows = [(name, value + k / 10, k) for k in range(9) for name, value in sensors.items()]
    rows += [("air", "unavailable", 9), ("box_temperature", -196.6, 9)]
    data = "entity_id,state,last_changed\n" + "".join(
        f"sensor.{name},{value},2026-06-14T10:0{k}:0{len(name) % 9}.000Z\n"
        for name, value, k in rows
    )
    found = logged(tmp_path, data)
    # a processor at 70 °C is no room in °F
    assert list(found.channels) == ["sensor.box_temperature", "sensor.air", "sensor.cpu"]
    unread = read(tmp_path, "time;T1 °C;T2 °C", "{s};-127.00;{t:.2f}")
    assert list(unread.channels) == ["T2", "T1"]
    for name, values in found.channels.items():
        known = sensors[name.removeprefix("sensor.")] + np.arange(9) / 10
        assert values[np.isfinite(values)] == pytest.approx(known)
    lacking = "2 values of 'state' without a reading ('unavailable', '-196.6'): left empty"
    assert any(lacking in note for note in found.notes)
    with pytest.raises(DataError, match=r"no column 'sensor.lens'.* are 'sensor.box_temperature'"):
        logged(tmp_path, data, temperatures=("sensor.lens",))
    given = {"temperatures": ("sensor.cpu",), "names": {"sensor.cpu": "processor"}}
    assert list(logged(tmp_path, data, **given).channels) == ["processor"]


def test_sensors_that_take_turns_are_channels_if_each_has_one(tmp_path):
    """They were one series that leapt to and fro."""
    rows = [f"{m + timedelta(seconds=9 * k):%Y-%m-%d %X},{w},{20 + 5 * k},21"
            for m in MOMENTS for k, w in enumerate(("lens", "room"))]  # fmt: skip
    found = read(tmp_path, "time,device,T °C,RH", rows)
    assert {n: np.nanmax(v) for n, v in found.channels.items()} == {"lens": 20, "room": 25}
    with pytest.raises(DataError, match=r"2 sensors with several temperatures each .*'device'"):
        read(tmp_path, "time,device,T °C,T2 °C", rows)
    given = read(tmp_path, "time,device,T °C,T2 °C", rows, temperatures=("T2 °C",))
    assert np.nanmax(given.channels["room"]) == 21
    moved = [row.replace("room", "lens") for row in rows[:6]] + rows[7::2]
    assert list(read(tmp_path, "time,device,T °C,RH", moved).channels) == ["T"]


def test_of_one_sensor_of_many_only_its_readings_are_examined(tmp_path):
    """1013 hPa is no temperature, but not asked for either."""
    data = "entity_id,state,last_changed\n" + "".join(
        f"sensor.{name},{value},{1780000000 + 60 * k}\n"
        for k in range(9) for name, value in (("box", 21.5), ("air_pressure", 1013), ("w", 2000))
    )  # fmt: skip
    assert list(logged(tmp_path, data, temperatures=("sensor.box",)).channels) == ["sensor.box"]


def test_a_log_of_changes_holds_its_value_in_a_pause_but_not_while_unavailable(tmp_path):
    """Home Assistant writes no row while a value stays the same; ten minutes were a gap."""
    rows: list = [(20.0 + k, 10 * k) for k in range(6)]
    rows += [(25.1, 650), ("unavailable", 660), (25.2, 1300), (25.3, 91_300)]
    data = "entity_id,state,last_changed\n" + "".join(
        f"sensor.{name},{value},{1.78e9 + t:.0f}\n"
        for value, t in rows for name in ("box_temperature", "air_temperature")
    )  # fmt: skip
    found = logged(tmp_path, data)
    assert found.step == 10.0
    at = found.times[0] + np.array([30.0, 300.0, 645.0, 900.0, 40_000.0])
    for readings in found.channels.values():
        known = interpolate_readings(at, found.times, readings)
        np.testing.assert_allclose(known, [23.0, 25.0, 25.05, np.nan, np.nan])
    assert sum("is held in 1 pause of up to 600 s" in note for note in found.notes) == 2


@pytest.mark.parametrize(("rows", "near", "order", "day", "says"), [
    ("06/07/2026 12:00 06/07/2026 12:01", "07-06", None, "2026-07-06", "near the photographs"),
    ("06/07/2026 12:00 06/07/2026 12:01", "06-07", None, "2026-06-07", "near the photographs"),
    # a log past midnight continues on the next day, not the next month
    ("06/07/2026 23:59 07/07/2026 00:01", "", None, "2026-07-06", "rows consecutive"),
    ("07/06/2026 23:59 07/07/2026 00:01", "", None, "2026-07-06", "rows consecutive"),
    ("07/07/2026 12:00 07/07/2026 12:01", "", None, "2026-07-07", ""),
    # a year of two digits may be first
    ("26/06/14 12:00 26/06/14 12:01", "", None, "2014-06-26",
     "doubtful: '26/06/14 12:00' is taken as day/month/year, 2014-06-26; if it is 2026-06-14"),
    ("14.06.26 12:00 14.06.26 12:01", "", None, "2026-06-14", "if it is 2014-06-26, give --date-"),
    ("26-06-14 12:00 26-06-14 12:01", "", "ymd", "2026-06-14", ""),
    ("26/06/14 23:59 26/06/15 00:01", "", None, "2026-06-14", "year/month/day: this makes"),
])  # fmt: skip
def test_the_order_of_day_month_and_year_is_found(tmp_path, rows, near, order, day, says):
    first, second = rows[: len(rows) // 2], rows[len(rows) // 2 + 1 :]
    photographs = near and (datetime.fromisoformat(f"2026-{near}").timestamp() + 36000,) * 2
    data = f"time,temp °C\n{first},21\n{second},21\n"
    found = logged(tmp_path, data, photographs or None, date_order=order)
    assert datetime.fromtimestamp(found.times[0], BERLIN.zone).date().isoformat() == day
    assert found.times[-1] - found.times[0] <= 120
    assert any(says in note for note in found.notes)
    assert any("--date-order" in note for note in found.notes) == ("if it is" in says)


@pytest.mark.parametrize(("encoding", "head", "channel"), [
    ("cp1251", "Дата;Температура (°C)", "Температура"), ("koi8-r", "Время;Темп. 1", "Темп. 1"),
    ("cp866", "Дата;Влажность;Температура", "Температура"),
    ("shift_jis", "日時;湿度;筐体温度[℃]", "筐体温度"), ("euc-jp", "時刻;気温", "気温"),
    ("gb18030", "时间;外壳温度(℃)", "外壳温度"), ("big5", "時間;溫度", "溫度"),
    ("euc-kr", "측정시간;온도(℃)", "온도"), ("cp1250", "Čas;Teplota", "Teplota"),
    ("cp1250", "Data;Temperatura wewnętrzna", "Temperatura wewnętrzna"),
    ("cp1253", "Ώρα;Θερμοκρασία", "Θερμοκρασία"), ("cp1252", "Tid;Kåpa °C", "Kåpa"),
    ("cp1252", "Zeit;Gerät ä ä (%);Gehäuse °C", "Gehäuse"),  # ä is a small delta in cp1253
    ("cp850", "Zeit;Gehäuse °C", "Gehäuse"), ("mac-roman", "Heure;Température °C", "Température"),
    *((utf, "Zeit;Gehäuse °C", "Gehäuse")
      for utf in ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be")),
])  # fmt: skip
def test_an_encoding_is_detected_by_its_words_and_said(tmp_path, encoding, head, channel):
    data = "\n".join([head, *rows_of("{b}" + ";45" * (head.count(";") - 1) + ";{t}"), ""])
    found = logged(tmp_path, data.encode(encoding), times=(head.partition(";")[0],))
    assert list(found.channels) == [channel]
    assumed = "(assumed; set --encoding to change), columns" in found.notes[0]
    assert assumed == (not encoding.startswith("utf"))
    given = logged(tmp_path, data.encode(encoding), encoding=encoding)
    assert list(given.channels) == [channel]
    assert "assumed" not in given.notes[0]


@pytest.mark.parametrize(("data", "options", "reason"), [
    ("time,T\n13/05/2026 12:00,20\n05/13/2026 12:01,20\n", {},
     "line 3, column 'time': '05/13/2026 12:01' is not in the order of day and month"),
    ("Datum;T\n14.06.2026 12:00:00;21,5\n14.06.2026 12:01:00;21,5\n", {"clock": DeviceClock()},
     "no time zone: give it with --timezone"),
    ("time,temp\n06/07/2026 12:00,21\n06/07/2026 12:01,21\n", {}, "--date-order dmy or mdy"),
    ("Date;Time;T\n" + 9 * "05/06/2026;10:00;21\n" + "05/06/2026;10:;21\n",
     {"date_order": "dmy"}, "10:' is"),
    ("time,T\n07/07/2026 9:00,21\n08/07/2026 9:00,21\n08/08/2026 9:00,21\n", {}, "--date-"),
    ("Time (EST/EDT),T\n2026-06-14 12:00,20\n", {}, "EST/EDT.*Berlin: give --log-timezone"),
    ("time;T\n05/06/2026 10:00;21\n05/06/2026 10:01+01:00;21\n", {}, "--date-order dmy or"),
    ("time,temp\n2026-06-14 12:00,294.5\n2026-06-14 12:01,294.6\n", {}, "--unit K"),
    ("time,temp K (Kelvin)\n2026-06-14 12:00,20\n2026-06-14 12:01,20\n", {},
     "20 K is -253.*Another unit"),
    ("time,T (F)\n2026-06-14 12:00,20 C\n2026-06-14 12:01,20 C\n", {}, "at once.*--unit"),
    ("time,T\n2026-06-14 12:00,20.5\n2026-06-14 12:01,69F\n", {}, "only 1 of 2.*--unit"),
    ("time,T\n2026-06-14 12:00,20\n2026-06-14 12:01,2_5.0\n", {"temperatures": ("T",)},
     "is not a number"),
    ("a,b\n1,2\n3,4\n", {}, "no separator"),
    ("2026-06-14 4:50:00 PM 21.5\n2026-06-14 4:51:00 PM 21.5\n", {}, "no separator"),
    ("time,T\n" + 3 * "2026-06-14 12:00,20\n", {}, "has readings at 1 time; two"),
    *((empty, {}, "is empty") for empty in (b"", b"\xef\xbb\xbf\n\n", b"\xff\xfe", "\u00a0\n")),
    ("entity_id,state,last_changed\nsensor.rh,45,1780000000\nsensor.rh,45,1780000060\n", {},
     "no sensor .* has temperatures"),
    (b"\x7fELF\0\0\0\0", {}, "is not text"),
    ("time,temp\n46187.5,20\n46187.54,20\n", {}, "line 2.* spreadsheet's date"),
    ("Zeit;T\n46187.5,20\n46188.5,20\n", {}, "show 45992.5 as a date with a time"),
    ("time,T °C\n2026-06-14 12:00,20\n", {"encoding": "utf-16"},
     "--encoding utf-16: .* cannot be read so: .*BOM"),
    (f"time,T\n{'x' * 200_000}\n", {"separator": ","}, "line 2: is not readable: field larger"),
    # it swallowed the rows below
    ("time,note,T\n" + "".join(
        f"{1.78e9 + i},{'x' if i - 3 else chr(34)},{i}\n" for i in range(12)),
     {}, "line 5: a quote is not closed"),
    ("No.,time,x\n" + "".join(f"{i},{1.78e9 + i},{i}\n" for i in range(9)), {},
     "which column is the temperature"),
    # 21,5 split at its comma would be 21
    ("time,T\n2026-06-14 12:00,21,5\n2026-06-14 12:01,21,75\n", {},
     "line 2: the row holds more fields than the head"),
    *((f"time,T{more}\n" + "".join(
        f"2026-06-14 12:0{i},21{',5' * (i == 5)}{more.replace('RH', '45')}\n" for i in range(9)),
       {}, "line 7: the row holds more fields than the head") for more in ("", ",RH")),
    ("time,T °C\n2000-07-06 13:55,21\n2000-07-06 13:56,21\n2026-07-06 13:57,21\n", {},
     "line 4, column 'time': is 26 years after the row before"),
    ("time,T\n" + "".join(f"2026-06-14 12:0{i},{21 if i < 4 else 70}\n" for i in range(8)), {},
     "line 6, column 'T': the unit seems to change from °C to °F here.*--unit"),
    ("time,T °C\n13:55,21\n13:56,21\n", {},
     "as in 2026-06-14 12:00:00; .*'time': 13:55; 'T °C': 21"),
])  # fmt: skip
def test_what_is_not_certain_is_refused_with_the_remedy(tmp_path, data, options, reason):
    with pytest.raises((DataError, UsageError), match=reason):
        logged(tmp_path, data, **options)


UNITS = {
    "degF": (
        "(F)", "T °F", "degF", "TempF", "[F]", "tempf", "temp_f", "Temperature, F", "Temp. (F)",
        "deg. F", "Degrees F", "T ℉", "TºF", "Fahrenheit", "housing_f", "T_degF", "T1 F°",
        "Temp (Fahr.)", "Temp Farenheit", "degrees-f", "T (F, mean)", "温度(华氏)"),
    "degC": ("Celsius(°C)", "Temperature   (°C )", "Temperatur[°C]", "TempC", "温度(℃)", "T_degC"),
    "K": ("T [K]", "kelvin", "degK", "(K)", "housing_k"),
    None: ("temperature", "Tempfühler", "Temp Fan", "offset", "state", "temperature_factory",
           "board_temperature", "Probe F"),
}  # fmt: skip


def test_one_pattern_reads_the_unit_of_a_head():
    for unit, heads in UNITS.items():
        assert {head: stated_unit(head) for head in heads} == dict.fromkeys(heads, unit)


def test_columns_are_called_as_their_owner_calls_them(tmp_path):
    two = HOBO + ',"Temp, °C (LGR S/N: 1, SEN S/N: 2)"', rows_of("{i},{b},{t:.2f},21.0")
    assert list(read(tmp_path, *two).channels) == ["housing", "Temp"]
    given = log_options(name=["Temp, °C (LGR S/N: 1, SEN S/N: 2)=相机"]).names
    assert list(read(tmp_path, *two, names=given).channels) == ["housing", "相机"]
    # as the notes call it, also twice
    german = LOGS["Berlin, German"]
    one = read(tmp_path, *german, temperatures=("Temperatur", "Temperatur °C"))
    assert one.channels["Temperatur"].round(2).tolist() == np.round(CELSIUS, 2).tolist()
    given = log_options(name=["Temperatur=box"]).names
    assert list(read(tmp_path, *german, names=given).channels) == ["box"]
    for name, words in (("Temp", "COLUMN=LABEL"), ("Temp=c", "column of this program"),
                        ("lens=x", "no column 'lens'")):  # fmt: skip
        with pytest.raises((UsageError, DataError), match=words):
            read(tmp_path, *two, names=log_options(name=[name]).names)


@pytest.mark.parametrize("head", [
    "Logger,7\nFirmware,2\nDate Time,Temp (°F)", "Logger 7,\nDate Time,Temp\n,°F",
    "Date Time,Temperature,°F", "Station,Turm\nDate Time,Temperature, F",
    "Unit: °F\nDate Time,Temp", "F°,06/14/2026 12:00,70.2,75.2\nDate Time,Temp (F°)",
    "Timestamp for sample frequency every 1 min min,Temperature_Fahrenheit",
])  # fmt: skip
def test_the_unit_is_found_in_any_head(tmp_path, head):
    """If the head is not found, °F is read as °C."""
    (values,) = read(tmp_path, head, "{b:%Y-%m-%d %H:%M:%S},{f:.2f}").channels.values()
    assert np.abs(values - CELSIUS).max() < 0.006


@pytest.mark.parametrize("head", ["time;RH %;T °C", "time;T °F"])
def test_another_head_below_is_refused(tmp_path, head):
    """A file of two logs: below the second head the columns are others."""
    one = ["time;T °C", *(f"2026-07-06 13:{i}:00;21.4" for i in range(30, 45))]
    rows = rows_of("{m:%Y-%m-%d %H:%M:%S};{t:.2f}")
    for above in (one, one[:3]):
        line = len(above) + 7
        with pytest.raises(DataError, match=f"line {line}: another head begins here"):
            read(tmp_path, "\n".join(above), [*rows[:6], head, *rows[6:]])
    assert len(read(tmp_path, "\n".join(one), [*rows[:6], one[0], *rows[6:]]).times) == 27


@pytest.mark.parametrize(("time", "lost"), [("{s}", 5), ("{s}", 12), ("{b:%d.%m.%Y %X}", 20)])
def test_a_row_that_is_cut_off_is_left_out(tmp_path, time, lost):
    """A logger is writing the row: of 22.60 is left 22, or of the time a part."""
    data = "\r\n".join(["time,T °C", *rows_of(time + ",{t:.2f}"), ""])
    found = logged(tmp_path, data[:-lost])
    assert found.times.tolist() == TIMES[:-1]
    assert "the last row is cut off" in found.notes[-1]
    assert logged(tmp_path, data.strip()).times.tolist() == TIMES


DOUBTFUL = {
    "no seconds": (
        "T °C", [f"{START + timedelta(minutes=i // 6):%Y-%m-%d %H:%M},{t}"
                 for i, t in enumerate(CELSIUS)],
        "doubtful: 10 rows with the time of the row before: left out; the times have no seconds"),
    "hours without AM and PM": (
        "T °C", [f"{m - timedelta(hours=1):%d.%m.%Y %I:%M},21.5" for m in MOMENTS],
        "run back 1 time, the first by 43140 s"),
    **{f"no unit: {head}": (
        head, "{s},{f:.2f}", "70.7 is taken as °C; if it is °F, it is 21.5 °C: give --unit")
       for head in ("temp", "T1", "Sensor 1", "value")},
    "85": ("temp °C", "{s},85.00", "all 12 readings are 85 °C"),
    "sensors below one another": (
        "whose,temp °C", [f"{m:%Y-%m-%d %X},S{k},{20 + k}" for m in MOMENTS for k in (0, 5)],
        "left out; its reading is another: are sensors below one another? Make a file of each"),
}  # fmt: skip


@pytest.mark.parametrize("name", DOUBTFUL)
def test_what_is_doubtful_is_told(tmp_path, name):
    head, row, words = DOUBTFUL[name]
    (note,) = [n for n in read(tmp_path, f"time,{head}", row).notes if "doubtful" in n]
    assert words in note
    if "no unit" in name:
        found = read(tmp_path, f"time,{head}", row, unit="degF")
        assert not [n for n in found.notes if "doubtful" in n]
        assert next(iter(found.channels.values()))[0] == pytest.approx(21.5)


def test_no_two_days_of_a_real_log_have_two_units(shared, tmp_path):
    lines = (shared / "data/temperature_logs/six_ds18b20_15min_excerpt.tsv").read_text()
    head, *rows = lines.splitlines()[:-1]
    wanted = tuple(head.split("\t")[2:])
    for first in range(0, len(rows) - 300, 41):
        days = rows[first : first + 40] + rows[first + 250 : first + 290]
        assert len(logged(tmp_path, "\n".join([head, *days]), temperatures=wanted).channels) == 6


@pytest.mark.parametrize(
    "head",
    ["Pt100 mV", "Sensor Ohm", "T W/m²", "Delta T K", "T diff", "dT",
     # what a thermometer was to show
     "Setpoint", "setpoint temp", "T_set", "Set Temp (°C)", "Solltemperatur", "T_soll",
     "Target Temperature", "desired_temp", "consigne", "SP °C", "Temp max", "min temp",
     "avg temperature", "Forecast °C", "目标温度", "temp_set"],
)  # fmt: skip
def test_a_column_of_another_quantity_is_no_temperature(tmp_path, head):
    if not head.startswith("avg"):  # a mean alone is one
        with pytest.raises(DataError, match="which column is the temperature"):
            read(tmp_path, f"time;{head}", "{s};{t:.2f}")
    assert list(read(tmp_path, f"time;{head};Temp", "{s};2;{t:.2f}").channels) == ["Temp"]


def test_a_name_that_only_looks_like_another_quantity_is_a_temperature(tmp_path):
    for head in ("Temp housing", "T1", "Settle tank T", "spot temp"):
        assert len(read(tmp_path, f"time;{head}", "{s};{t:.2f}").channels) == 1


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
    newest = at("03:10", "02:50", "02:20", "02:50", "02:20", "01:50")
    back = logged(tmp_path, newest, clock=replace(BERLIN, ambiguous="order")).times
    assert back.tolist() == found.tolist()
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
    times = datetime(2026, 10, 24, 23, 50, 10, tzinfo=UTC).timestamp() + 20.0 * np.arange(600)
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


LOCAL = {
    "2026:06:14 12:00:01": "2026-06-14T12:00:01", "20260614_120001": "2026-06-14T12:00:01",
    "06.14.26 12:00:03,5": "2026-06-14T12:00:03.500000", "14 Jun 99 12:00": "1999-06-14T12:00:00",
    "2026-06-30 24:00": "2026-07-01T00:00:00",
    "6/14/2026 12:02 AM": "2026-06-14T00:02:00", "6/14/2026 12:02 p. m.": "2026-06-14T12:02:00",
    "Sun Jun 14 12:00:00 2026": "2026-06-14T12:00:00",
}  # fmt: skip


def test_moments():
    assert {text: parse_moment(text, "mdy").isoformat() for text in LOCAL} == LOCAL
    for text in NOON_IN_BERLIN:
        moment = parse_moment(text, "mdy")
        assert (moment.tzinfo is None, moment) == (False, datetime(2026, 6, 14, 10, tzinfo=UTC))


@pytest.mark.parametrize(("parse", "texts", "error", "words"), [
    (clock_error, ("three", "1:2:3:4", "+", "00:03:12 ahead"), UsageError, "HH:MM:SS"),
    (time_zone, ("Europe/Nowhere", "CEST!", "+99:00", "../../etc/passwd", ""), UsageError, "zone"),
    (parse_moment, ("2026-13-01 12:00", "25:00:00", "tomorrow", "", "2026-06-14 12",
                    "2026-06-14 24:00:01", "9999-12-31 24:00"), ValueError, "."),
    (find_photographs, [[]], DataError, "no photographs are given"),
])  # fmt: skip
def test_what_is_none_is_refused(parse, texts, error, words):
    for text in texts:
        with pytest.raises(error, match=words):
            parse(text)


@pytest.mark.parametrize(("head", "offset_h", "zone"), [
    ("Zeit (MEZ)", 1, "Europe/Berlin"), ("timestamp_utc", 0, "Europe/Berlin"),
    ("Time (EST/EDT)", -4, "America/New_York"), ("Time (CST/CDT)", -5, "America/Chicago"),
    ("Time (CST)", 8, "Asia/Shanghai"), ("Time, GMT-03:30", -3.5, "UTC"),
    ("Time, GMT+05.30", 5.5, "UTC"), ("Time, GMT+5½", 5.5, "Asia/Kolkata"),
    ("Time (Etc/GMT-2)", 2, "UTC"), ("Time, UTC offset +2", 2, "Europe/Berlin"),
    ("Time (Asia/Tokyo)", 9, "UTC"), ("Timezone: Europe/Berlin\nTime", 2, "UTC"),
    ("Time zone: (UTC+01:00) Berlin, Rome\nTime", 2, "Europe/Berlin"),
])  # fmt: skip
def test_the_zone_in_the_head_of_the_times_is_theirs(tmp_path, head, offset_h, zone):
    rows = [f"{datetime.fromtimestamp(t + 3600 * offset_h, UTC):%Y-%m-%d %X};21.5" for t in TIMES]
    found = read(tmp_path, f"{head};T °C", rows, clock=DeviceClock(time_zone(zone)))
    assert found.times.tolist() == TIMES
    used = not any(unclear in head for unclear in ("(CST)", ") Berlin", "½", "offset"))
    assert used == any("gives the time zone" in note for note in found.notes)
    assert ("(CST)" in head) == any("'CST' in the head" in note for note in found.notes)


def test_a_zone_that_is_given_for_the_logger_overrules_that_of_its_head(tmp_path):
    clock = DeviceClock(time_zone("+03:00"), forced=True)
    forced = read(tmp_path, HOBO, "{i},{b:%m/%d/%Y %H:%M:%S},{t:.2f}", clock=clock)
    assert [time + 3600 for time in forced.times] == TIMES
    assert any("is used instead" in note for note in forced.notes)
