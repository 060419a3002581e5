"""Names of hidden effects in blind recordings (`python -m tests.blind.score`).

Single effects of 0.1 px are the corpus of tests/golden.
"""

from __future__ import annotations

import pytest

from tests.blind.case import Case
from tests.blind.score import judge, run
from tests.blind.tables import summary

CASES = {
    "no effect": Case((), 0.3, 23, epochs=45, with_m2=False),
    "twice the thermometer's noise": Case((), 0.3, 42, thermometer_k=0.08),
    # it distorts the rates that both have in common, by which M2 seems to hold one too
    "a slip of M1 is none of M2": Case(("slip",), 0.05, 802),
    # a lag smooths the thermometer's noise, so that a smooth image would favour it
    "a delay is no lag": Case(("time_offset",), 0.3, 330),
    # its extreme is not read; taking the largest reading for it would exclude every play
    "a play shorter than an interval": Case(("hysteresis",), 0.1, 360),
}


@pytest.mark.parametrize(
    "case",
    [pytest.param(c, id=n, marks=pytest.mark.slow if c.effects else ()) for n, c in CASES.items()],
)
def test_a_case(case):
    outcome = judge(case)
    assert outcome.right
    assert all(abs(pull) < 3 for pull in outcome.pulls.values())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "share", "least"),
    [("hard-0.3", "exact_or_listed", 0.9), ("pair-0.3", "exact_or_listed", 0.9),
     ("none", "exact", 1.0), ("outside-0.3", "exact", 0.9)],
)  # fmt: skip
def test_a_part(part, share, least):
    assert summary(run(part, [50]))[share] >= least
