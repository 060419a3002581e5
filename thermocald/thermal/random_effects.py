"""Random effects of a series: unknowns of no hypothesis, integrated out of its likelihood.

The offsets of targets that are hidden for long: where they are taken for known, a target that comes
back pulls at the camera. The slow movement of the camera on its mount: a random walk, or a bounded
one, in the well-determined combinations of the camera's parameters.

Source: Patterson, Thompson (1971), Biometrika 58, 545-554 (variance components); Rasmussen,
Williams (2006), Gaussian Processes for Machine Learning, section 2.7.

How random effects are coupled with the epochs' parameters in the normal equations.

The movement of the mount has hundreds of amplitudes, but few directions, each with its cosines: its
couplings are kept as products of the two, never written out over epochs and parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array

_OFTEN = 0.9  # share of the epochs that show a target whose offset needs no unknown of its own
_SEEN = 0.05  # variance of an amplitude, in units of the image noise, that is worth an unknown
_LOOSE = 1e-4  # px⁻², of an offset a priori


@dataclass(frozen=True, eq=False)
class HiddenTargets:
    """Offsets of hidden targets, S combinations that the camera's parameters could take up.

    patterns (G, E) px⁻²: weights of the targets that are seen together; members: per pattern the
    targets' rows (n,) and the combinations (2n, s) of their coordinates; group (S,): the pattern of
    each combination; vectors (S, P): its products with scaled parameters; right (S, E): with the
    misclosures.
    """

    patterns: Array
    members: tuple[tuple[NDArray[np.int64], Array], ...]
    group: NDArray[np.int64]
    vectors: Array
    right: Array

    @property
    def cross(self) -> Array:
        """Their part of the normal equations alongside the epochs' parameters, (S, E, P)."""
        out: Array = self.patterns[self.group][:, :, None] * self.vectors[:, None, :]
        return out

    @property
    def normal(self) -> Array:
        """The diagonal (S,) of their own normal matrix."""
        out: Array = self.patterns.sum(axis=1)[self.group] + _LOOSE
        return out

    def scaled(self, factor: Array | float) -> HiddenTargets:
        """Multiply all weights by a factor, or by one (E,) for each epoch."""
        return replace(self, patterns=self.patterns * factor, right=self.right * factor)

    def in_blocks(self, starts: NDArray[np.int64]) -> HiddenTargets:
        """Sum over blocks of neighbouring epochs that start at some rows."""
        return replace(
            self,
            patterns=np.add.reduceat(self.patterns, starts, axis=1),
            right=np.add.reduceat(self.right, starts, axis=1),
        )

    def turned(self, T: Array, values: Array) -> HiddenTargets:
        """Follow normal matrices taken to T N Tᵀ about the epochs' own values (E, P)."""
        vectors = self.vectors @ T.T
        change = (vectors - self.vectors) @ values.T
        right = self.right + self.patterns[self.group] * change
        return replace(self, vectors=vectors, right=right)

    def less(self, change: Array) -> HiddenTargets:
        """Take changes (E, T, 2) px off the image points."""
        parts = [
            self.patterns[k] * (change[:, rows].reshape(len(change), -1) @ U).T
            for k, (rows, U) in enumerate(self.members)
        ]
        return replace(self, right=self.right - np.concatenate(parts))


