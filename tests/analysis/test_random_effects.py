"""A camera type: intervals for a new specimen hold."""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.analysis.statistics.random_effects import population

# rates of c, x0, y0 (µm/K) and the level of x0 (µm): their mean and scatter between specimens
MEAN = np.array([1.2, -0.8, 0.5, 3.0])
SD = np.array([0.30, 0.25, 0.20, 6.0])
CORRELATION = 0.6


def fleet(rng, count, noise):
    """Draw true values (count, k), estimates and their covariances."""
    k = len(MEAN)
    R = np.full((k, k), CORRELATION) + (1 - CORRELATION) * np.eye(k)
    true = MEAN + rng.multivariate_normal(np.zeros(k), R * np.outer(SD, SD), count)
    C = np.diag((noise * SD) ** 2)
    return true, true + rng.multivariate_normal(np.zeros(k), C, count), np.array([C] * count)


def coverage(noise, own, fleets):
    """Return the shares (5,) of 95 % intervals that hold: of the parameters, and x0 at T0 + 20 K.

    own: the new specimen's noise over the scatter of its type.
    """
    rng = np.random.default_rng([21, int(100 * noise), int(10 * own)])
    inside = np.zeros(5)
    for _ in range(fleets):
        _, found, C = fleet(rng, 10, noise)
        true, seen, C_new = fleet(rng, 1, own)
        new = population(found, C).posterior(seen[0], np.linalg.inv(C_new[0]))
        for i, direction in enumerate((*np.eye(4), np.array([0, 20.0, 0, 1.0]))):
            _, low, high = new.interval(direction)
            inside[i] += low <= direction @ true[0] <= high
    return inside / fleets


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "own"), [(0.05, 1.0), (0.3, 0.3), (0.1, 3.0), (0.1, 1.0)])
def test_the_intervals_hold_over_a_thousand_fleets(noise, own):
    found = coverage(noise, own, 1000)
    assert found[:4].mean() == pytest.approx(0.95, abs=0.01)
    assert (found > 0.92).all()


def test_unknown_values_come_from_the_type():
    rng = np.random.default_rng(5)
    _, found, C = fleet(rng, 10, 0.1)
    people = population(found, C)
    new = people.posterior(np.full(4, np.nan), np.zeros((4, 4)))
    assert new.values == pytest.approx(people.mean)
    assert new.covariance == pytest.approx(people.prior)
    exact = people.posterior(MEAN, np.diag(1e12 / SD**2))
    assert exact.values == pytest.approx(MEAN, abs=1e-6)
    equal = population(np.array([MEAN] * 3), np.zeros((3, 4, 4)))  # was a ValueError
    same = equal.posterior(MEAN, np.eye(4)).interval(np.eye(4)[0])
    assert same == pytest.approx((MEAN[0],) * 3, abs=1e-12)
