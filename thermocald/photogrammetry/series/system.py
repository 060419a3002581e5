"""The linearised series: normal equations with common unknowns reduced, and data snooping.

A `Design` defines the unknowns and their priors. Own parameters are those of an epoch (p of them),
common ones those of the series (q parameters, then the offsets in x and in y of the T targets). A
parameter may be both: an epoch's own part is then drawn to the common one, as a random effect.
Arrays only; `covariances` gives the accuracy. Data snooping tests every point against its own
epoch, as `epoch.gauss_markov` does, for all epochs at once.

Source: the reduction of common unknowns as Helmert blocking, Wolf, H. (1978): The Helmert block
method.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP
from thermocald.photogrammetry.epoch.gauss_markov import TRUSTED_REDUNDANCY, limit_2d
from thermocald.photogrammetry.linalg import MEDIAN_CHI2, inverse_of_determined
from thermocald.photogrammetry.series.normals import (
    Partials,
    chunks,
    cofactors,
    inverses_of,
    normal_matrices,
    products,
    right_hand_sides,
    sums_of_targets,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.field.testfield import TestField


@dataclass(frozen=True, eq=False)
class State:
    """Values of the unknowns: values (E, 16), offsets (T, 2) px and the common pose (6,)."""

    values: Array
    offsets: Array
    pose: Array


@dataclass(frozen=True, eq=False)
class Design:
    """The unknowns of a series and their priors.

    at: the linearisation; own (p,), common (q,): positions of the parameters; known (16,): values
    of the priors; own_prior (p, p), common_prior (q,): their weights, 0 without a prior; shifts
    (E, 6) or (1, 6): if the prior of an epoch's exterior orientation is the common one instead,
    known movements of the latter, else None; offset_prior
    (T, 3) px⁻²: weights xx, yy, xy of the offsets, (0, 3) without offsets.
    """

    at: Partials
    own: Index
    common: Index
    known: Array
    own_prior: Array
    common_prior: Array
    shifts: Array | None
    offset_prior: Array

    @property
    def width(self) -> int:
        """Number of common unknowns, q or q + 2T."""
        return len(self.common) + 2 * len(self.offset_prior)

    def common_pull(self, pose: Array, offsets: Array) -> Array:
        """Return the gradient (width,) of the common unknowns' priors."""
        pull: Array = self.common_prior * (self.known[self.common] - pose[: len(self.common)])
        (wx, wy, wxy), (x, y) = self.offset_prior.T, offsets[: len(self.offset_prior)].T
        return np.concatenate([pull, -wx * x - wxy * y, -wxy * x - wy * y])

    def apply(self, state: State, step: Step) -> State:
        """Return the state after a step."""
        values = state.values.copy()
        values[:, self.own] += step.d_own
        values[:, self.common] += step.d_common
        pose = state.pose + step.d_common if len(self.common) else state.pose
        return State(values, state.offsets + step.d_offsets, pose)

    def gradient(self, weights: Array, residuals: Array) -> Array:
        """Return the gradient (width,) of the common unknowns.

        weights (E, T, 3), residuals (E, T, 2) px.
        """
        b = right_hand_sides(weights, residuals, self.at.A[..., self.common])
        of_targets = sums_of_targets(weights, residuals, weights[..., 0] > 0)
        return np.concatenate([b.sum(axis=0), of_targets[: len(self.offset_prior)].T.ravel()])

    def prior_matrix(self) -> Array:
        """Return the weights (width, width) of the common unknowns' priors."""
        out = np.zeros((self.width, self.width))
        q = len(self.common)
        out[np.arange(q), np.arange(q)] = self.common_prior
        _add_blocks(out[q:, q:], self.offset_prior)
        return out

    def with_offsets(self, weights: Array, columns: Index) -> Array:
        """Return the blocks (E, k, 2T) of some parameters with the offsets."""
        t = len(self.offset_prior)
        wx, wy, wxy = np.moveaxis(weights[:, :t], -1, 0)[:, :, None]
        ax, ay = self.at.A[:t, 0, columns].T, self.at.A[:t, 1, columns].T
        return np.concatenate([wx * ax + wxy * ay, wxy * ax + wy * ay], axis=2)


