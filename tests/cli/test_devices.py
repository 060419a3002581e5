"""`thermocald devices` and `check --probe`, on a sysfs tree without hardware."""

from __future__ import annotations

import json
import re

import pytest
import yaml

from tests.commands import answer, succeed
from tests.drivers.fakes.sysfs import Sysfs, w1_slave
from tests.drivers.small_camera import write_small_camera
from thermocald.daemon import soundness
from thermocald.errors import ConfigurationError, DeviceError
from thermocald.hal import load_driver

DRIVERS = {
    "thermometer": ["hwmon", "thermal_zone", "ds18b20", "tmp117"], "camera": ["v4l2"], "output": []
}  # fmt: skip


@pytest.fixture
def sysfs(tmp_path, monkeypatch):
    """A machine with two hwmon chips of one name, a zone, a 1-wire probe, an I2C bus, a camera."""
    tree = Sysfs(tmp_path / "sys")
    tree.hwmon(0, "lm75", "1-0048", temp1_input="21000")
    tree.hwmon(1, "lm75", "1-0049", temp1_input="22000")
    tree.hwmon(2, "nvme_no_temperature")
    tree.zone(0, "cpu-thermal", "48312")
    tree.w1("28-000000bfe244", w1_slave(20.0))
    tree.write("class/i2c-dev/i2c-1/name", "bcm2835")
    for index in ("0", "1"):
        tree.write(f"class/video4linux/video{index}/name", "HD Pro Webcam C920")
        tree.write(f"class/video4linux/video{index}/index", index)
    for kind, name in ((kind, name) for kind, names in DRIVERS.items() for name in names):
        driver = load_driver(kind, name)
        look = driver.attached.__func__
        attached = classmethod(lambda cls, look=look: look(cls, sysfs=str(tree.root)))
        monkeypatch.setattr(driver, "attached", attached)
    monkeypatch.setattr(soundness, "driver_names", DRIVERS.get)
    return tree


def test_what_is_attached_can_be_written_as_it_is_shown(sysfs, tmp_path):
    out = tmp_path / "devices.json"
    text = succeed("devices", "--json", out).stdout
    document = json.loads(out.read_text())
    assert (len(document["devices"]), document["notes"]) == (6, [])
    stanzas = yaml.safe_load(text)
    assert [(t["driver"], t.get("chip") or t.get("zone")) for t in stanzas["thermometers"]] == [
        ("hwmon", "1-0048"), ("hwmon", "1-0049"), ("thermal_zone", "cpu-thermal"), ("ds18b20", None)
    ]  # fmt: skip
    assert "# - {name: tmp117-5, driver: tmp117, bus: 1" in text  # not certain: a comment
    assert [c["device"] for c in stanzas["cameras"]] == ["/dev/video0"]  # not the metadata node
    for kind, key in (("thermometer", "thermometers"), ("camera", "cameras")):
        for stanza in stanzas[key]:
            known = load_driver(kind, stanza["driver"]).Options.model_fields
            assert set(stanza) - {"name", "driver"} <= set(known)


@pytest.fixture
def check(tmp_path):
    """Run `thermocald check config.yaml`; return its error and lines."""

    def run(document, *more):
        path = tmp_path / "config.yaml"
        path.write_text(yaml.safe_dump({"store": {"path": "t.db"}, **document}))
        result = answer("check", path, *more)
        return result.exception, result.stdout.splitlines()

    return run


@pytest.fixture
def devices(sysfs):
    """Devices of which the first camera and the first thermometer are not there."""
    root, model = str(sysfs.root), write_small_camera(sysfs.root / "small.thermal.yaml")
    return {
        "cameras": [
            {"name": "gone", "driver": "v4l2", "device": f"{root}/dev/video9", "width": 64,
             "height": 48},
            {"name": "left", "driver": "mock", "period_s": 10, "options": {"model": str(model)}},
        ],
        "thermometers": [
            {"name": "away", "driver": "hwmon", "chip": "tmp421", "sysfs": root},
            {"name": "lens", "driver": "hwmon", "chip": "1-0048", "sysfs": root},
        ],
        "outputs": [{"name": "log", "driver": "jsonl", "path": f"{root}/r.jsonl"}],
    }  # fmt: skip


def test_check_shows_every_device_though_the_first_fails(devices, check, tmp_path):
    error, lines = check(devices, "--probe", "--json", tmp_path / "check.json")
    assert isinstance(error, DeviceError)
    assert error.exit_status == 3
    assert "2 of 4 devices failed: gone, away" in str(error)
    shown = {line.split()[1]: line for line in lines if line.startswith("  ")}
    assert "FAILED: " in shown["gone"]
    assert "'tmp421' is not there" in shown["away"]
    assert re.search(r"thermometer lens \(hwmon\), \d+ ms: temperature_c 21\.0$", shown["lens"])
    assert "width_px 820, height_px 616" in shown["left"]
    assert shown["log:"] == "  output log: driver jsonl"  # never tried: it might switch a lamp
    probes = json.loads((tmp_path / "check.json").read_text())["probes"]
    failed = {probe["name"]: probe["error"] is not None for probe in probes}
    assert failed == {"gone": True, "left": False, "away": True, "lens": False}


def test_check_goes_on_after_a_driver_with_a_mistake(devices, check, monkeypatch):
    monkeypatch.setattr(load_driver("thermometer", "hwmon"), "read", lambda _: 1 / 0)
    error, lines = check(devices, "--probe")
    assert isinstance(error, DeviceError)
    (line,) = (line for line in lines if "thermometer lens" in line)
    assert "FAILED: its driver failed: ZeroDivisionError: division by zero" in line


def test_check_refuses_what_a_driver_does_not_take(devices, check):
    """Without a probe, devices are only constructed: a wrong address shows without hardware."""
    devices["thermometers"].append({"name": "box", "driver": "mcp9808", "address": 0x48})
    error, _ = check(devices)
    assert isinstance(error, ConfigurationError)
    assert re.search(r"config\.yaml: thermometer box: .*0x48", str(error))
