"""Dialects and units of loggers: right, or refused with the option that decides."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from thermocald.errors import DataError, UsageError
from thermocald.store.logger.clock import DeviceClock, time_zone
from thermocald.store.logger.dialect import stated_unit
from thermocald.store.logger.options import LogOptions, log_options
from thermocald.store.logger.temperatures import read_log
from thermocald.store.recording.reader import interpolate_readings

BERLIN = DeviceClock(time_zone("Europe/Berlin"))
JUNE = datetime(2026, 6, 14, 10, 0, tzinfo=UTC).timestamp()  # 12:00 in Berlin


def logged(folder, data, near=None, **options):
    path = folder / "log.csv"
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return read_log(path, LogOptions(**{"clock": BERLIN, **options}), near)


GERMAN = """Datum;Uhrzeit;Temperatur °C;Feuchte %
14.06.2026;12:00:00;21,5;40,1
14.06.2026;12:01:00;21,75;40,0
"""
ENGLISH = """time,temperature,humidity
2026-06-14 12:00:00,21.5,40
2026-06-14 12:01:00,21.75,40
"""
PLAIN = ENGLISH.replace(",40", "").replace(",humidity", "")
HOBO = """"Plot Title: x"
"#","Date Time, GMT+02:00","Temp, °C (LGR S/N: 1)"
1,06/14/26 12:00:00 PM,21.5
2,06/14/26 12:01:00 PM,21.75
"""
DIALECTS = {
    "German, Latin-1": GERMAN.encode("latin-1"),
    "German, UTF-8 with BOM": GERMAN.encode("utf-8-sig"),
    "German, UTF-16": GERMAN.encode("utf-16"),
    "German, UTF-16 without a mark": GERMAN.encode("utf-16-le"),
    "English, UTF-16 without a mark": ENGLISH.encode("utf-16-be"),
    "lines above, CR LF": ("Logger 4711\nSerie A\n\n" + GERMAN).replace("\n", "\r\n").encode(),
    "English": ENGLISH.encode(),
    "tabs": PLAIN.replace(",", "\t").replace(".", ",").encode(),
    "UTC in the times": PLAIN.replace(" 12:", "T10:").replace(":00,", ":00Z,").encode(),
    "offset in the times": PLAIN.replace(":00,", ":00+0200;").replace("e,t", "e;t").encode(),
    "seconds since 1970": f"time,temp\n{JUNE:.0f},21.5\n{JUNE + 60:.0f},21.75\n".encode(),
    "milliseconds": f"time,temp\n{JUNE:.0f}000,21.5\n{JUNE + 60:.0f}000,21.75\n".encode(),
    "no header": PLAIN.partition("\n")[2].encode(),
    "HOBO": HOBO.encode("utf-8-sig"),
    "spaces, as a shell writes vcgencmd": (
        b"2026-06-14 12:00:00  temp=21.5'C\n2026-06-14 12:01:00 temp=21.75'C\n"
    ),
    "units in a second line": PLAIN.replace("ature\n", "ature\n,deg C\n").encode(),
    "quoted decimal commas": PLAIN.replace(",21.5", ',"21,5"')
    .replace(",21.75", ',"21,75"')
    .encode(),
}


VENDORS = {
    # EL-USB: day first, the logger's data in the first row only, constant alarm levels
    "Lascar EasyLog": (
        "garden,Time,Celsius(°C),High Alarm,Low Alarm,Serial Number\n"
        "1,14/06/2026 12:00:00,21.5,30.0,0.0,10012345\n2,14/06/2026 12:01:00,21.75,30.0,0.0\n"
    ).encode("cp1252"),
    # Comfort Software: statistics below the rows
    "Testo": (
        "Datum/Zeit;Temperatur[°C];Feuchte[%rF]\n14.06.2026 12:00:00;21,50;45,1\n"
        "14.06.2026 12:01:00;21,75;45,0\n\nMinimum;21,50;45,0\nMaximum;21,75;45,1\n"
        "Mittelwert;21,63;45,1\n"
    ).encode("cp1252"),
    # history as CSV: UTC, a sensor that was unavailable, also at the beginning
    "Home Assistant": (
        b"entity_id,state,last_changed\n"
        b"sensor.box_temperature,unavailable,2026-06-14T09:59:00.000Z\n"
        b"sensor.box_temperature,21.5,2026-06-14T10:00:00.000Z\n"
        b"sensor.box_temperature,unknown,2026-06-14T10:00:30.000Z\n"
        b"sensor.box_temperature,-196.6,2026-06-14T10:00:40.000Z\n"
        b"sensor.box_temperature,21.75,2026-06-14T10:01:00.000Z\n"
    ),
    "months as words": (
        b'Timestamp,Temperature (C)\n"Jun 14, 2026 12:00 PM",21.5\n"Jun 14, 2026 12:01 PM",21.75\n'
    ),
    # T&D Thermo Recorder: the time again as a spreadsheet's day number
    "T&D Ondotori": (
        b'"Date/Time","Date/Time","No.1"\n"","","Temp.(C)"\n'
        b'"2026/06/14 12:00:00","46187.5","21.5"\n"2026/06/14 12:01:00","46187.5006944","21.75"\n'
    ),
    # Maxim OneWireViewer: the unit in a column
    "Thermochron iButton": (
        b"1-Wire/iButton Part Number: DS1922L\nMission Start: Sun Jun 14 11:58:00 CEST 2026\n\n"
        b"Date/Time,Unit,Value\n14/06/26 12:00:00 PM,C,21.5\n14/06/26 12:01:00 PM,C,21.75\n"
    ),
    # a panel's "download CSV": readings with their unit
    "Grafana": (
        '"Time","box"\n"2026-06-14 12:00:00","21.5 °C"\n"2026-06-14 12:01:00","21.75 °C"\n'
    ).encode(),
    "HOBO in °F": HOBO.replace("°C", "°F")
    .replace("21.5", "70.7")
    .replace("21.75", "71.15")
    .encode(),
    "Govee": (
        b"Timestamp for sample frequency every 1 min min,Temperature_Fahrenheit,Relative_Humidity\n"
        b"2026-06-14 12:00:00,70.7,45.1\n2026-06-14 12:01:00,71.15,45.0\n"
    ),
    "LogTag, rows that end with a separator": (
        b"Index;Date;Time;Temperature\n1;14-Jun-2026;12:00:00;21,5;\n2;14-Jun-2026;12:01:00;21,75;\n"
    ),
    "kelvin": b"time,T [K]\n2026-06-14 12:00,294.65\n2026-06-14 12:01,294.9\n",
    "a column of units": (
        "Time,Temp,Temp Unit\n2026-06-14 12:00,70.7,F°\n2026-06-14 12:01,71.15,F°\n".encode()
    ),
}
"""Tables as in vendors' manuals and programs."""
SAID = {
    "Testo": "3 rows without a time: left out (line 5: 'Minimum')",
    "Home Assistant": "3 values of 'state' without a reading "
    "('unavailable', 'unknown', '-196.6'): left empty",
    "HOBO in °F": "is converted from degF, the unit in its head",
    "kelvin": "is converted from K",
}
"""What is passed over or converted."""


