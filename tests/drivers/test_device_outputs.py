"""Outputs of devices, each with the expected reading: right, or rejected with its reason.

Those found in public are the files of ../shared/data/devices, whose first line has source, kind,
expected and options, and of ../shared/data/adb, read by hand; the others are in OUTPUTS. Those of
data sheets and public drivers are the rows of `chip_outputs.tsv`: driver, chip, output, further
options, temperature or `refuse`, source. The unchanged driver reads each as the first reading after
opening, so that nothing supports an idle value: from an adb server, a tty or a sysfs tree.
"""

from __future__ import annotations

import csv
import json
import re
import threading
from pathlib import Path

import pytest

from tests.drivers.fakes.adb_server import FakePhone
from tests.drivers.fakes.pty_instrument import Instrument
from tests.drivers.fakes.sysfs import Sysfs, scratchpad, w1_slave
from thermocald.errors import BadReading, DeviceDenied, DeviceError, DeviceGone
from thermocald.hal import SystemClock, VirtualClock, open_device

DATA = Path(__file__).parents[3] / "shared/data"
HEAD = re.compile(
    r"# source: .*? \| kind: (?P<kind>\w+) \| expected: (?P<expected>.*?)"
    r"(?: \| options: (?P<options>.*))?$"
)


def read(driver, clock=None, **options):
    with open_device("thermometer", driver, options, clock or VirtualClock()) as device:
        return device.read().values


def phone_reads(server, sensors, **dumps):
    server.listing = None
    server.phones = {"X": FakePhone(**{"battery": "", **dumps})}
    return read("android", serial="X", port=server.port, start_server=False, sensors=sensors)


def battery(server, folder, text, options):
    return phone_reads(server, {"temperature": "battery"}, battery=text)["temperature"]


def thermal(server, folder, text, options):
    names = {"battery", *re.findall(r"mName=(\w[^,}\n]*)", text)} - {"soc"}
    return phone_reads(server, {name: f"thermal:{name}" for name in names}, thermal=text)


def zones(server, folder, text, options):
    names = {line.split()[0] for line in text.splitlines() if line.split()} | {"battery"}
    return phone_reads(server, {name: f"zone:{name}" for name in names}, zones=text)


def onewire(server, folder, text, options):
    rom = f"{options['family']}-000000bfe244"
    Sysfs(folder).w1(rom, text)
    return read("ds18b20", sensors={"temperature": rom}, sysfs=str(folder))["temperature"]


def kernel(server, folder, text, options):
    """Read an input of `driver`; text: its file, or NAME=CONTENT of several."""
    driver, name = options["driver"], options["name"]
    given = dict(part.split("=") for part in text.split()) if "=" in text else {"input": text}
    prefix = {"hwmon": "temp1_", "iio": "in_temp_"}.get(driver)
    own = "fault_" if driver == "iio" else " "  # of the chip, not of an input
    files = {k if k.startswith(own) else f"{prefix}{k}": v for k, v in given.items()}
    if prefix:
        getattr(Sysfs(folder), driver)(0, name, **files)
    else:
        Sysfs(folder).zone(0, name, text)
    more = {key: value for key, value in options.items() if key not in ("driver", "name")}
    key = "chip" if prefix else "zone"
    return read(driver, **{key: name, "sysfs": str(folder), **more})["temperature"]


def serial(server, folder, text, options):
    far, stop = Instrument(), threading.Event()
    line = text.encode("latin-1").replace(b"\r\n", b"\n").replace(b"\n", b"\r\n")

    def speak():
        """Send unprompted and repeatedly: on a busy machine the first may precede the reading."""
        while not stop.wait(0.004):
            far.send(b"\r\n" + line + b"\r\n")

    speaker = threading.Thread(target=speak)
    try:
        stanza = {"port": far.port, "timeout_s": 0.4, **options}
        with open_device("thermometer", "serial", stanza, SystemClock()) as device:
            speaker.start()
            return device.read().values["temperature"]
    finally:
        stop.set()
        speaker.join()
        far.close()


def devices(server, folder, text, options):
    server.listing = text.rstrip("\n") + "\n"
    stanza = {"serial": options["serial"], "port": server.port, "start_server": False}
    try:
        with open_device("thermometer", "android", stanza, VirtualClock()):
            return "ok"
    except (DeviceDenied, DeviceGone) as error:
        return {DeviceDenied: "denied", DeviceGone: "gone"}[type(error)]


