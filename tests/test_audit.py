"""The audit of the standard deviations is repeatable, can fail, and its page shows its rows."""

import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from benchmarks.audit import HEADER, SECTIONS, with_rows
from tests.marks import mostly_slow

FIGURE = r"\d+\.\d+"
PAGE = Path(__file__).parents[1] / "docs" / "reference" / "standard-deviations.md"


def lines_of_the_page(section: str) -> list[tuple[str, list[str]]]:
    """Return what each command prints, with the least and the largest ratio of its cases."""
    page = PAGE.read_text(encoding="utf-8")
    found = []
    for line in re.findall(rf"^\| {section} \|(.*)\|$", page, re.M):
        printed_by, cell = (part.strip() for part in line.split("|"))
        found.append((printed_by, re.findall(r"[\d.]+ ± [\d.]+(?: %)?", cell)))
    return found


LONG = {"cameras", "lenses", "delay"}
LONGER_WITH_TWO = {"distortion", "thermal", "outside", "discovery"}  # one draw gives all their rows


@pytest.mark.parametrize("section", mostly_slow(SECTIONS, *(set(SECTIONS) - LONG)))
def test_page_and_audit_have_the_same_rows(section):
    """The page's ratios are those of 200 draws; of one or two none is above 3."""
    draws = 1 if section in LONGER_WITH_TWO else 2
    rows = SECTIONS[section](draws, np.random.default_rng(1))
    assert all(row.value < 3.0 for row in rows if row.level is None)
    found = lines_of_the_page(section)
    cases = Counter((row.printed_by, row.level is None) for row in rows)
    assert [(by, "%" not in figures[0]) for by, figures in found] == list(cases)
    for by, figures in found:
        assert 1 <= len(figures) <= min(cases[by, "%" not in figures[0]], 2)


def test_every_ratio_on_the_page_is_met():
    """Ratios are 0.9 to 1.1 within three standard deviations; levels of 1 and 5 % hold."""
    for section in SECTIONS:
        for printed_by, figures in lines_of_the_page(section):
            for value in figures:
                if value.endswith("%"):
                    rate, sd = (float(v) for v in value[:-2].split(" ± "))
                    level = 1 if sd < 1 else 5  # sd of a share of 1 % of 100 draws or more
                    assert rate <= level + 3 * sd, (section, printed_by)
                else:
                    ratio_, sd = (float(v) for v in value.split(" ± "))
                    assert 0.85 - 3 * sd <= ratio_ <= 1.1 + 3 * sd, (section, printed_by)


WHOLE = (
    "epoch", "series", "mount", "survey", "online", "significance", "null", "thermal",
    "distortion", "thermometer", "outside", "calibrate",
)  # fmt: skip
"""Sections that take less than a minute."""


@pytest.mark.parametrize("section", mostly_slow(WHOLE, "epoch"))
def test_the_page_shows_what_the_audit_prints(section):
    """All 200 draws: the same seed gives the same ratios, and all are met."""
    rows = SECTIONS[section](200, np.random.default_rng(1))
    page = PAGE.read_text(encoding="utf-8")
    assert HEADER in page
    again = with_rows(page, section, rows)
    assert re.sub(FIGURE, "", again) == re.sub(FIGURE, "", page)
    # other versions of NumPy may round the last digit otherwise
    printed, figures = (np.array(re.findall(FIGURE, text), float) for text in (page, again))
    np.testing.assert_allclose(figures, printed, atol=0.011)
    assert all(row.met for row in rows)