def _add_blocks(matrix: Array, blocks: Array) -> None:
    """Add weights (T, 3) xx, yy, xy to a matrix (2T, 2T) of all x, then all y."""
    T = len(blocks)
    x, y = np.arange(T), np.arange(T, 2 * T)
    matrix[x, x] += blocks[:, 0]
    matrix[y, y] += blocks[:, 1]
    matrix[x, y] += blocks[:, 2]
    matrix[y, x] += blocks[:, 2]


def offset_weights(field: TestField, at: Partials) -> Array:
    """Return the offsets' weights (T, 3) px⁻² from the sigmas of the object coordinates."""
    variance = field.shape_sigmas**2
    tiny = 1e-12  # px²: a target without sigma has no offset
    xx = (at.B[:, 0] ** 2 * variance).sum(axis=1) + tiny
    yy = (at.B[:, 1] ** 2 * variance).sum(axis=1) + tiny
    return inverses_of(xx, yy, (at.B[:, 0] * at.B[:, 1] * variance).sum(axis=1))


_FARTHEST_PX = 200.0  # largest movement of an image point by one step
_KEPT = 4_000_000  # elements of all couplings, 32 MB, up to which they are kept
_CHUNK = 128  # epochs whose couplings with the offsets are computed at a time


@dataclass(frozen=True, eq=False)
class Step:
    """Corrections d_own (E, p), d_common (q,), d_offsets (T, 2) px; size of the whole step and
    sizes (E,) of the epochs' steps in standard deviations.
    """

    d_own: Array
    d_common: Array
    d_offsets: Array
    size: float
    sizes: Array


