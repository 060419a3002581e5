"""`thermocald devices` and the probe: over a sysfs tree, without hardware."""

from __future__ import annotations

import json

import pytest
import typer
import yaml
from typer.testing import CliRunner

from tests.drivers.fakes.sysfs import Sysfs, w1_slave
from thermocald.cli import devices
from thermocald.config import parse_config
from thermocald.hal import load_driver, option_names


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


def test_what_is_attached_can_be_written_as_it_is_shown(sysfs):
    found, notes = devices.attached()
    assert notes == []
    text = "\n".join(devices._stanzas(found))
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
            known = option_names(kind, stanza["driver"])
            assert set(stanza) - {"name", "driver"} <= set(known)


def test_the_command(sysfs, tmp_path):
    app = typer.Typer()
    devices.register(app)
    app.callback()(lambda: None)
    out = tmp_path / "devices.json"
    result = CliRunner().invoke(app, ["devices", "--json", str(out)])
    assert result.exit_code == 0, result.output
    document = json.loads(out.read_text())
    assert document["format"] == "thermocald-devices/1"
    assert len(document["devices"]) == 6
    assert "driver: ds18b20" in result.stdout


def test_a_probe_takes_one_of_each_and_names_what_fails(sysfs, tmp_path):
    root = str(sysfs.root)
    document = {
        "thermometers": [
            {"name": "lens", "driver": "hwmon", "chip": "1-0048", "sysfs": root},
            {"name": "gone", "driver": "hwmon", "chip": "tmp421", "sysfs": root},
        ]
    }
    config = parse_config(document, tmp_path / "config.yaml", option_names)
    good, bad = devices.probe(config)
    assert good.values == {"temperature_c": 21.0}
    assert good.shows == "temperature_c 21.0"
    assert "'tmp421' is not there" in bad.error
    lines = list(devices.probe_lines([good, bad]))
    assert lines[0].startswith("thermometer lens (hwmon), ")
    assert lines[0].endswith("temperature_c 21.0")
    assert "FAILED: " in lines[1]
    entries = devices.probe_document([good, bad])["devices"]
    assert [entry["error"] is None for entry in entries] == [True, False]


def test_a_probe_of_a_camera(tmp_path):
    config = parse_config({"cameras": [{"name": "m", "driver": "mock"}]}, tmp_path / "c.yaml")
    (frame,) = devices.probe(config)
    assert frame.error == ""
    assert frame.values["width_px"] > 0
    assert frame.took_s < 30
