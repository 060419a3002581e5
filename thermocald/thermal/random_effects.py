"""The random effects of a series, which belong to no hypothesis and are integrated out.

They are the offsets of targets that are hidden for long (if these were fixed, a target that
reappears would bias the camera), and the slow movement of the camera on its mount (a random walk,
possibly bounded, in the well-determined combinations of the camera's parameters).

Source: Patterson, Thompson (1971), Biometrika 58, 545-554 (variance components); Rasmussen,
Williams (2006), Gaussian Processes for Machine Learning, section 2.7.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array

_OFTEN = 0.9  # share of the epochs with a target from which its offset needs no unknown
_SEEN = 0.05  # variance of an amplitude, in units of the image noise, from which it is an unknown
_LOOSE = 1e-4  # px⁻², prior weight of an offset


@dataclass(frozen=True, eq=False)
class HiddenTargets:
    """The offsets of hidden targets, as S combinations that the camera's parameters could absorb.

    patterns (G, E) px⁻²: weights of the targets that are seen at the same epochs; members: for each
    pattern the targets' rows (n,) and the combinations (2n, s) of their coordinates; group (S,):
    the pattern of each combination; vectors (S, P): its products with the scaled parameters' design
    matrix; right (S, E): its products with the weighted misclosures.
    """

    patterns: Array
    members: tuple[tuple[NDArray[np.int64], Array], ...]
    group: NDArray[np.int64]
    vectors: Array
    right: Array

    @property
    def cross(self) -> Array:
        """The normal equations' block (S, E, P) with the epochs' parameters."""
        return np.asarray(self.patterns[self.group][:, :, None] * self.vectors[:, None, :])

    @property
    def normal(self) -> Array:
        """The diagonal (S,) of the offsets' own normal matrix."""
        return np.asarray(self.patterns.sum(axis=1)[self.group] + _LOOSE)

    def scaled(self, factor: Array | float) -> HiddenTargets:
        """Multiply the weights by a factor, or by a factor (E,) for each epoch."""
        return replace(self, patterns=self.patterns * factor, right=self.right * factor)

    def in_blocks(self, starts: NDArray[np.int64]) -> HiddenTargets:
        """Sum over blocks of neighbouring epochs, which begin at the rows `starts`."""
        return replace(
            self,
            patterns=np.add.reduceat(self.patterns, starts, axis=1),
            right=np.add.reduceat(self.right, starts, axis=1),
        )

    def turned(self, T: Array, values: Array) -> HiddenTargets:
        """Transform the offsets with normal matrices to T N Tᵀ, about the epochs' values (E, P)."""
        vectors = self.vectors @ T.T
        change = (vectors - self.vectors) @ values.T
        right = self.right + self.patterns[self.group] * change
        return replace(self, vectors=vectors, right=right)

    def less(self, change: Array) -> HiddenTargets:
        """Subtract changes (E, T, 2) px from the image points."""
        parts = [
            self.patterns[k] * (change[:, rows].reshape(len(change), -1) @ U).T
            for k, (rows, U) in enumerate(self.members)
        ]
        return replace(self, right=self.right - np.concatenate(parts))


def group_hidden_targets(w: Array, left: Array, A: Array) -> HiddenTargets | None:
    """Group the targets that are hidden for long by the epochs that show them; None if none is.

    w (E, T, 3) px⁻²: weights; left (E, T, 2) px: misclosures; A (T, 2, P): partial derivatives.
    """
    there = w[..., 0] > 0
    epochs = there.any(axis=1)
    rows = np.flatnonzero(there.any(axis=0) & (there[epochs].mean(axis=0) < _OFTEN))
    if not len(rows):
        return None
    together: dict[bytes, list[int]] = {}
    for row in rows.tolist():
        together.setdefault(np.packbits(there[:, row]).tobytes(), []).append(row)
    patterns, members, group, vectors = [], [], [], []
    for number, targets in enumerate(together.values()):
        U, s, V = np.linalg.svd(A[targets].reshape(2 * len(targets), -1), full_matrices=False)
        kept = s > 1e-9 * s[0]
        patterns.append(w[:, targets, :2].mean(axis=(1, 2)))
        members.append((np.array(targets), U[:, kept]))
        group.append(np.full(int(kept.sum()), number))
        vectors.append(s[kept, None] * V[kept])
    empty = HiddenTargets(
        np.stack(patterns), tuple(members), np.concatenate(group), np.concatenate(vectors),
        np.zeros((sum(U.shape[1] for _, U in members), len(w))),
    )  # fmt: skip
    return empty.less(-np.where(there[..., None], left, 0.0))


@dataclass(frozen=True, eq=False)
class Movement:
    """A slow movement of the epochs' parameters that no hypothesis explains.

    directions (P, m): in px-scaled columns; trajectories (E, K): orthonormal cosines; sd (m, K): of
    their amplitudes, in units of the image noise. Amplitudes below the noise are left out.
    """

    directions: Array
    trajectories: Array
    sd: Array

    @cached_property
    def states(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The direction and the cosine of each amplitude that counts, indices (F,) each."""
        seen = self.sd**2 > _SEEN
        if not seen.any():
            seen[-1, 0] = True
        mode, wave = np.nonzero(seen)
        return mode, wave

    @property
    def operators(self) -> list[tuple[Array, Array]]:
        """The directions (P,) that count, each with its trajectories (E, ·) of unit variance."""
        mode, wave = self.states
        return [
            (self.directions[:, i], self.trajectories[:, k] * self.sd[i, k])
            for i in np.unique(mode)
            for k in [wave[mode == i]]
        ]

    def moments(self, mean: Array, root: Array) -> tuple[Array, Array]:
        """Return the amplitudes' products and their gain in precision, (m, m), summed over cosines.

        mean (F,), root (·, F): of the amplitudes and of their covariance, given the data; the
        amplitudes that are left out have mean 0 and variance 1.
        """
        mode, wave = self.states
        m, K = self.sd.shape
        amplitudes = np.zeros((m, K))
        amplitudes[mode, wave] = mean
        known = np.zeros((m, m))
        for k in np.unique(wave):
            own = np.flatnonzero(wave == k)
            part = root[:, own]
            known[np.ix_(mode[own], mode[own])] += np.eye(len(own)) - part.T @ part
        return amplitudes @ amplitudes.T, known


def waves(times: Array, count: int) -> Array:
    """Return cosines (E, K) over a series, orthonormal for epochs at even intervals."""
    E = len(times)
    u = (times - times[0]) / max(float(times[-1] - times[0]), 1e-9)
    u = (u * (E - 1) + 0.5) / E
    return np.asarray(np.sqrt(2.0 / E) * np.cos(np.pi * np.arange(1, count + 1) * u[:, None]))
