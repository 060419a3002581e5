"""The movement of the mount beside a hypothesis."""

from __future__ import annotations

import numpy as np

from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.movement import (
    Mount,
    estimate_mount_motion,
    find_combinations,
    guess_mount_motion,
)


def test_slow_drifts_in_weak_directions_are_movement(evidence_of):
    """Moments of rough half-waves do not show them; set to zero, they would be named as effects."""
    (e,), _ = evidence_of(seed=7, epochs=60, with_m2=False)
    W = find_combinations([e])
    half_wave = np.cos(np.pi * np.linspace(0, 1, len(e.times)))
    drift = np.outer(2.0 * half_wave, W[:, 3:11].sum(axis=1))
    fitter = HypothesisFitter([e.with_values(e.values + drift)])
    start = fitter.fit(())

    mount = Mount(W, guess_mount_motion(fitter, start, W), 0.0)
    _, fit, _ = estimate_mount_motion(fitter, (), mount, start.coefficients, 5)

    assert start.chi2 - fit.chi2 > 0.8 * 8 * 2.0**2 * len(e.times) / 2
