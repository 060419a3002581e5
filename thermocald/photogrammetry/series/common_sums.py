"""The common unknowns of a long series, summed over its blocks of epochs.

Each block adds its normal equations with the own parameters of its epochs reduced. At the epochs'
own solution the reduced right-hand side is the plain gradient, which is summed epoch by epoch. The
matrix is that of the mean weights of all epochs that see the same targets; it differs from the sum
by the square of how much their weights vary, and costs one reduction per kind of epoch.

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

__all__ = ["Alike", "CommonSums", "Shared", "Solved", "kinds_of", "level_of"]

_FEW = 0.02  # share of a block's epochs that is worth a matrix of its own
_MOST = 12  # kinds of epochs in a block
_MOST_PATTERNS = 300  # of targets seen, over the series; the epochs of others count together


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
class _Pattern:
    """Epochs that see the same targets: how many, sums of their weights (T, 3), of their numbers,
    and of the gradients (p,) of their own parameters.
    """

    epochs: int
    weights: Array
    times: float
    right: Array


@dataclass(eq=False)
class CommonSums:
    """The sums over the blocks so far.

    at: linearisation; own (p,), common (q,): columns; own_prior (p, p) as in `SeriesSystem`; prior
    (T, 3) px⁻²: of the offsets, None without; gradient (q + 2T,); epochs, times, squares: how many,
    sums of their numbers and of the squares; ends: the first and the last.
    """

    at: Partials
    own: Columns
    common: Columns
    own_prior: Array
    prior: Array | None
    gradient: Array = field(init=False)
    epochs: int = 0
    times: float = 0.0
    squares: float = 0.0
    ends: tuple[int, int] | None = None
    patterns: dict[bytes, _Pattern] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.gradient = np.zeros(self.width)

    @property
    def width(self) -> int:
        """How many common unknowns there are."""
        return len(self.common) + (0 if self.prior is None else 2 * len(self.at.A))

    def add(self, first: int, system: SeriesSystem, left: Array, right: Array) -> None:
        """Add a block that begins at epoch `first`.

        system: of the block, its common unknowns held; left (E, T, 2) px: residuals; right (E, p):
        gradient of the own parameters, which is 0 at their solution.
        """
        good = np.flatnonzero(system.good)
        if not len(good):
            return
        t = (first + good).astype(np.float64)
        self.ends = (self.ends[0] if self.ends else int(t[0]), int(t[-1]))
        self.epochs += len(good)
        self.times += float(t.sum())
        self.squares += float(t @ t)
        if not self.width:
            return
        w = np.where(system.use[..., None], system.weights, 0.0)[good]
        v = np.nan_to_num(left[good])
        total = [right_hand_sides(w, v, self.at.A[..., self.common]).sum(axis=0)]
        if self.prior is not None:
            total.append((w[..., 0] * v[..., 0] + w[..., 2] * v[..., 1]).sum(axis=0))
            total.append((w[..., 2] * v[..., 0] + w[..., 1] * v[..., 1]).sum(axis=0))
        self.gradient += np.concatenate(total)
        seen, of = np.unique(np.packbits(system.use[good], axis=1), axis=0, return_inverse=True)
        for k, bits in enumerate(seen):
            rows = np.flatnonzero(of.ravel() == k)
            key = bits.tobytes()
            if key not in self.patterns and len(self.patterns) >= _MOST_PATTERNS:
                key = b""
            if key not in self.patterns:
                empty = np.zeros((len(self.at.A), 3)), np.zeros(len(self.own))
                self.patterns[key] = _Pattern(0, empty[0], 0.0, empty[1])
            found = self.patterns[key]
            found.epochs += len(rows)
            found.weights += w[rows].sum(axis=0)
            found.times += float(t[rows].sum())
            found.right += right[good[rows]].sum(axis=0)

    def solved(self, known: Shared) -> Solved:
        """What is known with these sums."""
        p, q, n = len(self.own), len(self.common), max(self.epochs, 1)
        normal, gradient = np.zeros((self.width, self.width)), self.gradient.copy()
        mean, tilt = np.zeros((2, p, self.width))
        kinds = []
        for pattern in self.patterns.values() if self.width else ():
            one = _typical(self, pattern.weights / pattern.epochs)
            if not one.good[0]:
                continue
            G = _sensitivity(one)
            normal += pattern.epochs * one.common_normals()
            gradient -= G.T @ pattern.right
            mean += pattern.epochs * G
            tilt += pattern.times * G
            kinds.append((G, np.sqrt(np.diag(one.Q[0]))))
        mean /= n
        if self.prior is not None:
            T, o, w = len(self.prior), known.offsets, self.prior
            x, y = np.arange(q, q + T), np.arange(q + T, q + 2 * T)
            normal[x, x] += w[:, 0]
            normal[y, y] += w[:, 1]
            normal[x, y] += w[:, 2]
            normal[y, x] += w[:, 2]
            gradient[x] -= w[:, 0] * o[:, 0] + w[:, 2] * o[:, 1]
            gradient[y] -= w[:, 2] * o[:, 0] + w[:, 1] * o[:, 1]
        cofactors = inverse_of_determined(normal)
        change = cofactors @ gradient
        offsets = known.offsets
        if self.prior is not None:
            offsets = offsets + change[q:].reshape(2, -1).T
        rest = max((float(np.max(np.abs((G - mean) @ change) / sd)) for G, sd in kinds), default=0)
        middle = self.times / n
        spread = self.squares - n * middle**2
        line = np.zeros((p, self.width))
        if spread > 0 and self.ends is not None:
            line = (tilt - middle * n * mean) / spread * (self.ends[1] - self.ends[0])
        pose = known.pose + change[:q] if q else known.pose
        return Solved(Shared(offsets, pose, cofactors, mean), -mean @ change, line, rest)


@dataclass(frozen=True, eq=False)
class Solved:
    """The common unknowns from all sums: shared; own (p,): the mean change of own parameters that
    goes with them; line (p, q + 2T): what they do to a straight line from the first to the last
    epoch; rest: by how many of their standard deviations single kinds of epochs change otherwise.
    """

    shared: Shared
    own: Array
    line: Array
    rest: float


def _typical(sums: CommonSums, weights: Array) -> SeriesSystem:
    """The system of one epoch with some weights (T, 3)."""
    w = weights[None]
    zero = None if sums.prior is None else np.zeros((len(weights), 3))
    return SeriesSystem.formed(
        sums.at, w, w[..., 0] > 0, sums.own, sums.common, zero, sums.own_prior
    )


def _sensitivity(one: SeriesSystem) -> Array:
    """G (p, q + 2T): by how much own parameters of an epoch follow the common unknowns."""
    coupling = next((C for _, C in one.couplings()), None)
    width = len(one.common) + (0 if one.prior is None else 2 * len(one.at.A))
    out: Array = np.zeros((len(one.own), width)) if coupling is None else one.Q[0] @ coupling[0]
    return out


def kinds_of(sums: CommonSums, system: SeriesSystem) -> list[Alike]:
    """The kinds of epochs of a block: the frequent ones by what they see, the others together.

    system: of the block, its common unknowns held.
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
    out = []
    for rows in groups:
        w = np.where(system.use[rows][..., None], system.weights[rows], 0.0)
        one = _typical(sums, w.mean(axis=0))
        if one.good[0]:
            out.append(Alike(rows, one, _sensitivity(one)))
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
