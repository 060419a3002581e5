"""The likelihood against the dense covariance, and of blocks that are left out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag

from thermocald.discovery.validation import is_confirmed, measure_block_gains
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import Term


def of_images(e):
    """The well-determined combinations (P, k), and the covariance of the images alone."""
    size, U = np.linalg.eigh(e.N.mean(axis=0))
    keep = U[:, size > 1e-3 * np.median(size)]
    N = np.einsum("pi,epq,qj->eij", keep, e.N, keep)
    return keep, block_diag(*np.linalg.inv(N))


def products(S, C, V):
    """Inner products under S of trajectories C (E, R) along V (k, R), with levels eliminated."""
    X = np.einsum("er,kr->ekr", C, V).reshape(-1, C.shape[1])
    level = np.tile(np.eye(len(V)), (len(C), 1))
    inverse = np.linalg.inv(S)
    L = inverse @ level
    return X.T @ (inverse - L @ np.linalg.solve(level.T @ L, L.T)) @ X


@pytest.fixture(scope="module")
def dense(evidence_of):
    """A short series, a fit with two carried trajectories, and S built entry by entry."""
    evidence, _ = evidence_of("nonlinear_expansion", seed=5, epochs=30, with_m2=False)
    fitter = HypothesisFitter(evidence)
    fit = fitter.fit((Term("nonlinear_expansion"),))
    e = evidence[0]
    keep, images = of_images(e)
    J = np.zeros((len(images), len(e.state_sd("temperature"))))
    for block, operator, _ in fitter.list_operators(fit.terms, fit.blocks, 0):
        d = keep.T @ fit.direction(block)[0]
        J += np.einsum("k,er->ekr", d, operator).reshape(J.shape)
    S = images + J @ np.diag(e.state_sd("temperature") ** 2) @ J.T
    return e, fit, keep, S, images


def test_inner_products_equal_the_dense_ones(dense):
    e, fit, keep, S, images = dense
    rng = np.random.default_rng(0)
    C = rng.normal(size=(len(e.times), 3))
    C -= C.mean(axis=0)
    V = keep @ rng.normal(size=(keep.shape[1], 3))

    A = fit.weightings[0].reduce(C, V)[0]

    expected = products(S, C, keep.T @ V)
    assert pytest.approx(expected, rel=2e-3, abs=2e-3 * np.abs(expected).max()) == A
    # the thermometer's part of S matters: image noise alone gives other values
    alone = products(images, C, keep.T @ V)
    assert np.abs(alone - expected).max() > 0.02 * np.abs(expected).max()


def test_determinant(dense):
    _, fit, keep, S, images = dense
    expected = np.linalg.slogdet(S)[1] - np.linalg.slogdet(images)[1]
    assert (
        expected > keep.shape[1]
    )  # readings are noisier than images: the determinants differ greatly
    assert fit.weightings[0].logdet == pytest.approx(expected, rel=1e-3)


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
    times = [s["time"] for (s,) in truth["effects"] if s["happens"]]
    own = [
        (("time", float(e.times[np.searchsorted(e.times, t)])),)
        for e, t in zip(lab.series, times, strict=False)
    ]
    fresh = tuple(own) + (None,) * (len(lab.series) - len(own))

    (gain,) = measure_block_gains(lab, lab.refine(lab.fit([Term("slip", fresh=fresh)])))

    assert is_confirmed(gain)
