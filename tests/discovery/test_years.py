"""Discovery in a year's series: an effect within one afternoon, and one that takes a year."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from year_of_means import DAY, year

from thermocald.discovery.result import discover_series
from thermocald.thermal.series import in_blocks

LAG_S = 1200.0


def cellar(t):
    """The temperature of a cellar: 1 K over the year, and one afternoon with open shutters."""
    slow = 15.0 + np.sin(2 * np.pi * t / (365 * DAY))
    return slow + 12.0 * np.exp(-0.5 * ((t - 200.6 * DAY) / (0.06 * DAY)) ** 2)


def outdoors(t):
    weather = np.sin(t / (5.3 * DAY)) + np.sin(t / (2.1 * DAY) + 1.0)
    year_ = 10.0 * np.sin(2 * np.pi * t / (365 * DAY))
    return 15.0 + year_ + 5.0 * np.sin(2 * np.pi * t / DAY) + weather


def behind(at, _):
    """The cellar's temperature with a lag, in steps of 10 s about the afternoon."""
    fine = np.arange(199.0 * DAY, 203.0 * DAY, 10.0)
    a = np.exp(-10.0 / LAG_S)
    warm = cellar(fine)
    lagged, _ = lfilter([1 - a], [1, -a], warm, zi=[a * warm[0]])
    # for a slow change, a lag is a delay
    out = cellar(at - LAG_S)
    near = (at > 199.5 * DAY) & (at < 202.5 * DAY)
    out[near] = np.interp(at[near], fine + 5.0, lagged)
    return out


def test_the_afternoon_keeps_short_rows():
    (evidence,) = year(cellar, behind, 5, targets=12)
    blocks = in_blocks(evidence, rows=300)
    assert len(blocks.times) <= 300
    inside = (blocks.times > 200.3 * DAY) & (blocks.times < 200.95 * DAY)
    assert inside.sum() > 25  # a day elsewhere has one at most
    np.testing.assert_allclose(blocks.N.sum(axis=0), evidence.N.sum(axis=0), rtol=1e-12)
    np.testing.assert_allclose(blocks.b.sum(axis=0), evidence.b.sum(axis=0), rtol=1e-9)


@pytest.mark.slow
def test_an_effect_hidden_in_one_afternoon_of_a_year():
    found = discover_series(year(cellar, behind, 3))
    assert [e.effect for e in found.effects] == ["thermal_lag"]
    assert found.effects[0].estimates["tau"]["value"] == pytest.approx(LAG_S, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "drives", "number", "true", "sds"),
    [
        ("creep", lambda at, T: T + 2.0 * at / (365 * DAY), "a_c", 2.0 * 2e-4 / (365 * DAY), 4),
        ("slip", lambda at, T: T + 1.5 * (at > 123.6 * DAY), "time", 123.6 * DAY, 3),
    ],
)
def test_what_takes_a_year_or_comes_on_one_day_is_named(effect, drives, number, true, sds):
    found = discover_series(year(outdoors, drives, 3))
    assert [e.effect for e in found.effects] == [effect]
    said = found.effects[0].estimates[number]
    assert said["value"] == pytest.approx(true, abs=sds * said["sd"])


@pytest.mark.slow
def test_nothing_is_found_in_a_year_without_an_effect():
    found = discover_series(year(outdoors, lambda _, T: T, 3))
    assert found.verdict == "adequate"