@pytest.mark.parametrize("name", [*DIALECTS, *VENDORS])
def test_a_log_is_the_same_in_every_dialect_without_an_option(tmp_path, name):
    found = logged(tmp_path, {**DIALECTS, **VENDORS}[name])
    (values,) = found.channels.values()
    there = np.isfinite(values)
    assert any(SAID.get(name, "guessed") in note for note in found.notes)
    assert found.times[there].tolist() == [JUNE, JUNE + 60]
    assert values[there] == pytest.approx([21.5, 21.75])
    assert name in VENDORS or there.all()
    assert any("guessed" in note for note in found.notes)


def test_sensors_below_one_another_are_channels(tmp_path):
    """As Home Assistant writes them; a humidity is no channel."""
    rows = [
        ("sensor.box_temperature", 21.5, "10:00:00"), ("sensor.box_humidity", 45.0, "10:00:10"),
        ("sensor.air_temperature", 19.5, "10:00:20"), ("sensor.box_temperature", 21.75, "10:01:00"),
    ]  # fmt: skip
    data = "entity_id,state,last_changed\n" + "".join(
        f"{name},{value},2026-06-14T{time}.000Z\n" for name, value, time in rows
    )
    found = logged(tmp_path, data)
    assert list(found.channels) == ["sensor.box_temperature", "sensor.air_temperature"]
    box, air = found.channels.values()
    assert box[np.isfinite(box)].tolist() == [21.5, 21.75]
    assert air[np.isfinite(air)].tolist() == [19.5]
    with pytest.raises(DataError, match=r"no column 'sensor.air'.* are 'sensor.box_temperature'"):
        logged(tmp_path, data, temperatures=("sensor.air",))
    # a processor at 70 °C is no room in °F
    data = data.partition("\n")[0] + "".join(
        f"\nsensor.{name},{value + k / 10},2026-06-14T10:0{k}:00.000Z"
        for name, value in (("air", 21.1), ("cpu", 70.0)) for k in range(9)
    ) + "\n"  # fmt: skip
    assert list(logged(tmp_path, data).channels) == ["sensor.air", "sensor.cpu"]
    given = {"temperatures": ("sensor.cpu",), "names": {"sensor.cpu": "processor"}}
    assert list(logged(tmp_path, data, **given).channels) == ["processor"]


