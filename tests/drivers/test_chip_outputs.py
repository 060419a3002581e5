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

from tests.drivers.test_device_outputs import battery, kernel, serial
from thermocald.errors import BadReading

with Path(__file__).with_suffix("").with_name("chip_outputs.tsv").open() as file:
    ROWS = list(csv.DictReader(file, delimiter="\t", quoting=csv.QUOTE_NONE))
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
        *((driver, PARTS.get(driver, 1)) for driver in sorted({row["driver"] for row in ROWS})),
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
