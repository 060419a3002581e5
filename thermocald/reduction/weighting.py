"""One series under a fixed covariance: inner products of trajectories, alone or many at once.

What is integrated out (`likelihood`) stands in one triangular factor; trajectories are whitened by
it, one by one where they are few, else through the epochs, which all trajectories share.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.reduction.couplings import Couplings

__all__ = ["NormalEquations", "Weighting"]

_MANY = 0.15  # trajectories per epoch from which on epochs are whitened, for all that follow


@dataclass(frozen=True, eq=False)
class Weighting:
    """One series with a fixed covariance S: inner products of hypotheses under S⁻¹.

    b (E, P), yy: data with the readings' own deviations put in; logdet: log |C| + log |M|. effects:
    couplings of the F random effects with the epochs' parameters; they are the first F states, of
    which the mount's movement has the first `moving`; those of the readings follow.
    """

    N: Array
    b: Array
    yy: float
    logdet: float
    # (R, ·) blocks: L⁻¹ Oᵀ… ; empty lists where no thermometer matters
    operators: tuple[Array, ...]
    places: tuple[slice, ...]  # of their states
    directions: tuple[Array, ...]  # d_k (P,)
    dN: tuple[Array, ...]  # d_kᵀN_e (E, P)
    moving: int
    effects: Couplings
    factor: Array | None
    data: Array  # L⁻¹ Jᵀ b (R,)
    level: Array  # L⁻¹ Jᵀ constants (R, P)
    level_normal: Array  # inverse-ready (P, P) of the constants, thermometer included
    level_b: Array
    level_factor: Array
    kept: dict[bytes, Array] = field(default_factory=dict)  # of `by_epoch`

    def carried(self, trajectories: Array, directions: Array) -> Array:
        """L⁻¹ Jᵀ of regressors: trajectories (E, R), directions (P, R) → (states, R)."""
        from scipy.linalg import solve_triangular

        assert self.factor is not None
        total = np.zeros((len(self.factor), trajectories.shape[1]))
        for operator, at, dN in zip(self.operators, self.places, self.dN, strict=True):
            total[at] += operator.T @ ((dN @ directions) * trajectories)
        if len(self.effects):
            total[: len(self.effects)] = self.effects.driven(trajectories, directions)
        out: Array = solve_triangular(self.factor, total, lower=True, check_finite=False)
        return out

    def carried_stack(self, s: Array, directions: Array) -> Array:
        """L⁻¹ Jᵀ of every trajectory (E, G) along every direction (P, k) → (states, G k)."""
        E, G = s.shape
        if G < _MANY * E:
            columns = np.repeat(s, directions.shape[1], axis=1)
            return self.carried(columns, np.tile(directions, G))
        parts = [self.by_epoch(d) @ s for d in directions.T]
        return np.stack(parts, axis=2).reshape(len(parts[0]), -1)

    def by_epoch(self, direction: Array) -> Array:
        """L⁻¹ Jᵀ (states, E) of shifts of single epochs along a direction (P,); kept."""
        from scipy.linalg import solve_triangular

        key = direction.tobytes()
        if key not in self.kept:
            assert self.factor is not None
            total = np.zeros((len(self.factor), len(self.N)))
            for operator, at, dN in zip(self.operators, self.places, self.dN, strict=True):
                total[at] += (operator * (dN @ direction)[:, None]).T
            if len(self.effects):
                total[: len(self.effects)] = self.effects.along(direction)
            self.kept[key] = solve_triangular(
                self.factor, total, lower=True, overwrite_b=True, check_finite=False
            )
        return self.kept[key]

    def weighted(self, parameters: Array) -> Array:
        """Images (E, P, R) of trajectories of all parameters (E, P, R) under S⁻¹ after the levels:
        their sums along other trajectories are inner products.
        """
        from scipy.linalg import cho_solve, solve_triangular

        b: Array = self.N @ parameters
        level_b, carried = b.sum(axis=0), None
        if self.factor is not None:
            right = np.zeros((len(self.factor), b.shape[2]))
            for operator, at, d in zip(self.operators, self.places, self.directions, strict=True):
                right[at] += operator.T @ (d @ b)
            right[: len(self.effects)] = self.effects.onto(parameters)
            carried = solve_triangular(self.factor, right, lower=True, check_finite=False)
            level_b = level_b - self.level.T @ carried
        level = cho_solve((self.level_factor, True), level_b)
        b = b - self.N @ level
        if carried is not None:
            left = carried - self.level @ level
            states = solve_triangular(self.factor, left, lower=True, trans=1, check_finite=False)
            for operator, at, dN in zip(self.operators, self.places, self.dN, strict=True):
                b -= dN[:, :, None] * (operator @ states[at])[:, None, :]
            b -= self.effects.images(states[: len(self.effects)])
        return b

    def joint(self, trajectories: Array, directions: Array) -> tuple[Array, Array, Array]:
        """Normal equations alongside the levels: A (R, R), c (R,), K (P, R).

        trajectories (E, R), directions (P, R); K couples them with the levels, whose own normal
        equations are `level_normal` and `level_b`.
        """
        NV = self.N @ directions
        VNV = directions.T @ NV
        A = np.sum(VNV * trajectories[:, :, None] * trajectories[:, None, :], axis=0)
        c = np.einsum("ei,ei->i", trajectories, self.b @ directions)
        K = np.einsum("epi,ei->pi", NV, trajectories)
        if self.factor is not None:
            U = self.carried(trajectories, directions)
            A = A - U.T @ U
            c = c - U.T @ self.data
            K = K - self.level.T @ U
        return A, c, K

    def reduce(self, trajectories: Array, directions: Array) -> NormalEquations:
        """Normal equations after the levels: trajectories (E, R), directions (P, R)."""
        return self._without_level(*self.joint(trajectories, directions))

    def _without_level(self, A: Array, c: Array, K: Array) -> NormalEquations:
        from scipy.linalg import solve_triangular

        Q = solve_triangular(self.level_factor, np.column_stack([K, self.level_b]), lower=True)
        q = Q[:, -1]
        Q = Q[:, :-1]
        return NormalEquations(A - Q.T @ Q, c - Q.T @ q, self.yy - float(q @ q), self.logdet)

    def scan(
        self, trajectories: Array, directions: Array, base: tuple[Array, Array]
    ) -> tuple[Array, Array, Array]:
        """Many candidates at once: trajectories (G, E, m), directions (P, k); m·k columns each.

        base: trajectories (E, R), directions (P, R) of what the model holds already.
        Returns, after the levels: A (G, mk, mk), c (G, mk), cross with the base (G, mk, R).
        """
        from scipy.linalg import solve_triangular

        G, E, m = trajectories.shape
        P, k = directions.shape
        s = np.moveaxis(trajectories, 0, 1).reshape(E, G * m)  # candidate by candidate
        NV = self.N @ directions  # (E, P, k)
        VNV = np.einsum("pa,epb->eab", directions, NV)
        pairs = np.einsum("gem,gen->egmn", trajectories, trajectories).reshape(E, -1)
        A = (pairs.T @ VNV.reshape(E, -1)).reshape(G, m, m, k, k)
        A = A.transpose(0, 1, 3, 2, 4).reshape(G, m * k, m * k)
        c = (s.T @ (self.b @ directions)).reshape(G, m * k)
        by_course = (s.T @ NV.reshape(E, -1)).reshape(G * m, P, k)
        K: Array = by_course.transpose(1, 0, 2).reshape(P, G * m * k)
        Cb, Vb = base
        R = Cb.shape[1]
        cross_weights: Array = np.einsum("epa,pr,er->ear", NV, Vb, Cb, optimize=True)
        B = (s.T @ cross_weights.reshape(E, -1)).reshape(G, m * k, R)
        Kb = np.einsum("epq,qi,ei->pi", self.N, Vb, Cb, optimize=True)
        U = None
        if self.factor is not None:
            U = self.carried_stack(s, directions)
            Ub = self.carried(Cb, Vb)
            Ug = U.reshape(len(U), G, m * k)
            A = A - np.einsum("rgi,rgj->gij", Ug, Ug, optimize=True)
            c = c - (U.T @ self.data).reshape(G, m * k)
            B = B - (U.T @ Ub).reshape(G, m * k, R)
            K = K - self.level.T @ U
            Kb = Kb - self.level.T @ Ub
        Q = solve_triangular(self.level_factor, np.column_stack([K, Kb, self.level_b]), lower=True)
        n = G * m * k
        Qg = Q[:, :n].reshape(P, G, m * k)
        A = A - np.einsum("pgi,pgj->gij", Qg, Qg, optimize=True)
        c = c - (Q[:, :n].T @ Q[:, -1]).reshape(G, m * k)
        B = B - (Q[:, :n].T @ Q[:, n:-1]).reshape(G, m * k, R)
        return A, c, B


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations after the levels: A (R, R), c (R,), yy, logdet."""

    A: Array
    c: Array
    yy: float
    logdet: float
