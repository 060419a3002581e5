"""A thermometer read between the frames: its noise, kinks of temperature, and its clock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.audit_thermal import fitted, rate_errors, read_apart, seen, simulated, switched
from tests.marks import mostly_slow
from thermocald.physics.model import ModelEffect
from thermocald.thermal.noise import calibrate_thermometers
from thermocald.thermal.reduce import reduce_series

DELAY = ModelEffect("time_offset", {"d": 0.0})


@pytest.mark.slow
@pytest.mark.parametrize("interval", [10.0, 15.0])
def test_the_noise_of_readings_between_the_frames(interval):
    """Interpolated values have less noise than a reading, which is what is estimated."""
    found = []
    for seed in range(1, 7):
        source = read_apart(simulated(seed, ()), 0.0, interval)
        e = calibrate_thermometers([reduce_series(source, strict=False)])[0]
        found.append(e.thermometers[e.history.reference].noise)
    # eighty readings give it to 8 %, six series to 3.3 %; the lamp's kinks add 4 %
    assert 0.90 < np.mean(found) / 0.05 < 1.14


@pytest.mark.parametrize("late", mostly_slow([-90.0, -33.0, 0.0, 7.5, 90.0], -33.0))
def test_a_wrong_clock(late):
    """With an initial value of 0, over the whole range and at half an interval."""
    for seed in (1, 2):
        s = simulated(seed, ())
        f = fitted(read_apart(s, late), DELAY)
        assert abs(f.model.effects[0].values["d"] + late) < 3.0 * f.model.sd("time_offset.d")
        assert f.model.sd("time_offset.d") < 0.2
        assert np.abs(rate_errors(f, s)).max() < 3.5


@pytest.mark.slow
@pytest.mark.parametrize("interval", [10.0, 15.0, 30.0, 60.0])
def test_a_wrong_clock_with_any_interval_of_readings(interval):
    """The temperature bends between readings; a straight line would add a delay of h²/12τ."""
    off = []
    for seed, late in enumerate(np.linspace(-90.0, 90.0, 12), start=40):
        f = fitted(read_apart(switched(seed), float(late), interval), DELAY)
        assert ("read_seldom" in f.fitted) >= (interval == 60.0)
        assert interval > 15.0 or "the temperature turns between" not in " ".join(f.lines())
        off.append((f.model.effects[0].values["d"] + late) / f.model.sd("time_offset.d"))
    assert np.max(np.abs(off)) < 3.5
    # the RMS of twelve draws scatters by 0.2
    assert np.sqrt(np.mean(np.square(off))) < 1.6


def read_with(s, noise_k):
    source, rng = seen(s), np.random.default_rng([s.seed, 3])
    poor = {n: r + rng.normal(0, noise_k, len(r)) for n, r in source.readings.items()}
    return replace(source, readings=poor, resolutions=dict.fromkeys(poor))


def test_a_delay_by_a_thermometer_of_1_k():
    """Where frames are half-way between readings, its sd was a tenth of its error."""
    off = {}
    for seed in (9107, 9109):
        true = float(np.random.default_rng([seed, 4]).uniform(-25, 25))
        s = simulated(seed, (replace(DELAY, values={"d": true}),))
        f = fitted(read_with(s, 1.0), DELAY)
        if "read_poorly" not in f.fitted:
            off[seed] = (f.model.effects[0].values["d"] - true) / f.model.sd("time_offset.d")
    assert 9107 not in off  # it is 15 standard deviations off
    assert np.max(np.abs(list(off.values()))) < 3.0, off


@pytest.mark.parametrize("noise_k", [0.05, 1.0])
def test_a_gradient_by_a_poor_thermometer_is_doubted(noise_k):
    """With 1 K of noise, the images alone determine it, to a tenth of the errors."""
    gradient = ModelEffect("thermal_gradient", {"c": 2e-3, "x0": 6e-3, "y0": -4e-3})
    f = fitted(read_with(simulated(9105, (gradient,)), noise_k), gradient)
    assert ("read_poorly" in f.fitted) == (noise_k == 1.0)
    assert ("thermal_gradient: the thermometer is too noisy" in " ".join(f.lines())) == (
        noise_k == 1.0
    )


def test_a_lamp_switched_between_two_readings_is_no_delay():
    """With readings every 30 s, the instant of the kink is unknown."""
    for seed in (1, 5):  # otherwise 2 s
        f = fitted(read_apart(simulated(seed, ()), 0.0, 30.0), DELAY)
        assert abs(f.model.effects[0].values["d"]) < 0.6  # s
