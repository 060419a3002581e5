"""Covariances of an adjusted series' parameters, from the linearised system.

Errors that differ between epochs are separate from the level, the errors common to all epochs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP, EOP_COLUMNS, IOP, PARAMETER_NAMES
from thermocald.photogrammetry.linalg import (
    inverse_2x2,
    inverse_of_determined,
    root_of,
    symmetric_power,
    unit_diagonal,
)
from thermocald.photogrammetry.series.normals import (
    as_matrices,
    cofactors,
    linearise,
    normal_matrices,
    right_hand_sides,
    sums_of_targets,
)
from thermocald.photogrammetry.series.system import SeriesSystem

if TYPE_CHECKING:
    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.series.system import State
    from thermocald.photogrammetry.series.target_noise import CorrelatedPairs

AFFINITY = 1e-4  # of a good lens; fx and fy of phones differ by 1e-4 to 3e-3
C1, C2 = PARAMETER_NAMES.index("C1"), PARAMETER_NAMES.index("C2")
_STEPS = 4  # of Gauss-Newton, from the adjusted series
_MOST_REMOVED = 0.6  # of the variance of a combination of parameters


def all_cofactors(system: SeriesSystem) -> tuple[Array, Array, Array]:
    """Return the cofactors of all parameters.

    Those of the own ones relative to the series (E, p, p); those of the level (16, 16); and those
    of the change of a straight line from the first to the last epoch by the common unknowns (16,
    16).

    An epoch's parameters depend on the common unknowns by -G. The mean of G over the epochs cancels
    in differences within the series; the deviation from it is the epoch's own.
    """
    design = system.design
    own, common = design.own, design.common
    Q = system.Q.copy()
    level, trend = np.zeros((16, 16)), np.zeros((16, 16))
    width = len(system.Q_common)
    if width:
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
        # A parameter that is both own and common depends on them both ways.
        all_level = np.zeros((16, width))
        all_level[common] = root[: len(common)]
        all_level[own] -= mean @ root
        level = all_level @ all_level.T
    return Q, level, trend


def scaled_covariances(Q: Array, system: SeriesSystem, unit: Array, pooled: float) -> Array:
    """Scale cofactors (E, p, p) by the epochs' variances (E,), the priors' part by the series'."""
    bound = system.Q @ system.design.own_prior @ system.Q
    return np.asarray((Q - bound) * unit[:, None, None] + pooled * bound)


def with_excess(covariance: Array, excess: Array) -> Array:
    """Add excess variances (p,) to covariances (E, p, p), whose correlations remain.

    Scatter beyond the noise is that of image points: real series show the noise's correlations.
    """
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    ratio = np.divide(excess, variances, out=np.zeros_like(variances), where=variances > 0)
    factor = np.sqrt(1.0 + ratio)
    return covariance * factor[:, :, None] * factor[:, None, :]


