"""Noise that the images' own sigmas do not know: correlated in time, or shared by neighbours.

Correlation in time is seen in the residuals of single targets and makes slow trajectories less
certain than their number of epochs says; corners of a marker, or of a board, err slowly together,
and pull at some combinations of the parameters more than at others. Noise that neighbours share
from epoch to epoch goes into the camera's parameters; it is seen in their jumps, once the
trajectories have been explained.

Source: Liang, Zeger (1986), Biometrika 73, 13-22, for covariances from clusters that err together;
Bell, McCaffrey (2002), Survey Methodology 28, 169-181, for what the fit takes off their residuals.
"""

from __future__ import annotations

from dataclasses import replace
from math import comb
from typing import TYPE_CHECKING

import numpy as np

from thermocald.reduction.adequacy import ORDERS, cosines
from thermocald.reduction.random_effects import waves

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.reduction.fit import HypothesisFitter
    from thermocald.reduction.hypothesis import Block, Fit
    from thermocald.reduction.series import ReducedSeries

__all__ = [
    "jumps", "noisier", "slow_together", "trembles", "trembling", "with_correlated_noise",
    "with_jumps",
]  # fmt: skip

_FEWEST = 60  # epochs that tell how much the series jumps
_BEYOND = 1.15  # times the largest eigenvalue that noise shows (Marchenko, Pastur)
_FAST = 8  # order of differences that leaves little but what jumps
_UNUSUAL = 1.7  # a variance from 170 second differences has 13 % of standard deviation


def with_correlated_noise(evidence: ReducedSeries) -> ReducedSeries:
    """The series with weights as its slow trajectories deserve them."""
    k = evidence.correlation
    if k <= 1.0:
        return evidence
    factors, W = slow_together(evidence)
    hidden = evidence.hidden.scaled(1.0 / k) if evidence.hidden else None
    e = replace(evidence, N=evidence.N / k, b=evidence.b / k, yy=evidence.yy / k, hidden=hidden)
    return with_jumps(e, factors / k, W) or e


def slow_together(evidence: ReducedSeries) -> tuple[Array, Array]:
    """Variance of slow trajectories over that of white noise (P,), by combinations W (P, P).

    The combinations are orthonormal under the mean normal matrix.

    From what clusters of neighbouring targets leave over together in slow trajectories; what the
    fit has taken off a cluster's residuals is put back, so that white noise gives 1.
    """
    M = evidence.N.mean(axis=0)
    W, good = _orthonormal(M)
    trajectories = cosines(evidence.history.times, ORDERS)
    trajectories /= np.linalg.norm(trajectories, axis=1, keepdims=True)
    weights = evidence.weights[..., :2]
    v = np.nan_to_num(evidence.residuals) * weights
    mean = weights.mean(axis=0)
    total = np.zeros(M.shape)
    for rows in _clusters(evidence):
        A = (evidence.columns[rows] @ W).reshape(-1, len(M))
        left, V = np.linalg.eigh(np.eye(len(M)) - A.T @ (A * mean[rows].reshape(-1, 1)))
        pull = (trajectories @ v[:, rows].reshape(len(v), -1)) @ A
        # what a cluster determines alone cannot be told from its residuals at all
        pull = pull @ (V / np.sqrt(np.maximum(left, 0.05))) @ V.T
        total += pull.T @ pull / len(trajectories)
    total[~good] = 0.0
    total[:, ~good] = 0.0
    factors, turn = np.linalg.eigh(total)
    return factors, W @ turn