@dataclass(eq=False)
class SeriesSystem:
    """Normal equations at one linearisation.

    weights (E, T, 3): a priori; use (E, T): points in use; N (E, 16, 16): empty without common
    unknowns; Q (E, p, p): cofactors of the epochs' own parameters, the common ones held; good (E,):
    epochs that determine their parameters; Q_common (q, q), or with offsets (q + 2T, q + 2T): empty
    before `solved`; coupled: the result of `couplings`, if it needs little memory.
    """

    design: Design
    weights: Array
    use: Mask
    N: Array
    Q: Array
    good: Mask
    Q_common: Array
    coupled: list[tuple[Index, Array]] | None = None

    @classmethod
    def formed(cls, design: Design, weights: Array, use: Mask) -> SeriesSystem:
        """Form the normal equations and invert those of the epochs' own parameters."""
        own, A = design.own, design.at.A
        w = weights * use[..., None]
        separate = design.width == 0
        N = normal_matrices(w, A[..., own] if separate else A)
        Q, good = cofactors((N if separate else N[:, own[:, None], own]) + design.own_prior)
        good &= use.any(axis=1)
        return cls(design, weights, use, N[:0] if separate else N, Q, good, np.empty((0, 0)))

    def solved(self) -> SeriesSystem:
        """Return the system with the cofactors of the common unknowns."""
        if len(self.good) * len(self.design.own) * self.design.width <= _KEPT:
            self.coupled = list(self.couplings())
        return replace(self, Q_common=inverse_of_determined(self.common_normals()))

    def used(self, rows: Index | Mask | slice = slice(None)) -> Array:
        """Return the weights (e, T, 3) of some epochs, 0 for points not in use."""
        return self.weights[rows] * self.use[rows][..., None]

    def common_normals(self, count: Array | None = None) -> Array:
        """Return the normal matrix of the common unknowns, with all own parameters reduced.

        count (E,): number of epochs that each of these represents, one by default.
        """
        n = np.ones(len(self.good)) if count is None else count
        design, q = self.design, len(self.design.common)
        full = design.prior_matrix()
        N = np.tensordot(n[self.good], self.N[self.good], axes=1)
        full[:q, :q] += N[design.common[:, None], design.common]
        weights = np.tensordot(n[self.good], self.used(self.good), axes=1)
        _add_blocks(full[q:, q:], weights[: len(design.offset_prior)])
        full[:q, q:] = design.with_offsets(weights[None], design.common)[0]
        full[q:, :q] = full[:q, q:].T
        for part, C in self.couplings():
            half = np.swapaxes(np.linalg.cholesky(self.Q[part]), 1, 2) @ C
            half *= np.sqrt(n[part, None, None])
            half = half.reshape(-1, half.shape[-1])
            full -= half.T @ half
        return full

    def couplings(self) -> Iterator[tuple[Index, Array]]:
        """Yield chunks of good epochs and their blocks (e, p, q + 2T) of own by common unknowns."""
        if self.coupled is not None:
            yield from self.coupled
            return
        rows, design = np.flatnonzero(self.good), self.design
        if design.width == 0 or len(design.own) == 0:
            return
        for start in range(0, len(rows), _CHUNK):
            part = rows[start : start + _CHUNK]
            C: Array = self.N[part][:, design.own[:, None], design.common]
            if len(design.offset_prior):
                offsets = design.with_offsets(self.used(part), design.own)
                C = np.concatenate([C, offsets], axis=2)
            yield part, C

    def step(self, residuals: Array, state: State) -> Step:
        """Return one Gauss-Newton step from a state with its residuals (E, T, 2) px."""
        design, q = self.design, len(self.design.common)
        right = self.own_gradient(residuals, state)
        right[~self.good] = 0.0
        total = design.common_pull(state.pose, state.offsets)
        if design.width:
            total += design.gradient(self.used(self.good), residuals[self.good])
        solved = (self.Q @ right[..., None])[..., 0]
        for part, C in self.couplings():
            total -= np.einsum("epi,ep->i", C, solved[part])
        d_all = self.Q_common @ total
        size = float(np.sqrt(max(float(total @ d_all), 0.0)))
        if len(d_all):
            for part, C in self.couplings():
                right[part] -= C @ d_all
            solved = (self.Q @ right[..., None])[..., 0]
        solved[~self.good] = 0.0
        sizes = np.sqrt(np.maximum((right * solved).sum(axis=1), 0.0))
        size += float(sizes.max(initial=0.0))
        d_offsets = np.zeros_like(state.offsets)
        d_offsets[: len(design.offset_prior)] = d_all[q:].reshape(2, -1).T
        return Step(self._bound(solved), d_all[:q], d_offsets, size, sizes)

    def _bound(self, d_own: Array) -> Array:
        """Shorten steps (E, p) that would move an image point by more than `_FARTHEST_PX`."""
        A = self.design.at.A[..., self.design.own]
        reach = np.abs(d_own) @ np.abs(A).max(axis=(0, 1), initial=0.0)
        far = np.flatnonzero(reach > _FARTHEST_PX)
        if len(far):
            px = np.abs(np.einsum("tkp,ep->etk", A, d_own[far]))
            shorter = np.minimum(1.0, _FARTHEST_PX / np.maximum(px.max(axis=(1, 2)), 1e-9))
            d_own = d_own.copy()
            d_own[far] *= shorter[:, None]
        return d_own

    def move(self, residuals: Array, step: Step) -> None:
        """Update the residuals (E, T, 2) px for a small step by the partials, in place."""
        A, own = self.design.at.A, self.design.own
        if self.design.width:
            residuals -= A[..., self.design.common] @ step.d_common + step.d_offsets
        Ax, Ay = A[:, 0, own].T, A[:, 1, own].T
        for part in chunks(*residuals.shape[:2]):
            residuals[part, :, 0] -= step.d_own[part] @ Ax
            residuals[part, :, 1] -= step.d_own[part] @ Ay

    def gradient(self, residuals: Array) -> Array:
        """Return Aᵀ P l (E, 16) of every epoch."""
        return right_hand_sides(self.weights, residuals, self.design.at.A, self.use)

    def own_gradient(self, residuals: Array, state: State) -> Array:
        """Return the gradient (E, p) of the own parameters and their priors; 0 at the solution."""
        own, A = self.design.own, self.design.at.A
        b = right_hand_sides(self.weights, residuals, A[..., own], self.use)
        if self.design.own_prior.any():
            centre, shifts = self.design.known, self.design.shifts
            if shifts is not None:
                centre = np.tile(centre, (len(shifts), 1))
                centre[:, EOP] = state.pose + shifts
            b += (centre - state.values)[:, own] @ self.design.own_prior
        return b

    @property
    def common_share(self) -> float:
        """Number of observations that the common unknowns use up."""
        return self.design.width - self.held[0]

    @cached_property
    def held(self) -> tuple[float, float]:
        """Traces of Q P, the share of the priors in the common unknowns, and of its square.

        Along a direction in which the prior has the share h, the redundancy h - h² depends on the
        prior being as stated: in one epoch a wrong prior and a different noise look the same, only
        many epochs separate them.
        """
        prior, (wx, wy, wxy) = self.design.common_prior, self.design.offset_prior.T
        pose, x, y = np.split(self.Q_common, [len(prior), len(prior) + len(wx)], axis=1)
        held = np.hstack([pose * prior, x * wx + y * wxy, x * wxy + y * wy])
        return float(np.trace(held)), float(np.einsum("ij,ji->", held, held))


