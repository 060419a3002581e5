"""The likelihood against the dense covariance, and of blocks that are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from thermocald.discovery.validation import is_confirmed, measure_block_gains
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import Term
from thermocald.thermal.series import Movement, waves


def products(S, C, V):
    """Inner products under S of trajectories C (E, R) along V (k, R), with levels eliminated."""
    X = np.einsum("er,kr->ekr", C, V).reshape(-1, C.shape[1])
    level = np.tile(np.eye(len(V)), (len(C), 1))
    inverse = np.linalg.inv(S)
    L = inverse @ level
    return X.T @ (inverse - L @ np.linalg.solve(level.T @ L, L.T)) @ X


@pytest.mark.parametrize("moves", [False, True], ids=["a fixed mount", "a mount that moves"])
def test_the_likelihood_is_that_of_the_dense_covariance(evidence_of, moves):
    """Of images, of the thermometer's errors through each trajectory, and of a movement."""
    (e,), _ = evidence_of("nonlinear_expansion", seed=5, epochs=30, with_m2=False)
    size, U = np.linalg.eigh(e.N.mean(axis=0))
    keep = U[:, size > 1e-3 * np.median(size)]  # the well-determined combinations
    images = block_diag(*np.linalg.inv(np.einsum("pi,epq,qj->eij", keep, e.N, keep)))
    if moves:
        directions = keep[:, -2:] / np.sqrt(size[-2:])  # which have the noise as unit
        e = replace(e, movement=Movement(directions, waves(e.times, 4), np.full((2, 4), 2.0)))
    fitter = HypothesisFitter([e])
    fit = fitter.fit((Term("nonlinear_expansion"),))

    def carried(direction, operator):
        return np.einsum("k,er->ekr", keep.T @ direction, operator).reshape(len(images), -1)

    errors = sum(
        carried(fit.direction(block)[0], reach.states)
        for block, reach, _ in fitter.list_operators(fit.terms, fit.blocks, 0)
    ) * e.state_sd("temperature")
    S = images + errors @ errors.T
    for direction, sd in zip(e.movement.directions.T, e.movement.sd, strict=True) if moves else ():
        J = carried(direction, e.movement.trajectories * sd)
        S += J @ J.T
    rng = np.random.default_rng(0)
    C = rng.normal(size=(len(e.times), 3)).cumsum(axis=0)
    C -= C.mean(axis=0)
    V = keep @ rng.normal(size=(keep.shape[1], 3))
    expected = products(S, C, keep.T @ V)

    found = fit.weightings[0].reduce(C, V)[0]

    limit = np.abs(expected).max()
    assert found == pytest.approx(expected, rel=2e-3, abs=2e-3 * limit)
    # the thermometer's part of S matters: image noise alone gives other values
    assert np.abs(products(images, C, keep.T @ V) - expected).max() > 0.02 * limit
    if not moves:  # the size of a movement is estimated by restricted likelihood
        larger = np.linalg.slogdet(S)[1] - np.linalg.slogdet(images)[1]
        assert larger > keep.shape[1]  # readings are noisier than images
        assert fit.weightings[0].logdet == pytest.approx(larger, rel=1e-3)


def test_a_knee_stays_within_the_recorded_temperatures(evidence_of):
    """Above them it moves nothing, and normal equations are singular."""
    (e,), _ = evidence_of("creep", seed=2, epochs=60, with_m2=False)
    T, lab = e.history.temperature(), HypothesisFitter([e])
    start = Term("softening", nonlinear=(("T_k", float(T.min() + 0.9 * np.ptp(T))),))
    knee = dict(lab.refine(lab.fit([start]), 20).terms[0].nonlinear)["T_k"]
    assert T.min() < knee < T.max()


def test_a_course_that_follows_the_noise_predicts_nothing(evidence_of):
    """A cycle is fitted to a recording without effects, at the best period."""
    lab = HypothesisFitter(evidence_of(px=0.2, seed=92, epochs=90, with_m2=False)[0])
    trials = [
        lab.fit([Term("cyclic_interference", nonlinear=(("P", p),))])
        for p in np.geomspace(40, 400, 60)
    ]

    (gain,) = measure_block_gains(lab, min(trials, key=lambda f: f.objective))

    assert gain.sum() < 12  # of six coefficients


def test_a_step_within_the_block_left_out_is_no_fault(evidence_of):
    """Without the block that holds an early slip in M2, its size is undetermined."""
    evidence, truth = evidence_of("slip", px=0.2, seed=91, epochs=90)
    lab = HypothesisFitter(evidence)
    fresh = tuple(
        (("time", float(e.times[np.searchsorted(e.times, s["time"])])),) if s["happens"] else None
        for e, (s,) in zip(lab.series, truth["effects"], strict=True)
    )

    (gain,) = measure_block_gains(lab, lab.refine(lab.fit([Term("slip", fresh=fresh)])))

    assert is_confirmed(gain)
