"""The movement of the mount beside a hypothesis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.blind.bridge import series_input
from tests.blind.case import Case
from tests.blind.generator import generate
from thermocald.reduction.fit import HypothesisFitter
from thermocald.reduction.movement import Mount, combinations, estimated, first_guess
from thermocald.reduction.reduce import reduce_series


def test_slow_drifts_in_weak_directions_are_movement():
    """Moments of rough half-waves do not show them; left at zero they were told as effects."""
    series, _ = generate(Case((), 0.3, 7, epochs=60, with_m2=False))
    e = reduce_series(series_input(series[0]))
    W = combinations([e])
    half_wave = np.cos(np.pi * np.linspace(0, 1, len(e.times)))
    drift = np.outer(2.0 * half_wave, W[:, 3:11].sum(axis=1))
    values = e.values + drift
    b = e.b + np.einsum("epq,eq->ep", e.N, drift)
    moved = replace(e, b=b, values=values, yy=np.einsum("ek,ek->e", values, b))
    fitter = HypothesisFitter([moved])
    start = fitter.fit(())

    mount = Mount(W, first_guess(fitter, start, W), 0.0)
    _, fit, _ = estimated(fitter, (), mount, start.coefficients, 5)

    assert start.chi2 - fit.chi2 > 0.8 * 8 * 2.0**2 * len(e.times) / 2