def test_a_log_of_changes_holds_its_value_in_a_pause_but_not_while_unavailable(tmp_path):
    """Home Assistant writes no row while a value stays the same; ten minutes were a gap."""
    rows: list = [(20.0 + k, 10 * k) for k in range(6)]
    rows += [(25.1, 650), ("unavailable", 660), (25.2, 1300)]
    data = "entity_id,state,last_changed\n" + "".join(
        f"sensor.{name},{value},{1.78e9 + t:.0f}\n"
        for value, t in rows for name in ("box_temperature", "air_temperature")
    )  # fmt: skip
    found = logged(tmp_path, data)
    assert found.step == 10.0
    at = found.times[0] + np.array([30.0, 300.0, 645.0, 900.0])
    for readings in found.channels.values():
        known = interpolate_readings(at, found.times, readings)
        np.testing.assert_allclose(known[:3], [23.0, 25.0, 25.05])
        assert np.isnan(known[3])
    assert sum("is held in 1 pause of up to 600 s" in note for note in found.notes) == 2


@pytest.mark.parametrize(("order", "month"), [("dmy", 7), ("mdy", 6)])
def test_photographs_settle_the_order_of_day_and_month(tmp_path, order, month):
    day = 6 if order == "dmy" else 7
    first = datetime(2026, month, day, 10, tzinfo=UTC).timestamp()
    data = "time,temp\n06/07/2026 12:00,21\n06/07/2026 12:01,21\n"
    found = logged(tmp_path, data, (first + 20, first + 40))
    assert found.times.tolist() == [first, first + 60]
    assert any("this puts the log near the photographs" in note for note in found.notes)


@pytest.mark.parametrize(("rows", "first"), [
    (("06/07/2026 23:59", "07/07/2026 00:01"), datetime(2026, 7, 6, 21, 59, tzinfo=UTC)),
    (("07/06/2026 23:59", "07/07/2026 00:01"), datetime(2026, 7, 6, 21, 59, tzinfo=UTC)),
    (("07/07/2026 12:00", "07/07/2026 12:01"), datetime(2026, 7, 7, 10, 0, tzinfo=UTC)),
])  # fmt: skip
def test_rows_settle_the_order_of_day_and_month(tmp_path, rows, first):
    """A log past midnight continues on the next day, not the next month."""
    found = logged(tmp_path, "time,temp\n" + "".join(f"{row},21\n" for row in rows))
    assert found.times[0] == first.timestamp()
    assert found.times[-1] - found.times[0] <= 120