def slow_target_covariance(
    system: SeriesSystem, errors: Array, group: Index, together: bool
) -> Array:
    """Return the covariance (16, 16) of a change over the series from slow target errors.

    errors (T, 2) px: from the residuals. The parameters have absorbed a part of the error of a
    group of targets with a common error; it is restored as in the jackknife (HC3):
    Σ Q Aᵀ W (I - H)⁻¹ e eᵀ (I - H)⁻¹ W A Q over the groups. together: whether many targets may
    have moved alike. A camera absorbs the targets' mean movement: residuals do not show it, but
    most targets, which stood still, have as large an error.
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
    total, moved = np.zeros((len(design.own), len(design.own))), np.zeros_like(errors)
    for label in np.unique(group):
        rows = group == label
        e = (errors[rows] * w[rows]).ravel()
        if not e.any():
            continue
        Jg = J[rows].reshape(len(e), -1)
        left = np.eye(len(e)) - Jg @ inverse[0] @ Jg.T
        values, vectors = np.linalg.eigh(left)
        # A group's residuals do not show what the group alone determines.
        back = vectors @ ((vectors.T @ e) / np.maximum(values, 0.1))
        pull = inverse[0] @ (Jg.T @ back)
        total += np.outer(pull, pull)
        moved[rows] = back.reshape(-1, 2) / np.maximum(w[rows], 1e-12)
    if together:
        shifted = inverse[0] @ np.einsum("tkp,tk->pk", J, w)
        squares = (moved[w[:, 0] > 0] ** 2).sum(axis=1)
        usual = np.median(squares) / max(squares.sum(), 1e-300)
        total += shifted @ (usual * moved.T @ moved) @ shifted.T
    out[design.own[:, None], design.own] = total
    return out


def correlated_error_cofactors(
    system: SeriesSystem, pairs: CorrelatedPairs, variance: float
) -> Array:
    """Return the part of the own parameters' cofactors (E, p, p) from correlated errors.

    variance: of unit weight of the series from which the pairs come.
    """
    design = system.design
    extra = pairs.normal_matrices(system.used(), design.at.A[..., design.own]) / variance
    own: Array = system.Q @ extra @ system.Q
    # Covariances from epochs that see different targets may be indefinite together: the variance
    # of a combination is reduced by three fifths at most.
    root = np.linalg.cholesky(system.Q)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ own @ np.swapaxes(inverse, 1, 2))
    back = root @ vectors
    own = (back * np.maximum(values, -_MOST_REMOVED)[:, None, :]) @ np.swapaxes(back, 1, 2)
    own[~system.good] = 0.0
    return own


def level_errors(
    sensor: Sensor, field: TestField, system: SeriesSystem, values: Array, level: Array
) -> tuple[Array, float, Array]:
    """Return the combination (16,) of parameters whose course is the series' main change, of range
    1, its mean, and the covariance (16, 16) of what errors of the level add to a change by 1.

    An image shows a change by the partials at the level: where a field hardly determines that, such
    as one plane, a change of c looks like one of the principal point. values (E, 16); level (16,
    16): covariance.
    """
    design, rows, out = system.design, np.flatnonzero(system.good), np.zeros((16, 16))
    own, at, combination = design.own, design.at, np.zeros(16)
    if len(rows) < 2 or not len(own):
        return combination, 0.0, out
    w = system.used(rows).mean(axis=0, keepdims=True)
    usual = SeriesSystem.formed(design, w, w[..., 0] > 0)
    if not usual.good[0]:
        return combination, 0.0, out
    root = np.linalg.cholesky(usual.Q[0])
    away = np.linalg.solve(root, (values[rows][:, own] - values[rows][:, own].mean(axis=0)).T)
    direction = np.linalg.eigh(away @ away.T)[1][:, -1]
    size = max(float(np.ptp(direction @ away)), 1e-300)
    combination[own], change = np.linalg.solve(root.T, direction) / size, root @ direction * size
    scaled, scale = unit_diagonal(level)
    for error in (symmetric_power(scaled, 0.5) / scale[:, None]).T:
        more, less = (
            linearise(sensor, field, at.iop + e[IOP], at.eop + e[EOP]).A for e in (error, -error)
        )
        looks = 0.5 * (more - less)[..., own] @ change
        pull = usual.Q[0] @ right_hand_sides(w, looks[None], at.A[..., own])[0]
        out[own[:, None], own] += np.outer(pull, pull)
    return combination, float((values[rows] @ combination).mean()), out


def typical_sensitivity(system: SeriesSystem) -> Array:
    """Return the derivatives (p, 6) of a typical epoch's own parameters by an error of the pose."""
    design = system.design
    N = system.N[system.good].mean(axis=0)
    Q, _ = cofactors((N[design.own[:, None], design.own] + design.own_prior)[None])
    return np.asarray(Q[0] @ N[design.own[:, None], EOP_COLUMNS])


def perspective_cofactor_roots(system: SeriesSystem) -> Array:
    """Return the roots (16,) of a typical epoch's cofactors with a completely free mount.

    NaN for held parameters, for a series without a common pose, and where rounding makes a cofactor
    negative.
    """
    out = np.full(16, np.nan)
    if len(system.design.common) and system.good.any():
        free = np.union1d(system.design.own, EOP_COLUMNS)
        N = system.N[system.good].mean(axis=0)[free[:, None], free]
        cofactor = np.diag(inverse_of_determined(N))
        out[free] = np.sqrt(np.where(cofactor >= 0, cofactor, np.nan))
    return out


@dataclass(frozen=True)
class HeldAffinity:
    """Estimated differences (k,) of the held ones of C1 and C2 from their held values, their sds
    (k,), and the change of the level (k, 16) for a difference of 1.
    """

    names: tuple[str, ...]
    differences: Array
    sds: Array
    moves: Array


