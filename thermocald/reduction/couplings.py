"""How random effects are coupled with the epochs' parameters in the normal equations.

The movement of the mount has hundreds of amplitudes, but few directions, each with its cosines: its
couplings are kept as products of the two, never written out over epochs and parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.reduction.random_effects import Movement

__all__ = ["Couplings"]


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

    @classmethod
    def still(cls, others: Array) -> Couplings:
        """Where nothing moves."""
        _, E, P = others.shape
        return cls(np.zeros((E, 0, P)), np.zeros((E, 0)), (), others)

    @classmethod
    def of(cls, movement: Movement, N: Array, others: Array) -> Couplings:
        """Of a movement of epochs with normal matrices N (E, P, P)."""
        modes = [mode for mode, _ in movement.spans]
        moved = movement.directions[:, modes].T @ N
        return cls(moved, movement.operator, tuple(span for _, span in movement.spans), others)

    def __len__(self) -> int:
        return int(self.operator.shape[1]) + len(self.others)

    def blurred(
        self, whitened: Array, own: Array, epochs: NDArray[np.int64]
    ) -> tuple[Couplings, Array]:
        """Where some epochs (n,) shift at random, and couplings (n, t, F + S) with those shifts.

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
        """Couplings (F + S, E) with a direction (P,) of the parameters."""
        own: Array = (self.operator * np.repeat(self.moved @ direction, self._counts, axis=1)).T
        return np.concatenate([own, self.others @ direction]) if len(self.others) else own

    def onto(self, shifts: Array) -> Array:
        """Sums (F + S, R) over all epochs' shifts (E, P, R) of the parameters."""
        return np.concatenate([*self._amplitudes(self.moved @ shifts), self._others(shifts)])

    def driven(self, trajectories: Array, directions: Array) -> Array:
        """Sums (F + S, R) over shifts along directions (P, R) that go as trajectories (E, R)."""
        shifts = trajectories[:, None, :] * directions
        along = (self.moved @ directions) * trajectories[:, None, :]
        return np.concatenate([*self._amplitudes(along), self._others(shifts)])

    def images(self, amplitudes: Array) -> Array:
        """What amplitudes (F + S, R) give in the epochs' right-hand sides, (E, P, R)."""
        out: Array = np.tensordot(self.others, amplitudes[self.operator.shape[1] :], axes=(0, 0))
        for m, span in enumerate(self.spans):
            course = self.operator[:, span] @ amplitudes[span]
            out += self.moved[:, m, :, None] * course[:, None, :]
        return out

    def total(self) -> Array:
        """Couplings (F + S, P) with the levels of the parameters."""
        return np.concatenate([*self._amplitudes(self.moved), self.others.sum(axis=1)])

    @property
    def _counts(self) -> list[int]:
        """How many amplitudes each direction has."""
        return [span.stop - span.start for span in self.spans]

    def _others(self, shifts: Array) -> Array:
        out: Array = np.tensordot(self.others, shifts, axes=([1, 2], [0, 1]))
        return out

    def _amplitudes(self, along: Array) -> list[Array]:
        """Of each direction, the sums (·, R) over what its amplitudes move: along (E, m, R)."""
        return [self.operator[:, span].T @ along[:, m] for m, span in enumerate(self.spans)]