@pytest.mark.parametrize(("row", "order", "month", "says"), [
    ("26/06/14 12:00", None, 201406, "is taken as day/month/year, 2014-06-26; if it is 2026-06-14"),
    ("14.06.26 12:00", None, 202606, "is taken as day/month/year, 2026-06-14; if it is 2014-06-26"),
    ("26-06-14 12:00", "ymd", 202606, ""),
    ("26/06/14 23:59", None, 202606, "is year/month/day: this makes the rows consecutive"),
])  # fmt: skip
def test_a_year_of_two_digits_may_be_first(tmp_path, row, order, month, says):
    after = row.replace("14 23:59", "15 00:01")
    found = logged(tmp_path, f"time,temp °C\n{row},21\n{after}:30,21\n", date_order=order)
    assert f"{datetime.fromtimestamp(found.times[0], UTC):%Y%m}" == str(month)
    assert any(says in note for note in found.notes)
    assert any("--date-order" in note for note in found.notes) == ("if it is" in says)


@pytest.mark.parametrize(("encoding", "head", "channel"), [
    ("cp1251", "Дата;Температура (°C)", "Температура"), ("koi8-r", "Время;Темп. 1", "Темп. 1"),
    ("cp866", "Дата;Влажность;Температура", "Температура"),
    ("shift_jis", "日時;湿度;筐体温度[℃]", "筐体温度"), ("euc-jp", "時刻;気温", "気温"),
    ("gb18030", "时间;外壳温度(℃)", "外壳温度"), ("big5", "時間;溫度", "溫度"),
    ("euc-kr", "측정시간;온도(℃)", "온도"), ("cp1250", "Čas;Teplota", "Teplota"),
    ("cp1253", "Ώρα;Θερμοκρασία", "Θερμοκρασία"), ("cp1252", "Tid;Kåpa °C", "Kåpa"),
    ("cp850", "Zeit;Gehäuse °C", "Gehäuse"), ("mac-roman", "Heure;Température °C", "Température"),
])  # fmt: skip
def test_an_encoding_is_detected_by_its_words_and_said(tmp_path, encoding, head, channel):
    rows = "".join(f"2026-06-14 12:0{i}{';45' * (head.count(';') - 1)};21.5\n" for i in range(3))
    found = logged(tmp_path, f"{head}\n{rows}".encode(encoding))
    assert list(found.channels) == [channel]
    assert "(assumed; set --encoding to change), columns" in found.notes[0]
    given = logged(tmp_path, f"{head}\n{rows}".encode(encoding), encoding=encoding)
    assert list(given.channels) == [channel]
    assert "assumed" not in given.notes[0]