READERS = {f.__name__: f for f in (battery, thermal, zones, onewire, kernel, serial, devices)}


def of_file(path):
    head, _, text = path.read_bytes().decode("latin-1").partition("\n")
    match = HEAD.fullmatch(head.encode("latin-1").decode("utf-8"))
    options, expected = json.loads(match["options"] or "{}"), json.loads(match["expected"])
    return pytest.param(match["kind"], text, options, expected, id=path.stem)


# libcamera's sensor temperature is not a reading
FILES = [
    p for p in sorted((DATA / "devices").glob("*.txt")) if b"kind: picam" not in p.read_bytes()
]
A52 = {"AP": 25.6, "BAT": 23.8, "LRB": 24.7, "LRF": 24.7, "LRP": 24.7, "PA": 25.7}
LIVE = {"cpu0-silver-usr": 32.300003}
# number of the file, its part, some of the readings
DUMPS = [
    ("battery", "01", 0, 30.9), ("battery", "02", 0, 27.5), ("battery", "03", 0, "refuse"),
    ("battery", "04", 0, 24.2),
    ("thermal", "06", 0, A52 | dict.fromkeys(("SUBBAT", "SUBBATRAW", "USB"), "absent")),
    ("thermal", "07", 0, "refuse"),  # only the cache is printed
    ("thermal", "08", 0, LIVE | {"maxfg": 25.900002}),  # the cache says 54.600002
    # volts and percent
    ("thermal", "10", 0, {"skin": 33.136, "vbat": "absent", "socd": "absent"}),
    ("thermal", "12", 0, LIVE), ("thermal", "12", 1, LIVE),
    ("thermal", "12", 2, {"test temperature sensor": 30.8}),
    ("thermal", "15", 0, "refuse"),  # a HAL that is not ready
]  # fmt: skip


def of_dump(kind, number, part, expected):
    path = next((DATA / "adb").glob(f"{number}_*.txt"))
    return pytest.param(kind, path.read_text().split("\n---\n")[part], {}, expected, id=path.stem)


def record(value, kind=2, name="battery"):
    return f"\tTemperature{{mValue={value}, mType={kind}, mName={name}, mStatus=0}}\n"


