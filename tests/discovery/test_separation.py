"""The experiment that separates two effects, and the test whether a recording separates them."""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.discovery.experiment import (
    Body,
    Limits,
    compare_effects,
    estimate_body,
    rank_experiments,
    read_alternatives,
)
from thermocald.errors import ConfigurationError, UsageError

PAIRS = [("permanent_set", "self_heating"), ("thermal_lag", "hysteresis"), ("creep", "slip")]
LIMITS = [Limits(40.0, 1.5, 0.8), Limits(60.0, 4.0, 0.3), Limits(40.0, 1.5, 0.8)]


@pytest.mark.parametrize(("pair", "limits"), [*zip(PAIRS, LIMITS, strict=True)])
def test_programmes_stay_within_the_limits(pair, limits):
    for found in rank_experiments(*pair, limits, Body(), 150, 10.0):
        holds = [h for _, h in found.steps if h is not None]
        rises = np.diff([22.0, *holds])
        assert max(holds) <= limits.max_c - 0.5
        assert found.temperature.max() <= limits.max_c
        assert rises.max() <= limits.max_rate + 0.55  # the first step is half a degree late
        assert found.duty <= limits.max_duty
        assert sum(s for s, _ in found.steps) >= 149 * 10.0


def test_what_separates_is_preferred():
    """Heating twice separates a permanent set from a warm-up; one long hold does not."""
    ranked = rank_experiments(*PAIRS[0], Limits(55.0), Body(), 180, 10.0)
    order, sigmas = [e.name for e in ranked], [e.sigmas for e in ranked]
    assert order.index("two equal cycles") < order.index("one long hold")
    assert sigmas == sorted(sigmas, reverse=True)
    assert sigmas[0] > 3 * sigmas[-1]


def test_a_recording_tells_how_the_camera_warms():
    t = np.arange(0, 3000.0, 10.0)
    power = (t < 1400.0).astype(float)
    T = [20.0]
    for p in power[1:]:
        T.append(T[-1] + (20.0 + 30.0 * p - T[-1]) * (1 - np.exp(-10.0 / 420.0)))
    body = estimate_body(t, np.array(T))
    assert body.tau == pytest.approx(420.0, rel=0.05)
    assert body.rise == pytest.approx(30.0, rel=0.1)


def test_two_effects_are_separated_by_a_recording(evidence_of):
    evidence, _ = evidence_of("permanent_set", px=0.1, seed=22, with_m2=False)
    found = compare_effects(evidence, "creep", "permanent_set")
    assert (found.better, found.worse, found.separated) == ("permanent_set", "creep", True)
    assert "creep is excluded" in found.sentence


def test_nothing_is_separated_where_neither_is(evidence_of):
    evidence, _ = evidence_of(seed=23, with_m2=False, epochs=60)
    assert not compare_effects(evidence, "creep", "permanent_set").separated


@pytest.mark.parametrize(
    ("text", "error", "said"),
    [
        ("creep,creep", UsageError, "give two different effects"),
        ("creep,kreep", ConfigurationError, "did you mean 'creep'"),
        ("creep,defocus", UsageError, "defocus shows in the image"),
    ],
)
def test_what_is_no_pair_is_refused(text, error, said):
    with pytest.raises(error, match=said):
        read_alternatives(text)
