"""Condensed evidence: what a trajectory of a few parameters would explain, by two products.

The likelihood of the base model is a quadratic form in any further trajectory of the camera's
parameters; on rows of neighbouring epochs, with levels and the base's own rates eliminated, its
matrix is a few hundred square. Its root whitens trajectory and data once, and thousands of
candidates cost milliseconds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.reduction.series import COLUMNS
from thermocald.simulation.history import History

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array
    from thermocald.reduction.fit import HypothesisFitter
    from thermocald.reduction.hypothesis import Fit
    from thermocald.reduction.series import ReducedSeries
    from thermocald.reduction.weighting import Weighting

__all__ = ["Condensed", "condensed"]

_ROWS = 90  # of one series
_KNOTS = 400
_NULL = 1e-9  # of the largest eigenvalue: levels, the base's own rates


@dataclass(frozen=True, eq=False)
class Condensed:
    """Series on few rows, whitened.

    histories: one per series, asked for the rows' times; edges: where each series begins among the
    rows; root (k, rows, r): whitens trajectories of each parameter; data (r,), whitened; amplitude
    (k, rows): the trajectories that the data have themselves, px-scaled; epochs: how many the
    series hold.
    """

    histories: tuple[History, ...]
    edges: tuple[int, ...]
    root: Array
    data: Array
    amplitude: Array
    epochs: int

    def gains(self, trajectories: Array) -> Array:
        """χ² (G,) that trajectories (rows, G) explain, each in all parameters together."""
        Z = self.regressors(trajectories)
        out: Array = np.sum((Z @ self.data) ** 2, axis=1)
        return out

    def gains_of(self, regressors: Array, data: Array) -> Array:
        """The same (G, S) for other data (r, S), from `regressors` (G, k, r)."""
        G, k, r = regressors.shape
        out: Array = ((regressors.reshape(G * k, r) @ data) ** 2).reshape(G, k, -1).sum(axis=1)
        return out

    def whitened(self, trajectories: Array) -> Array:
        """Trajectories (rows, G) in each parameter, whitened: (G, k, r)."""
        s = trajectories - trajectories.mean(axis=0)
        return np.stack([s.T @ part for part in self.root], axis=1)

    def regressors(self, trajectories: Array) -> Array:
        """Orthonormal whitened regressors (G, k, r) of trajectories (rows, G)."""
        s = trajectories - trajectories.mean(axis=0)
        Z = self.whitened(s / np.maximum(np.abs(s).max(axis=0), 1e-300))
        Z /= np.maximum(np.linalg.norm(Z, axis=2, keepdims=True), 1e-9)
        own = Z @ np.swapaxes(Z, 1, 2) + 1e-7 * np.eye(Z.shape[1])
        out: Array = np.linalg.inv(np.linalg.cholesky(own)) @ Z
        return out

    def beside(self, trajectory: Array) -> Condensed:
        """The same when a trajectory (rows,) is in the model already."""
        Q = self.regressors(trajectory[:, None])[0].T
        root = self.root - (self.root @ Q) @ Q.T
        return replace(self, root=root, data=self.data - Q @ (Q.T @ self.data))

    @property
    def power(self) -> float:
        """χ² of everything that the base model leaves in these parameters."""
        return float(self.data @ self.data)

    def surrogates(self, count: int, rng: np.random.Generator) -> Array:
        """Whitened data (r, count) whose trajectories are moved in time against what was recorded.

        Each series by itself: shifted in a circle, half of them reversed, half turned in sign. So
        they are as smooth as the misfit, and their cause was not recorded.
        """
        out = np.zeros((len(self.data), count))
        for i in range(count):
            moved = np.empty_like(self.amplitude)
            for begin, end in zip(self.edges[:-1], self.edges[1:], strict=True):
                n = end - begin
                part = np.roll(self.amplitude[:, begin:end], rng.integers(n // 8, n - n // 8), 1)
                part = part[:, ::-1] if rng.random() < 0.5 else part
                moved[:, begin:end] = part if rng.random() < 0.5 else -part
            out[:, i] = np.einsum("ker,ke->r", self.root, moved)
        return out


def condensed(
    fitter: HypothesisFitter,
    fit: Fit,
    parameters: Sequence[str],
    weightings: Sequence[Weighting] | None = None,
) -> Condensed:
    """Condense the evidence of all series about some parameters, beside a fitted hypothesis.

    weightings: covariances of another hypothesis, whose reading errors are nearer to the truth.
    """
    k, K = len(parameters), len(fit.coefficients)
    directions = np.zeros((len(COLUMNS), k))
    for j, name in enumerate(parameters):
        directions[COLUMNS.index(name), j] = 1.0
    pools = [_pool(e) for e in fitter.series]
    counts = [p.shape[1] for p in pools]
    edges = np.concatenate([[0], np.cumsum(counts)])
    rows = int(edges[-1])
    A = np.zeros((k, rows, k, rows))
    c = np.zeros((k, rows))
    B, base, right = np.zeros((k, rows, K)), np.zeros((K, K)), np.zeros(K)
    for s, (pool, m) in enumerate(zip(pools, counts, strict=True)):
        C, V, index = fit.designs[s]
        trajectories = np.hstack([np.tile(pool, k), C])
        found = (weightings or fit.weightings)[s].reduce(
            trajectories, np.hstack([np.repeat(directions, m, axis=1), V])
        )
        n, at = k * m, slice(edges[s], edges[s + 1])
        A[:, at, :, at] = found.A[:n, :n].reshape(k, m, k, m)
        c[:, at] = found.c[:n].reshape(k, m)
        B[:, at, index] = found.A[:n, n:].reshape(k, m, -1)
        base[np.ix_(index, index)] += found.A[n:, n:]
        right[index] += found.c[n:]
    X = np.linalg.solve(base, np.column_stack([right, B.reshape(-1, K).T]))
    Q = A.reshape(k * rows, -1) - B.reshape(-1, K) @ X[:, 1:]
    y = c.ravel() - B.reshape(-1, K) @ X[:, 0]
    size, U = np.linalg.eigh(0.5 * (Q + Q.T))
    kept = size > _NULL * size[-1]
    size, U = size[kept], U[:, kept]
    held = 0.1 * float(np.median(size))
    amplitude = U @ (U.T @ y / (size + held))
    return Condensed(
        tuple(_history(e, p) for e, p in zip(fitter.series, pools, strict=True)),
        tuple(int(i) for i in edges),
        (U * np.sqrt(size)).reshape(k, rows, -1),
        U.T @ y / np.sqrt(size),
        amplitude.reshape(k, rows),
        sum(int((e.n > 0).sum()) for e in fitter.series),
    )


def _pool(e: ReducedSeries) -> Array:
    """Which of the rows each epoch belongs to, (E, m)."""
    E = len(e.times)
    size = int(np.ceil(E / _ROWS))
    group = np.arange(E) // size
    out: Array = (group[:, None] == np.arange(group[-1] + 1)).astype(float)
    return out


def _history(e: ReducedSeries, pool: Array) -> History:
    """The history at the rows' mean times, on some hundred knots."""
    h = e.history
    knots = h.polygon().times
    knots = knots[:: int(np.ceil(len(knots) / _KNOTS))]
    readings = {name: h.polygon(name).at(knots) for name in h.readings}
    times = (e.times @ pool) / pool.sum(axis=0)
    return History(times, knots, readings, h.reference, h.T0, h.columns)