def _orthonormal(M: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Combinations W (P, P) of the parameters that are orthonormal under a normal matrix M (P, P),
    and which of them (P,) it determines.
    """
    size, U = np.linalg.eigh(M)
    good = size > 1e-6 * np.median(size)
    return U / np.sqrt(np.where(good, size, 1.0)), good


def _clusters(evidence: ReducedSeries) -> list[NDArray[np.int64]]:
    """Neighbouring targets of the field together, markers whole: some thirty clusters."""
    from scipy.cluster.hierarchy import fcluster, linkage

    field = evidence.source.field
    used = np.flatnonzero((evidence.weights[..., 0] > 0).any(axis=0))
    markers, member = np.unique(field.groups[used], return_inverse=True)
    middle = np.stack([field.points[used[member == g]].mean(axis=0) for g in range(len(markers))])
    count = int(np.clip(len(used) // 6, 8, 30))
    if len(middle) > count:
        label = fcluster(linkage(middle, "complete"), count, "maxclust")
    else:
        label = np.arange(len(middle))
    return [used[label[member] == g] for g in np.unique(label)]


def jumps(fitter: HypothesisFitter, fit: Fit, series: int) -> tuple[Array, Array]:
    """Variance of the jumps over its expectation (P,) and the combinations W (P, P) it is of.

    The columns of W are orthonormal under the mean normal matrix; the thermometer's noise, which
    jumps too, is in the expectation. What trembles as a whole has a direction of its own: where one
    is clear, the combinations are turned to it.
    """
    e = fitter.series[series]
    rest = _left(fitter, fit, series)
    W, good = _orthonormal(e.N.mean(axis=0))
    z = (rest @ W)[e.n > 0]
    d = np.diff(z, 2, axis=0)
    spread = np.median(np.abs(d), axis=0) * 1.4826
    observed = np.array(
        [np.mean(x[np.abs(x) <= 4 * s] ** 2) for x, s in zip(d.T, spread, strict=True)]
    )
    white = 6.0 / e.correlation
    carried = _thermometer_jumps(fitter, fit, series, W)
    usual = np.all(np.abs(d) <= 4 * spread + 1e-12, axis=1)
    turned = _turned(d[usual][:, good], white, carried[np.ix_(good, good)], 2)
    if turned is not None:
        factors, U = turned
        return np.concatenate([np.ones(int((~good).sum())), factors]), np.column_stack(
            [W[:, ~good], W[:, good] @ U]
        )
    return np.where(good, observed / (white + np.diag(carried)), 1.0), W


def _left(fitter: HypothesisFitter, fit: Fit, series: int) -> Array:
    """What a fit and one level leave of the right-hand sides (E, P) of a series."""
    e = fitter.series[series]
    C, V, index = fit.designs[series]
    rest = e.b - np.einsum("epq,eq->ep", e.N, (C * fit.coefficients[index]) @ V.T)
    level = np.linalg.lstsq(e.N.sum(axis=0), rest.sum(axis=0), rcond=1e-12)[0]
    out: Array = rest - e.N @ level
    return out


def trembles(evidence: ReducedSeries) -> bool:
    """Whether all targets jump together from epoch to epoch.

    From differences of so high an order that nothing is left of what follows a temperature: no
    effect is assumed, and no thermometer's errors come in.
    """
    M = evidence.N.mean(axis=0)
    W, good = _orthonormal(M)
    W = W[:, good]
    d = np.diff((evidence.values @ M @ W)[evidence.n > 0], _FAST, axis=0)
    if len(d) < _FEWEST:
        return False
    spread = np.median(np.abs(d), axis=0) * 1.4826
    usual = np.all(np.abs(d) <= 4 * spread + 1e-12, axis=1)
    white = comb(2 * _FAST, _FAST) / evidence.correlation
    return _turned(d[usual], white, np.zeros((len(W.T), len(W.T))), _FAST) is not None


def _turned(d: Array, white: float, carried: Array, order: int) -> tuple[Array, Array] | None:
    """Factors (m,) along orthonormal directions (m, m) in which differences d (n, m) of an order
    are clearly larger than expected; None where there are none.

    white: the mean square that image noise gives, carried (m, m): that of thermometers.
    """
    n, m = d.shape
    if n < _FEWEST:
        return None
    # differences repeat each other: of n second ones 18/35 are independent
    shared = np.array([comb(2 * order, k) for k in range(2 * order + 1)], dtype=float)
    independent = n * shared[order] ** 2 / np.sum(shared**2)
    edge = (1.0 + np.sqrt(m / independent)) ** 2
    covariance = d.T @ d / n
    _, U = np.linalg.eigh(covariance - carried)
    own = np.einsum("ji,jk,ki->i", U, covariance, U)
    expected = white + np.einsum("ji,jk,ki->i", U, carried, U)
    clear = own > _UNUSUAL * edge * expected
    if not clear.any():
        return None
    # what thermometers carry is an upper bound: trajectories are smoothed
    return np.where(clear, own / white, 1.0), U


def _thermometer_jumps(fitter: HypothesisFitter, fit: Fit, series: int, W: Array) -> Array:
    """Mean products (P, P) of the second differences that the thermometers' noise makes in z."""
    e = fitter.series[series]
    second = np.diff(np.eye(len(e.times)), 2, axis=0)
    total = np.zeros((W.shape[1], W.shape[1]))
    for block in fit.blocks:
        if block.trajectories > 1 or block.series not in (None, series):
            continue
        operator, channel = _reading_operator(fitter, fit, block, series)
        if operator is None:
            continue
        jump = (second @ operator) * e.state_sd(channel)
        share = W.T @ e.N.mean(axis=0) @ fit.direction(block)[0]
        total += np.mean(np.sum(jump**2, axis=1)) * np.outer(share, share)
    return total


def with_jumps(evidence: ReducedSeries, factors: Array, W: Array) -> ReducedSeries | None:
    """The series with unusual jumps as part of its noise; None where there are none."""
    factors = np.where(factors > _UNUSUAL, factors, 1.0)
    if np.all(factors == 1.0):
        return None
    inverse = np.linalg.inv(W)
    T = inverse.T @ np.diag(1.0 / np.sqrt(factors)) @ W.T
    N = T @ evidence.N @ T.T
    N = 0.5 * (N + N.swapaxes(1, 2))
    b = np.einsum("epq,eq->ep", N, evidence.values)
    hidden = evidence.hidden.turned(T, evidence.values) if evidence.hidden else None
    return replace(evidence, N=N, b=b, yy=np.einsum("ep,ep->e", evidence.values, b), hidden=hidden)


def trembling(fitter: HypothesisFitter, fit: Fit, slower: int) -> list[ReducedSeries]:
    """All series with what moves from epoch to epoch as a movement of each epoch by itself.

    slower: how many of the slowest half-waves are accounted for otherwise.
    """
    out = []
    for s, e in enumerate(fitter.series):
        M, W = _fast_power(fitter, fit, s, slower)
        edge = (1.0 + np.sqrt(len(M) / max(len(e.times) - slower, 1))) ** 2
        factors, U = np.linalg.eigh(M)
        clear = factors > _BEYOND * edge  # what so few half-waves cannot show by chance
        D = W @ (U[:, clear] * np.sqrt(factors[clear] - 1.0))
        rest = np.diag(M - (U[:, clear] * (factors[clear] - 1.0)) @ U[:, clear].T)
        more = rest > _UNUSUAL
        D = np.column_stack([D, W[:, more] * np.sqrt(rest[more] - 1.0)])
        out.append(replace(e, tremble=D) if D.shape[1] else e)
    return out


def _fast_power(
    fitter: HypothesisFitter, fit: Fit, series: int, slower: int
) -> tuple[Array, Array]:
    """Mean power (m, m) of the fast half-waves that a fit leaves in the determined combinations
    W (P, m) of the parameters: the unit matrix where the image noise is all. What the
    thermometers' noise makes is taken off.
    """
    e = fitter.series[series]
    W, good = _orthonormal(e.N.mean(axis=0))
    W = W[:, good]
    rest = _left(fitter, fit, series)
    fast = waves(e.times, len(e.times) - 1)[:, slower:].T
    z = fast @ (rest @ W)
    power: Array = z.T @ z / len(fast)
    for block in fit.blocks:
        if block.trajectories > 1 or block.series not in (None, series):
            continue
        operator, channel = _reading_operator(fitter, fit, block, series)
        if operator is not None:
            carried = fast @ operator
            noise = np.mean(np.sum((carried * e.state_sd(channel)) ** 2, axis=1))
            # the fit has smoothed readings: what smoothing took off them is not in the rest
            taken = np.mean((carried @ e.state_deviation(channel)) ** 2)
            left = max(np.sqrt(noise) - np.sqrt(taken), 0.0) ** 2
            along = W.T @ e.N.mean(axis=0) @ fit.direction(block)[0]
            power -= left * np.outer(along, along)
    return power, W


def _reading_operator(
    fitter: HypothesisFitter, fit: Fit, block: Block, series: int
) -> tuple[Array | None, str]:
    """How the readings' errors reach the trajectory of a block, and their channel."""
    if block.term < 0:
        return fitter.drive(fit.terms, series)[1], fitter.series[series].history.reference
    _, operator, channel = fitter.trajectories(fit.terms[block.term], series, fit.terms)
    return operator, channel


def noisier(fitter: HypothesisFitter, fit: Fit) -> list[ReducedSeries] | None:
    """All series with what still jumps from epoch to epoch as noise; None where nothing does."""
    if any(len(e.times) < _FEWEST for e in fitter.series):
        return None
    out = [with_jumps(e, *jumps(fitter, fit, s)) for s, e in enumerate(fitter.series)]
    if all(e is None for e in out):
        return None
    return [e or old for e, old in zip(out, fitter.series, strict=True)]
