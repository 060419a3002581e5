"""Entries of effects: constants that M1 does not separate, a thermometer that lags."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.analysis.test_thermal_model import for_fit, simulated
from tests.blind.world import lagged
from thermocald.discovery.entries import find_tied_constants
from thermocald.discovery.lag import lagging_thermometer
from thermocald.discovery.result import discover_series
from thermocald.physics import catalogue
from thermocald.physics.formula import Node, say_together
from thermocald.physics.model import ModelEffect
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import BASE, Term
from thermocald.thermal.reduce import reduce_series
from thermocald.thermal.source import epochs_input

T = Node("", name="temperature")


def lags(first, second):
    return Node("lag", (Node("lag", (T,), (first,)),), (second,))


@pytest.mark.parametrize(
    ("formula", "said"),
    [
        pytest.param(
            lags(30.0, 30.0),
            "tau, tau_2 and the size are best known together, as they correlate by 1.0000",
            id="two equal lags",
        ),
        pytest.param(lags(20.0, 150.0), None, id="a short and a long lag"),
        # its tail is an exponential: middle and size are one number
        pytest.param(
            Node("saturation", (T,), (3783.7, 288.2)),
            "k and the size are known only together, as other values fit as well: slope and ",
            id="a saturation far outside the recorded range",
        ),
        pytest.param(Node("saturation", (T,), (30.0, 8.0)), None, id="one within the range"),
    ],
)
def test_constants_that_are_known_only_together(evidence_of, formula, said):
    fitter = HypothesisFitter(evidence_of("thermal_lag", seed=3)[0])
    structure, values = formula.named()
    fit = fitter.fit((Term(structure.text(), BASE, tuple(values.items())),))
    found = find_tied_constants(fitter, fitter.refine(fit, max_iterations=0), 0)
    assert (found and say_together(found)[: len(said or "")]) == said


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
    stuck = {**e.source.readings, "board_temperature": np.full(30, 21.0)}

    found = discover_series([reduce_series(replace(e.source, readings=stuck))])

    assert found.headline == "effects_found: thermal_lag"


def test_only_what_follows_the_cameras_rates_may_be_a_lag_of_the_thermometer():
    rates, tau = simulated(1, listed=()).model.rates, 60.0

    def alternative(seed, **gradients):
        s = simulated(seed, listed=(ModelEffect("thermal_gradient", gradients),))
        source = epochs_input(s.head, s.field, list(s.epochs()), s.programme.series)
        fitter = HypothesisFitter([for_fit(source)])
        return lagging_thermometer(
            fitter.refine(fitter.fit((Term("thermal_gradient", tuple(gradients)),))), 0
        )

    late = {n: tau * rates[n] for n in ("c", "x0", "y0")}
    off = [alternative(seed, **late)["values"]["tau"] - tau for seed in range(3)]
    assert np.abs(off).max() < 2.0  # about four standard deviations
    assert alternative(1, c=8e-3, x0=3e-2, y0=1e-2) is None  # a mount that bends
    assert alternative(2, **{n: -v for n, v in late.items()}) is None  # the thermometer is early


def late(source, tau):
    """Return a series whose thermometer lags by tau s."""
    fine = np.arange(source.reading_times[0], source.reading_times[-1])
    name, warm = next(iter(source.readings.items()))
    slow = lagged(np.interp(fine, source.reading_times, warm), tau)
    return replace(source, readings={name: np.interp(source.reading_times, fine, slow)})


def test_a_slow_thermometer_is_offered_beside_a_negative_delay(evidence_of):
    """A lag of 12 s of the thermometer itself looks like a pure delay of as much."""
    (series,), _ = evidence_of(seed=2, epochs=60, with_m2=False)

    (effect,) = discover_series([reduce_series(late(series.source, 12.0))]).effects

    assert (effect.effect, effect.alternative_names) == ("time_offset", ["lagging_thermometer"])
    assert effect.statement.startswith("the thermometer follows the camera after a pure delay of 1")
    assert abs(effect.alternatives[-1]["values"]["tau"] - 12.0) < 1.0
    assert "thermometer" in effect.alternatives[-1]["experiment"]


def test_a_slow_thermometer_is_offered_where_a_gradient_has_other_proportions(evidence_of):
    """Regression: of a lag of 40 s, a gradient 60 sd off the rates was named alone."""
    (series,), _ = evidence_of("permanent_set", seed=2, epochs=100, with_m2=False)

    found = discover_series([reduce_series(late(series.source, 40.0))])

    assert found.headline.endswith("thermal_gradient or lagging_thermometer, and permanent_set")
    assert abs(found.effects[0].alternatives[-1]["values"]["tau"] - 40.0) < 1.0


@pytest.mark.parametrize(
    "effect", ["radial_distortion_drift", pytest.param("softening", marks=pytest.mark.slow)]
)
def test_a_slow_thermometer_beside_an_effect_is_no_unknown_cause(evidence_of, effect):
    """Regression: whatever else follows the temperature lags too, which no gradient describes."""
    (series,), _ = evidence_of(effect, seed=1, epochs=60, with_m2=False)

    found = discover_series([reduce_series(late(series.source, 40.0))])

    assert found.headline == f"unexplained: unnamed or lagging_thermometer+{effect}"
    assert abs(found.effects[0].alternatives[0]["values"]["tau"] - 40.0) < 1.0
    assert found.effects[0].statement.endswith(f"40 s, which with {effect} reproduces the data")
