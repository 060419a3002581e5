"""The common unknowns of a long series, summed over its blocks of epochs.

Each block adds its normal equations with the own parameters of its epochs reduced. At the epochs'
own solution the reduced right-hand side is the plain gradient, which is summed epoch by epoch; the
matrix is that of the mean weights of epochs that see the same targets, which differs from the sum
by the square of how much weights vary, and takes a hundredth of the time.

Source: Helmert blocking, Wolf, H. (1978): The Helmert block method.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import inverse_of_determined, root_of
from thermocald.photogrammetry.series.normals import right_hand_sides
from thermocald.photogrammetry.series.system import SeriesSystem

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.photogrammetry.series.normals import Partials

    Array = NDArray[np.float64]
    Mask = NDArray[np.bool_]
    Columns = NDArray[np.int64]

__all__ = ["Alike", "CommonSums", "Shared", "kinds_of", "level_of"]

_FEW = 0.02  # share of a block's epochs that is worth a matrix of its own
_MOST = 12  # kinds of epochs in a block
_MOST_KEPT = 40  # kinds of which the last change is checked


@dataclass(frozen=True, eq=False)
class Shared:
    """What is known of the common unknowns: offsets (T, 2) px, pose (6,), their cofactors (q + 2T,
    q + 2T), the mean G (p, q + 2T) by which own parameters follow an error of theirs.
    """

    offsets: Array
    pose: Array
    cofactors: Array
    mean: Array


@dataclass(frozen=True, eq=False)
class Alike:
    """Epochs of a block that see nearly the same targets: rows (n,), system of one epoch with their
    mean weights, G (p, q + 2T): by how much own parameters follow the common unknowns.
    """

    rows: Columns
    system: SeriesSystem
    G: Array


@dataclass(eq=False)
class CommonSums:
    """The sums over the blocks so far.

    q: common parameters beside the offsets; normal (q + 2T, q + 2T), gradient (q + 2T,); mean, tilt
    (p, q + 2T): sums of G and of G times the epoch; epochs, times, squares: how many, sums of the
    epochs' numbers and their squares; kinds: G of each kind of epoch that was seen.
    """

    q: int
    width: int
    own: int
    normal: Array = field(init=False)
    gradient: Array = field(init=False)
    mean: Array = field(init=False)
    tilt: Array = field(init=False)
    epochs: int = 0
    times: float = 0.0
    squares: float = 0.0
    ends: tuple[int, int] | None = None
    kinds: list[tuple[Array, Array]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.normal = np.zeros((self.width, self.width))
        self.gradient = np.zeros(self.width)
        self.mean, self.tilt = np.zeros((self.own, self.width)), np.zeros((self.own, self.width))

    def add(self, first: int, kinds: list[Alike], system: SeriesSystem, left: Array,
            right: Array) -> None:  # fmt: skip
        """Add a block that begins at epoch `first`.

        system: of the block, its common unknowns held; left (E, T, 2) px: residuals; right (E, p):
        gradient of the own parameters, which is 0 at their solution.
        """
        good = np.flatnonzero(system.good)
        if not len(good):
            return
        self.ends = (self.ends[0] if self.ends else first + int(good[0]), first + int(good[-1]))
        if not self.width:
            return
        common = kinds[0].system.common
        w = np.where(system.use[..., None], system.weights, 0.0)[good]
        v = np.nan_to_num(left[good])
        b = right_hand_sides(w, v, system.at.A[..., common]).sum(axis=0)
        total = [b]
        if self.width > self.q:
            total.append((w[..., 0] * v[..., 0] + w[..., 2] * v[..., 1]).sum(axis=0))
            total.append((w[..., 2] * v[..., 0] + w[..., 1] * v[..., 1]).sum(axis=0))
        self.gradient += np.concatenate(total)
        for kind in kinds:
            n, t = len(kind.rows), (first + kind.rows).astype(np.float64)
            self.normal += n * kind.system.common_normals()
            self.gradient -= kind.G.T @ right[kind.rows].sum(axis=0)
            self.mean += n * kind.G
            self.tilt += t.sum() * kind.G
            self.epochs, self.times = self.epochs + n, self.times + float(t.sum())
            self.squares += float(t @ t)
            new = all(not np.allclose(kind.G, G, rtol=0.02, atol=1e-12) for G, _ in self.kinds)
            if new and len(self.kinds) < _MOST_KEPT:
                self.kinds.append((kind.G, np.sqrt(np.diag(kind.system.Q[0]))))

    def solved(self, known: Shared, prior: Array | None) -> tuple[Shared, Array, float]:
        """What is known with these sums, the mean change (p,) of own parameters that goes with it,
        and by how many of their standard deviations single epochs change otherwise.

        prior (T, 3) px⁻²: of the offsets, in the units of the weights.
        """
        if not self.width or not self.epochs:
            return known, np.zeros(self.own), 0.0
        normal, gradient, q = self.normal.copy(), self.gradient.copy(), self.q
        if prior is not None:
            T = len(prior)
            x, y = np.arange(q, q + T), np.arange(q + T, q + 2 * T)
            normal[x, x] += prior[:, 0]
            normal[y, y] += prior[:, 1]
            normal[x, y] += prior[:, 2]
            normal[y, x] += prior[:, 2]
            o = known.offsets
            gradient[x] -= prior[:, 0] * o[:, 0] + prior[:, 2] * o[:, 1]
            gradient[y] -= prior[:, 2] * o[:, 0] + prior[:, 1] * o[:, 1]
        cofactors = inverse_of_determined(normal)
        change = cofactors @ gradient
        mean = self.mean / self.epochs
        offsets = known.offsets
        if prior is not None:
            offsets = offsets + change[q:].reshape(2, -1).T
        new = Shared(offsets, known.pose + (change[:6] if q else 0.0), cofactors, mean)
        rest = max(
            (float(np.max(np.abs((G - mean) @ change) / sd)) for G, sd in self.kinds), default=0.0
        )
        return new, -mean @ change, rest

    def line(self) -> Array:
        """Covariance root (p, q + 2T) of a straight line from the first to the last epoch: what
        common unknowns with unit errors do to it.
        """
        if not self.epochs or self.ends is None:
            return np.zeros((self.own, self.width))
        middle = self.times / self.epochs
        spread = self.squares - self.epochs * middle**2
        if spread <= 0:
            return np.zeros((self.own, self.width))
        out: Array = (self.tilt - middle * self.mean) / spread * (self.ends[1] - self.ends[0])
        return out


def kinds_of(system: SeriesSystem, common: Columns, targets: bool, at: Partials) -> list[Alike]:
    """The kinds of epochs of a block: the frequent ones by what they see, the others together.

    system: of the block, its common unknowns held; targets: whether offsets are common unknowns.
    """
    good = np.flatnonzero(system.good)
    if not len(good):
        return []
    seen = np.packbits(system.use[good], axis=1)
    _, of, count = np.unique(seen, axis=0, return_inverse=True, return_counts=True)
    of = of.ravel()
    often = np.argsort(-count, kind="stable")[:_MOST]
    often = often[count[often] >= max(_FEW * len(good), 2)]
    groups = [good[of == label] for label in often]
    rest = good[~np.isin(of, often)]
    if len(rest):
        groups.append(rest)
    zero = np.zeros((len(at.A), 3)) if targets else None
    out = []
    for rows in groups:
        w = np.where(system.use[rows][..., None], system.weights[rows], 0.0).mean(axis=0)[None]
        one = SeriesSystem.formed(at, w, w[..., 0] > 0, system.own, common, zero, system.own_prior)
        if not one.good[0]:
            continue
        coupling = [C for _, C in one.couplings()]
        width = len(common) + (2 * len(at.A) if targets else 0)
        G = one.Q[0] @ coupling[0][0] if coupling else np.zeros((len(system.own), width))
        out.append(Alike(rows, one, G))
    return out


def level_of(known: Shared, own: Columns, common: Columns) -> Array:
    """Cofactors (16, 16) of what all epochs have in common."""
    width = len(known.cofactors)
    out = np.zeros((16, 16))
    if not width:
        return out
    root = root_of(known.cofactors)
    whole = np.zeros((16, width))
    whole[common] = root[: len(common)]
    whole[own] -= known.mean @ root
    level: Array = whole @ whole.T
    return level
