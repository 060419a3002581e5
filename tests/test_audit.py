"""The audit of the standard deviations: it repeats, it can fail, and its page shows its rows."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.audit import SECTIONS, ratio, share

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "standard-deviations.md"


@pytest.mark.parametrize("name", ["epoch", "online", "significance"])
def test_the_same_seed_gives_the_same_rows(name):
    rows, again = (SECTIONS[name](8, np.random.default_rng(1)) for _ in range(2))
    assert rows == again
    assert all(row.met for row in rows)
    assert rows != SECTIONS[name](8, np.random.default_rng(2))


def test_a_false_statement_is_outside():
    rng = np.random.default_rng(3)
    off = rng.standard_normal(200)
    assert ratio("a", "b", "c", off).met
    assert not ratio("a", "b", "c", 1.5 * off).met
    assert not ratio("a", "b", "c", 0.5 * off).met
    assert share("a", "b", "c", [True] * 8 + [False] * 192).met
    assert not share("a", "b", "c", [True] * 30 + [False] * 170).met


def test_the_page_has_the_rows_of_every_section():
    page = PAGE.read_text(encoding="utf-8")
    for name in SECTIONS:
        assert f"## {name.capitalize()}" in page, name
