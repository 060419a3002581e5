"""What is unknown in a series, at one linearisation: per epoch, once, and what priors say of it.

Own parameters are per epoch (p of them), common ones are the series' (q parameters, then the
offsets in x and in y of the T targets). A parameter may be both: an epoch's own part is then drawn
to the common one, a random effect.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP
from thermocald.photogrammetry.series.normals import right_hand_sides

if TYPE_CHECKING:
    from thermocald.arrays import Array, Index
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.photogrammetry.series.normals import Partials


__all__ = ["Design", "State", "offset_weights"]


@dataclass(frozen=True, eq=False)
class State:
    """values (E, 16), offsets (T, 2) px and the common pose (6,)."""

    values: Array
    offsets: Array
    pose: Array


@dataclass(frozen=True, eq=False)
class Design:
    """The unknowns of a series.

    at: the linearisation; own (p,), common (q,): positions of the parameters; known (16,): the
    values that priors draw parameters to; own_prior (p, p), common_prior (q,): their weights, 0 for
    those without; sways: whether an epoch's exterior orientation is drawn to the common one
    instead; offset_prior (T, 3) px⁻²: weights xx, yy, xy of the offsets, None without offsets.
    """

    at: Partials
    own: Index
    common: Index
    known: Array
    own_prior: Array
    common_prior: Array
    sways: bool
    offset_prior: Array | None

    @property
    def width(self) -> int:
        """How many common unknowns there are, q or q + 2T."""
        return len(self.common) + (0 if self.offset_prior is None else 2 * len(self.at.A))

    def own_pull(self, values: Array, pose: Array) -> Array:
        """Gradient (E, p) by which priors draw own parameters, at values (E, 16)."""
        centre = self.known.copy()
        if self.sways:
            centre[EOP] = pose
        pull: Array = (centre - values)[:, self.own] @ self.own_prior
        return pull

    def common_pull(self, pose: Array, offsets: Array) -> Array:
        """Gradient (width,) by which priors draw the common unknowns."""
        pull: Array = self.common_prior * (self.known[self.common] - pose[: len(self.common)])
        if self.offset_prior is None:
            return pull
        (wx, wy, wxy), (x, y) = self.offset_prior.T, offsets.T
        return np.concatenate([pull, -wx * x - wxy * y, -wxy * x - wy * y])

    def without_common_priors(self) -> Design:
        """The same unknowns, nothing known beforehand of the common ones."""
        offsets = None if self.offset_prior is None else np.zeros_like(self.offset_prior)
        return replace(self, common_prior=np.zeros(len(self.common)), offset_prior=offsets)

    def gradient(self, weights: Array, residuals: Array) -> Array:
        """Gradient (width,) of the common unknowns: weights (E, T, 3), residuals (E, T, 2) px."""
        b = right_hand_sides(weights, residuals, self.at.A[..., self.common])
        total: Array = b.sum(axis=0)
        if self.offset_prior is None:
            return total
        v = np.nan_to_num(residuals)
        x = (weights[..., 0] * v[..., 0] + weights[..., 2] * v[..., 1]).sum(axis=0)
        y = (weights[..., 2] * v[..., 0] + weights[..., 1] * v[..., 1]).sum(axis=0)
        return np.concatenate([total, x, y])

    def prior_matrix(self) -> Array:
        """Weights (width, width) of the priors of the common unknowns."""
        out = np.zeros((self.width, self.width))
        q = len(self.common)
        out[np.arange(q), np.arange(q)] = self.common_prior
        if self.offset_prior is not None:
            _add_blocks(out[q:, q:], self.offset_prior)
        return out

    def common_matrix(self, N: Array, weights: Array) -> Array:
        """Normal matrix (width, width) of the common unknowns, own ones held, with the priors.

        N (16, 16), weights (T, 3): summed over the epochs.
        """
        out, q = self.prior_matrix(), len(self.common)
        out[:q, :q] += N[self.common[:, None], self.common]
        if self.offset_prior is not None:
            _add_blocks(out[q:, q:], weights)
            out[:q, q:] = self._with_offsets(weights[None], self.common)[0]
            out[q:, :q] = out[:q, q:].T
        return out

    def coupling(self, N: Array, weights: Array) -> Array:
        """Blocks (E, p, width) of own with common unknowns: N (E, 16, 16), weights (E, T, 3)."""
        parameters: Array = N[:, self.own[:, None], self.common]
        if self.offset_prior is None:
            return parameters
        return np.concatenate([parameters, self._with_offsets(weights, self.own)], axis=2)

    def _with_offsets(self, weights: Array, columns: Index) -> Array:
        """Blocks (E, k, 2T) of some parameters with the offsets."""
        wx, wy, wxy = np.moveaxis(weights, -1, 0)[:, :, None]
        ax, ay = self.at.A[:, 0, columns].T, self.at.A[:, 1, columns].T
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
    """Inverse covariance (T, 3) px⁻² of the offsets, from that of the object coordinates."""
    variance = field.sigmas**2
    tiny = 1e-12  # px²: a target without sigma has no offset
    xx = (at.B[:, 0] ** 2 * variance).sum(axis=1) + tiny
    yy = (at.B[:, 1] ** 2 * variance).sum(axis=1) + tiny
    xy = (at.B[:, 0] * at.B[:, 1] * variance).sum(axis=1)
    weights: Array = np.stack([yy, xx, -xy], axis=1) / (xx * yy - xy**2)[:, None]
    return weights
