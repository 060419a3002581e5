"""The linearised series: normal equations of all epochs with their common unknowns reduced.

The working half of `series`, arrays only: what is unknown says a `Design`, how sure it is
`covariances`.

Source: the reduction of common unknowns as Helmert blocking, Wolf, H. (1978): The Helmert block
method.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import inverse_of_determined
from thermocald.photogrammetry.series.cofactors import cofactors
from thermocald.photogrammetry.series.normals import (
    chunks,
    normal_matrices,
    right_hand_sides,
    same_rows,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.series.design import Design, State


__all__ = ["SeriesSystem", "Step", "alike"]

_FARTHEST_PX = 200.0  # that one step may move an image point by
_KEPT = 4_000_000  # numbers of all couplings together, 32 MB
_CHUNK = 128  # epochs whose couplings with the offsets are held at a time


@dataclass(frozen=True, eq=False)
class Step:
    """Corrections d_own (E, p), d_common (q,), d_offsets (T, 2) px; size in standard deviations of
    all together, and sizes (E,) of each epoch.
    """

    d_own: Array
    d_common: Array
    d_offsets: Array
    size: float
    sizes: Array


@dataclass(eq=False)
class SeriesSystem:
    """Normal equations at one linearisation.

    weights (E, T, 3): a priori; use (E, T): which points take part; N (E, 16, 16), empty where
    nothing is common; Q (E, p, p): cofactors of an epoch's own parameters, the common ones held;
    good (E,): epochs that carry theirs; Q_common (q, q), or with offsets (q + 2T, q + 2T), empty
    before `solved`; alike: which epochs have the same matrices, as of `same_rows`, or None where
    that is no longer known; coupled: what `couplings` gave, where that takes little memory.
    """

    design: Design
    weights: Array
    use: Mask
    N: Array
    Q: Array
    good: Mask
    Q_common: Array
    alike: tuple[Index, Index] | None
    coupled: list[tuple[Index, Array]] | None = None

    @classmethod
    def formed(cls, design: Design, weights: Array, use: Mask) -> SeriesSystem:
        """Form the normal equations and invert those of the epochs' own parameters."""
        own, A = design.own, design.at.A
        first, of = alike(weights, use)
        w = _used(weights[first], use[first])
        separate = design.width == 0
        N = normal_matrices(w, A[..., own] if separate else A)
        Q, good = cofactors((N if separate else N[:, own[:, None], own]) + design.own_prior)
        good &= use[first].any(axis=1)
        if len(first) < len(of):
            Q, good = Q[of], good[of]
        N = N[:0] if separate else N[of]
        return cls(design, weights, use, N, Q, good, np.empty((0, 0)), (first, of))

    def solved(self) -> SeriesSystem:
        """The same with the cofactors of the common unknowns."""
        if len(self.good) * len(self.design.own) * self.design.width <= _KEPT:
            self.coupled = list(self.couplings())
        return replace(self, Q_common=inverse_of_determined(self.common_normals()))

    def used(self, rows: Index | Mask | slice = slice(None)) -> Array:
        """Weights (e, T, 3) of some epochs, 0 where a point takes no part."""
        return _used(self.weights[rows], self.use[rows])

    def common_normals(self, count: Array | None = None) -> Array:
        """Normal matrix of the common unknowns, the own parameters of all epochs reduced.

        count (E,): how many epochs each of these stands for, one by default.
        """
        n = np.ones(len(self.good)) if count is None else count
        full = self.design.common_matrix(
            np.tensordot(n[self.good], self.N[self.good], axes=1),
            np.tensordot(n[self.good], self.used(self.good), axes=1),
        )
        for part, C in self.couplings():
            half = np.swapaxes(np.linalg.cholesky(self.Q[part]), 1, 2) @ C
            half *= np.sqrt(n[part, None, None])
            half = half.reshape(-1, half.shape[-1])
            full -= half.T @ half
        return full

    def couplings(self) -> Iterator[tuple[Index, Array]]:
        """Chunks of good epochs and their blocks (e, p, q + 2T) of own with common unknowns."""
        if self.coupled is not None:
            yield from self.coupled
            return
        rows = np.flatnonzero(self.good)
        if self.design.width == 0 or len(self.design.own) == 0:
            return
        for start in range(0, len(rows), _CHUNK):
            part = rows[start : start + _CHUNK]
            yield part, self.design.coupling(self.N[part], self.used(part))

    def step(self, residuals: Array, state: State) -> Step:
        """One Gauss-Newton step from a state, which leaves residuals (E, T, 2) px."""
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
        offsets = design.offset_prior is not None
        d_offsets = d_all[q:].reshape(2, -1).T if offsets else np.zeros_like(state.offsets)
        return Step(self._bounded(solved), d_all[:q], d_offsets, size, sizes)

    def _bounded(self, d_own: Array) -> Array:
        """The steps (E, p), shortened where they would move the image out of all proportion."""
        A = self.design.at.A[..., self.design.own]
        reach = np.abs(d_own) @ np.abs(A).max(axis=(0, 1))
        far = np.flatnonzero(reach > _FARTHEST_PX)
        if len(far):
            px = np.abs(np.einsum("tkp,ep->etk", A, d_own[far]))
            shorter = np.minimum(1.0, _FARTHEST_PX / np.maximum(px.max(axis=(1, 2)), 1e-9))
            d_own = d_own.copy()
            d_own[far] *= shorter[:, None]
        return d_own

    def move(self, residuals: Array, step: Step) -> None:
        """Carry the residuals (E, T, 2) through a small step by the partials, in place."""
        A, own = self.design.at.A, self.design.own
        if self.design.width:
            residuals -= A[..., self.design.common] @ step.d_common + step.d_offsets
        Ax, Ay = A[:, 0, own].T, A[:, 1, own].T
        for part in chunks(*residuals.shape[:2]):
            residuals[part, :, 0] -= step.d_own[part] @ Ax
            residuals[part, :, 1] -= step.d_own[part] @ Ay

    def replace(self, rows: Index, part: SeriesSystem) -> None:
        """Put some epochs in from another system of the same linearisation, in place.

        Only where nothing is common: the common unknowns would not follow.
        """
        self.use[rows], self.Q[rows], self.good[rows] = part.use, part.Q, part.good
        self.alike = None

    def gradient(self, residuals: Array) -> Array:
        """Aᵀ P l (E, 16) of every epoch."""
        return right_hand_sides(self.weights, residuals, self.design.at.A, self.use)

    def own_gradient(self, residuals: Array, state: State) -> Array:
        """Gradient (E, p) of the own parameters, with that of their priors; 0 at the solution."""
        own, A = self.design.own, self.design.at.A
        b = right_hand_sides(self.weights, residuals, A[..., own], self.use)
        if self.design.own_prior.any():
            b += self.design.own_pull(state.values, state.pose)
        return b

    def own_count(self) -> Array:
        """How many parameters of its own every epoch uses up (E,); a prior leaves less than p."""
        held = np.einsum("epq,qp->e", self.Q, self.design.own_prior)
        count: Array = len(self.design.own) - held
        return count

    def common_share(self) -> float:
        """How many of the observations the common unknowns use up."""
        held = np.einsum("ij,ji->", self.Q_common, self.design.prior_matrix())
        return float(self.design.width - held)

    def prior_share(self) -> float:
        """How much of the redundancy rests on priors of the common unknowns being as stated.

        Along a direction of which the prior tells the share h, that is h - h² of an observation: of
        one epoch alone a wrong prior and another noise look the same, and many tell them apart.
        """
        held = self.Q_common @ self.design.prior_matrix()
        return float(np.trace(held) - np.einsum("ij,ji->", held, held))


def _used(weights: Array, use: Mask) -> Array:
    used: Array = weights * use[..., None]
    return used


def alike(weights: Array, use: Mask) -> tuple[Index, Index]:
    """Epochs of which the same points take part with the same weights, as of `same_rows`."""
    return same_rows(np.packbits(use, axis=1), *np.moveaxis(weights, -1, 0))
