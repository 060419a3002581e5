"""Each driver of a device has a fault table in docs/how-to, each row a test that exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from thermocald.daemon.probe import KINDS
from thermocald.hal import driver_names

HERE = Path(__file__).parent
PAGES = sorted((HERE.parents[1] / "docs/how-to").glob("*.md"))
NO_TEST = "—"
NO_DEVICE = {"mock", "replay"}


def rows():
    for page in PAGES:
        inside, heading = False, ""
        for line in page.read_text().splitlines():
            cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
            heading = line if line.startswith("#") else heading
            if cells == ["fault", "what happens", "test"]:
                inside = True
            elif not line.startswith("|"):
                inside = False
            elif inside and set(line) - set("|- "):
                yield page.name, heading, cells


ROWS = list(rows())


def test_there_are_tables():
    assert {page for page, _, _ in ROWS} >= {"cameras.md", "phones.md", "thermometers.md"}


@pytest.mark.parametrize("name", sorted({n for k in KINDS for n in driver_names(k)} - NO_DEVICE))
def test_the_driver_has_its_table(name):
    """Its name stands in the heading of one, or before the colon of its rows."""
    mine = [
        cells
        for _, heading, cells in ROWS
        if name in re.findall(r"\w+", f"{heading} {cells[0].split(':')[0].lower()}")
    ]
    assert len(mine) >= 3


@pytest.mark.parametrize(
    ("page", "cells"), [(p, c) for p, _, c in ROWS], ids=lambda value: str(value)[:60]
)
def test_the_row_has_its_test(page, cells):
    fault, happens, test = cells
    assert fault
    assert happens
    if test == NO_TEST:
        assert "cannot be told" in happens  # the only reason for which a row may have none
        return
    file, name = re.fullmatch(r"`([\w/]+\.py)::(\w+)`", test).groups()
    folder = HERE if not file.startswith("hil/") else HERE.parent
    assert f"\ndef {name}(" in (folder / file).read_text()
