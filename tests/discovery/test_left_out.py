"""A cause predicts blocks left out, unless they hold a step; a look-alike does not."""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.discovery.validation import cross_validation, is_confirmed, measure_block_gains
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import Term


def test_the_cause_predicts_every_block(evidence_of):
    lab = HypothesisFitter(evidence_of("nonlinear_expansion", px=0.2, seed=91, epochs=90)[0])
    fit = lab.refine(lab.fit([Term("nonlinear_expansion")]))

    (gain,) = measure_block_gains(lab, fit)

    assert is_confirmed(gain)
    outside, inside = cross_validation(lab, fit)
    assert 0.95 * inside < outside < 1.1 * inside


@pytest.mark.parametrize(
    ("gain", "expected"),
    [
        ([30.0, 5.0, -3.0, 0.0, 20.0, 1.0], True),
        ([30.0, 5.0, -30.0, 0.0, 20.0, 1.0], False),  # one block contradicts it
        ([-1.0, -2.0, 1.0, 0.0, 0.0, 0.0], False),  # nothing is predicted
        ([1e5, 2e4, -300.0, 10.0, 20.0, 1.0], True),  # small relative to what it explains
    ],
)
def test_what_confirms(gain, expected):
    assert is_confirmed(np.array(gain)) == expected


def test_a_course_that_follows_the_noise_predicts_nothing(evidence_of):
    """A cycle is fitted to a recording without effects, at the best period."""
    lab = HypothesisFitter(evidence_of(px=0.2, seed=92, epochs=90, with_m2=False)[0])
    trials = [
        lab.fit([Term("cyclic_interference", nonlinear=(("P", p),))])
        for p in np.geomspace(40, 400, 60)
    ]

    (gain,) = measure_block_gains(lab, min(trials, key=lambda f: f.objective))

    assert gain.sum() < 12  # of six coefficients


def test_a_step_within_the_block_left_out_is_no_fault(evidence_of):
    """Without the block that holds an early slip in M2, its size is undetermined."""
    evidence, truth = evidence_of("slip", px=0.2, seed=91, epochs=90)
    lab = HypothesisFitter(evidence)
    times = [s["time"] for (s,) in truth["effects"] if s["happens"]]
    own = [
        (("time", float(e.times[np.searchsorted(e.times, t)])),)
        for e, t in zip(lab.series, times, strict=False)
    ]
    fresh = tuple(own) + (None,) * (len(lab.series) - len(own))

    (gain,) = measure_block_gains(lab, lab.refine(lab.fit([Term("slip", fresh=fresh)])))

    assert is_confirmed(gain)