@pytest.mark.parametrize(
    ("data", "options", "reason"),
    [
        ("time,T\n13/05/2026 12:00,20\n05/13/2026 12:01,20\n", {},
         "line 3, column 'time': '05/13/2026 12:01' is not in the order of day and month"),
        (GERMAN, {"clock": DeviceClock()}, "no time zone: give it with --timezone"),
        (b"time,temp\n06/07/2026 12:00,21\n06/07/2026 12:01,21\n", {}, "--date-order dmy or mdy"),
        (b"Date;Time;T\n" + 9 * b"05/06/2026;10:00;21\n" + b"05/06/2026;10:;21\n",
         {"date_order": "dmy"}, "10:' is"),
        (b"time,T\n07/07/2026 9:00,21\n08/07/2026 9:00,21\n08/08/2026 9:00,21\n", {}, "--date-"),
        (b"Time (EST/EDT),T\n2026-06-14 12:00,20\n", {}, "EST/EDT.*Berlin: give --log-timezone"),
        (b"time;T\n05/06/2026 10:00;21\n05/06/2026 10:01+01:00;21\n", {}, "--date-order dmy or"),
        (b"time,temp\n2026-06-14 12:00,294.5\n2026-06-14 12:01,294.6\n", {}, "--unit K"),
        (b"time,temp K (Kelvin)\n2026-06-14 12:00,20\n2026-06-14 12:01,20\n", {}, "20 K is -253"),
        (b"time,T (F)\n2026-06-14 12:00,20 C\n2026-06-14 12:01,20 C\n", {}, "at once.*--unit"),
        (b"time,T\n2026-06-14 12:00,20.5\n2026-06-14 12:01,69F\n", {}, "only 1 of 2.*--unit"),
        (b"time,a,b\n2026-06-14 12:00,20,21\n2026-06-14 12:01,20,21\n", {}, "--temperature-column"),
        (PLAIN.replace("21.75", "2_5.0"), {"temperatures": ("temperature",)}, "is not a number"),
        (b"time,temp\n2026-06-14 12:00,20\n2026-06-14 12:01,1e300\n", {}, "Another unit"),
        (b"a,b\n1,2\n3,4\n", {}, "no separator"),
        (b"2026-06-14 4:50:00 PM 21.5\n2026-06-14 4:51:00 PM 21.5\n", {}, "no separator"),
        (b"time,T\n" + 3 * b"2026-06-14 12:00,20\n", {}, "has readings at 1 time; two"),
        (b"", {}, "is empty"),
        (b"\xef\xbb\xbf\n\n", {}, "is empty"),
        (b"\xff\xfe", {}, "is empty"),
        ("\u00a0\n", {}, "is empty"),
        ((b"entity_id,state,last_changed\nsensor.humidity,45,2026-06-14T12:00:00Z\n"
         b"sensor.humidity,46,2026-06-14T12:01:00Z\n"), {}, "no sensor .* has temperatures"),
        (b"\x7fELF\0\0\0\0", {}, "is not text"),
        (b"time,temp\n46187.5,20\n46187.54,20\n", {}, "line 2.* spreadsheet's date"),
        (b"Zeit;T\n46187.5,20\n46188.5,20\n", {}, "show 45992.5 as a date with a time"),
        (GERMAN, {"temperatures": ("Temp",)}, "there is no column 'Temp'"),
        (GERMAN, {"encoding": "utf-16"}, "--encoding utf-16: .* cannot be read so: .*BOM"),
        (f"time,T\n{'x' * 200_000}\n", {"separator": ","}, "line 2: is not readable: field larger"),
        # 21,5 split at its comma would be 21
        (PLAIN.replace("21.", "21,"), {}, "line 2: the rows hold more fields than the head"),
        ("time,T °C\n2000-07-06 13:55,21\n2000-07-06 13:56,21\n2026-07-06 13:57,21\n", {},
         "line 4, column 'time': is 26 years after the row before"),
        ("time,T °C\n13:55,21\n13:56,21\n", {},
         "as in 2026-06-14 12:00:00; .*'time': 13:55; 'T °C': 21"),
    ],
)  # fmt: skip
def test_what_is_not_certain_is_refused_with_the_remedy(tmp_path, data, options, reason):
    with pytest.raises((DataError, UsageError), match=reason):
        logged(tmp_path, data, **options)


@pytest.mark.parametrize(
    ("head", "unit"),
    [
        *((head, "degF") for head in (
            "(F)", "T °F", "degF", "TempF", "[F]", "tempf", "temp_f", "Temperature, F", "Temp. (F)",
            "deg. F", "Degrees F", "T ℉", "TºF", "Fahrenheit", "housing_f", "T_degF", "T1 F°",
            "Temp (Fahr.)", "Temp Farenheit", "degrees-f", "T (F, mean)", "温度(华氏)")),
        *((head, "degC") for head in (
            "Celsius(°C)", "Temperatur[°C]", "TempC", "温度(℃)", "T_degC")),
        *((head, "K") for head in ("T [K]", "kelvin", "degK", "(K)", "housing_k")),
        *((head, None) for head in (
            "temperature", "Tempfühler", "Temp Fan", "offset", "state", "temperature_factory",
            "board_temperature", "Probe F")),
    ],
)  # fmt: skip
def test_one_pattern_reads_the_unit_of_a_head(head, unit):
    assert stated_unit(head) == unit


