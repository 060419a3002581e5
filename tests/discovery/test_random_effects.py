"""Random effects: offsets of hidden targets, the mount's movement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.blind.bridge import series_input
from tests.blind.case import Case
from tests.blind.generator import generate
from tests.discovery.test_likelihood import of_images, products
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.random_effects import Movement, waves
from thermocald.thermal.reduce import reduce_together


def hidden_but(epochs: slice, targets: list[int]):
    """A camera with rates only, which sees some targets only in some epochs."""
    series, _ = generate(Case((), 0.3, 7, epochs=40, with_m2=False))
    source = series_input(series[0])
    never = np.zeros(source.grid.observed.shape, dtype=bool)
    never[:, targets] = True
    seldom = never.copy()
    seldom[epochs][:, targets] = False
    return [
        reduce_together([replace(source, grid=source.grid.reject(bad))]) for bad in (never, seldom)
    ]


def test_targets_seen_in_one_epoch_say_nothing():
    """Whatever their offsets are, a single epoch cannot be compared with others."""
    without, once = hidden_but(slice(11, 12), list(range(60)))

    a, b = (HypothesisFitter(series).fit(()) for series in (without, once))

    sd = np.sqrt(np.diag(a.covariance))
    scale = once[0].scale[:3] / without[0].scale[:3]
    assert np.max(np.abs(b.coefficients / scale - a.coefficients) / sd[:3]) < 0.3
    assert np.sqrt(np.diag(b.covariance)) / scale == pytest.approx(sd, rel=0.03)


def test_movement_is_the_dense_covariance(evidence_of):
    """Inner products with a movement equal those of the covariance matrix written out."""
    (e,), _ = evidence_of(seed=5, epochs=24, with_m2=False)
    keep, S = of_images(e)
    directions = keep[:, -2:]
    movement = Movement(directions, waves(e.times, 4), np.full((2, 4), 0.5))
    fit = HypothesisFitter([replace(e, movement=movement)]).fit(())

    J = [
        np.einsum("e,k->ek", column, keep.T @ d).ravel()
        for d, operator in movement.operators
        for column in operator.T
    ]
    assert len(J) == 8
    own = HypothesisFitter([e]).drive((), 0)[1] * e.state_sd("temperature")
    d = keep.T @ fit.direction(fit.blocks[0])[0]
    J += [np.einsum("e,k->ek", own[:, i], d).ravel() for i in range(own.shape[1])]
    S += np.transpose(J) @ np.array(J)
    C = np.random.default_rng(1).normal(size=(len(e.times), 2))
    C -= C.mean(axis=0)
    expected = products(S, C, keep.T @ keep[:, :2])

    found = fit.weightings[0].reduce(C, keep[:, :2])[0]

    assert found == pytest.approx(expected, rel=2e-3, abs=2e-3 * np.abs(expected).max())
