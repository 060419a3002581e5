"""The unit's DeviceAllow= and the drivers' device classes are one list."""

from __future__ import annotations

import inspect
import re
from collections import defaultdict
from pathlib import Path

import pytest

from thermocald.daemon.soundness import KINDS
from thermocald.hal import driver_names, load_driver

SYSTEMD = Path(__file__).resolve().parents[2] / "systemd"
DRIVERS = [(kind, name) for kind in KINDS for name in driver_names(kind)]
# the character devices of Linux by the names of /proc/devices, and the udev subsystem of each
SUBSYSTEMS = {
    "char-dma_heap": "dma_heap",
    "char-gpiochip": "gpio",
    "char-i2c": "i2c-dev",
    "char-media": "media",
    "char-ttyACM": "tty",
    "char-ttyAMA": "tty",
    "char-ttyS": "tty",
    "char-ttyUSB": "tty",
    "char-usb_device": "usb",
    "char-video4linux": "video4linux",
}


def declared():
    """{device class: the drivers that open it}."""
    users = defaultdict(set)
    for kind, name in DRIVERS:
        for device_class in load_driver(kind, name).device_classes:
            users[device_class].add(name)
    return users


@pytest.mark.parametrize("unit", ["thermocald.service", "thermocald@.service"])
def test_the_unit_allows_what_the_drivers_open_and_nothing_else(unit):
    text = (SYSTEMD / unit).read_text()
    assert "\nDevicePolicy=closed\n" in text
    allowed = re.findall(r"^# (.*)\nDeviceAllow=(\S+) rw$", text, re.M)
    assert len(allowed) == len(re.findall("^DeviceAllow=", text, re.M))
    named = {device_class: set(users.split(", ")) for users, device_class in allowed}
    assert named == declared()


@pytest.mark.parametrize(("kind", "name"), DRIVERS)
def test_a_driver_that_names_a_node_declares_it(kind, name):
    """A module that mentions /dev/ or adb opens a node there."""
    driver = load_driver(kind, name)
    modules = {inspect.getmodule(one) for one in driver.__mro__}
    text = "".join(inspect.getsource(m) for m in modules if m.__name__.startswith("thermocald_dr"))
    if re.search(r"/dev/(?!null)|picamera2|adbutils|AdbPhone", text):
        assert driver.device_classes


def test_the_udev_rules_cover_every_class():
    rules = (SYSTEMD / "60-thermocald.rules").read_text()
    assert set(declared()) <= set(SUBSYSTEMS), "add the udev subsystem of the new class"
    for device_class in declared():
        subsystem = SUBSYSTEMS[device_class]
        (rule,) = [r for r in rules.splitlines() if f'SUBSYSTEM=="{subsystem}"' in r]
        if subsystem == "tty":
            assert f"{device_class.removeprefix('char-')}*" in rule
