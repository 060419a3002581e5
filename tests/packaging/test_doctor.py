"""`thermocald doctor` on folders that stand for machines."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.commands import answer
from thermocald.machine import Machine

PI = "proc/device-tree/model"
FINE = {
    PI: "Raspberry Pi 4 Model B Rev 1.4\x00",
    "etc/os-release": 'PRETTY_NAME="Debian GNU/Linux 13 (trixie)"\n',
    "boot/firmware/config.txt": "# as delivered\ncamera_auto_detect=1\n",
    "dev/i2c-1": "", "dev/video0": "", "dev/gpiochip0": "",
    "sys/devices/platform/soc/soc:firmware/get_throttled": "0\n",
    "sys/class/thermal/thermal_zone0/temp": "48312\n",
    "usr/bin/adb": "",
}  # fmt: skip


POWER, VOLTS = "sys/devices/platform/soc/soc:firmware/get_throttled", "sys/class/hwmon/hwmon1"


def look(root, files=(), groups=("video", "i2c", "gpio"), synchronised=True, modules=True):
    """Return findings by name of a machine with files; None as a text: the file is not there."""
    for name, text in {**FINE, **dict(files)}.items():
        if text is not None:
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    machine = Machine(root, "pi", 1000, frozenset(groups), synchronised, lambda name: modules)
    return {finding.name: finding for finding in machine.findings()}


def test_nothing_is_missing_on_a_pi_that_is_set_up(tmp_path):
    found = look(tmp_path)
    assert {name for name, f in found.items() if f.state == "missing"} == set()
    assert "Raspberry Pi 4" in found["machine"].text
    assert "trixie" in found["machine"].text


@pytest.mark.parametrize(
    ("changes", "name", "state", "said"),
    [
        ({"modules": False}, "camera stack", "missing", "apt-get install python3-picamera2"),
        ({"files": {"usr/lib/python3/dist-packages/picamera2/__init__.py": ""}, "modules": False},
         "camera stack", "missing", "--system-site-packages"),
        ({"groups": ("video",)}, "groups", "missing", "usermod -aG i2c,gpio pi"),
        ({"files": {"dev/i2c-1": None}}, "I2C", "missing", "raspi-config nonint do_i2c 0"),
        ({"files": {"boot/firmware/config.txt": "camera_auto_detect=0\n"}},
         "camera connector", "missing", "camera_auto_detect=1"),
        ({"synchronised": False}, "clock", "missing", "timedatectl set-ntp true"),
        ({"files": {POWER: "50005"}}, "power", "missing", "power supply"),
        ({"files": {POWER: "0x0"}}, "power", "ok", "no under-voltage"),
        ({"files": {POWER: "50000"}}, "power", "warning", "too low since the start"),
        ({"files": {POWER: "8"}}, "power", "missing", "temperature limit now"),
        ({"files": {POWER: "nonsense"}}, "power", "warning", "does not report"),
        ({"files": {POWER: None, f"{VOLTS}/name": "rpi_volt\n", f"{VOLTS}/in0_lcrit_alarm": "1\n"}},
         "power", "missing", ""),
    ],
)  # fmt: skip
def test_what_is_missing_has_the_line_that_mends_it(tmp_path, changes, name, state, said):
    finding = look(tmp_path, **changes)[name]
    assert finding.state == state
    assert said in f"{finding.text} {finding.remedy}"


def test_an_empty_folder_is_a_machine_without_anything(tmp_path):
    machine = Machine(tmp_path, "me", 1000, frozenset(), None, lambda name: False)
    assert [f.name for f in machine.findings() if f.state == "missing"] == []


def test_the_command_works_on_this_machine():
    done = answer("doctor", "--json", "-")
    document = json.loads(done.stdout)
    assert document["format"] == "thermocald-doctor/1"
    missing = any(f["state"] == "missing" for f in document["findings"])
    assert done.exit_code == (1 if missing else 0), done.output
    assert {"machine", "clock", "disk"} <= {f["name"] for f in document["findings"]}


def test_lines_are_for_people(tmp_path):
    (tmp_path / "proc/device-tree").mkdir(parents=True)
    (tmp_path / PI).write_text("Raspberry Pi 3 Model B")
    done = answer("doctor", "--root", tmp_path)
    assert done.exit_code == 1
    assert "MISSING  I2C" in done.stdout
    assert "→ sudo raspi-config nonint do_i2c 0" in done.stdout
    assert done.stdout.splitlines()[-1].startswith("to mend: ")
    assert Path(PI).name not in done.stdout
