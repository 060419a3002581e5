"""A lagging thermometer causes gradients of one time constant times the rates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.analysis.test_thermal_model import for_fit, simulated
from tests.blind.world import lagged
from thermocald.discovery.entries import lagging_thermometer
from thermocald.discovery.result import discover_series
from thermocald.physics.model import ModelEffect
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import Term
from thermocald.thermal.reduce import reduce_series
from thermocald.thermal.source import epochs_input

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
    for seed in range(5):
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
    (series,), _ = evidence_of(seed=2, epochs=100, with_m2=False)
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
