"""Two time constants of which the data determine only the sum."""

from __future__ import annotations

import pytest

from tests.discovery.test_movement import trembling
from thermocald.discovery.entries import find_tied_constants, find_trade_off
from thermocald.physics import catalogue
from thermocald.physics.formula import Node, say_together
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import BASE, Term


@pytest.fixture(scope="module")
def lagging():
    return HypothesisFitter(trembling(("thermal_lag",), 0.0, 3))


T = Node("", name="temperature")


def fitted(fitter, formula):
    """A formula in c, x0, y0, with its constants as unknowns."""
    structure, values = formula.named()
    fit = fitter.fit((Term(structure.text(), BASE, tuple(values.items())),))
    return fitter.refine(fit, max_iterations=0)


def twice_lagging(fitter, first, second):
    return fitted(fitter, Node("lag", (Node("lag", (T,), (first,)),), (second,)))


def saturating(fitter, middle, width):
    """A saturation of the temperature."""
    return fitted(fitter, Node("saturation", (T,), (middle, width)))


def test_two_equal_lags_are_said_by_their_sum(lagging):
    found = find_trade_off(lagging, twice_lagging(lagging, 30.0, 30.0), 0)

    document, sentence = found
    assert document["sum"] == pytest.approx(60.0)
    assert 0.0 < document["sd"] < 5.0
    assert "not separable, their sum is 60" in sentence


def test_a_short_and_a_long_lag_are_separate(lagging):
    assert find_trade_off(lagging, twice_lagging(lagging, 20.0, 150.0), 0) is None


def test_a_constant_that_is_not_determined_is_said_so():
    estimate = {"value": 120.0, "sd": 3.1e4, "unit": "s"}

    said = catalogue.get("lag(temperature, tau)").sentence({"tau": estimate, "a_c": estimate})

    assert "about 1.2e+02" not in said
    assert "about 120 s" in said


def test_a_saturation_far_outside_the_recorded_range_is_known_by_its_course_alone(lagging):
    """Its tail is an exponential: middle and size are one number."""
    found = find_tied_constants(lagging, saturating(lagging, 3783.7, 288.2), 0)

    assert found["parameters"] == ["k"]
    assert found["exchanged"]
    assert "known only together, as other values fit as well: slope and " in say_together(found)


@pytest.mark.parametrize(("middle", "width"), [(50.0, 20.0), (60.0, 30.0), (3783.7, 288.2)])
def test_what_is_known_of_it_is_slope_and_curvature(lagging, middle, width):
    """The curve is the same for all formulas that explain the same."""
    found = find_tied_constants(lagging, saturating(lagging, middle, width), 0)
    square = Node("square", (Node("offset", (T,), (found["temperature"],)),))
    parabola = lagging.refine(lagging.fit((Term(square.text(), BASE),)), max_iterations=0)

    own = parabola.blocks[1]
    scale = lagging.series[0].scale[:3]
    for i, p in enumerate(BASE):
        curvature, value = found["curvature"][p], 2 * parabola.coefficients[own.start + i]
        assert curvature["value"] == pytest.approx(value / scale[i], abs=4 * curvature["sd"])
        assert 0 < curvature["sd"] < 1e-4
        assert found["slope"][p]["sd"] < 1e-5


def test_a_saturation_within_the_recorded_range_is_known(lagging):
    middle = float(lagging.series[0].history.temperature().mean())
    assert find_tied_constants(lagging, saturating(lagging, middle, 8.0), 0) is None