TWO = """"Plot Title: x"
"#","Date Time, GMT+02:00","Temp, °C (LGR S/N: 1, SEN S/N: 1, LBL: housing)","Temp, °C (LGR S/N: 1, SEN S/N: 2)"
1,06/14/26 12:00:00 PM,21.5,21.0
2,06/14/26 12:01:00 PM,21.75,21.0
"""  # noqa: E501


def test_columns_are_called_as_their_owner_calls_them(tmp_path):
    assert list(logged(tmp_path, TWO).channels) == ["housing", "Temp"]
    given = log_options(name=["Temp, °C (LGR S/N: 1, SEN S/N: 2)=相机"]).names
    assert list(logged(tmp_path, TWO, names=given).channels) == ["housing", "相机"]
    # as the notes call it, also twice
    one = logged(tmp_path, GERMAN, temperatures=("Temperatur", "Temperatur °C"))
    assert one.channels["Temperatur"].tolist() == [21.5, 21.75]
    given = log_options(name=["Temperatur=box"]).names
    assert list(logged(tmp_path, GERMAN, names=given).channels) == ["box"]


@pytest.mark.parametrize(
    ("name", "words"), [("Temp", "COLUMN=LABEL"), ("Temp=c", "column of this program"),
                        ("lens=x", "no column 'lens'")]
)  # fmt: skip
def test_a_name_that_cannot_be_given_is_refused(tmp_path, name, words):
    with pytest.raises((UsageError, DataError), match=words):
        logged(tmp_path, TWO, names=log_options(name=[name]).names)


@pytest.mark.parametrize(
    "head",
    [
        "Logger,7\nFirmware,2\nDate Time,Temp (°F)",
        "Logger 7,\nDate Time,Temp\n,°F",
        "Date Time,Temperature, F",
        "Date Time,Temperature,°F",
        "Station,Turm\nDate Time,Temperature, F",
        "Unit: °F\nDate Time,Temp",
        "F°,06/14/2026 12:00,70.2,75.2\nDate Time,Temp (F°)",
    ],
)
def test_the_unit_is_found_in_any_head(tmp_path, head):
    """If the head is not found, °F is read as °C."""
    rows = "".join(f"2026-06-14 12:0{i}:00,{70 + i}.25\n" for i in range(6))
    (values,) = logged(tmp_path, f"{head}\n{rows}").channels.values()
    assert values == pytest.approx((np.arange(70.25, 76) - 32) / 1.8)


START = datetime(2026, 7, 6, 13, 55, tzinfo=UTC)
MOMENTS = [START + timedelta(seconds=60 * i) for i in range(12)]
CELSIUS = [21.5 + 0.1 * i for i in range(12)]


def read(folder, head, row, unit="", zone="UTC"):
    """Read a log of a head and one row per moment, °C and number."""
    rows = [row(m, t, i) for i, (m, t) in enumerate(zip(MOMENTS, CELSIUS, strict=True))]
    data, near = "\r\n".join([*head, *rows, ""]), (MOMENTS[0].timestamp(), MOMENTS[-1].timestamp())
    return logged(folder, data, near, clock=DeviceClock(time_zone(zone)), unit=unit or None)


PROGRAMS = {
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
    "days of a spreadsheet": (
        ["Datum;T °C"],
        lambda m, t, i: f"{(m.timestamp() / 86400 + 25569):.5f};{t:.2f}".replace(".", ",")),
    "a shell's date in German": (
        [], lambda m, t, i: f"Mo {m.day}. Jul {m:%H:%M:%S} UTC {m.year};{t:.2f}"),
    "a Raspberry Pi's vcgencmd": (
        [], lambda m, t, i: f"{m:%Y-%m-%dT%H:%M:%S}Z,temp={t:.2f}'C"),
    "InfluxDB, annotated": (
        ["#group,false,false,false", "#datatype,long,dateTime:RFC3339,double", "#default,,,",
         ",table,_time,_value"],
        lambda m, t, i: f",0,{m:%Y-%m-%dT%H:%M:%SZ},{t:.2f}"),
    "ThingSpeak": (
        ["created_at,entry_id,field1"], lambda m, t, i: f"{m:%Y-%m-%d %H:%M:%S} UTC,{i},{t:.2f}"),
    "Chinese dates below a logger's name": (
        ["设备名称,RC-5", "序号,时间,温度(℃),湿度(%RH)"],
        lambda m, t, i: f"{i},{m.year}年{m.month}月{m.day}日 {m:%H:%M:%S},{t:.2f},45"),
    "a remark between the rows": (
        ["time,T °C"],
        lambda m, t, i: "# battery changed\r\n" * (i == 6) + f"{int(m.timestamp())},{t:.2f}"),
    "least, most and mean": (
        ["time,T max °C,T min °C,T avg °C"],
        lambda m, t, i: f"{int(m.timestamp())},{t + 0.5:.2f},{t - 0.5:.2f},{t:.2f}"),
}  # fmt: skip


