"""The sums of a series before anything is integrated out of its likelihood.

Normal equations of the epochs' parameters, of the random effects (movement of the mount, offsets of
hidden targets), and their couplings; with shifts of single epochs, which trembling or a temperature
nobody saw makes, as part of the noise.

Source: Rasmussen, Williams (2006), Gaussian Processes for Machine Learning, A.3 (Woodbury).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from thermocald.reduction.couplings import Couplings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.reduction.random_effects import Movement
    from thermocald.reduction.series import ReducedSeries

__all__ = ["Sums", "sums_of"]


@dataclass(frozen=True, eq=False)
class Sums:
    """The sums of a series before anything is integrated out, those of random effects included."""

    N: Array  # (E, P, P)
    b: Array  # (E, P)
    yy: float
    logdet: float
    cross: Couplings
    normal: Array  # (F, F)
    right: Array  # (F,)

    def blurred(self, D: Array, epochs: NDArray[np.int64]) -> Sums:
        """With random shifts of unit variance of some epochs (n,) along D (n, P, t): Woodbury."""
        N, b = self.N[epochs], self.b[epochs]
        Dt = np.swapaxes(D, 1, 2)
        DtN = Dt @ N
        L = np.linalg.cholesky(np.eye(D.shape[2]) + DtN @ D)
        own = np.linalg.solve(L, DtN)  # (n, t, P)
        data = np.linalg.solve(L, Dt @ b[..., None])  # (n, t, 1)
        cross, coupled = self.cross.blurred(np.linalg.solve(L, Dt), own, epochs)
        whole, right = self.N.copy(), self.b.copy()
        whole[epochs] -= np.swapaxes(own, 1, 2) @ own
        right[epochs] -= np.sum(own * data, axis=1)
        wide = coupled.reshape(data.size, len(self.cross))
        return replace(
            self,
            N=whole,
            b=right,
            yy=self.yy - float(np.sum(data**2)),
            logdet=self.logdet + 2 * float(np.sum(np.log(np.einsum("eii->ei", L)))),
            cross=cross,
            normal=self.normal - wide.T @ wide,
            right=self.right - wide.T @ data.ravel(),
        )

    def shifted(self, shift: Array) -> Sums:
        """With shifts (E, P) of the parameters taken off the data."""
        moved = np.einsum("epq,eq->ep", self.N, shift)
        yy = self.yy - 2 * float(np.sum(shift * self.b)) + float(np.sum(shift * moved))
        right = self.right - self.cross.onto(shift[..., None])[:, 0]
        return Sums(self.N, self.b - moved, yy, self.logdet, self.cross, self.normal, right)

    def alongside(self, movement: Movement | None) -> Sums:
        """With a movement as random effects before the others."""
        if movement is None:
            return self
        own = movement.own(self.N) + np.eye(len(movement))
        between = movement.onto(self.cross.others)
        return replace(
            self,
            cross=Couplings.of(movement, self.N, self.cross.others),
            normal=np.block([[own, between.T], [between, self.normal]]),
            right=np.concatenate([movement.onto(self.b[None])[0], self.right]),
        )


@dataclass(frozen=True, eq=False)
class _Still:
    """A series whatever its movement: two are equal where all else is the same."""

    evidence: ReducedSeries

    @property
    def _parts(self) -> tuple[object, ...]:
        e = self.evidence
        return e.N, e.b, e.yy, e.hidden, e.tremble

    def __hash__(self) -> int:
        return hash(tuple(map(id, self._parts)))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Still):
            return False
        return all(a is b for a, b in zip(self._parts, other._parts, strict=True))


@lru_cache(maxsize=4)
def _trembled(still: _Still) -> Sums:
    """The sums with what trembles from epoch to epoch."""
    evidence, hidden = still.evidence, still.evidence.hidden
    cross, right = np.zeros((0, *evidence.b.shape)), np.zeros(0)
    normal = np.zeros((0, 0))
    if hidden is not None:
        cross, normal, right = hidden.cross, np.diag(hidden.normal), hidden.right.sum(axis=1)
    sums = Sums(
        evidence.N, evidence.b, float(evidence.yy.sum()), 0.0, Couplings.still(cross), normal, right
    )  # fmt: skip
    if evidence.tremble is None:
        return sums
    every = np.arange(len(evidence.N))
    D = np.broadcast_to(evidence.tremble, (len(every), *evidence.tremble.shape))
    return sums.blurred(D, every)


@lru_cache(maxsize=4)
def sums_of(evidence: ReducedSeries) -> Sums:
    """The sums with what moves: first the movement, then hidden targets."""
    return _trembled(_Still(evidence)).alongside(evidence.movement)