HAL = """HAL Ready: true
Cached temperatures:
	Temperature{mValue=61.0, mType=3, mName=skin, mStatus=0}
HAL connection:
	ThermalHAL AIDL 3 connected: yes
Current temperatures from HAL:
%sCurrent cooling devices from HAL:
	CoolingDevice{mValue=0, mType=2, mName=thermal-cpufreq-0}
Temperature static thresholds from HAL:
	TemperatureThreshold{mType=3, mName=skin, mHotThrottlingThresholds=[NaN, 39.0, 43.0]}
"""
WARM = "pm_tz 30500\n"
TWO = {"skin": 31.0, "battery": 25.0}
NO_SENSOR, UNKNOWN = "the phone does not report it", "the unit of .* is unknown"
DEGREES = {"pattern": r"(?P<temperature>[-+]?\d+\.\d+) ?°C"}
CHECKED = {"pattern": r"T=(?P<temperature>[-+]?\d+\.\d+)(?:°C)?\*(?P<checksum>[0-9A-Fa-f]{2})"}
GOOD = w1_slave(21.0)
# (kind, options, [(output, reading or reason)])
OUTPUTS = [
    ("battery", {}, [
        ("present: true\n temperature: 25", "unknown unit"),
        ("voltage: 4\n temperature: 85", "unknown unit"),  # 85 °C or 8.5 °C
        ("present: false\n temperature: 250", "no battery"),
        ("(UPDATES STOPPED -- use 'reset' to restart)\n temperature: 250", "frozen"),
        ("  voltage: 4352\r\n  temperature: 274\r\n", 27.4), ("status: 2 temperature: 268", "no b"),
        ("temperature: ٢٥٠", "no battery"),
    ]),
    ("thermal", {}, [
        (HAL % record(31.5, 3, "back cover"), {"back cover": 31.5}),
        (HAL % record(75.0, 13, "lmh-dcvs-00"), NO_SENSOR),  # a limit
        (HAL % record(33250.0, 3, "skin"), "outside"),  # millidegrees
        (HAL % record(-40.0, 15, "camera"), "outside"),  # not fitted
        *((HAL % record(value), NO_SENSOR) for value in ("NaN", "0.0", "2_5.0", "Infinity", "")),
        # their unit is not degrees
        *((HAL % record(46.7, kind), NO_SENSOR) for kind in (-1, 6, 7, 8, 20)),
        # a name with a line end does not hide the other sensors
        (HAL % (record(42.0, -1, "soc\n") + record(31.0, 3, "skin\n") + record(25.0)), TWO),
        ((HAL % (record(25.0) + "Cached temperatures:\n" + record(55.0, 0, "cpu"))).replace(
            "\n", "\r\n"), {"battery": 25.0, "cpu": "absent"}),
        (HAL % (record(25.0) + record(31.0, 3)), NO_SENSOR),  # one name for two sensors
    ]),
    ("zones", {}, [
        ("cpu-0-0-usr 37000", {"cpu-0-0-usr": 37.0}), ("foo 370", {"foo": 37.0}),
        ("foo -5500", {"foo": -5.5}), ("foo 37", UNKNOWN),  # 37 °C or 3.7 °C
        ("foo 900", UNKNOWN), ("foo 1003", UNKNOWN),  # 90 °C or 0.9 °C; 100.3 °C or 1.003 °C
        ("tsens_tz_sensor5 45", UNKNOWN), ("battery 370", {"battery": 37.0}),
        ("battery 45", UNKNOWN), ("battery 25500", {"battery": 25.5}),
        ("mtktsAP 45", {"mtktsAP": 45.0}), ("xo_therm_buf 31", {"xo_therm_buf": 31.0}),
        ("pa_therm1 -40", UNKNOWN), ("foo -274000", UNKNOWN), ("foo 0", "absent sensor"),
        # among others: in the unit of its neighbours
        ("foo 37\n" + WARM, {"foo": 37.0}),
        ("tsens_tz_sensor5 45\n" + WARM, {"tsens_tz_sensor5": 45.0}),
        # 45 °C under load or 4.5 °C at rest
        ("tsens_tz_sensor5 45\npm_tz 5200\n", {"tsens_tz_sensor5": "absent"}),
        (f"chg_temp 7\n{WARM}xo_therm 31", {"chg_temp": 7.0}),
        *((f"{name} 25000", "by its name") for name in (
            "soc", "socd", "pm8150b-ibat-lvl0", "pm8150b-vbat-lvl0", "pm8150l-bcl-lvl0", "vbat",
            "pm8150l-vph-lvl0", "smpl_gm", "soft_ocp_gpu", "batoilo", "battery_cycle",
            "USB2-MINUS-QI", "FLASH_LED_REDUCE", "ibat-high", "vdroop1")),
        *((f"{name} 25000", {name: 25.0}) for name in (
            "soc-thermal", "soc_max", "VIRTUAL-SKIN", "mtktspa")),
        ("gpu 36000\r\nbroken \ncat: x: Permission denied\nx 2_5", {"gpu": 36.0}),
        ("gpu 36000\ngpu 45000", NO_SENSOR),  # one name for two
    ]),
    ("onewire", {"family": "28"}, [
        ("", "empty: no answer"), ("garbage", "not a w1_slave"),
        (GOOD.splitlines()[0], "not a w1_slave"), (GOOD.replace("t=21", "t=2_1"), "not a w1_slave"),
        (GOOD.replace("t=21000", "t=21500"), "does not follow"),
        (GOOD.replace("YES", "NO"), "CRC error"), (w1_slave(125.5), "outside"),
        # 25 °C of a chip that is not of family D
        (scratchpad("90 01 4b 46 7f ff 10 10", 25000), 25.0),
        # GX20MH01, by a kernel that does not support it, and in a frost
        (scratchpad("90 01 4b 46 e3 ff 0c 10", 25000), 25.046),
        (scratchpad("70 fe 4b 46 e2 ff 0c 10", -24968), -24.968),
        (scratchpad("ff 07 4b 46 7f ff 0c 10", 127937), "outside"),  # a failed conversion
    ]),
    ("onewire", {"family": "3b"}, [(scratchpad("94 01 98 19 f0 ff ff ff", 25250), 25.25)]),
    ("onewire", {"family": "10"}, [
        (scratchpad("e6 ff 4b 46 ff ff 08 10", -12750), -12.75),
        (scratchpad("2a 00 4b 46 ff ff 0e 00", 0), "COUNT_PER_C"),
    ]),
    ("kernel", {"driver": "hwmon", "name": "w1_slave_temp"}, [("85000", "power-on")]),
    ("kernel", {"driver": "hwmon", "name": "lm90"}, [("input=21000 fault=1", "fault")]),
    ("kernel", {"driver": "hwmon", "name": "lm75"}, [
        ("31.0", "31.0 is not a whole number of 1/1000 °C"), ("", "not a number")]),
    # bmp280 family: raw only; ABI: (raw + offset) * scale in m°C
    ("kernel", {"driver": "iio", "name": "tmp006"}, [
        ("raw=731 scale=31.25 offset=10", 741 * 31.25 / 1000), ("input=21530 raw=1 scale=1", 21.53),
        ("raw=731", "scale")]),
    ("kernel", {"driver": "thermal_zone", "name": "camera-therm-usr"}, [
        ("48312", 48.312), ("-274000", "outside"), ("-40000", "absent sensor")]),
    ("serial", DEGREES, [  # of other encodings
        (f"27.0{sign.decode('latin-1')}C", 27.0)
        for sign in ("°".encode(), b"\xb0", b"\xf8", b"\xdf", "º".encode())]),
    *(("serial", {**CHECKED, "checksum": kind}, [
        (f"T=20.50*{value:02X}", 20.5), (f"T=20.51*{value:02X}", "checksum")])
      for kind, value in (("xor", 0x6A), ("sum8", 0xB0), ("nmea", 0x40))),
    ("serial", {**CHECKED, "checksum": "sum8"}, [  # of the bytes
        ("T=20.50°C*65".encode().decode("latin-1"), 20.5)]),
]  # fmt: skip
ROWS = [
    *map(of_file, FILES),
    *(of_dump(*row) for row in DUMPS if DATA.is_dir()),
    *((kind, text, more, told) for kind, more, outputs in OUTPUTS for text, told in outputs),
]


