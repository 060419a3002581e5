"""Blind recordings: names right, none wrong, gaps closed (`python -m tests.blind.score`)."""

from __future__ import annotations

import pytest

from tests.blind.case import SINGLE, Case
from tests.blind.score import judge, run
from tests.blind.tables import summary


def slow(effect: str):
    return pytest.param(effect, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    "effect", ["time_offset", slow("hysteresis"), slow("slip"), "second_heat_source"]
)
def test_some_single_effects(effect):
    assert judge(Case((effect,), 0.1, 41)).right


def test_thermometer_noise_doubled_gives_no_name():
    assert judge(Case((), 0.3, 42, thermometer_k=0.08)).right


@pytest.mark.slow
def test_single_effects_at_0_1_px():
    s = summary(run("single-0.1", range(50, 52)))
    assert s["exact_or_listed"] >= 0.95
    assert s["within_3_sd"] >= 0.9
    assert s["gap_closed_90"] >= 0.9
    assert s["cases"] == 2 * len(SINGLE)


@pytest.mark.slow
def test_the_harder_kind():
    assert summary(run("hard-0.3", [50]))["exact_or_listed"] >= 0.9


@pytest.mark.slow
def test_pairs():
    assert summary(run("pair-0.3", [50]))["exact_or_listed"] >= 0.9


@pytest.mark.slow
def test_no_effect_no_name():
    assert summary(run("none", [50]))["exact"] == 1.0


@pytest.mark.slow
def test_outside_influence_stays_unnamed():
    assert summary(run("outside-0.3", [50]))["exact"] >= 0.9
