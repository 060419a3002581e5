"""The camera's movement on its mount, as variance components beside a hypothesis.

A camera on a tripod drifts. The amplitudes of cosines in the well-determined combinations of the
camera's parameters are random, with the covariance Sigma / (corner² + k²) at the k-th half-wave: a
random walk, bounded unless the corner is zero. Sigma is estimated by restricted maximum likelihood
(EM) from all series together, and anew for each hypothesis, as what a hypothesis explains is not a
movement.

Source: Patterson, Thompson (1971), Biometrika 58, 545-554 (restricted maximum likelihood);
Dempster, Laird, Rubin (1977), J. Royal Statistical Society B 39, 1-38 (EM).

Movement from epoch to epoch is estimated from differences, in which slow effects cancel. It is
treated as an independent movement of each epoch, or as noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import (
    mad_sd,
    orthonormal_combinations,
    scaled_inverse,
    subtract_level,
    symmetric_power,
)
from thermocald.thermal import criteria
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.likelihood import whiten
from thermocald.thermal.series import Movement, waves

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array
    from thermocald.thermal.hypothesis import Fit, Term
    from thermocald.thermal.series import ReducedSeries

_WAVES = 24
_LEAST = 0.2  # variance of a half-wave, in units of the image noise, from which it is a state
_TINY = 1e-6
_FLOOR = 3.0
_LITTLE = 1e-3  # of the best determined direction's gain in precision
_FAST = 8  # order of differences that leaves little but jumps
_KINKS = 3 * (_FAST + 1)  # differences that a lamp switched three times may bend


@dataclass(frozen=True, eq=False)
class Mount:
    """A movement of the mount: covariance (m, m) of combinations (P, m), corner in half-waves.

    The combinations have unit variance if there is image noise only. walks: whether the tremble is
    the fast part of this movement.
    """

    combinations: Array
    covariance: Array
    corner: float
    walks: bool = False

    def modes(self) -> tuple[Array, Array]:
        """Return the variances and directions (P, ·) of the independent movements that matter."""
        size, U = np.linalg.eigh(self.covariance)
        kept = size > _LEAST
        kept[-1] = True  # at least one, so that likelihoods remain comparable
        return np.maximum(size[kept], _TINY), self.combinations @ U[:, kept]

    def on(self, series: Sequence[ReducedSeries]) -> list[ReducedSeries]:
        """Return the series with the movement as part of their noise."""
        size, directions = self.modes()
        out = []
        for e in series:
            K = _count_waves(e)
            k = np.arange(1, K + 1)
            sd = np.sqrt(size[:, None] / (self.corner**2 + k**2))
            out.append(replace(e, movement=Movement(directions, waves(e.times, K), sd)))
        return out

    def smoothness(self, fitter: HypothesisFitter, fit: Fit) -> float:
        """Return the power of the slowest half-waves over that of the fast ones, for this movement.

        It is about 1 for a random walk, and much larger for a smooth influence.
        """
        slow, fast = 0.0, 0.0
        for e, (mean, root) in zip(fitter.series, _estimate_amplitudes(fit), strict=True):
            assert e.movement is not None
            K = e.movement.sd.shape[1]
            mode, wave = e.movement.states
            power = np.zeros(K)
            own = mode == mode.max()  # the strongest
            k = wave[own]
            power[k] = (mean[own] ** 2 + np.sum(root[:, own] ** 2, axis=0)) * e.movement.sd[
                -1, k
            ] ** 2
            power *= np.arange(1, K + 1) ** 2
            slow += float(np.mean(power[: K // 4]))
            fast += float(np.mean(power[K // 2 :]))
        return slow / max(fast, 1e-12)

    def size_px(self, e: ReducedSeries) -> float:
        """Return the movement's expected RMS, px, over image points and time."""
        size, _ = self.modes()
        falling = 1.0 / (self.corner**2 + np.arange(1, _count_waves(e) + 1) ** 2)
        power = float(np.sum(size)) * float(np.sum(falling))
        coordinates = 2.0 * float(e.n.mean()) * len(e.times)
        return float(e.sigma_px * np.sqrt(power / max(coordinates, 1.0)))


