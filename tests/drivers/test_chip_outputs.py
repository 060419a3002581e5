"""Outputs of chips and loggers, from data sheets and public drivers: right or rejected.

`chip_outputs.tsv` has a row for each: the driver, the chip, its output, further options, the
temperature or `refuse`, and the source. The unchanged driver reads each as the first reading after
opening, so that nothing supports an idle value.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from tests.drivers.fakes.sysfs import Sysfs
from tests.drivers.test_device_outputs import phone_reads, serial
from thermocald.errors import BadReading
from thermocald.hal import VirtualClock, open_device

with Path(__file__).with_suffix("").with_name("chip_outputs.tsv").open() as file:
    ROWS = list(csv.DictReader(file, delimiter="\t", quoting=csv.QUOTE_NONE))
REFUSE = "refuse"


def fields(text):
    return dict(part.split("=") for part in text.split())


def kernel(row, folder):
    sysfs, name = Sysfs(folder), row["chip"]
    if row["driver"] == "hwmon":
        given = row["what it gives"]
        files = fields(given) if "=" in given else {"input": given}
        sysfs.hwmon(0, name, **{f"temp1_{k}": v for k, v in files.items()})
    elif row["driver"] == "iio":
        files = fields(row["what it gives"])
        names = {k: k if k.startswith("fault") else f"in_temp_{k}" for k in files}
        sysfs.iio(0, name, **{names[k]: v for k, v in files.items()})
    else:
        sysfs.zone(0, name, row["what it gives"])
    key, driver = ("zone", "thermal_zone") if row["driver"] == "zone" else ("chip", row["driver"])
    options = {key: name, "sysfs": str(folder), **json.loads(row["options"] or "{}")}
    with open_device("thermometer", driver, options, VirtualClock()) as device:
        return device.read().values["temperature"]


def reading(row, server, folder):
    """Return the driver's °C for a row; raises BadReading."""
    if row["driver"] == "serial":
        options = {"pattern": r"T=(?P<temperature>\S+)", **json.loads(row["options"] or "{}")}
        return serial(server, folder, row["what it gives"], options)
    if row["driver"] == "battery":
        lines = [f"  {k}: {v}" for k, v in fields(row["what it gives"]).items()]
        text = "\n".join(["Current Battery Service state:", "  present: true", *lines, ""])
        return phone_reads(server, {"temperature": "battery"}, battery=text)["temperature"]
    return kernel(row, folder)


DRIVERS = sorted({row["driver"] for row in ROWS})
PARTS = {"serial": 12, "hwmon": 4, "iio": 6}


@pytest.mark.parametrize(
    ("driver", "every"),
    [
        *((driver, PARTS.get(driver, 1)) for driver in DRIVERS),
        *(pytest.param(driver, 1, marks=pytest.mark.slow) for driver in PARTS),
    ],
)
def test_a_chip_is_read_rightly_or_refused(driver, every, server, tmp_path):
    wrong = []
    for k, row in enumerate([row for row in ROWS if row["driver"] == driver][::every]):
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
    assert len(ROWS) >= 1050
    assert sum(row["expected"] != REFUSE for row in ROWS) >= 200