def point_tests(system: SeriesSystem, residuals: Array) -> Array:
    """Return the test (E, T) of every image point against its epoch: χ² with 2 degrees of freedom.

    Points not in use are tested as check points. The common unknowns count as error-free, as they
    come from all epochs.
    """
    pairs = products(system.design.at.A[..., system.design.own])
    E, T = residuals.shape[:2]
    test = np.empty((E, T))
    for part in chunks(E, T):
        xx, yy, xy = _test_weights(system, part, pairs)
        x, y = residuals[part, :, 0], residuals[part, :, 1]
        out = np.multiply(xx, x, out=test[part])
        out += xy * y
        out *= x
        out += yy * y * y
    test[np.isnan(test)] = 0.0
    return test


def _test_weights(
    system: SeriesSystem, epochs: slice, products: tuple[Array, Array, Array]
) -> Array:
    """Return the residuals' inverse covariance (3, M, T): xx, yy, twice xy; 0 without a test."""
    weights = system.weights[epochs]
    rows, columns = np.triu_indices(len(system.design.own))
    Q = system.Q[epochs][:, rows, columns] * np.where(rows == columns, 1.0, 2.0)
    sign = np.where(system.use[epochs], -1.0, 1.0)
    lxx, lyy, lxy = (sign * (Q @ pairs.T) for pairs in products)
    offered = weights[..., 0] > 0
    wx, wy, wxy = (np.where(offered, weights[..., k], k < 2) for k in range(3))
    determinant = wx * wy - wxy * wxy
    vxx, vyy = wy / determinant + lxx, wx / determinant + lyy
    vxy = 0.5 * lxy - wxy / determinant
    d = vxx * vyy - vxy * vxy
    d[~(offered & (d > 1e-9 / determinant))] = np.inf
    inverse = np.stack([vyy, vxx, -2 * vxy])
    inverse /= d
    return inverse


def _variances(tests: Array, used: Mask) -> Array:
    """Return variances of unit weight (E,) from each epoch's median, robust to gross errors."""
    n = used.sum(axis=1)
    half = np.minimum(n // 2, tests.shape[1] - 1)
    ordered = np.where(used, tests, np.inf)
    ordered.sort(axis=1)
    middle = ordered[np.arange(len(n)), half]
    return np.where(n > 0, middle, 1.0) / MEDIAN_CHI2


def typical_variance(tests: Array, used: Mask) -> float:
    """Return the epochs' median variance of unit weight; 1 without residuals."""
    variances = _variances(tests, used)
    return float(np.median(variances[used.any(axis=1)])) or 1.0 if used.any() else 1.0


def snoop_series(
    tests: Array,
    offered: Mask,
    used: Mask,
    unknowns: int,
    alpha: float,
    typical: float,
    freedom: Array | None,
) -> Mask:
    """Return the mask (E, T) of image points to keep, by the rule of `epoch.gauss_markov.snoop`.

    typical: variance of unit weight of the series, for epochs too poor to estimate theirs; freedom
    (T,): degrees of freedom of each target's noise, None if the noise is as stated.
    """
    keep = offered.copy()
    for part in chunks(*used.shape):
        test, use = tests[part], used[part]
        n = use.sum(axis=1)
        few = 2 * n - unknowns < TRUSTED_REDUNDANCY
        variance = np.where(few, typical, _variances(test, use))
        uncertain = np.where(few, 0.0, 1.0 / np.maximum(n, 1))[:, None]
        if freedom is not None:
            uncertain = uncertain + 1.0 / freedom
        fits = test <= np.maximum(variance, 1e-12)[:, None] * limit_2d(alpha, uncertain)
        worst = np.where(use, test, 0.0).max(axis=1, initial=0.0)
        keep[part] &= fits | (use & (test < (np.where(few, 1.0, 0.5) * worst)[:, None]))
    return keep
