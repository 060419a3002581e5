"""The likelihood of a hypothesis about one series, with the thermometer's error in it.

Per epoch the evidence is a small normal matrix N_e over camera parameters. A hypothesis moves the
parameters along directions v (P,) with trajectories c (E,): Σ v c(t). Trajectories that are made
from temperatures carry the thermometer's error δ (R,) through their own operator O (E, R): what is
observed is d·O δ beside the image noise. δ is integrated out exactly (Woodbury), so neither white
nor lagged thermometer noise passes for an effect:

    S = N⁻¹ + J C Jᵀ,  J = Σ_k d_k ⊗ O_k,   S⁻¹ = N - N J (C⁻¹ + JᵀN J)⁻¹ JᵀN

The level of every parameter belongs to the series and is eliminated here.

Source: Fuller (1987), Measurement Error Models, section 3.2; Rasmussen, Williams (2006), Gaussian
Processes for Machine Learning, section 2.7 for marginalised linear terms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.reduction.series import ReducedSeries

    Array = NDArray[np.float64]

__all__ = ["NormalEquations", "ReadingErrorTerm", "Weighting", "prepare"]


@dataclass(frozen=True, eq=False)
class ReadingErrorTerm:
    """How a thermometer's error reaches the camera: d (P,) px per K·operator, O (E, R) from the
    column's independent errors (`ReducedSeries.states`), channel.

    unresolved (E,): standard deviation of the trajectory itself where the temperature bends within
    one interval, in the trajectory's unit; None where the operator resolves it.
    """

    direction: Array
    operator: Array
    channel: str
    unresolved: Array | None = None


@dataclass(frozen=True, eq=False)
class Weighting:
    """One series with a fixed covariance S: inner products of hypotheses under S⁻¹.

    b (E, P), yy: data with the readings' own deviations put in; logdet: log |C| + log |M|.
    """

    N: Array
    b: Array
    yy: float
    logdet: float
    # (R, ·) blocks: L⁻¹ Oᵀ… ; empty lists where no thermometer matters
    operators: tuple[Array, ...]
    dN: tuple[Array, ...]  # d_kᵀN_e (E, P)
    factor: Array | None
    data: Array  # L⁻¹ Jᵀ b (R,)
    level: Array  # L⁻¹ Jᵀ constants (R, P)
    level_normal: Array  # inverse-ready (P, P) of the constants, thermometer included
    level_b: Array
    level_factor: Array

    def _carried(self, trajectories: Array, directions: Array) -> Array:
        """L⁻¹ Jᵀ of regressors: trajectories (E, R), directions (P, R) → (states, R)."""
        from scipy.linalg import solve_triangular

        assert self.factor is not None
        total: Array | float = 0.0
        for operator, dN in zip(self.operators, self.dN, strict=True):
            total = total + operator.T @ ((dN @ directions) * trajectories)
        out: Array = solve_triangular(
            self.factor, np.asarray(total), lower=True, check_finite=False
        )
        return out

    def reduce(self, trajectories: Array, directions: Array) -> NormalEquations:
        """Normal equations after the levels: trajectories (E, R), directions (P, R)."""
        VNV = np.einsum("pi,epq,qj->eij", directions, self.N, directions, optimize=True)
        A = np.einsum("ei,ej,eij->ij", trajectories, trajectories, VNV, optimize=True)
        c = np.einsum("ei,ei->i", trajectories, self.b @ directions)
        K = np.einsum("epq,qi,ei->pi", self.N, directions, trajectories, optimize=True)
        if self.factor is not None:
            U = self._carried(trajectories, directions)
            A = A - U.T @ U
            c = c - U.T @ self.data
            K = K - self.level.T @ U
        return self._without_level(A, c, K)

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
            total = np.zeros((self.operators[0].shape[1], G * m, k))
            for operator, dN in zip(self.operators, self.dN, strict=True):
                h = dN @ directions
                for a in range(k):
                    total[:, :, a] += operator.T @ (s * h[:, a : a + 1])
            U = solve_triangular(
                self.factor, total.reshape(len(total), -1), lower=True, check_finite=False
            )
            Ub = self._carried(Cb, Vb)
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


def prepare(
    evidence: ReducedSeries, carried: list[ReadingErrorTerm], thermometer_factor: float = 1.0
) -> Weighting:
    """Fix the covariance of a series: image noise, and the thermometers' carried by `carried`.

    thermometer_factor: multiplies the standard deviations of the readings.
    """
    from scipy.linalg import cholesky, solve_triangular

    N, b = evidence.N, evidence.b
    P = N.shape[1]
    yy = float(evidence.yy.sum())
    k0, N0 = b.sum(axis=0), N.sum(axis=0)
    if not carried:
        F = _level_factor(N0)
        return Weighting(N, b, yy, 0.0, (), (), None, np.zeros(0), np.zeros((0, P)), N0, k0, F)
    names = list(dict.fromkeys(c.channel for c in carried))
    sizes = [len(evidence.state_sd(n)) for n in names]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    sd = np.concatenate([evidence.state_sd(n) for n in names]) * thermometer_factor
    deviation = np.concatenate([evidence.state_deviation(n) for n in names])
    operators = []
    for item in carried:
        operator = np.zeros((len(N), starts[-1]))
        i = names.index(item.channel)
        operator[:, starts[i] : starts[i + 1]] = item.operator
        operators.append(operator)
    N, b, yy, logdet = _blurred(N, b, yy, carried)
    N0 = N.sum(axis=0)
    dN = [np.einsum("p,epq->eq", item.direction, N) for item in carried]
    # the readings' own deviation from the smooth trajectory, carried to the camera
    shift = np.zeros((len(N), P))
    for item, operator in zip(carried, operators, strict=True):
        shift += np.outer(operator @ deviation, item.direction)
    Nshift = np.einsum("epq,eq->ep", N, shift)
    yy = yy - 2 * float(np.sum(shift * b)) + float(np.sum(shift * Nshift))
    b = b - Nshift
    k0 = b.sum(axis=0)
    M = np.diag(1.0 / sd**2)
    for i, (Oi, item) in enumerate(zip(operators, carried, strict=True)):
        for j, Oj in enumerate(operators):
            if j < i:
                continue
            weight = dN[i] @ carried[j].direction
            part = Oi.T @ (weight[:, None] * Oj)
            M += part if i == j else part + part.T
        del item
    factor = cholesky(M, lower=True, check_finite=False)
    logdet += 2 * float(np.sum(np.log(np.diag(factor)))) + 2 * float(np.sum(np.log(sd)))
    right = np.zeros((starts[-1], P + 1))
    for operator, w, item in zip(operators, dN, carried, strict=True):
        right[:, :P] += operator.T @ w
        right[:, P] += operator.T @ (b @ item.direction)
    right = solve_triangular(factor, right, lower=True, check_finite=False)
    level, data = right[:, :P], right[:, P]
    N0 = N0 - level.T @ level
    k0 = k0 - level.T @ data
    return Weighting(
        N, b, yy - float(data @ data), logdet, tuple(operators), tuple(dN), factor, data, level,
        N0, k0, _level_factor(N0),
    )  # fmt: skip


def _blurred(
    N: Array, b: Array, yy: float, carried: list[ReadingErrorTerm]
) -> tuple[Array, Array, float, float]:
    """Per epoch, the variance of unresolved trajectories is added (Sherman-Morrison)."""
    logdet = 0.0
    for item in carried:
        if item.unresolved is None or not item.unresolved.any():
            continue
        d, variance = item.direction, item.unresolved**2
        Nd = N @ d
        gain = variance / (1.0 + variance * (Nd @ d))
        db = b @ d
        logdet += float(np.sum(np.log1p(variance * (Nd @ d))))
        yy -= float(np.sum(gain * db**2))
        b = b - (gain * db)[:, None] * Nd
        N = N - gain[:, None, None] * Nd[:, :, None] * Nd[:, None, :]
    return N, b, yy, logdet


def _level_factor(N0: Array) -> Array:
    """Cholesky factor; the levels that the field cannot tell apart are held by 1000 px, or as
    loosely as rounding lets them.
    """
    held = 1e-6 + 1e-13 * float(np.trace(N0))
    factor = np.linalg.cholesky(N0 + held * np.eye(len(N0)))
    return np.asarray(factor, dtype=float)
