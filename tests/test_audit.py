"""The audit of the standard deviations: it repeats, it can fail, and its page shows its rows."""

import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks.audit import HEADER, SECTIONS, ratio, share, with_rows

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


def rows_of_the_page(section: str) -> list[list[str]]:
    page = PAGE.read_text(encoding="utf-8")
    table = page.split(f"## {section.capitalize()}\n")[1].split("\n## ")[0].split(HEADER + "\n")[1]
    lines = table.split("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


@pytest.mark.parametrize("section", SECTIONS)
def test_page_and_audit_have_the_same_rows(section):
    """What is printed, what it holds, and the seed; the figures are those of 200 draws."""
    rows = SECTIONS[section](2, np.random.default_rng(1))
    expected = [[row.printed_by, row.what, row.holds] for row in rows]
    found = rows_of_the_page(section)
    assert [line[:3] for line in found] == expected
    for line in found:
        assert line[5] == "1"
        assert re.fullmatch(r"[\d.]+ ± [\d.]+( %)?", line[3]), line


def test_every_ratio_on_the_page_is_met():
    """0.9 to 1.1 within three of its own standard deviations; a level of 1 or 5 % holds."""
    for section in SECTIONS:
        for *_, value, draws, _ in rows_of_the_page(section):
            if value.endswith("%"):
                rate, sd = (float(v) for v in value[:-2].split(" ± "))
                level = 5 if sd > 150 * np.sqrt(0.01 * 0.99 / int(draws)) else 1
                assert rate <= level + 3 * sd, (section, value)
            else:
                ratio_, sd = (float(v) for v in value.split(" ± "))
                assert 0.85 - 3 * sd <= ratio_ <= 1.1 + 3 * sd, (section, value)


@pytest.mark.slow
def test_the_page_shows_what_the_audit_prints():
    """One section whole: the same seed, the same figures."""
    rows = SECTIONS["significance"](200, np.random.default_rng(1))
    page = PAGE.read_text(encoding="utf-8")
    assert with_rows(page, "significance", [row.text(1) for row in rows]) == page


def test_the_tests_that_the_page_names_are_there():
    page = PAGE.read_text(encoding="utf-8")
    for name in re.findall(r"`(tests/[^`]+)`", page):
        assert (PAGE.parents[2] / name).exists(), name
