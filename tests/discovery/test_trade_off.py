"""Two time constants of which the data determine the sum alone."""

from __future__ import annotations

import pytest

from tests.discovery.test_tremble import trembling
from thermocald.discovery.entries import find_ridge, find_trade_off
from thermocald.physics import catalogue
from thermocald.physics.formula import Node
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import BASE, Term


@pytest.fixture(scope="module")
def lagging():
    return HypothesisFitter(trembling(("thermal_lag",), 0.0, 3))


def fitted(fitter, first, second):
    T = Node("", name=fitter.series[0].history.reference)
    twice = Node("lag", (Node("lag", (T,), (first,)),), (second,))
    structure, values = twice.named()
    fit = fitter.fit((Term(structure.text(), BASE, tuple(values.items())),))
    return fitter.refine(fit, max_iterations=0)


def test_two_equal_lags_are_said_by_their_sum(lagging):
    fit = fitted(lagging, 30.0, 30.0)

    found = find_trade_off(lagging, fit, 0)

    document, sentence = found
    assert document["sum"] == pytest.approx(60.0)
    assert 0.0 < document["sd"] < 5.0
    assert "not separable, their sum is 60" in sentence


def test_a_short_and_a_long_lag_are_separate(lagging):
    assert find_trade_off(lagging, fitted(lagging, 20.0, 150.0), 0) is None


def test_a_constant_that_is_not_determined_is_said_so():
    estimate = {"value": 120.0, "sd": 3.1e4, "unit": "s"}

    said = catalogue.get("lag(temperature, tau)").sentence({"tau": estimate, "a_c": estimate})

    assert "about 1.2e+02" not in said
    assert "about 120 s" in said


def saturating(fitter, middle, width):
    """A saturation of the temperature, centred somewhere, with its constants as unknowns."""
    T = Node("", name=fitter.series[0].history.reference)
    structure, values = Node("saturation", (T,), (middle, width)).named()
    return fitter.refine(
        fitter.fit((Term(structure.text(), BASE, tuple(values.items())),)), max_iterations=0
    )


def test_a_saturation_far_outside_the_recorded_range_is_known_by_its_course_alone(lagging):
    """Its tail is an exponential: middle and size are one number."""
    found = find_ridge(lagging, saturating(lagging, 3783.7, 288.2), 0)

    document, sentence = found
    assert document == {"parameters": ["k"]}
    assert "only their product" in sentence


def test_a_saturation_within_the_recorded_range_is_known(lagging):
    T = lagging.series[0].history.temperature()
    assert find_ridge(lagging, saturating(lagging, float(T.mean()), 8.0), 0) is None
