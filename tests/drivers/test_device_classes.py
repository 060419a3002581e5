"""The unit's DeviceAllow= and the drivers' device classes are one list."""

from __future__ import annotations

import inspect
import re
from collections import defaultdict
from pathlib import Path

from tests.drivers.test_contract import REGISTERED
from thermocald.hal import load_driver

SYSTEMD = Path(__file__).resolve().parents[2] / "systemd"
# the udev subsystem of each class of /proc/devices
SUBSYSTEMS = {
    "char-dma_heap": "dma_heap", "char-gpiochip": "gpio", "char-i2c": "i2c-dev",
    "char-media": "media", "char-usb_device": "usb", "char-video4linux": "video4linux",
    **{f"char-tty{kind}": "tty" for kind in ("ACM", "AMA", "S", "USB")},
}  # fmt: skip


def test_a_driver_that_names_a_node_declares_it_as_the_unit_and_udev_rules_do():
    declared = defaultdict(set)
    for kind, name in REGISTERED:
        driver = load_driver(kind, name)
        for device_class in driver.device_classes:
            declared[device_class].add(name)
        modules = {inspect.getmodule(one) for one in driver.__mro__}
        ours = [m for m in modules if m.__name__.startswith("thermocald_dr")]
        sources = "".join(map(inspect.getsource, ours))
        if re.search(r"/dev/(?!null)|picamera2|adbutils|AdbPhone", sources):
            assert driver.device_classes, name
    for unit in ("thermocald.service", "thermocald@.service"):
        text = (SYSTEMD / unit).read_text()
        assert "\nDevicePolicy=closed\n" in text
        allowed = re.findall(r"^# (.*)\nDeviceAllow=(\S+) rw$", text, re.M)
        assert len(allowed) == len(re.findall("^DeviceAllow=", text, re.M))
        assert {node: set(users.split(", ")) for users, node in allowed} == declared
    rules = (SYSTEMD / "60-thermocald.rules").read_text()
    for device_class in declared:
        subsystem = SUBSYSTEMS[device_class]
        (rule,) = [r for r in rules.splitlines() if f'SUBSYSTEM=="{subsystem}"' in r]
        if subsystem == "tty":
            assert f"{device_class.removeprefix('char-')}*" in rule
