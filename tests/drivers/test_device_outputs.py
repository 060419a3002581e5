"""Outputs of devices as found in public, each with the expected reading.

The files of ../shared/data/devices; the first line of each: source, kind, expected, options.
The unchanged driver reads each: from an adb server, a tty or a sysfs tree.
"""

from __future__ import annotations

import json
import re
import threading
from pathlib import Path

import pytest

from tests.drivers.fakes.adb_server import FakePhone
from tests.drivers.fakes.pty_instrument import Instrument
from tests.drivers.fakes.sysfs import Sysfs
from thermocald.errors import BadReading, DeviceDenied, DeviceError, DeviceGone
from thermocald.hal import SystemClock, VirtualClock, open_device

FOLDER = Path(__file__).parents[3] / "shared/data/devices"
# libcamera's sensor temperature is not a reading
FILES = [p for p in sorted(FOLDER.glob("*.txt")) if b"kind: picamera" not in p.read_bytes()]
HEAD = re.compile(
    r"# source: .*? \| kind: (?P<kind>\w+) \| expected: (?P<expected>.*?)"
    r"(?: \| options: (?P<options>.*))?$"
)

pytestmark = pytest.mark.skipif(not FILES, reason=f"{FOLDER} is not there")


def android(server, serial, **options):
    options = {"serial": serial, "port": server.port, "start_server": False, **options}
    return open_device("thermometer", "android", options, VirtualClock())


def phone_reads(server, sensors, **dumps):
    server.listing = None
    server.phones = {"X": FakePhone(**{"battery": "", **dumps})}
    with android(server, "X", sensors=sensors) as device:
        return device.read().values


def battery(server, tmp_path, text, options):
    return phone_reads(server, {"temperature": "battery"}, battery=text)["temperature"]


def thermal(server, tmp_path, text, options):
    names = set(re.findall(r"mName=([^,\s]*)", text)) or {"battery"}
    return phone_reads(server, {name: f"thermal:{name}" for name in names}, thermal=text)


def zones(server, tmp_path, text, options):
    names = {line.split()[0] for line in text.splitlines() if line.split()} | {"battery"}
    return phone_reads(server, {name: f"zone:{name}" for name in names}, zones=text)


def onewire(server, tmp_path, text, options):
    rom = f"{options['family']}-000000bfe244"
    Sysfs(tmp_path).w1(rom, text)
    stanza = {"sensors": {"temperature": rom}, "sysfs": str(tmp_path)}
    with open_device("thermometer", "ds18b20", stanza, VirtualClock()) as device:
        return device.read().values["temperature"]


def serial(server, tmp_path, text, options):
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


def devices(server, tmp_path, text, options):
    server.listing = text.rstrip("\n") + "\n"
    try:
        with android(server, options["serial"]):
            return "ok"
    except DeviceDenied:
        return "denied"
    except DeviceGone:
        return "gone"


READERS = {f.__name__: f for f in (battery, thermal, zones, onewire, serial, devices)}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_an_output_is_read_as_it_should(path, server, tmp_path):
    head, _, text = path.read_bytes().decode("latin-1").partition("\n")
    match = HEAD.fullmatch(head.encode("latin-1").decode("utf-8"))
    expected = json.loads(match["expected"])
    options = json.loads(match["options"] or "{}")
    try:
        found = READERS[match["kind"]](server, tmp_path, text, options)
    except BadReading:
        found = "refuse"
    except DeviceError:
        found = "refuse" if expected == "refuse" else "error"
    if isinstance(expected, dict):
        found = {name: found.get(name, "absent") for name in expected}
    assert found == (pytest.approx(expected) if isinstance(expected, float) else expected)
