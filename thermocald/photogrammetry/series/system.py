"""The linearised series: normal equations of all epochs with their common unknowns reduced.

The working half of `series`: arrays only. Own parameters are per epoch (p of them), common ones are
the series' (q parameters, then the offsets in x and in y of the T targets). A parameter may be
both: an epoch's own part is then its deviation from the common one, a random effect with a prior.

Source: the reduction of common unknowns as Helmert blocking, Wolf, H. (1978): The Helmert block
method.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import inverse_of_determined, root_of
from thermocald.photogrammetry.parameters import EOP_COLUMNS
from thermocald.photogrammetry.series.cofactors import among_all, cofactors
from thermocald.photogrammetry.series.normals import (
    chunks,
    normal_matrices,
    right_hand_sides,
    same_rows,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from thermocald.photogrammetry.series.normals import Partials
    from thermocald.photogrammetry.series.target_noise import CorrelatedPairs

    Array = NDArray[np.float64]
    Mask = NDArray[np.bool_]
    Columns = NDArray[np.int64]

__all__ = ["SeriesCofactors", "SeriesSystem", "Step", "alike", "line_weights"]

_FARTHEST_PX = 200.0  # that one step may move an image point by
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


@dataclass(frozen=True, eq=False)
class SeriesCofactors:
    """relative (E, 16, 16): to the series; level (16, 16): of what all epochs have in common; trend
    (16, 16): of what the common unknowns do to a straight line from the first to the last epoch.
    """

    relative: Array
    level: Array
    trend: Array


@dataclass(eq=False)
class SeriesSystem:
    """Normal equations at one linearisation.

    weights (E, T, 3): a priori; use (E, T): which points take part; own (p,), common (q,): columns;
    own_prior (p, p): weights with which own parameters are drawn to the common ones, 0 for those
    without a prior; N (E, 16, 16), empty where nothing is common; Q (E, p, p): cofactors of an
    epoch's own parameters, the common ones held; good (E,): epochs that carry theirs; Q_common:
    (q, q), or with offsets (q + 2T, q + 2T); prior (T, 3) px⁻² of the offsets, or None; alike:
    which epochs have the same matrices, as of `same_rows`, or None where that is no longer known.
    """

    at: Partials
    weights: Array
    use: Mask
    own: Columns
    common: Columns
    N: Array
    Q: Array
    good: Mask
    Q_common: Array
    prior: Array | None
    alike: tuple[Columns, Columns] | None
    own_prior: Array

    @classmethod
    def build(
        cls,
        at: Partials,
        weights: Array,
        use: Mask,
        own: Columns,
        common: Columns,
        prior: Array | None,
        own_prior: Array | None = None,
    ) -> SeriesSystem:
        """Form, invert, and reduce the normal equations."""
        system = cls.formed(at, weights, use, own, common, prior, own_prior)
        if len(common) == 0 and prior is None:
            return system
        return replace(system, Q_common=inverse_of_determined(system.common_normals()))

    @classmethod
    def formed(
        cls,
        at: Partials,
        weights: Array,
        use: Mask,
        own: Columns,
        common: Columns,
        prior: Array | None,
        own_prior: Array | None = None,
    ) -> SeriesSystem:
        """The same without the cofactors of the common unknowns."""
        drawn = np.zeros((len(own), len(own))) if own_prior is None else own_prior
        first, of = alike(weights, use)
        w = _used(weights[first], use[first])
        apart = len(common) == 0 and prior is None
        N = normal_matrices(w, at.A[..., own] if apart else at.A)
        Q, good = cofactors((N if apart else N[:, own[:, None], own]) + drawn)
        good &= use[first].any(axis=1)
        if len(first) < len(of):
            Q, good = Q[of], good[of]
        N = N[:0] if apart else N[of]
        none = np.empty((0, 0))
        return cls(at, weights, use, own, common, N, Q, good, none, prior, (first, of), drawn)

    def common_normals(self) -> Array:
        """Normal matrix of the common unknowns, the own parameters of all epochs reduced."""
        w = _used(self.weights, self.use)[self.good]
        full = _common_matrix(self.at.A, self.N[self.good], w, self.common, self.prior)
        for part, C in self.couplings():
            half = np.swapaxes(np.linalg.cholesky(self.Q[part]), 1, 2) @ C
            half = half.reshape(-1, half.shape[-1])
            full -= half.T @ half
        return full

    def couplings(self) -> Iterator[tuple[NDArray[np.int64], Array]]:
        """Chunks of good epochs and their blocks (e, p, q + 2T) of own with common unknowns."""
        rows = np.flatnonzero(self.good)
        q = len(self.common) + (0 if self.prior is None else 2 * len(self.at.A))
        if q == 0 or len(self.own) == 0:
            return
        for start in range(0, len(rows), _CHUNK):
            part = rows[start : start + _CHUNK]
            yield part, self._coupling(part)

    def _coupling(self, part: NDArray[np.int64]) -> Array:
        parameters = self.N[part][:, self.own[:, None], self.common]
        if self.prior is None:
            return parameters
        wx, wy, wxy = np.moveaxis(_used(self.weights[part], self.use[part]), -1, 0)[:, :, None]
        ax, ay = self.at.A[:, 0, self.own].T, self.at.A[:, 1, self.own].T
        return np.concatenate([parameters, wx * ax + wxy * ay, wxy * ax + wy * ay], axis=2)

    def step(self, residuals: Array, offsets: Array, deviations: Array | None = None) -> Step:
        """One Gauss-Newton step from residuals (E, T, 2) px and the offsets they stand at.

        deviations (E, p): of own parameters from what their prior draws them to.
        """
        b = right_hand_sides(self.weights, residuals, self.at.A, self.use)
        b[~self.good] = 0.0
        right = b[:, self.own]
        if deviations is not None:
            right = right - (deviations @ self.own_prior) * self.good[:, None]
        q = len(self.common)
        total = b[:, self.common].sum(axis=0)
        if self.prior is not None:
            total = np.concatenate([total, self._offset_gradient(residuals, offsets)])
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
        d_offsets = d_all[q:].reshape(2, -1).T if self.prior is not None else np.zeros_like(offsets)
        return Step(self._bounded(solved), d_all[:q], d_offsets, size, sizes)

    def _bounded(self, d_own: Array) -> Array:
        """The steps (E, p), shortened where they would move the image out of all proportion."""
        reach = np.abs(d_own) @ np.abs(self.at.A[..., self.own]).max(axis=(0, 1))
        far = np.flatnonzero(reach > _FARTHEST_PX)
        if len(far):
            px = np.abs(np.einsum("tkp,ep->etk", self.at.A[..., self.own], d_own[far]))
            shorter = np.minimum(1.0, _FARTHEST_PX / np.maximum(px.max(axis=(1, 2)), 1e-9))
            d_own = d_own.copy()
            d_own[far] *= shorter[:, None]
        return d_own

    def move(self, residuals: Array, step: Step) -> None:
        """Carry the residuals (E, T, 2) through a small step by the partials, in place."""
        if self.prior is not None or len(self.common):
            residuals -= self.at.A[..., self.common] @ step.d_common + step.d_offsets
        Ax, Ay = self.at.A[:, 0, self.own].T, self.at.A[:, 1, self.own].T
        for part in chunks(*residuals.shape[:2]):
            residuals[part, :, 0] -= step.d_own[part] @ Ax
            residuals[part, :, 1] -= step.d_own[part] @ Ay

    def replace(self, rows: NDArray[np.int64], part: SeriesSystem) -> None:
        """Put some epochs in from another system of the same linearisation, in place.

        Only where nothing is common: the common unknowns would not follow.
        """
        self.use[rows], self.Q[rows], self.good[rows] = part.use, part.Q, part.good
        self.alike = None

    def _offset_gradient(self, residuals: Array, offsets: Array) -> Array:
        assert self.prior is not None
        w = _used(self.weights[self.good], self.use[self.good])
        v = np.nan_to_num(residuals[self.good])
        x = (w[..., 0] * v[..., 0] + w[..., 2] * v[..., 1]).sum(axis=0)
        y = (w[..., 2] * v[..., 0] + w[..., 1] * v[..., 1]).sum(axis=0)
        x -= self.prior[:, 0] * offsets[:, 0] + self.prior[:, 2] * offsets[:, 1]
        y -= self.prior[:, 2] * offsets[:, 0] + self.prior[:, 1] * offsets[:, 1]
        return np.concatenate([x, y])

    def common_share(self) -> float:
        """How many of the observations the common unknowns use up."""
        q = len(self.common)
        if self.prior is None:
            return float(q)
        T = len(self.prior)
        x, y = np.arange(q, q + T), np.arange(q + T, q + 2 * T)
        held = (
            self.Q_common[x, x] @ self.prior[:, 0]
            + self.Q_common[y, y] @ self.prior[:, 1]
            + 2 * self.Q_common[x, y] @ self.prior[:, 2]
        )
        return float(q + 2 * T - held)

    def covariances(self) -> SeriesCofactors:
        """The cofactors of all parameters.

        An epoch's parameters depend on the common unknowns by -G; what of G is the same in all
        epochs cancels in differences within the series, the rest is the epoch's own.
        """
        own, common = self.own, self.common
        cofactors = self.Q
        level, trend = np.zeros((16, 16)), np.zeros((16, 16))
        width = len(self.Q_common)
        if width:
            cofactors = cofactors.copy()
            mean, tilt = np.zeros((len(own), width)), np.zeros((len(own), width))
            line = line_weights(self.good)
            for part, C in self.couplings():
                G = self.Q[part] @ C
                mean += G.sum(axis=0)
                tilt += np.tensordot(line[part], G, axes=1)
            mean /= max(int(self.good.sum()), 1)
            root = root_of(self.Q_common)
            own_tilt = tilt @ root
            trend[own[:, None], own] = own_tilt @ own_tilt.T
            for part, C in self.couplings():
                deviation = (self.Q[part] @ C - mean) @ root
                cofactors[part] += deviation @ np.swapaxes(deviation, 1, 2)
            # A parameter that is both own and common takes both ways.
            all_level = np.zeros((16, width))
            all_level[common] = root[: len(common)]
            all_level[own] -= mean @ root
            level = all_level @ all_level.T
        relative = among_all(cofactors, own)
        relative[~self.good] = 0.0
        return SeriesCofactors(relative, level, trend)

    def slow(self, errors: Array, group: NDArray[np.int64]) -> Array:
        """Covariance (16, 16) of a straight line over the series from targets' slow errors.

        errors (T, 2) px: seen in the residuals, of which a group of targets that errs together has
        already pulled a part into the parameters; as in the jackknife (HC3) that is put back:
        Σ Q Aᵀ W (I - H)⁻¹ e eᵀ (I - H)⁻¹ W A Q over the groups.
        """
        out = np.zeros((16, 16))
        if not self.good.any():
            return out
        w = np.sqrt(_used(self.weights, self.use)[self.good].mean(axis=0)[:, :2])
        J = self.at.A[..., self.own] * w[..., None]
        inverse, good = cofactors((np.einsum("tkp,tkq->pq", J, J) + self.own_prior)[None])
        if not good[0]:
            return out
        total = np.zeros((len(self.own), len(self.own)))
        for label in np.unique(group):
            rows = group == label
            e = (errors[rows] * w[rows]).ravel()
            if not e.any():
                continue
            Jg = J[rows].reshape(len(e), -1)
            left = np.eye(len(e)) - Jg @ inverse[0] @ Jg.T
            values, vectors = np.linalg.eigh(left)
            # What a group determines alone cannot be told from its residuals at all.
            back = vectors @ ((vectors.T @ e) / np.maximum(values, 0.1))
            pull = inverse[0] @ (Jg.T @ back)
            total += np.outer(pull, pull)
        out[self.own[:, None], self.own] = total
        return out

    def correlated(self, pairs: CorrelatedPairs) -> Array:
        """What correlated errors add to the covariance (E, 16, 16) of own parameters."""
        extra = pairs.normal_matrices(_used(self.weights, self.use), self.at.A[..., self.own])
        own = self.Q @ extra @ self.Q
        # Covariances from epochs that do not see the same targets may be indefinite together: drawn
        # in so that they take at most three fifths off the variance of any combination.
        root = np.linalg.inv(np.linalg.cholesky(self.Q))
        least = np.linalg.eigvalsh(root @ own @ np.swapaxes(root, 1, 2))[:, 0]
        drawn = np.where(self.good, np.minimum(1.0, 0.6 / np.maximum(-least, 1e-9)), 0.0)
        drawn[least >= 0] = 1.0
        return among_all(drawn[:, None, None] * own, self.own)

    def own_count(self) -> Array:
        """How many parameters of its own every epoch uses up (E,); a prior leaves less than p."""
        held = np.einsum("epq,qp->e", self.Q, self.own_prior)
        count: Array = len(self.own) - held
        return count

    def from_priors(self) -> Array:
        """The part (E, p, p) of the cofactors that the priors contribute, Q P Q."""
        part: Array = self.Q @ self.own_prior @ self.Q
        part[~self.good] = 0.0
        return part

    def gradient(self, residuals: Array) -> Array:
        """Aᵀ P l (E, 16) of every epoch."""
        return right_hand_sides(self.weights, residuals, self.at.A, self.use)

    def typical_sensitivity(self) -> Array:
        """By how much own parameters (p,) follow an error of the pose (6,), in a typical epoch."""
        N = self.N[self.good].mean(axis=0)
        Q, _ = cofactors((N[self.own[:, None], self.own] + self.own_prior)[None])
        sensitivity: Array = Q[0] @ N[self.own[:, None], EOP_COLUMNS]
        return sensitivity

    def of_common(self, covariance: Array) -> Array:
        """Covariance (E, p, p) of own parameters where the common ones (q, q) err in an epoch."""
        G = self.Q @ self.N[:, self.own[:, None], self.common]
        part: Array = G @ covariance @ np.swapaxes(G, 1, 2)
        part[~self.good] = 0.0
        return part

    def offset_cofactors(self) -> Array:
        """Cofactors (T, 2) px² of the offsets in x and y; NaN without offsets."""
        if self.prior is None:
            return np.full((len(self.at.A), 2), np.nan)
        return np.diag(self.Q_common)[len(self.common) :].reshape(2, -1).T

    def score(self, residuals: Array, columns: Columns) -> Array:
        """Chi-square (E,) of held parameters being the same in an epoch as in the series.

        Rao's score test: the gradient by these columns, with the epoch's own parameters reduced.
        """
        b = right_hand_sides(self.weights, residuals, self.at.A, self.use)
        C = self.N[:, self.own[:, None], columns]
        QC = self.Q @ C
        V = self.N[:, columns[:, None], columns] - np.swapaxes(C, 1, 2) @ QC
        g = b[:, columns] - np.einsum("epi,ep->ei", QC, b[:, self.own])
        inverse, good = cofactors(V)
        score = np.einsum("ei,eij,ej->e", g, inverse, g)
        return np.where(good & self.good, score, np.nan)


def _used(weights: Array, use: Mask) -> Array:
    """Weights (E, T, 3), 0 where a point takes no part."""
    used: Array = weights * use[..., None]
    return used


def line_weights(good: Mask) -> Array:
    """Weights (E,) that give the change of a straight line from the first epoch to the last."""
    t = np.flatnonzero(good).astype(np.float64)
    weights = np.zeros(len(good))
    if len(t) > 1:
        centred = t - t.mean()
        weights[good] = centred / (centred @ centred) * (t[-1] - t[0])
    return weights


def alike(weights: Array, use: Mask) -> tuple[Columns, Columns]:
    """Epochs of which the same points take part with the same weights, as of `same_rows`."""
    return same_rows(np.packbits(use, axis=1), *np.moveaxis(weights, -1, 0))


def _common_matrix(
    A: Array, N: Array, weights: Array, common: Columns, prior: Array | None
) -> Array:
    """The common unknowns' own block, over all good epochs, with the offsets' prior."""
    q = len(common)
    parameters: Array = N[:, common[:, None], common].sum(axis=0)
    if prior is None:
        return parameters
    w = weights.sum(axis=0)
    A = A[..., common]
    T = len(w)
    full = np.zeros((q + 2 * T, q + 2 * T))
    full[:q, :q] = parameters
    x, y = np.arange(q, q + T), np.arange(q + T, q + 2 * T)
    full[x, x] = w[:, 0] + prior[:, 0]
    full[y, y] = w[:, 1] + prior[:, 1]
    full[x, y] = full[y, x] = w[:, 2] + prior[:, 2]
    wx, wy, wxy = (w[:, k, None] for k in range(3))
    full[x, :q] = wx * A[:, 0] + wxy * A[:, 1]
    full[y, :q] = wxy * A[:, 0] + wy * A[:, 1]
    full[:q, q:] = full[q:, :q].T
    return full
