"""Gross errors are found in time, and a fast drift is none."""

import numpy as np

from thermocald.thermal.reduce import find_spikes


def drifting(rng):
    """300 epochs of 20 targets that a camera moves by a pixel, far beyond the noise of 0.004 px."""
    arm = rng.uniform(0.5, 1.5, (20, 2))
    way = np.sin(2 * np.pi * np.arange(300) / 40.0)
    return way[:, None, None] * arm + rng.normal(0, 0.004, (300, 20, 2))


def test_where_a_drift_turns_there_is_no_gross_error():
    """The neighbours' median was the epoch itself but at the turns, and noise beyond all there."""
    misclosure = drifting(np.random.default_rng(3))
    assert find_spikes(misclosure, np.ones((300, 20), dtype=bool)).sum() == 0


def test_a_target_that_leaps_is_found():
    misclosure = drifting(np.random.default_rng(4))
    misclosure[[50, 121, 250], [3, 7, 3]] += 0.5
    found = np.argwhere(find_spikes(misclosure, np.ones((300, 20), dtype=bool)))
    leaps = {(50, 3), (121, 7), (250, 3)}
    assert leaps <= set(map(tuple, found))
    # its neighbours may be suspected as well, until there is an adjustment
    assert all(any(abs(e - k) <= 2 and t == j for k, j in leaps) for e, t in found)
