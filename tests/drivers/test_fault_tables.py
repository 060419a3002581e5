"""Each row of the fault tables in docs/how-to names a test that exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

HERE = Path(__file__).parent
PAGES = sorted((HERE.parents[1] / "docs/how-to").glob("*.md"))
NO_TEST = "—"


def rows():
    for page in PAGES:
        inside = False
        for line in page.read_text().splitlines():
            cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
            if cells == ["fault", "what happens", "test"]:
                inside = True
            elif not line.startswith("|"):
                inside = False
            elif inside and set(line) - set("|- "):
                yield page.name, cells


ROWS = list(rows())


def test_there_are_tables():
    assert {page for page, _ in ROWS} >= {"cameras.md", "phones.md", "thermometers.md"}


@pytest.mark.parametrize(("page", "cells"), ROWS, ids=lambda value: str(value)[:60])
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
