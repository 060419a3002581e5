"""`thermocald devices` and `check --probe`, on a sysfs tree without hardware."""

from __future__ import annotations

import json
import re

import pytest
import yaml

from tests.commands import answer, succeed
from tests.drivers.fakes.sysfs import Sysfs, w1_slave
from tests.drivers.small_camera import write_small_camera
from thermocald.daemon import soundness as devices
from thermocald.errors import ConfigurationError, DeviceError
from thermocald.hal import load_driver


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
    tree.write("class/video4linux/video0/name", "HD Pro Webcam C920")
    tree.write("class/video4linux/video0/index", "0")
    tree.write("class/video4linux/video1/name", "HD Pro Webcam C920")
    tree.write("class/video4linux/video1/index", "1")
    names = ["hwmon", "thermal_zone", "ds18b20", "tmp117"]
    classes = [load_driver("thermometer", name) for name in names]
    classes.append(load_driver("camera", "v4l2"))
    for driver in classes:
        look = driver.attached.__func__
        monkeypatch.setattr(
            driver, "attached", classmethod(lambda cls, look=look: look(cls, sysfs=str(tree.root)))
        )
    monkeypatch.setattr(
        devices,
        "driver_names",
        lambda kind: {"thermometer": names, "camera": ["v4l2"], "output": []}[kind],
    )
    return tree


def test_what_is_attached_can_be_written_as_it_is_shown(sysfs, tmp_path):
    out = tmp_path / "devices.json"
    text = succeed("devices", "--json", out).stdout
    document = json.loads(out.read_text())
    assert document["format"] == "thermocald-devices/1"
    assert (len(document["devices"]), document["notes"]) == (6, [])
    stanzas = yaml.safe_load(text)
    assert [(t["driver"], t.get("chip") or t.get("zone")) for t in stanzas["thermometers"]] == [
        ("hwmon", "1-0048"),
        ("hwmon", "1-0049"),
        ("thermal_zone", "cpu-thermal"),
        ("ds18b20", None),
    ]
    assert "# - {name: tmp117-5, driver: tmp117, bus: 1" in text  # not certain: a comment
    assert [c["device"] for c in stanzas["cameras"]] == ["/dev/video0"]  # not the metadata node
    for kind, key in (("thermometer", "thermometers"), ("camera", "cameras")):
        for stanza in stanzas[key]:
            known = load_driver(kind, stanza["driver"]).Options.model_fields
            assert set(stanza) - {"name", "driver"} <= set(known)


@pytest.fixture
def check(tmp_path):
    """Run `thermocald check config.yaml --probe`; return its error, lines and JSON."""

    def run(document, *more):
        path = tmp_path / "config.yaml"
        path.write_text(yaml.safe_dump(document))
        out = tmp_path / "check.json"
        result = answer("check", path, "--json", out, *more)
        said = json.loads(out.read_text()) if out.exists() else None
        return result.exception, result.stdout.splitlines(), said

    return run


def devices_of_which_the_first_fails(sysfs):
    root = str(sysfs.root)
    return {
        "store": {"path": "t.db"},
        "cameras": [
            {"name": "gone", "driver": "v4l2", "device": f"{root}/dev/video9", "width": 64,
             "height": 48},
        ],
        "thermometers": [
            {"name": "away", "driver": "hwmon", "chip": "tmp421", "sysfs": root},
            {"name": "lens", "driver": "hwmon", "chip": "1-0048", "sysfs": root},
        ],
        "outputs": [{"name": "log", "driver": "jsonl", "path": f"{root}/r.jsonl"}],
    }  # fmt: skip


def test_check_shows_every_device_though_the_first_fails(sysfs, check):
    document = devices_of_which_the_first_fails(sysfs)
    small = {"model": str(write_small_camera(sysfs.root / "small.thermal.yaml"))}
    document["cameras"].append({"name": "left", "driver": "mock", "period_s": 10, "options": small})
    error, lines, document = check(document, "--probe")
    assert isinstance(error, DeviceError)
    assert error.exit_status == 3
    assert "2 of 4 devices failed: gone, away" in str(error)
    shown = {line.split()[1]: line for line in lines if line.startswith("  ")}
    assert "FAILED: " in shown["gone"]
    assert "'tmp421' is not there" in shown["away"]
    assert re.search(r"thermometer lens \(hwmon\), \d+ ms: temperature_c 21\.0$", shown["lens"])
    assert "width_px 820, height_px 616" in shown["left"]
    assert shown["log:"] == "  output log: driver jsonl"  # never tried: it might switch a lamp
    failed = {probe["name"]: probe["error"] is not None for probe in document["probes"]}
    assert failed == {"gone": True, "left": False, "away": True, "lens": False}


def test_check_goes_on_after_a_driver_with_a_mistake(sysfs, check, monkeypatch):
    def read(_):
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(load_driver("thermometer", "hwmon"), "read", read)
    document = devices_of_which_the_first_fails(sysfs)
    error, lines, _ = check(document, "--probe")
    assert isinstance(error, DeviceError)
    (line,) = (line for line in lines if "thermometer lens" in line)
    assert "FAILED: its driver failed: ZeroDivisionError: division by zero" in line


def test_check_refuses_what_a_driver_does_not_take(sysfs, check):
    """Without a probe, devices are only constructed: a wrong address shows without hardware."""
    document = devices_of_which_the_first_fails(sysfs)
    document["thermometers"].append({"name": "box", "driver": "mcp9808", "address": 0x48})
    error, _, said = check(document)
    assert isinstance(error, ConfigurationError)
    assert "config.yaml: thermometer box: " in str(error)
    assert "0x48" in str(error)
    assert said is None


def test_check_warns_of_a_camera_that_may_focus(check):
    camera = {"name": "web", "driver": "v4l2", "device": "/dev/video9", "width": 64, "height": 48}
    document = {"store": {"path": "t.db"}, "cameras": [{**camera, "focus": "auto"}]}
    error, lines, _ = check(document)
    assert error is None
    (warning,) = [line for line in lines if "warning" in line]
    assert "camera web: warning: focus: auto lets the camera change it" in warning