def estimate_held_affinity(
    sensor: Sensor,
    field: TestField,
    system: SeriesSystem,
    found: State,
    residuals: Array,
    field_variance: float,
) -> HeldAffinity:
    """Estimate how far C1 and C2 are from their held values, by the mean image of all epochs.

    residuals (E, T, 2) px; field_variance: factor of the field's stated covariance. As this very
    affinity may have caused it, the covariance is as stated here, and the sds follow the misfit.
    """
    design, A = system.design, system.design.at.A
    free = np.union1d(design.own, design.common)
    held = np.setdiff1d([C1, C2], free)
    both = np.concatenate([free, held])
    use = system.use & system.good[:, None]
    weights = np.stack([(system.weights[..., k] * use).sum(axis=0) for k in range(3)], axis=1)
    seen = (weights[:, :2] > 0).all(axis=1)
    noise, of_field = inverse_2x2(as_matrices(weights[seen])), np.zeros((2, 2))
    if len(design.offset_prior):
        of_field = inverse_2x2(as_matrices(design.offset_prior[seen]))
    N = _normals(A[seen], inverse_2x2(noise + of_field))
    moves = np.zeros((len(held), 16))
    moves[:, free] = -N[np.ix_(held, free)] @ inverse_of_determined(N[np.ix_(free, free)])
    sums = sums_of_targets(system.weights, residuals, use)[seen]
    state = start = found.values[system.good].mean(axis=0)
    image = linearise(sensor, field, start[:10], start[10:]).predicted + np.nan_to_num(
        found.offsets
    )
    image[seen] += np.einsum("tkl,tl->tk", noise, sums)
    W = inverse_2x2(noise + of_field / field_variance)
    for _ in range(_STEPS):
        at = linearise(sensor, field, state[:10], state[10:])
        left = np.nan_to_num(image - at.predicted)[seen]
        b = np.einsum("tki,tkl,tl->i", at.A[seen], W, left)[both]
        Q = inverse_of_determined(_normals(at.A[seen], W)[np.ix_(both, both)])
        state = state.copy()
        state[both] += Q @ b
    redundancy = 2 * int(seen.sum()) - len(both)
    sds = np.full(len(held), np.inf)
    if redundancy > 0:
        rest = float(np.einsum("tk,tkl,tl->", left, W, left) - b @ Q @ b)
        sds = np.sqrt(max(rest / redundancy, 1.0) * np.diag(Q)[len(free) :])
    names = tuple(PARAMETER_NAMES[k] for k in held)
    return HeldAffinity(names, (state - start)[held], sds, moves)


def _normals(A: Array, W: Array) -> Array:
    return np.asarray(np.einsum("tki,tkl,tlj->ij", A, W, A, optimize=True))


def pose_equations(N: Array, b: Array, own: Index, Q: Array) -> tuple[Array, Array]:
    """Return normal equations (E, 6, 6), (E, 6) of the pose, an epoch's own parameters reduced.

    N (E, 16, 16), b (E, 16); Q (E, p, p): cofactors of the own parameters, the pose held.
    """
    C = N[:, own[:, None], EOP_COLUMNS]
    QC = Q @ C
    reduced = N[:, EOP, EOP] - np.swapaxes(C, 1, 2) @ QC
    return reduced, b[:, EOP] - np.einsum("epi,ep->ei", QC, b[:, own])


def stillness(system: SeriesSystem, residuals: Array) -> tuple[Array, Array]:
    """Test whether an epoch's exterior orientation is the series'; return χ² (E,), and by how much
    it differs (E, 6).

    Rao's score test: the gradient of the six parameters, with the epoch's own ones reduced.
    """
    N, b = system.N, system.gradient(residuals)
    if not len(N):  # the common unknowns are held
        N = normal_matrices(system.used(), system.design.at.A)
    V, g = pose_equations(N, b, system.design.own, system.Q)
    inverse, good = cofactors(V)
    moved = (inverse @ g[..., None])[..., 0]
    score = np.einsum("ei,ei->e", g, moved)
    return np.where(good & system.good, score, np.nan), moved


def count_moved(stillness: Array) -> tuple[int, float]:
    """Return how many epochs moved by their χ² (E,), NaN if unknown, and the bound of that test.

    One epoch or more of a series that stands still exceeds it in one of 100 series.
    """
    from scipy.special import chdtri

    bound = float(chdtri(6, 0.01 / max(int(np.isfinite(stillness).sum()), 1)))
    return int((stillness > bound).sum()), bound


def shown_movement(system: SeriesSystem, residuals: Array, unit: Array) -> Array:
    """Return the mean square (6, 6) of the movements that single epochs show, with their noise; 0
    if the camera stood still.

    unit (E,): variances of unit weight. For a series too short to estimate how the mount moves.
    """
    score, moved = stillness(system, residuals)
    moved = moved[np.isfinite(score)]
    if not count_moved(score / np.maximum(unit, 1e-12))[0]:
        return np.zeros((6, 6))
    return np.asarray(moved.T @ moved / len(moved))


def line_weights(good: Mask) -> Array:
    """Return weights (E,) of the change of a straight line from the first epoch to the last."""
    t = np.flatnonzero(good).astype(np.float64)
    weights = np.zeros(len(good))
    if len(t) > 1:
        centred = t - t.mean()
        weights[good] = centred / (centred @ centred) * (t[-1] - t[0])
    return weights
