"""Gross errors are found in the time series, and a fast drift is none."""

import numpy as np

from thermocald.thermal.reduce import find_spikes


def drifting(rng):
    """Draw 300 epochs of 20 targets: a drift of a pixel, noise of 0.004 px."""
    arm = rng.uniform(0.5, 1.5, (20, 2))
    way = np.sin(2 * np.pi * np.arange(300) / 40.0)
    return way[:, None, None] * arm + rng.normal(0, 0.004, (300, 20, 2))


def test_turning_points_of_a_drift_are_no_gross_errors():
    """Only there does an epoch differ from the median of its neighbours."""
    misclosure = drifting(np.random.default_rng(3))
    assert find_spikes(misclosure, np.ones((300, 20), dtype=bool)).sum() == 0


def test_a_target_that_jumps_is_found():
    misclosure = drifting(np.random.default_rng(4))
    misclosure[[50, 121, 250], [3, 7, 3]] += 0.5
    found = np.argwhere(find_spikes(misclosure, np.ones((300, 20), dtype=bool)))
    jumps = {(50, 3), (121, 7), (250, 3)}
    assert jumps <= set(map(tuple, found))
    # neighbouring epochs may also be suspected before an adjustment
    assert all(any(abs(e - k) <= 2 and t == j for k, j in jumps) for e, t in found)
