"""Names of hidden effects in blind recordings (`python -m tests.blind.score`).

Single effects of 0.1 px are the corpus of tests/golden.
"""

from __future__ import annotations

import pytest

from tests.blind.case import Case
from tests.blind.score import judge, run
from tests.blind.tables import summary


@pytest.mark.slow
def test_a_single_effect():
    assert judge(Case(("second_heat_source",), 0.1, 41)).right


def test_doubled_thermometer_noise_gives_no_name():
    assert judge(Case((), 0.3, 42, thermometer_k=0.08)).right


@pytest.mark.slow
def test_hard_recordings():
    assert summary(run("hard-0.3", [50]))["exact_or_listed"] >= 0.9


@pytest.mark.slow
def test_pairs():
    assert summary(run("pair-0.3", [50]))["exact_or_listed"] >= 0.9


@pytest.mark.slow
def test_recordings_without_an_effect_give_no_name():
    assert summary(run("none", [50]))["exact"] == 1.0


@pytest.mark.slow
def test_outside_influences_are_unnamed():
    assert summary(run("outside-0.3", [50]))["exact"] >= 0.9
