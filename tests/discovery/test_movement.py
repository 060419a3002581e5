"""The movement of the mount beside a hypothesis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.blind.bridge import series_input
from tests.blind.case import Case
from tests.blind.generator import generate
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.movement import (
    Mount,
    estimate_mount_motion,
    find_combinations,
    guess_mount_motion,
)
from thermocald.thermal.reduce import reduce_series


def test_slow_drifts_in_weak_directions_are_movement():
    """Moments of rough half-waves do not show them; left at zero they were told as effects."""
    series, _ = generate(Case((), 0.3, 7, epochs=60, with_m2=False))
    e = reduce_series(series_input(series[0]))
    W = find_combinations([e])
    half_wave = np.cos(np.pi * np.linspace(0, 1, len(e.times)))
    drift = np.outer(2.0 * half_wave, W[:, 3:11].sum(axis=1))
    values = e.values + drift
    b = e.b + np.einsum("epq,eq->ep", e.N, drift)
    moved = replace(e, b=b, values=values, yy=np.einsum("ek,ek->e", values, b))
    fitter = HypothesisFitter([moved])
    start = fitter.fit(())

    mount = Mount(W, guess_mount_motion(fitter, start, W), 0.0)
    _, fit, _ = estimate_mount_motion(fitter, (), mount, start.coefficients, 5)

    assert start.chi2 - fit.chi2 > 0.8 * 8 * 2.0**2 * len(e.times) / 2