@pytest.mark.parametrize(("kind", "text", "options", "expected"), ROWS)
def test_an_output_is_read_as_it_should(kind, text, options, expected, server, tmp_path):
    try:
        found = READERS[kind](server, tmp_path, text, options)
    except BadReading as error:
        found = f"refuse: {error}"
    except DeviceError:
        found = "refuse" if expected == "refuse" else "error"
    if isinstance(expected, str):
        assert re.search(expected, str(found))
        return
    if isinstance(expected, dict):
        found = {name: found.get(name, "absent") for name in expected}
    assert found == (pytest.approx(expected) if isinstance(expected, float) else expected)


with Path(__file__).with_name("chip_outputs.tsv").open() as file:
    CHIPS = list(csv.DictReader(file, delimiter="\t", quoting=csv.QUOTE_NONE))
REFUSE = "refuse"


def reading(row, server, folder):
    """Return the driver's °C for a row; raises BadReading."""
    driver, text = row["driver"], row["what it gives"]
    options = json.loads(row["options"] or "{}")
    if driver == "serial":
        options = {"pattern": r"T=(?P<temperature>\S+)", **options}
        return serial(server, folder, text, options)
    if driver == "battery":
        lines = "".join(f"  {part.replace('=', ': ')}\n" for part in text.split())
        text = f"Current Battery Service state:\n  present: true\n{lines}"
        return battery(server, folder, text, {})
    driver = {"zone": "thermal_zone"}.get(driver, driver)
    return kernel(server, folder, text, {"driver": driver, "name": row["chip"], **options})


PARTS = {"serial": 12, "hwmon": 4, "iio": 6}


@pytest.mark.parametrize(
    ("driver", "every"),
    [
        *((driver, PARTS.get(driver, 1)) for driver in sorted({row["driver"] for row in CHIPS})),
        *(pytest.param(driver, 1, marks=pytest.mark.slow) for driver in PARTS),
    ],
)
def test_a_chip_is_read_rightly_or_refused(driver, every, server, tmp_path):
    wrong = []
    for k, row in enumerate([row for row in CHIPS if row["driver"] == driver][::every]):
        found, message, expected = REFUSE, "", row["expected"]
        try:
            found = reading(row, server, tmp_path / str(k))
        except BadReading as error:
            message = str(error)
        # the kernel's offsets and scales are rounded to as much as 3 mK
        meant = REFUSE if expected == REFUSE else pytest.approx(float(expected), abs=5e-3)
        if found != meant or len(message.splitlines()) > 1:
            wrong.append((row["chip"], row["what it gives"], found, expected, message))
    assert wrong == []


def test_there_are_enough():
    """With good readings among them: otherwise a driver that rejects everything would pass."""
    assert len(CHIPS) >= 1050
    assert sum(row["expected"] != REFUSE for row in CHIPS) >= 200
