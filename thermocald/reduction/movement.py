"""The camera's movement on its mount, as variance components alongside a hypothesis.

A camera on a tripod wanders. The amplitudes of cosines in the well-determined combinations of the
camera's parameters are random, with a covariance Sigma / (corner² + k²) at the k-th half-wave: a
random walk where the corner is zero, else one that is bounded. Sigma is found by restricted maximum
likelihood (EM), both series together, with each hypothesis by itself: what a hypothesis explains
is not a movement.

Source: Patterson, Thompson (1971), Biometrika 58, 545-554 (restricted maximum likelihood);
Dempster, Laird, Rubin (1977), J. Royal Statistical Society B 39, 1-38 (EM).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.reduction.fit import HypothesisFitter
from thermocald.reduction.random_effects import Movement, waves

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array
    from thermocald.reduction.hypothesis import Fit, Term
    from thermocald.reduction.series import ReducedSeries

__all__ = ["Mount", "combinations", "estimated", "first_guess", "steadied"]

WAVES = 24
_LEAST = 0.2  # variance of a half-wave, in units of the image noise, that is worth a state
_TINY = 1e-6
_FLOOR = 3.0
_LITTLE = 1e-3  # of what is known of the best known direction
_LEAP = 10.0  # times the usual deviation of an epoch from its neighbours


@dataclass(frozen=True, eq=False)
class Mount:
    """A movement estimated: covariance (m, m) of the combinations W (P, m), corner in half-waves.

    The combinations have unit variance where the image noise is all.
    """

    combinations: Array
    covariance: Array
    corner: float

    def modes(self) -> tuple[Array, Array]:
        """Variances and directions (P, ·) of the independent movements that matter."""
        size, U = np.linalg.eigh(self.covariance)
        kept = size > _LEAST
        kept[-1] = True  # one at least, so that likelihoods remain comparable
        return np.maximum(size[kept], _TINY), self.combinations @ U[:, kept]

    def on(self, series: Sequence[ReducedSeries]) -> list[ReducedSeries]:
        """The series with the movement as part of their noise."""
        size, directions = self.modes()
        out = []
        for e in series:
            K = min(WAVES, len(e.times) // 2)
            k = np.arange(1, K + 1)
            sd = np.sqrt(size[:, None] / (self.corner**2 + k**2))
            out.append(replace(e, movement=Movement(directions, waves(e.times, K), sd)))
        return out

    def smoothness(self, fitter: HypothesisFitter, fit: Fit) -> float:
        """Power of the slowest half-waves over that of the fast, in units of this movement's own.

        About 1 for a random walk; an influence without rough parts has much more.
        """
        slow, fast = 0.0, 0.0
        for e, (mean, root) in zip(fitter.series, _amplitudes(fit), strict=True):
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
        """RMS over the image points and over time that the movement is expected to have in px."""
        size, _ = self.modes()
        K = min(WAVES, len(e.times) // 2)
        falling = 1.0 / (self.corner**2 + np.arange(1, K + 1) ** 2)
        power = float(np.sum(size)) * float(np.sum(falling))
        coordinates = 2.0 * float(e.n.mean()) * len(e.times)
        return float(e.sigma_px * np.sqrt(power / max(coordinates, 1.0)))


def combinations(series: Sequence[ReducedSeries]) -> Array:
    """The determined combinations (P, m) of parameters, orthonormal under the mean normals."""
    size, U = np.linalg.eigh(np.mean([e.N.mean(axis=0) for e in series], axis=0))
    good = size > 1e-6 * np.median(size)
    out: Array = U[:, good] / np.sqrt(size[good])
    return out


def first_guess(fitter: HypothesisFitter, fit: Fit, W: Array) -> Array:
    """Covariance (m, m) from the power of the misfit's half-waves beyond the image noise."""
    total = np.zeros((W.shape[1], W.shape[1]))
    count = 0
    for s, e in enumerate(fitter.series):
        C, V, index = fit.designs[s]
        w = fit.weightings[s]
        rest = w.b - np.einsum("epq,eq->ep", w.N, (C * fit.coefficients[index]) @ V.T)
        level = np.linalg.lstsq(w.N.sum(axis=0), rest.sum(axis=0), rcond=1e-12)[0]
        z = (rest - w.N @ level) @ W
        A = waves(e.times, min(WAVES, len(e.times) // 2)).T @ z
        k = np.arange(1, len(A) + 1)
        total += np.einsum("k,ki,kj->ij", k**2, A, A) - float(np.sum(k**2)) * np.eye(len(total))
        count += len(A)
    size, U = np.linalg.eigh(total / count)
    # what starts at zero stays there: a slow drift hides in the moments among rough half-waves
    out: Array = (U * np.maximum(size, _FLOOR)) @ U.T
    return out


def steadied(fitter: HypothesisFitter, fit: Fit, W: Array) -> list[ReducedSeries]:
    """The series with less weight on epochs that leap out of their neighbours and come back.

    Somebody leans on the mount, or a board is seen badly: one epoch, of which a fit by squares
    would make much.
    """
    out = []
    for s, e in enumerate(fitter.series):
        C, V, index = fit.designs[s]
        w = fit.weightings[s]
        rest = w.b - np.einsum("epq,eq->ep", w.N, (C * fit.coefficients[index]) @ V.T)
        normal = np.einsum("pi,epq,qj->eij", W, w.N, W) + 0.1 * np.eye(W.shape[1])
        y = np.linalg.solve(normal, (rest @ W)[..., None])[..., 0]
        padded = np.pad(y, ((2, 2), (0, 0)), mode="edge")
        calm = np.median(np.stack([padded[k : k + len(y)] for k in range(5)]), axis=0)
        leap = np.einsum("ei,eij,ej->e", y - calm, normal, y - calm)
        limit = _LEAP * float(np.median(leap[e.n > 0]))
        factor = np.where(leap > limit, limit / np.maximum(leap, 1e-9), 1.0)
        out.append(e if np.all(factor == 1.0) else _weighted(e, factor))
    return out


def _weighted(e: ReducedSeries, factor: Array) -> ReducedSeries:
    return replace(
        e,
        N=e.N * factor[:, None, None],
        b=e.b * factor[:, None],
        yy=e.yy * factor,
        weights=e.weights * factor[:, None, None],
        hidden=e.hidden.scaled(factor) if e.hidden else None,
    )


def estimated(
    fitter: HypothesisFitter,
    terms: Sequence[Term],
    mount: Mount,
    start: Array | None = None,
    max_iterations: int = 8,
) -> tuple[HypothesisFitter, Fit, Mount]:
    """The movement alongside a hypothesis: a fitter that has it, the fit in it, the estimate.

    fitter: of the series, with or without a movement; mount: where the iteration starts.
    """
    for turn in range(max_iterations + 1):
        own = HypothesisFitter(mount.on(fitter.series))
        own.thermometer_factor = fitter.thermometer_factor
        own.share_trajectories(fitter)
        fit = own.fit(terms, start, 1 if turn else 2)
        start = fit.coefficients
        if turn < max_iterations:
            mount = _step(own, fit, mount)
    return own, fit, mount


def _step(fitter: HypothesisFitter, fit: Fit, mount: Mount) -> Mount:
    """One step: the covariance whose moments the amplitudes have, given the data."""
    size, directions = mount.modes()
    power = np.zeros((len(size), len(size)))
    known = np.zeros((len(size), len(size)))
    for e, (mean, root) in zip(fitter.series, _amplitudes(fit), strict=True):
        assert e.movement is not None
        a, k = e.movement.moments(mean, root)
        power += a
        known += k
    # of each amplitude the data determine 1 - its variance: so many count (MacKay)
    value, V = np.linalg.eigh(known)
    root = (V / np.sqrt(np.maximum(value, _LITTLE * value[-1]))) @ V.T
    change = root @ power @ root
    # directions = W U: the covariance in W's coordinates again
    U = np.linalg.lstsq(mount.combinations, directions * np.sqrt(size), rcond=None)[0]
    new = U @ change @ U.T
    return replace(mount, covariance=0.5 * (new + new.T))


def _amplitudes(fit: Fit) -> list[tuple[Array, Array]]:
    """Mean of the movement's amplitudes (F,) of each series given the data, and a root (·, F) of
    their covariance: the product of its transpose with itself.

    Levels and coefficients are unknown too: their uncertainty is in the covariance.
    """
    from scipy.linalg import solve_triangular

    n = len(fit.coefficients)
    A = np.zeros((n, n))
    for (_, _, index), reduced in zip(fit.designs, fit.reduced, strict=True):
        A[np.ix_(index, index)] += reduced.A
    A += np.diag((np.diag(A) <= 0).astype(float))
    d = np.sqrt(np.diag(A))
    known = np.linalg.inv(A / np.outer(d, d) + 1e-10 * np.eye(n)) / np.outer(d, d)
    out = []
    for w, (C, V, index) in zip(fit.weightings, fit.designs, strict=True):
        assert w.factor is not None
        x = fit.coefficients[index]
        U = w.carried(C, V)
        K = np.einsum("epq,qi,ei->pi", w.N, V, C, optimize=True) - w.level.T @ U
        F = w.level_factor
        B = solve_triangular(F, K, lower=True)
        right = solve_triangular(F, w.level_b - K @ x, lower=True)
        level = solve_triangular(F.T, right, lower=False)
        data = w.data - U @ x - w.level @ level
        Q = solve_triangular(F, w.level.T, lower=True).T
        inverse = solve_triangular(w.factor, np.eye(len(w.factor), w.moving), lower=True)
        by_level = Q.T @ inverse
        size, turn = np.linalg.eigh(known[np.ix_(index, index)])
        by_x = (turn * np.sqrt(np.maximum(size, 0.0))).T @ (U - Q @ B).T @ inverse
        out.append((inverse.T @ data, np.concatenate([inverse, by_level, by_x])))
    return out