def _count_waves(e: ReducedSeries) -> int:
    """Return the number of half-waves of the mount; faster movement is a tremble."""
    return min(_WAVES, len(e.times) // 2)


def find_combinations(series: Sequence[ReducedSeries]) -> Array:
    """Return the determined combinations (P, m) of parameters, orthonormal in the mean normals."""
    W, good = orthonormal_combinations(np.mean([e.N.mean(axis=0) for e in series], axis=0))
    return W[:, good]


def solve_combinations(N: Array, b: Array, W: Array) -> tuple[Array, Array]:
    """Solve each epoch for combinations W (P, m) with a weak prior.

    Returns normal matrices (E, m, m) and values (E, m).
    """
    normal = np.einsum("pi,epq,qj->eij", W, N, W) + 0.1 * np.eye(W.shape[1])
    return normal, np.linalg.solve(normal, (b @ W)[..., None])[..., 0]


def guess_mount_motion(fitter: HypothesisFitter, fit: Fit, W: Array, walks: bool) -> Array:
    """Return an initial covariance (m, m) from the power of the misfit's half-waves above noise.

    walks: whether to count what the weights have taken for a tremble.
    """
    total = np.zeros((W.shape[1], W.shape[1]))
    count = 0
    for s, e in enumerate(fitter.series):
        w = fit.weightings[s]
        noise = np.eye(len(total))  # with the tremble, which the weights have
        if walks and e.tremble is not None:
            along = W.T @ e.N.mean(axis=0) @ e.tremble
            noise += along @ along.T
        z = subtract_level(w.N, w.left(fit.parameters(s))) @ W @ noise
        A = waves(e.times, _count_waves(e)).T @ z
        k = np.arange(1, len(A) + 1)
        total += np.einsum("k,ki,kj->ij", k**2, A, A) - float(np.sum(k**2)) * noise
        count += len(A)
    # EM leaves a zero variance at zero, and rough half-waves can hide a slow drift in the moments
    return symmetric_power(total / count, 1.0, _FLOOR)


def weight_leaps_down(fitter: HypothesisFitter, fit: Fit, W: Array) -> list[ReducedSeries]:
    """Return the series with less weight for single epochs that leap away from their neighbours.

    Someone touches the mount, or a board is measured badly: one epoch, but with much influence on a
    least-squares fit.
    """
    out = []
    for s, e in enumerate(fitter.series):
        w = fit.weightings[s]
        normal, y = solve_combinations(w.N, w.left(fit.parameters(s)), W)
        padded = np.pad(y, ((2, 2), (0, 0)), mode="edge")
        calm = np.median(np.stack([padded[k : k + len(y)] for k in range(5)]), axis=0)
        leap = np.einsum("ei,eij,ej->e", y - calm, normal, y - calm)
        limit = criteria.LEAP * float(np.median(leap[e.n > 0]))
        factor = np.where(leap > limit, limit / np.maximum(leap, 1e-9), 1.0)
        if np.any(factor != 1.0):
            sizes = 1 if e.blocks is None else np.diff(e.blocks.first, append=len(e.weights))
            of_epochs = np.repeat(factor, sizes)[:, None, None]
            e = replace(e.weighted(factor), weights=e.weights * of_epochs)
        out.append(e)
    return out


def estimate_mount_motion(
    fitter: HypothesisFitter,
    terms: Sequence[Term],
    mount: Mount,
    start: Array | None,
    max_iterations: int,
) -> tuple[HypothesisFitter, Fit, Mount]:
    """Estimate the movement together with a hypothesis.

    fitter: of the series, with or without a movement; mount: start of the iteration. Returns a
    fitter of the series with the movement, the fit, and the movement.
    """
    for turn in range(max_iterations + 1):
        own = HypothesisFitter(mount.on(fitter.series), like=fitter)
        fit = own.fit(terms, start, 1 if turn else 2)
        start = fit.coefficients
        if turn < max_iterations:
            mount = _improve_mount(own, fit, mount)
    return own, fit, mount


def _improve_mount(fitter: HypothesisFitter, fit: Fit, mount: Mount) -> Mount:
    """Take one EM step: set the covariance to the amplitudes' moments, given the data."""
    size, directions = mount.modes()
    power = np.zeros((len(size), len(size)))
    known = np.zeros((len(size), len(size)))
    for e, (mean, root) in zip(fitter.series, _estimate_amplitudes(fit), strict=True):
        assert e.movement is not None
        a, k = e.movement.moments(mean, root)
        power += a
        known += k
    # the data determine 1 - variance of each amplitude: the effective number of them (MacKay)
    value, V = np.linalg.eigh(known)
    root = (V / np.sqrt(np.maximum(value, _LITTLE * value[-1]))) @ V.T
    change = root @ power @ root
    # directions = W U: back to the covariance in W's coordinates
    U = np.linalg.lstsq(mount.combinations, directions * np.sqrt(size), rcond=None)[0]
    new = U @ change @ U.T
    return replace(mount, covariance=0.5 * (new + new.T))


def _estimate_amplitudes(fit: Fit) -> list[tuple[Array, Array]]:
    """Estimate each series' amplitudes (F,) of the movement, given the data.

    Returns them with a root R (·, F) of their covariance RᵀR, which includes the uncertainty of
    levels and coefficients.
    """
    known = scaled_inverse(fit.normals()[0], 1e-10)
    out = []
    for w, (C, V, index) in zip(fit.weightings, fit.designs, strict=True):
        x = fit.coefficients[index]
        U = w.carried(C, V)
        K = np.einsum("epq,qi,ei->pi", w.N, V, C, optimize=True) - w.level.T @ U
        F = w.level_factor
        B = whiten(F, K)
        level = whiten(F, whiten(F, w.level_b - K @ x), transposed=True)
        data = w.data - U @ x - w.level @ level
        Q = whiten(F, w.level.T).T
        inverse = whiten(w.factor, np.eye(len(w.factor))[:, w.moving])
        by_level = Q.T @ inverse
        size, turn = np.linalg.eigh(known[np.ix_(index, index)])
        by_x = (turn * np.sqrt(np.maximum(size, 0.0))).T @ (U - Q @ B).T @ inverse
        out.append((inverse.T @ data, np.concatenate([inverse, by_level, by_x])))
    return out


# -- movement from epoch to epoch ------------------------------------------------------------------


def measure_jumps(fitter: HypothesisFitter, fit: Fit, series: int) -> tuple[Array, Array]:
    """Return the variance of jumps over its expectation (P,), in combinations W (P, P).

    The columns of W are orthonormal in the mean normal matrix; the expectation includes the
    thermometer's noise, which jumps too. A common tremble has its own direction: if one is clear,
    the combinations are rotated to it.
    """
    e = fitter.series[series]
    W, good = orthonormal_combinations(e.N.mean(axis=0))
    z = (_subtract_fit(fitter, fit, series) @ W)[e.n > 0]
    d = np.diff(z, 2, axis=0)
    spread = mad_sd(d, axis=0)
    observed = np.array(
        [np.mean(x[np.abs(x) <= 4 * s] ** 2) for x, s in zip(d.T, spread, strict=True)]
    )
    white = 6.0 / e.correlation
    carried = np.zeros((W.shape[1], W.shape[1]))
    for block, reach, channel in fitter.list_operators(fit.terms, fit.blocks, series):
        jump = np.diff(reach.states, 2, axis=0) * e.state_sd(channel)
        share = W.T @ e.N.mean(axis=0) @ fit.direction(block)[0]
        carried += np.mean(np.sum(jump**2, axis=1)) * np.outer(share, share)
    usual = np.all(np.abs(d) <= 4 * spread + 1e-12, axis=1)
    turned = _find_directions(d[usual][:, good], white, carried[np.ix_(good, good)], 2)
    if turned is not None:
        factors, U = turned
        return np.concatenate([np.ones(int((~good).sum())), factors]), np.column_stack(
            [W[:, ~good], W[:, good] @ U]
        )
    return np.where(good, observed / (white + np.diag(carried)), 1.0), W


def _subtract_fit(fitter: HypothesisFitter, fit: Fit, series: int) -> Array:
    """Return the right-hand sides (E, P) of a series after a fit and one level."""
    e = fitter.series[series]
    return subtract_level(e.N, e.b - np.einsum("epq,eq->ep", e.N, fit.parameters(series)))


def _list_jumps(evidence: ReducedSeries) -> Array | None:
    """Return the jumps (n, m) of all targets together, in `find_combinations`; None if few.

    Jumps are differences of an order so high that nothing that follows a temperature remains but
    its kinks, without the largest ones: no effect is assumed, and no thermometer's error matters.
    """
    W = find_combinations([evidence])
    d = np.diff((evidence.values @ evidence.N.mean(axis=0) @ W)[evidence.n > 0], _FAST, axis=0)
    if len(d) < _KINKS:
        return None
    calm = np.argsort(np.sum(d**2, axis=1))[: max(len(d) - _KINKS, len(d) // 2)]
    return np.asarray(d[calm])


def detect_tremble(evidence: ReducedSeries) -> bool:
    """Return whether all targets jump together from epoch to epoch."""
    if (jumps := _list_jumps(evidence)) is None:
        return False
    m = jumps.shape[1]
    white = comb(2 * _FAST, _FAST) / evidence.correlation
    return _find_directions(jumps, white, np.zeros((m, m)), _FAST) is not None


def _find_directions(
    d: Array, white: float, carried: Array, order: int
) -> tuple[Array, Array] | None:
    """Find directions in which differences d (n, m) are clearly larger than expected, or None.

    white: the mean square due to image noise; carried (m, m): due to the thermometers; order: of
    the differences. Returns variance factors (m,) and orthonormal directions (m, m).
    """
    n, m = d.shape
    # differences are correlated: of n second ones, 18/35 are independent
    shared = np.array([comb(2 * order, k) for k in range(2 * order + 1)], dtype=float)
    independent = n * shared[order] ** 2 / np.sum(shared**2)
    edge = (1.0 + np.sqrt(m / independent)) ** 2
    covariance = d.T @ d / n
    _, U = np.linalg.eigh(covariance - carried)
    own = np.einsum("ji,jk,ki->i", U, covariance, U)
    expected = white + np.einsum("ji,jk,ki->i", U, carried, U)
    clear = own > criteria.UNUSUAL * edge * expected
    if not clear.any():
        return None
    # `carried` is an upper bound, as the trajectories are smoothed
    return np.where(clear, own / white, 1.0), U


def weight_jumps_down(evidence: ReducedSeries, factors: Array, W: Array) -> ReducedSeries | None:
    """Return the series with unusual jumps as part of its noise; None if there are none."""
    factors = np.where(factors > criteria.UNUSUAL, factors, 1.0)
    if np.all(factors == 1.0):
        return None
    inverse = np.linalg.inv(W)
    T = inverse.T @ np.diag(1.0 / np.sqrt(factors)) @ W.T
    N = T @ evidence.N @ T.T
    hidden = evidence.hidden.turned(T, evidence.values) if evidence.hidden else None
    turned = replace(evidence, N=0.5 * (N + N.swapaxes(1, 2)), hidden=hidden)
    return turned.with_values(evidence.values)


def _measure_fast(fitter: HypothesisFitter, fit: Fit, series: int) -> tuple[Array, Array]:
    """Return the mean power (m, m) of a misfit's fast half-waves in combinations W (P, m), and W.

    It is the unit matrix if there is image noise only; the thermometers' share is subtracted.
    """
    e = fitter.series[series]
    W = find_combinations([e])
    fast = waves(e.times, len(e.times) - 1)[:, _count_waves(e) :].T
    z = fast @ (_subtract_fit(fitter, fit, series) @ W)
    M = z.T @ z / len(fast)
    for block, reach, channel in fitter.list_operators(fit.terms, fit.blocks, series):
        carried = fast @ reach.states
        noise = np.mean(np.sum((carried * e.state_sd(channel)) ** 2, axis=1))
        # the fit uses smoothed readings: the noise that smoothing removed is not in the misfit
        taken = np.mean((fast @ reach.shift) ** 2)
        left = max(np.sqrt(noise) - np.sqrt(taken), 0.0) ** 2
        along = W.T @ e.N.mean(axis=0) @ fit.direction(block)[0]
        M -= left * np.outer(along, along)
    return M, W


def add_tremble(fitter: HypothesisFitter, fit: Fit) -> list[ReducedSeries]:
    """Return the series with the movement from epoch to epoch as a random movement of each epoch.

    It is measured by the fast half-waves of the fit's misfit; the slow ones are the mount's.
    """
    out = []
    for s, e in enumerate(fitter.series):
        M, W = _measure_fast(fitter, fit, s)
        edge = (1.0 + np.sqrt(len(M) / (len(e.times) - _count_waves(e)))) ** 2
        factors, U = np.linalg.eigh(M)
        clear = factors > criteria.BEYOND * edge  # more than so few half-waves show by chance
        D = W @ (U[:, clear] * np.sqrt(factors[clear] - 1.0))
        rest = np.diag(M - (U[:, clear] * (factors[clear] - 1.0)) @ U[:, clear].T)
        more = rest > criteria.UNUSUAL
        D = np.column_stack([D, W[:, more] * np.sqrt(rest[more] - 1.0)])
        out.append(replace(e, tremble=D) if D.shape[1] else e)
    return out


def leaves_kinks(fitter: HypothesisFitter, fit: Fit) -> bool:
    """Test whether the fast half-waves of a misfit are far larger than its jumps.

    A mount that trembles or walks jumps from epoch to epoch. A misfit that is smooth but for kinks,
    as that of a thermometer that lags, is no movement of a mount, however large a tremble would
    explain it.
    """
    for s, e in enumerate(fitter.series):
        if (jumps := _list_jumps(e)) is not None:
            usual = jumps.T @ jumps / len(jumps) / comb(2 * _FAST, _FAST) + np.eye(jumps.shape[1])
            root = symmetric_power(usual, -0.5, 1.0)
            power = root @ _measure_fast(fitter, fit, s)[0] @ root
            if np.linalg.eigvalsh(power)[-1] > criteria.KINKED:
                return True
    return False


def add_jumps_to_noise(fitter: HypothesisFitter, fit: Fit) -> list[ReducedSeries] | None:
    """Return the series with remaining jumps as part of their noise; None if there are none."""
    if any(len(e.times) < criteria.FEWEST for e in fitter.series):
        return None
    return fitter.replaced([
        weight_jumps_down(e, *measure_jumps(fitter, fit, s)) for s, e in enumerate(fitter.series)
    ])  # fmt: skip