@pytest.mark.parametrize("name", PROGRAMS)
def test_it_is_read_without_a_question(tmp_path, name):
    found = read(tmp_path, *PROGRAMS[name])
    assert found.times.tolist() == [m.timestamp() for m in MOMENTS]
    (values,) = found.channels.values()
    assert np.abs(values - CELSIUS).max() < 0.006
    assert not [note for note in found.notes if "doubtful" in note]


@pytest.mark.parametrize("head", ["time;RH %;T °C", "time;T °F"])
def test_another_head_below_is_refused(tmp_path, head):
    """A file of two logs: below the second head the columns are others."""

    def row(m, t, i):
        below = f"{head}\r\n" if i == 6 else ""
        return f"{below}{m:%Y-%m-%d %H:%M:%S};{t:.2f}"

    heads = ["time;T °C", *(f"2026-07-06 13:{i}:00;21.4" for i in range(30, 45))]
    with pytest.raises(DataError, match="line 23: another head begins here"):
        read(tmp_path, heads, row)
    found = read(tmp_path, heads, lambda m, t, i: row(m, t, i).replace(head, heads[0]))
    assert len(found.times) == 27


@pytest.mark.parametrize("lost", [5, 12])
def test_a_row_that_is_cut_off_is_left_out(tmp_path, lost):
    """A logger is writing the row: of 22.60 is left 22, or of the time a part."""
    path = tmp_path / "log.csv"
    read(tmp_path, ["time,T °C"], lambda m, t, i: f"{int(m.timestamp())},{t:.2f}")
    path.write_bytes(path.read_bytes()[:-lost])
    found = read_log(path)
    assert found.times.tolist() == [m.timestamp() for m in MOMENTS[:-1]]
    assert "the last row is cut off" in found.notes[-1]


DOUBTFUL = {
    "no seconds": (
        "T °C", lambda m, t, i: f"{START + timedelta(seconds=60 * (i // 6)):%Y-%m-%d %H:%M},{t}",
        "doubtful: 10 rows with the time of the row before: left out; the times have no seconds"),
    "hours without AM and PM": (
        "T °C", lambda m, t, i: f"{m - timedelta(minutes=60):%d.%m.%Y %I:%M},{t}",
        "run back 1 time, the first by 43140 s"),
    **{f"no unit: {head}": (
        head, lambda m, t, i: f"{int(m.timestamp())},{1.8 * t + 32:.2f}",
        "70.7 is taken as °C; if it is °F, it is 21.5 °C: give --unit")
       for head in ("temp", "T1", "Sensor 1", "value")},
    # nothing but what a thermometer gives without a measurement
    **{value: (
        "temp °C", lambda m, t, i, value=value: f"{int(m.timestamp())},{value}",
        f"all 12 readings are {float(value):g} °C")
       for value in ("85.00", "0.0", "127.94", "-40.0", "125.00", "-45.00")},
}  # fmt: skip


@pytest.mark.parametrize("name", DOUBTFUL)
def test_what_is_doubtful_is_told(tmp_path, name):
    head, row, words = DOUBTFUL[name]
    found = read(tmp_path, [f"time,{head}"], row)
    (note,) = [note for note in found.notes if "doubtful" in note]
    assert words in note
    if "no unit" in name:
        found = read(tmp_path, [f"time,{head}"], row, "degF")
        assert not [note for note in found.notes if "doubtful" in note]
        assert next(iter(found.channels.values()))[0] == pytest.approx(21.5)


