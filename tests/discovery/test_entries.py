"""Entries of effects: constants that M1 does not separate, a thermometer that lags."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.analysis.test_thermal_model import for_fit, simulated
from tests.blind.world import lagged
from tests.discovery.test_movement import trembling
from thermocald.discovery.entries import find_tied_constants, lagging_thermometer
from thermocald.discovery.result import discover_series
from thermocald.physics import catalogue
from thermocald.physics.formula import Node, say_together
from thermocald.physics.model import ModelEffect
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import BASE, Term
from thermocald.thermal.reduce import reduce_series
from thermocald.thermal.source import epochs_input


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


def test_two_equal_lags_are_known_only_together(lagging):
    found = find_tied_constants(lagging, twice_lagging(lagging, 30.0, 30.0), 0)

    assert say_together(found) == (
        "tau, tau_2 and the size are best known together, as they correlate by 1.0000"
    )
    assert find_tied_constants(lagging, twice_lagging(lagging, 20.0, 150.0), 0) is None


@pytest.mark.parametrize(
    ("name", "label"),
    [("board_temperature", "board temperature"), ("T, °C (LGR S/N: 2, LBL: Gehäuse)", "Gehäuse"),
     ("{x} <b>7 K</b>", "{x} <b>7 K</b>")],
)  # fmt: skip
def test_a_foreign_thermometer_is_said_by_its_label(name, label):
    channel = {"channel": {"value": name, "sd": None, "unit": "name"}}
    product = Node("product", (T, Node("", name=name))).text()

    heats = catalogue.get("second_heat_source").sentence(channel)

    assert heats == f"{label} heats the camera too"
    assert label in catalogue.get(product).sentence({"a_c": {}})


def test_a_thermometer_that_is_stuck_is_as_if_there_were_none(evidence_of):
    """Neither a second source of heat nor a cause of noise."""
    (e,), _ = evidence_of("thermal_lag", epochs=30, with_m2=False)
    stuck = np.full(30, 21.0)
    source = replace(e.source, readings={**e.source.readings, "board_temperature": stuck})

    found = discover_series([reduce_series(source)])

    assert found.headline == "effects_found: thermal_lag"


def test_a_saturation_far_outside_the_recorded_range_is_known_by_its_course_alone(lagging):
    """Its tail is an exponential: middle and size are one number."""
    found = find_tied_constants(lagging, saturating(lagging, 3783.7, 288.2), 0)

    assert found["parameters"] == ["k"]
    assert found["exchanged"]
    assert "known only together, as other values fit as well: slope and " in say_together(found)


def test_a_saturation_within_the_recorded_range_is_known(lagging):
    middle = float(lagging.series[0].history.temperature().mean())
    assert find_tied_constants(lagging, saturating(lagging, middle, 8.0), 0) is None


NAMES = ("c", "x0", "y0")
TAU = 60.0


def alternative(seed: int, gradients: dict[str, float]):
    s = simulated(seed, listed=(ModelEffect("thermal_gradient", gradients),))
    source = epochs_input(s.head, s.field, list(s.epochs()), s.programme.series)
    fitter = HypothesisFitter([for_fit(source)])
    fit = fitter.fit((Term("thermal_gradient", NAMES),))
    return lagging_thermometer(fitter.refine(fit), 0)


def test_a_lag_of_the_thermometer_is_offered_with_its_time_and_an_experiment():
    rates = simulated(1, listed=()).model.rates
    off = []
    for seed in range(3):
        found = alternative(seed, {n: TAU * rates[n] for n in NAMES})
        assert found is not None
        assert "thermometer" in found["experiment"]
        off.append(abs(found["values"]["tau"] - TAU))
    assert np.max(off) < 2.0  # about four standard deviations


def test_a_mount_that_bends_is_no_lag_of_the_thermometer():
    assert alternative(1, {"c": 8e-3, "x0": 3e-2, "y0": 1e-2}) is None
    rates = simulated(1, listed=()).model.rates
    early = {n: -TAU * rates[n] for n in NAMES}
    assert alternative(2, early) is None


def test_a_slow_thermometer_is_offered_beside_a_negative_delay(evidence_of):
    """A lag of 12 s of the thermometer itself looks like a pure delay of as much."""
    (series,), _ = evidence_of(seed=2, epochs=60, with_m2=False)
    source = series.source
    fine = np.arange(source.reading_times[0], source.reading_times[-1])
    name, warm = next(iter(source.readings.items()))
    slow = np.interp(
        source.reading_times, fine, lagged(np.interp(fine, source.reading_times, warm), 12.0)
    )

    (effect,) = discover_series([reduce_series(replace(source, readings={name: slow}))]).effects

    assert (effect.effect, effect.alternative_names) == ("time_offset", ["lagging_thermometer"])
    assert effect.statement.startswith("the thermometer follows the camera after a pure delay of 1")
    assert abs(effect.alternatives[-1]["values"]["tau"] - 12.0) < 1.0
