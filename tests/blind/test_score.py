"""Names of hidden effects in blind recordings (`python -m tests.blind.score`).

Single effects of 0.1 px are the corpus of tests/golden.
"""

from __future__ import annotations

import pytest

from tests.blind.case import Case
from tests.blind.score import judge, run
from tests.blind.tables import summary


def test_doubled_thermometer_noise_gives_no_name():
    assert judge(Case((), 0.3, 42, thermometer_k=0.08)).right


@pytest.mark.slow
def test_a_slip_of_the_first_recording_is_none_of_the_second():
    """It distorts the rates that both have in common, by which the second seems to hold one too."""
    assert judge(Case(("slip",), 0.05, 802)).right


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "share", "least"),
    [("hard-0.3", "exact_or_listed", 0.9), ("pair-0.3", "exact_or_listed", 0.9),
     ("none", "exact", 1.0), ("outside-0.3", "exact", 0.9)],
)  # fmt: skip
def test_a_part(part, share, least):
    assert summary(run(part, [50]))[share] >= least
