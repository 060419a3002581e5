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


@pytest.mark.parametrize(
    ("pair", "limits"),
    [
        (("permanent_set", "self_heating"), Limits(40.0, 1.5, 0.8)),
        (("thermal_lag", "hysteresis"), Limits(60.0, 4.0, 0.3)),
    ],
)
def test_programmes_stay_within_the_limits(pair, limits):
    for found in rank_experiments(*pair, limits, Body(), 150, 10.0):
        holds = [h for _, h in found.steps if h is not None]
        assert max(holds) <= limits.max_c - 0.5
        assert found.temperature.max() <= limits.max_c
        # the first step is half a degree late
        assert np.diff([22.0, *holds]).max() <= limits.max_rate + 0.55
        assert found.duty <= limits.max_duty
        assert sum(s for s, _ in found.steps) >= 149 * 10.0


def test_what_separates_is_preferred():
    """Heating twice separates a permanent set from a warm-up; one long hold does not."""
    ranked = rank_experiments("permanent_set", "self_heating", Limits(55.0), Body(), 180, 10.0)
    order, sigmas = [e.name for e in ranked], [e.sigmas for e in ranked]
    assert order.index("two equal cycles") < order.index("one long hold")
    assert sigmas == sorted(sigmas, reverse=True)
    assert sigmas[0] > 3 * sigmas[-1]


def test_a_recording_tells_how_the_camera_warms():
    t = np.arange(0, 3000.0, 10.0)
    warm = 30.0 * (1 - np.exp(-np.minimum(t, 1400.0) / 420.0))
    body = estimate_body(t, 20.0 + warm * np.exp(-np.maximum(t - 1400.0, 0.0) / 420.0))
    assert (body.tau, body.rise) == (pytest.approx(420.0, rel=0.05), pytest.approx(30.0, rel=0.1))


def test_two_effects_are_separated_by_a_recording_that_has_one(evidence_of):
    evidence, _ = evidence_of("permanent_set", px=0.1, seed=22, with_m2=False)
    found = compare_effects(evidence, "creep", "permanent_set")
    assert (found.better, found.worse, found.separated) == ("permanent_set", "creep", True)
    assert "creep is excluded" in found.sentence
    neither, _ = evidence_of(seed=23, with_m2=False, epochs=60)
    assert not compare_effects(neither, "creep", "permanent_set").separated


@pytest.mark.parametrize(
    ("text", "error", "said"),
    [("creep,kreep", ConfigurationError, "did you mean 'creep'"),
     ("creep,creep", UsageError, "give two different effects"),
     ("creep,defocus", UsageError, "defocus shows in the image")],
)  # fmt: skip
def test_what_is_no_pair_is_refused(text, error, said):
    with pytest.raises(error, match=said):
        read_alternatives(text)
