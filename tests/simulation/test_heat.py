"""The heat network, compared with closed-form solutions and other time steps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from thermocald.errors import ConfigurationError
from thermocald.physics.heat import Course, HeatNetwork

AIR = {"ambient": Course.constant(22.0)}
TIMES = np.arange(0.0, 1500.0, 7.3)
TWO = HeatNetwork({"a": 150.0, "b": 20.0}, (("a", "ambient", 0.5), ("a", "b", 0.1)))


def test_one_body_pulse_of_power():
    """The power jumps between two of the output instants."""
    network = HeatNetwork({"a": 150.0}, (("a", "ambient", 0.5),))
    lamp = Course.steps([0.0, 511.11, 2000.0], [5.0, 0.0])
    T = network.solve(TIMES, 22.0, {"a": lamp}, AIR)["a"]
    warmed = 1 - np.exp(-np.minimum(TIMES, 511.11) / 300)
    expected = 10 * warmed * np.exp(-np.maximum(TIMES - 511.11, 0) / 300)
    np.testing.assert_allclose(T, 22 + expected, rtol=0, atol=1e-9)


def test_two_bodies_ramp():
    ramp = {"ambient": Course.polygon([0.0, 1500.0], [0.0, 1500.0 * 0.02])}
    T = TWO.solve(TIMES, 0.0, {}, ramp)

    def slope(t, T):
        a, b = T
        return (0.5 * (0.02 * t - a) + 0.1 * (b - a)) / 150, 0.1 * (a - b) / 20

    expected = solve_ivp(slope, (0, 1500), [0, 0], t_eval=TIMES, rtol=1e-11, atol=1e-12).y
    np.testing.assert_allclose([T["a"], T["b"]], expected, rtol=0, atol=1e-8)


def test_energy_is_conserved():
    """Two isolated bodies keep their heat."""
    network = HeatNetwork({"a": 30.0, "b": 7.0}, (("a", "b", 0.2),))
    T = network.solve(TIMES, [20.0, 60.0], {"b": Course.constant(0.3)}, {})
    energy = 30.0 * T["a"] + 7.0 * T["b"]
    np.testing.assert_allclose(energy - 0.3 * TIMES, 30 * 20 + 7 * 60, rtol=1e-12)


@pytest.mark.parametrize(
    ("build", "reason"),
    [
        (lambda: HeatNetwork({"a": 3.0}, (("air", "ambient", 0.1),)), "neither 'air' nor 'ambie"),
        (lambda: HeatNetwork({}, ()), "at least one body"),
        (lambda: TWO.solve(TIMES, 22.0, {"lamp": Course.constant(1.0)}, AIR),
         "'lamp', which is not a body"),
        (lambda: TWO.solve(TIMES, 22.0, {}, {}), "'ambient' is not given"),
    ],
)  # fmt: skip
def test_impossible_networks(build, reason):
    with pytest.raises(ConfigurationError, match=reason):
        build()
