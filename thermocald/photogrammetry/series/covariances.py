"""How sure an adjusted series is: covariances of its parameters from the linearised system.

Two kinds are kept apart: what differs between epochs, and the level, which all have in common.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP, EOP_COLUMNS, PARAMETER_NAMES
from thermocald.photogrammetry.linalg import inverse_2x2, inverse_of_determined, root_of
from thermocald.photogrammetry.series.normals import among_all, cofactors

if TYPE_CHECKING:
    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.series.system import SeriesSystem
    from thermocald.photogrammetry.series.target_noise import CorrelatedPairs

AFFINITY = 1e-4  # of a good lens: fx and fy of phones differ by 1e-4 to 3e-3
C1, C2 = PARAMETER_NAMES.index("C1"), PARAMETER_NAMES.index("C2")
_MOST_TAKEN_OFF = 0.6  # of the variance of a combination of parameters


def all_cofactors(system: SeriesSystem) -> tuple[Array, Array, Array]:
    """Return the cofactors of all parameters.

    Those (E, 16, 16) relative to the series; of what all epochs have in common (16, 16); and of
    what the common unknowns do to a straight line from the first to the last epoch (16, 16).

    An epoch's parameters depend on the common unknowns by -G; what of G is the same in all
    epochs cancels in differences within the series, the rest is the epoch's own.
    """
    design = system.design
    own, common = design.own, design.common
    Q = system.Q
    level, trend = np.zeros((16, 16)), np.zeros((16, 16))
    width = len(system.Q_common)
    if width:
        Q = Q.copy()
        mean, tilt = np.zeros((len(own), width)), np.zeros((len(own), width))
        line = line_weights(system.good)
        for part, C in system.couplings():
            G = system.Q[part] @ C
            mean += G.sum(axis=0)
            tilt += np.tensordot(line[part], G, axes=1)
        mean /= max(int(system.good.sum()), 1)
        root = root_of(system.Q_common)
        own_tilt = tilt @ root
        trend[own[:, None], own] = own_tilt @ own_tilt.T
        for part, C in system.couplings():
            deviation = (system.Q[part] @ C - mean) @ root
            Q[part] += deviation @ np.swapaxes(deviation, 1, 2)
        # A parameter that is both own and common takes both ways.
        all_level = np.zeros((16, width))
        all_level[common] = root[: len(common)]
        all_level[own] -= mean @ root
        level = all_level @ all_level.T
    relative = among_all(Q, own)
    relative[~system.good] = 0.0
    return relative, level, trend


def of_slow_targets(system: SeriesSystem, errors: Array, group: Index) -> Array:
    """Covariance (16, 16) of a straight line over the series from targets' slow errors.

    errors (T, 2) px: seen in the residuals, of which a group of targets that errs together has
    already pulled a part into the parameters; as in the jackknife (HC3) that is put back:
    Σ Q Aᵀ W (I - H)⁻¹ e eᵀ (I - H)⁻¹ W A Q over the groups.
    """
    design = system.design
    out = np.zeros((16, 16))
    if not system.good.any():
        return out
    w = np.sqrt(system.used(system.good).mean(axis=0)[:, :2])
    J = design.at.A[..., design.own] * w[..., None]
    inverse, good = cofactors((np.einsum("tkp,tkq->pq", J, J) + design.own_prior)[None])
    if not good[0]:
        return out
    total = np.zeros((len(design.own), len(design.own)))
    for label in np.unique(group):
        rows = group == label
        e = (errors[rows] * w[rows]).ravel()
        if not e.any():
            continue
        Jg = J[rows].reshape(len(e), -1)
        left = np.eye(len(e)) - Jg @ inverse[0] @ Jg.T
        values, vectors = np.linalg.eigh(left)
        # What a group determines alone cannot be seen in its residuals at all.
        back = vectors @ ((vectors.T @ e) / np.maximum(values, 0.1))
        pull = inverse[0] @ (Jg.T @ back)
        total += np.outer(pull, pull)
    out[design.own[:, None], design.own] = total
    return out


def of_correlated(system: SeriesSystem, pairs: CorrelatedPairs) -> Array:
    """What correlated errors add to the covariance (E, 16, 16) of own parameters."""
    design = system.design
    extra = pairs.normal_matrices(system.used(), design.at.A[..., design.own])
    own = system.Q @ extra @ system.Q
    # Covariances from epochs that do not see the same targets may be indefinite together: at most
    # three fifths are taken off the variance of any combination.
    root = np.linalg.cholesky(system.Q)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ own @ np.swapaxes(inverse, 1, 2))
    back = root @ vectors
    own = (back * np.maximum(values, -_MOST_TAKEN_OFF)[:, None, :]) @ np.swapaxes(back, 1, 2)
    own[~system.good] = 0.0
    return among_all(own, design.own)


def of_priors(system: SeriesSystem) -> Array:
    """The part (E, p, p) of the cofactors that the priors contribute, Q P Q."""
    design = system.design
    part: Array = system.Q @ design.own_prior @ system.Q
    part[~system.good] = 0.0
    return part


def typical_sensitivity(system: SeriesSystem) -> Array:
    """By how much own parameters (p,) follow an error of the pose (6,), in a typical epoch."""
    design = system.design
    N = system.N[system.good].mean(axis=0)
    Q, _ = cofactors((N[design.own[:, None], design.own] + design.own_prior)[None])
    sensitivity: Array = Q[0] @ N[design.own[:, None], EOP_COLUMNS]
    return sensitivity


def by_perspective(system: SeriesSystem) -> Array:
    """Cofactors (16,) of a typical epoch's parameters if the mount could stand anywhere in each.

    NaN for what is held, and where nothing is common to the epochs.
    """
    out = np.full(16, np.nan)
    if len(system.design.common) and system.good.any():
        free = np.union1d(system.design.own, EOP_COLUMNS)
        N = system.N[system.good].mean(axis=0)[free[:, None], free]
        out[free] = np.diag(inverse_of_determined(N))
    return out


def of_held_affinity(system: SeriesSystem) -> Array:
    """How far the level (16,) lies off, at most, where an affinity or shear of `AFFINITY` is held.

    The mean image of all epochs is adjusted with and without it; the targets' offsets take part.
    """
    design, A = system.design, system.design.at.A
    out = np.zeros(16)
    free = np.union1d(design.own, design.common)
    weights = system.used(system.good).sum(axis=0)
    seen = (weights[:, :2] > 0).all(axis=1)
    V = inverse_2x2(_full(weights[seen]))
    if design.offset_prior is not None:
        V += inverse_2x2(_full(design.offset_prior[seen]))
    W = inverse_2x2(V)
    N = np.einsum("tki,tkl,tlj->ij", A[seen], W, A[seen], optimize=True)
    Q = inverse_of_determined(N[free[:, None], free])
    for held in np.setdiff1d([C1, C2], free):
        out[free] = np.maximum(out[free], np.abs(Q @ N[free, held]) * AFFINITY)
    return out


def _full(weights: Array) -> Array:
    """Weights (T, 3) xx, yy, xy as matrices (T, 2, 2)."""
    return np.stack([weights[:, [0, 2]], weights[:, [2, 1]]], axis=1)


def of_common(system: SeriesSystem, covariance: Array) -> Array:
    """Covariance (E, p, p) of own parameters where the common ones (q, q) err in an epoch."""
    design = system.design
    G = system.Q @ system.N[:, design.own[:, None], design.common]
    part: Array = G @ covariance @ np.swapaxes(G, 1, 2)
    part[~system.good] = 0.0
    return part


def pose_equations(N: Array, b: Array, own: Index, Q: Array) -> tuple[Array, Array]:
    """Return normal equations (E, 6, 6), (E, 6) of the pose, an epoch's own parameters reduced.

    N (E, 16, 16), b (E, 16); Q (E, p, p): cofactors of the own parameters, the pose held.
    """
    C = N[:, own[:, None], EOP_COLUMNS]
    QC = Q @ C
    reduced = N[:, EOP, EOP] - np.swapaxes(C, 1, 2) @ QC
    return reduced, b[:, EOP] - np.einsum("epi,ep->ei", QC, b[:, own])


def stillness(system: SeriesSystem, residuals: Array) -> Array:
    """Chi-square (E,) of the held exterior orientation being the same in an epoch as in the series.

    Rao's score test: the gradient by its six parameters, with the epoch's own ones reduced.
    """
    b = system.gradient(residuals)
    V, g = pose_equations(system.N, b, system.design.own, system.Q)
    inverse, good = cofactors(V)
    score = np.einsum("ei,eij,ej->e", g, inverse, g)
    return np.where(good & system.good, score, np.nan)


def line_weights(good: Mask) -> Array:
    """Weights (E,) that give the change of a straight line from the first epoch to the last."""
    t = np.flatnonzero(good).astype(np.float64)
    weights = np.zeros(len(good))
    if len(t) > 1:
        centred = t - t.mean()
        weights[good] = centred / (centred @ centred) * (t[-1] - t[0])
    return weights
