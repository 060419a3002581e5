"""Long series are examined in blocks of epochs, and all results are consistent."""

from __future__ import annotations

import re

import pytest

from thermocald.discovery import examination
from thermocald.discovery.result import discover_series
from thermocald.output.discovery import report_html
from thermocald.thermal.series import in_blocks


@pytest.fixture
def short_blocks(monkeypatch):
    """Make every series count as long: 120 epochs in 40 rows."""
    monkeypatch.setattr(examination, "in_blocks", lambda series: in_blocks(series, rows=40))


def test_an_effect_in_a_long_series(short_blocks, evidence_of):
    evidence, _ = evidence_of("nonlinear_expansion", px=0.2, seed=12, epochs=120, with_m2=False)
    found = discover_series(evidence)
    assert [e.effect for e in found.effects] == ["nonlinear_expansion"]
    first, last = found.effects[0].where["epochs"]
    assert 0 <= first < last <= evidence[0].source.numbers[-1]
    assert last > 40  # epochs, not rows
    page = report_html(found, "long")
    assert "<svg" in page
    assert re.search(r"Made on \d{4}-\d\d-\d\d at \d\d:\d\d UTC with thermocald", page)
    source = evidence[0].source
    assert f"{source.camera}, {source.sensor.width} × {source.sensor.height}\xa0px of" in page
    links = re.findall(r'href="#(chapter-1-\d)"', page)
    assert links == re.findall(r'<details id="(chapter-1-\d)"', page)
    assert len(links) >= 4


def test_what_is_unexplained_in_a_long_series(short_blocks, evidence_of):
    """The temperature's rate is of all epochs and the misfit of blocks: np.gradient of both."""
    evidence, _ = evidence_of("outside", px=0.3, seed=24, epochs=120, with_m2=False)
    found = discover_series(evidence)
    rows = found.as_dict()["effects"][0]["evidence"]["base_misfit"]["against"]
    assert "rate of temperature" in [row["what"] for row in rows]
    assert "<svg" in report_html(found, "long")