def group_hidden_targets(w: Array, left: Array, A: Array) -> HiddenTargets | None:
    """Group the targets that are hidden for long by when they are seen; None where none is.

    w (E, T, 3) px⁻², left (E, T, 2) px: misclosures, A (T, 2, P): partials.
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
    """Slow movement of the epochs' parameters that no hypothesis explains.

    directions (P, m) in px-scaled columns; trajectories (E, K): orthonormal cosines; sd (m, K): of
    their amplitudes in units of the image noise. Those that the noise hides are left out.
    """

    directions: Array
    trajectories: Array
    sd: Array

    @cached_property
    def states(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Direction and cosine of each amplitude that counts."""
        seen = self.sd**2 > _SEEN
        if not seen.any():
            seen[-1, 0] = True
        mode, wave = np.nonzero(seen)
        return mode, wave

    def __len__(self) -> int:
        return len(self.states[0])

    @cached_property
    def operator(self) -> Array:
        """Trajectories (E, F) of the amplitudes for unit variance."""
        mode, wave = self.states
        out: Array = self.trajectories[:, wave] * self.sd[mode, wave]
        return out

    @cached_property
    def spans(self) -> tuple[slice, ...]:
        """Where the amplitudes of each direction that count are."""
        stops = np.cumsum(np.bincount(self.states[0], minlength=len(self.sd))).tolist()
        return tuple(slice(a, b) for a, b in zip([0, *stops], stops, strict=False))

    def own(self, N: Array) -> Array:
        """Sum (F, F) products of the amplitudes' shifts under normal matrices N (E, P, P)."""
        between = self.directions.T @ N @ self.directions
        out = np.zeros((len(self), len(self)))
        for i, here in enumerate(self.spans):
            for j, there in enumerate(self.spans[i:], i):
                out[here, there] = self.operator[:, here].T @ (
                    between[:, i, j, None] * self.operator[:, there]
                )
                out[there, here] = out[here, there].T
        return out

    def onto(self, data: Array) -> Array:
        """Sum (n, F) data or couplings (n, E, P) over what each amplitude moves."""
        along = np.moveaxis(data @ self.directions, 2, 0)  # (m, n, E)
        parts = [along[mode] @ self.operator[:, span] for mode, span in enumerate(self.spans)]
        out: Array = np.concatenate(parts, axis=1)
        return out

    def moments(self, mean: Array, root: Array) -> tuple[Array, Array]:
        """Sum products of amplitudes over the cosines, and their gain in precision, (m, m).

        mean (F,), root (·, F) of the covariance given the data; 0 and 1 of those left out.
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
    """Return cosines (E, K) over a series, orthonormal where the epochs are at even intervals."""
    E = len(times)
    u = (times - times[0]) / max(float(times[-1] - times[0]), 1e-9)
    u = (u * (E - 1) + 0.5) / E
    out: Array = np.sqrt(2.0 / E) * np.cos(np.pi * np.arange(1, count + 1) * u[:, None])
    return out


@dataclass(frozen=True, eq=False)
class Couplings:
    """Couplings of F amplitudes of a movement, and of S other random effects.

    moved (E, m, P): normal matrices times each direction of the movement; operator (E, F):
    trajectories of its amplitudes, direction after direction; spans: those of each direction;
    others (S, E, P): written out.
    """

    moved: Array
    operator: Array
    spans: tuple[slice, ...]
    others: Array

    def __len__(self) -> int:
        return int(self.operator.shape[1]) + len(self.others)

    def blurred(
        self, whitened: Array, own: Array, epochs: NDArray[np.int64]
    ) -> tuple[Couplings, Array]:
        """Let some epochs (n,) shift at random; also couplings (n, t, F + S) with those shifts.

        whitened (n, t, P): their directions, independent; own: these times the normal matrices.
        """
        by_mode = whitened @ np.swapaxes(self.moved[epochs], 1, 2)  # (n, t, m)
        by_other = whitened @ np.moveaxis(self.others[:, epochs], 0, 2)  # (n, t, S)
        moved, others = self.moved.copy(), self.others.copy()
        moved[epochs] -= np.swapaxes(by_mode, 1, 2) @ own
        others[:, epochs] -= np.moveaxis(np.swapaxes(by_other, 1, 2) @ own, 1, 0)
        coupled = np.repeat(by_mode, self._counts, axis=2) * self.operator[epochs, None, :]
        out = Couplings(moved, self.operator, self.spans, others)
        return out, np.concatenate([coupled, by_other], axis=2)

    def along(self, direction: Array) -> Array:
        """Return couplings (F + S, E) with a direction (P,) of the parameters."""
        own: Array = (self.operator * np.repeat(self.moved @ direction, self._counts, axis=1)).T
        return np.concatenate([own, self.others @ direction]) if len(self.others) else own

    def onto(self, shifts: Array) -> Array:
        """Sum (F + S, R) over all epochs' shifts (E, P, R) of the parameters."""
        return np.concatenate([*self._amplitudes(self.moved @ shifts), self._others(shifts)])

    def driven(self, trajectories: Array, directions: Array) -> Array:
        """Sum (F + S, R) over shifts along directions (P, R) that go as trajectories (E, R)."""
        shifts = trajectories[:, None, :] * directions
        along = (self.moved @ directions) * trajectories[:, None, :]
        return np.concatenate([*self._amplitudes(along), self._others(shifts)])

    def images(self, amplitudes: Array) -> Array:
        """Return what amplitudes (F + S, R) give in the epochs' right-hand sides, (E, P, R)."""
        out: Array = np.tensordot(self.others, amplitudes[self.operator.shape[1] :], axes=(0, 0))
        for m, span in enumerate(self.spans):
            course = self.operator[:, span] @ amplitudes[span]
            out += self.moved[:, m, :, None] * course[:, None, :]
        return out

    def total(self) -> Array:
        """Return couplings (F + S, P) with the levels of the parameters."""
        return np.concatenate([*self._amplitudes(self.moved), self.others.sum(axis=1)])

    @property
    def _counts(self) -> list[int]:
        """How many amplitudes each direction has."""
        return [span.stop - span.start for span in self.spans]

    def _others(self, shifts: Array) -> Array:
        out: Array = np.tensordot(self.others, shifts, axes=([1, 2], [0, 1]))
        return out

    def _amplitudes(self, along: Array) -> list[Array]:
        """Sum (·, R) over what each direction's amplitudes move: along (E, m, R)."""
        return [self.operator[:, span].T @ along[:, m] for m, span in enumerate(self.spans)]