WARM, ROOM, COLD = (np.linspace(*ends, 20) for ends in ((27, 35.9), (20.1, 22.3), (4.0, 6.2)))


@pytest.mark.parametrize(
    ("first", "second", "hours", "change"),
    [
        (WARM, COLD, 14, None),  # 35.9 °F would be 2.2 °C
        (ROOM, WARM + 21, 14, None),  # 22.3 °C would be 72 °F
        (10 * COLD // 1, COLD, 14, "from tenths"),
        (COLD + 21, COLD / 2, 14, None),  # 27.2 are no tenths
        (1.8 * ROOM + 32, ROOM, 14, "from °F to °C"),
        (ROOM, 1.8 * ROOM + 35, 14, "from °C to °F"),
        (1.8 * COLD + 32, COLD[::-1], 0, "from °F to °C"),
        (ROOM, ROOM + 273.15, 0, "from °C to K"),
    ],
)
def test_a_night_changes_the_temperature_and_a_setting_the_unit(
    tmp_path, first, second, hours, change
):
    times = JUNE + np.arange(40) * 60.0 + np.repeat([0.0, 3600.0 * hours], 20)
    rows = zip(times, [*first, *second], strict=True)
    data = "time,T °C\n" + "".join(f"{time:.0f},{value:.1f}\n" for time, value in rows)
    if change is None:
        assert len(logged(tmp_path, data).times) == 40
        return
    with pytest.raises(DataError, match=f"line 22, .* the unit seems to change {change} here"):
        logged(tmp_path, data)


def test_no_two_days_of_a_real_log_have_two_units(shared, tmp_path):
    lines = (shared / "data/temperature_logs/six_ds18b20_15min_excerpt.tsv").read_text()
    head, *rows = lines.splitlines()[:-1]
    wanted = tuple(head.split("\t")[2:])
    for first in range(0, len(rows) - 300, 41):
        days = rows[first : first + 40] + rows[first + 250 : first + 290]
        assert len(logged(tmp_path, "\n".join([head, *days]), temperatures=wanted).channels) == 6


@pytest.mark.parametrize("head", ["Temp housing", "T1", "Settle tank T", "spot temp"])
def test_a_name_that_only_looks_like_another_quantity_is_a_temperature(tmp_path, head):
    found = read(tmp_path, [f"time;{head}"], lambda m, t, i: f"{int(m.timestamp())};{t:.2f}")
    assert len(found.channels) == 1


@pytest.mark.parametrize(
    "head",
    ["Pt100 mV", "Sensor Ohm", "T W/m²", "Delta T K", "T diff", "dT",
     # what a thermometer was to show
     "Setpoint", "setpoint temp", "T_set", "Set Temp (°C)", "Solltemperatur", "T_soll",
     "Target Temperature", "desired_temp", "consigne", "SP °C", "Temp max", "min temp",
     "avg temperature", "Forecast °C", "目标温度", "temp_set"],
)  # fmt: skip
def test_a_column_of_another_quantity_is_no_temperature(tmp_path, head):
    def row(m, t, i):
        return f"{int(m.timestamp())};{t:.2f}"

    if not head.startswith("avg"):  # a mean alone is one
        with pytest.raises(DataError, match="which column is the temperature"):
            read(tmp_path, [f"time;{head}"], row)
    found = read(tmp_path, [f"time;{head};Temp"], lambda m, t, i: f"{row(m, 2, i)};{t:.2f}")
    assert list(found.channels) == ["Temp"]


def test_the_minus_of_scandinavian_spreadsheets_is_one(tmp_path):
    found = read(
        tmp_path, ["time;T °C"], lambda m, t, i: f"{m:%Y-%m-%d %H:%M};−{t:.1f}".replace(".", ",")
    )
    assert found.channels["T"] == pytest.approx(-np.array(CELSIUS))
