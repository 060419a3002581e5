"""The likelihood of a hypothesis for a series, including the thermometers' errors.

For each epoch, the evidence is a small normal matrix N_e of the camera's parameters. A hypothesis
moves the parameters along directions v (P,) with trajectories c (E,): Σ v c(t). A trajectory
computed from temperatures propagates the thermometer's error δ (R,) through its operator O (E, R),
which adds d·O δ to the image noise. δ is integrated out exactly (Woodbury), so that neither white
nor lagged thermometer noise is mistaken for an effect:

    S = N⁻¹ + J C Jᵀ,  J = Σ_k d_k ⊗ O_k,   S⁻¹ = N - N J (C⁻¹ + JᵀN J)⁻¹ JᵀN

The level of every parameter belongs to the series and is eliminated here. The offsets of targets
that are hidden for long (if these were fixed, a target that reappears would bias the camera) and
the camera's slow movement on its mount (a random walk, possibly bounded, in the well-determined
combinations of the camera's parameters) are random effects, which are integrated out with δ.
Random shifts of single epochs, due to trembling or to a temperature between two readings, are part
of the noise.

All that is integrated out forms one triangular factor, which whitens trajectories: one by one if
they are few, otherwise through the epochs, which all trajectories share.

Source: Fuller (1987), Measurement Error Models, section 3.2; Patterson, Thompson (1971), Biometrika
58, 545-554 (variance components); Rasmussen, Williams (2006), Gaussian Processes for Machine
Learning, section 2.7 for marginalised linear terms.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.thermal.series import Carried, ReducedSeries


@dataclass(frozen=True, eq=False)
class Sums:
    """The normal equations of a series, and of its hidden targets, before the integration.

    N (E, P, P), b (E, P), yy: of the epochs' parameters; logdet: of the epochs' random shifts;
    cross (S, E, P), normal (S, S), right (S,): of the offsets of hidden targets.
    """

    N: Array
    b: Array
    yy: float
    logdet: float
    cross: Array
    normal: Array
    right: Array

    def blurred(self, D: Array, epochs: NDArray[np.int64]) -> Sums:
        """Add random shifts of some epochs (n,), of unit variance, along D (n, P, t): Woodbury."""
        N, b = self.N[epochs], self.b[epochs]
        Dt = np.swapaxes(D, 1, 2)
        DtN = Dt @ N
        L = np.linalg.cholesky(np.eye(D.shape[2]) + DtN @ D)
        own = np.linalg.solve(L, DtN)  # (n, t, P)
        data = np.linalg.solve(L, Dt @ b[..., None])  # (n, t, 1)
        coupled = np.linalg.solve(L, Dt) @ np.moveaxis(self.cross[:, epochs], 0, 2)  # (n, t, S)
        whole, right, cross = self.N.copy(), self.b.copy(), self.cross.copy()
        whole[epochs] -= np.swapaxes(own, 1, 2) @ own
        right[epochs] -= np.sum(own * data, axis=1)
        cross[:, epochs] -= np.moveaxis(np.swapaxes(coupled, 1, 2) @ own, 1, 0)
        wide = coupled.reshape(data.size, len(cross))
        logdet = self.logdet + 2 * float(np.sum(np.log(np.einsum("eii->ei", L))))
        return Sums(
            whole, right, self.yy - float(np.sum(data**2)), logdet, cross,
            self.normal - wide.T @ wide, self.right - wide.T @ data.ravel(),
        )  # fmt: skip


@lru_cache(maxsize=4)
def sum_series(evidence: ReducedSeries) -> Sums:
    """Sum a series with its hidden targets and its tremble from epoch to epoch."""
    hidden = evidence.hidden
    E, P = evidence.b.shape
    cross, normal, right = np.zeros((0, E, P)), np.zeros((0, 0)), np.zeros(0)
    if hidden is not None:
        cross, normal, right = hidden.cross, np.diag(hidden.normal), hidden.right.sum(axis=1)
    sums = Sums(evidence.N, evidence.b, float(evidence.yy.sum()), 0.0, cross, normal, right)
    if evidence.tremble is None:
        return sums
    D = np.broadcast_to(evidence.tremble, (E, *evidence.tremble.shape))
    return sums.blurred(D, np.arange(E))


_MANY = 0.15  # trajectories per epoch above which the epochs are whitened, once for all


@dataclass(frozen=True, eq=False)
class Weighting:
    """A series with a fixed covariance S: inner products of trajectories under S⁻¹.

    b (E, P), yy: data, corrected for the readings' deviations; logdet: log |C| + log |M|. The
    states are the S offsets of hidden targets, the amplitudes of the mount's movement (`moving`),
    and the errors of the readings.
    """

    N: Array
    b: Array
    yy: float
    logdet: float
    cross: Array  # couplings (S, E, P) of the offsets of hidden targets
    # for each direction of the movement and each error term: operator (E, states), slice of its
    # states, d (P,), dᵀN_e (E, P)
    errors: tuple[tuple[Array, slice, Array, Array], ...]
    moving: slice
    factor: Array  # L (states, states), lower
    data: Array  # L⁻¹ Jᵀ b (R,)
    level: Array  # L⁻¹ Jᵀ constants (R, P)
    level_normal: Array  # normal matrix (P, P) of the constants, with the thermometers' errors
    level_b: Array
    level_factor: Array
    kept: dict[bytes, Array] = field(default_factory=dict)  # {direction: see `carried_stack`}

    def left(self, parameters: Array) -> Array:
        """Return the right-hand sides (E, P) after a movement (E, P) of the parameters."""
        return np.asarray(self.b - np.einsum("epq,eq->ep", self.N, parameters))

    def carried(self, trajectories: Array, directions: Array) -> Array:
        """Return L⁻¹ Jᵀ (states, R) of trajectories (E, R) along directions (P, R)."""
        total = np.zeros((len(self.factor), trajectories.shape[1]))
        for operator, at, _, dN in self.errors:
            total[at] += operator.T @ ((dN @ directions) * trajectories)
        if len(self.cross):
            shifts = trajectories[:, None, :] * directions
            total[: len(self.cross)] = np.tensordot(self.cross, shifts, axes=([1, 2], [0, 1]))
        return whiten(self.factor, total)

    def carried_stack(self, s: Array, directions: Array) -> Array:
        """Return L⁻¹ Jᵀ (states, G k) of every trajectory (E, G) along every direction (P, k)."""
        E, G = s.shape
        if G < _MANY * E:
            columns = np.repeat(s, directions.shape[1], axis=1)
            return self.carried(columns, np.tile(directions, G))
        parts = []
        for direction in directions.T:
            key = direction.tobytes()
            if key not in self.kept:  # L⁻¹ Jᵀ (states, E) of shifts of single epochs
                total = np.zeros((len(self.factor), E))
                for operator, at, _, dN in self.errors:
                    total[at] += (operator * (dN @ direction)[:, None]).T
                total[: len(self.cross)] = self.cross @ direction
                self.kept[key] = whiten(self.factor, total)
            parts.append(self.kept[key] @ s)
        return np.stack(parts, axis=2).reshape(len(parts[0]), -1)

    def weighted(self, parameters: Array) -> Array:
        """Return S⁻¹ times movements (E, P, R) of all parameters, after the levels, (E, P, R).

        Their sums along other movements are inner products.
        """
        from scipy.linalg import cho_solve

        b: Array = self.N @ parameters
        right, few = np.zeros((len(self.factor), b.shape[2])), len(self.cross)
        for operator, at, d, _ in self.errors:
            right[at] += operator.T @ (d @ b)
        right[:few] = np.tensordot(self.cross, parameters, axes=([1, 2], [0, 1]))
        carried = whiten(self.factor, right)
        level_b = b.sum(axis=0) - self.level.T @ carried
        level = cho_solve((self.level_factor, True), level_b)
        b = b - self.N @ level
        states = whiten(self.factor, carried - self.level @ level, transposed=True)
        for operator, at, _, dN in self.errors:
            b -= dN[:, :, None] * (operator @ states[at])[:, None, :]
        return b - np.tensordot(self.cross, states[:few], axes=(0, 0))

    def joint(self, trajectories: Array, directions: Array) -> tuple[Array, Array, Array]:
        """Return normal equations A (R, R), c (R,) and their coupling K (P, R) with the levels.

        trajectories (E, R), directions (P, R); the levels' own normal equations are `level_normal`
        and `level_b`.
        """
        NV = self.N @ directions
        VNV = directions.T @ NV
        A = np.sum(VNV * trajectories[:, :, None] * trajectories[:, None, :], axis=0)
        c = np.einsum("ei,ei->i", trajectories, self.b @ directions)
        K = np.einsum("epi,ei->pi", NV, trajectories)
        U = self.carried(trajectories, directions)
        return A - U.T @ U, c - U.T @ self.data, K - self.level.T @ U

    def reduce(self, trajectories: Array, directions: Array) -> tuple[Array, Array, float]:
        """Return normal equations A (R, R), c (R,), yy after elimination of the levels.

        trajectories (E, R), directions (P, R).
        """
        A, c, K = self.joint(trajectories, directions)
        Q = whiten(self.level_factor, np.column_stack([K, self.level_b]))
        Q, q = Q[:, :-1], Q[:, -1]
        return A - Q.T @ Q, c - Q.T @ q, self.yy - float(q @ q)

    def scan(
        self, trajectories: Array, directions: Array, base: tuple[Array, Array]
    ) -> tuple[Array, Array, Array]:
        """Return the normal equations of many candidates, after elimination of the levels.

        trajectories (G, E, m), directions (P, k): of the candidates, with m·k columns each; base:
        trajectories (E, R), directions (P, R) of the model so far. Returns A (G, mk, mk), c (G,
        mk), and the coupling with the base (G, mk, R).
        """
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
        U, Ub = self.carried_stack(s, directions), self.carried(Cb, Vb)
        Ug = U.reshape(len(U), G, m * k)
        A = A - np.einsum("rgi,rgj->gij", Ug, Ug, optimize=True)
        c = c - (U.T @ self.data).reshape(G, m * k)
        B = B - (U.T @ Ub).reshape(G, m * k, R)
        K = K - self.level.T @ U
        Kb = Kb - self.level.T @ Ub
        Q = whiten(self.level_factor, np.column_stack([K, Kb, self.level_b]))
        n = G * m * k
        Qg = Q[:, :n].reshape(P, G, m * k)
        A = A - np.einsum("pgi,pgj->gij", Qg, Qg, optimize=True)
        c = c - (Q[:, :n].T @ Q[:, -1]).reshape(G, m * k)
        B = B - (Q[:, :n].T @ Q[:, n:-1]).reshape(G, m * k, R)
        return A, c, B


def prepare(
    evidence: ReducedSeries,
    carried: list[tuple[Array, Carried, str]],
    bends: list[tuple[Array, Array]],
    thermometer_factor: float,
) -> Weighting:
    """Return the weighting of a series by image noise, movement, and thermometers' errors.

    carried: of each trajectory that a thermometer's error reaches its direction (P,), px per unit,
    what readings do to it, and the channel; bends: of each trajectory its direction (P,) and its sd
    (E,), in its unit, beyond the independent errors, such as where the temperature bends between
    two readings; thermometer_factor: multiplies the standard deviations of the readings.
    """
    from scipy.linalg import cholesky

    sums = sum_series(evidence)
    # an error that no reading resolves is noise of single epochs
    for direction, sd in bends:
        if len(bent := np.flatnonzero(sd)):
            sums = sums.blurred(sd[bent, None, None] * direction[:, None], bent)
    E, P = sums.b.shape
    S = start = len(sums.right)
    errors = []
    movement = evidence.movement
    if movement is not None:
        for direction, operator in movement.operators:
            at = slice(start, start + operator.shape[1])
            errors.append((operator, at, direction, sums.N @ direction))
            start = at.stop
    moving = slice(S, start)
    places: dict[str, slice] = {}
    sds = [np.ones(start - S)]
    for name in dict.fromkeys(channel for _, _, channel in carried):
        sd = evidence.state_sd(name) * thermometer_factor
        places[name] = slice(start, start + len(sd))
        sds.append(sd)
        start += len(sd)
    whole = np.concatenate(sds)
    # the readings' deviation from the smooth trajectory, propagated to the camera
    shift = np.zeros((E, P))
    for direction, reach, channel in carried:
        shift += np.outer(reach.shift, direction)
        errors.append((reach.states, places[channel], direction, sums.N @ direction))
    moved = np.einsum("epq,eq->ep", sums.N, shift)
    yy = sums.yy - 2 * float(np.sum(shift * sums.b)) + float(np.sum(shift * moved))
    b = sums.b - moved
    M = np.zeros((start, start))  # its upper half
    M[:S, :S] = sums.normal
    M[S:, S:] = np.diag(1.0 / whole**2)
    _add_products(M, errors)
    right = np.zeros((start, P + 1))
    right[:S, :P] = sums.cross.sum(axis=1)
    right[:S, P] = sums.right - np.tensordot(sums.cross, shift, axes=([1, 2], [0, 1]))
    for operator, at, d, dN in errors:
        M[:S, at] += (sums.cross @ d) @ operator
        right[at] += operator.T @ np.column_stack([dN, b @ d])
    factor = np.ascontiguousarray(cholesky(M.T, lower=True, overwrite_a=True, check_finite=False))
    logdet = sums.logdet + 2 * float(
        np.sum(np.log(np.diag(factor)[:S])) + np.sum(np.log(np.diag(factor)[S:] * whole))
    )
    right = whiten(factor, right)
    level, data = right[:, :P], right[:, P]
    N0 = sums.N.sum(axis=0) - level.T @ level
    # levels that the field cannot separate have a prior of 1000 px, or as weak as rounding allows
    held = 1e-6 + 1e-13 * float(np.trace(N0))
    level_factor = np.linalg.cholesky(N0 + held * np.eye(P))
    if movement is not None:  # its size is estimated: restricted likelihood, with the levels' share
        logdet += 2 * float(np.sum(np.log(np.diag(level_factor))))
    return Weighting(
        sums.N, b, yy - float(data @ data), logdet, sums.cross, tuple(errors), moving, factor,
        data, level, N0, b.sum(axis=0) - level.T @ data, level_factor,
    )  # fmt: skip


def whiten(factor: Array, right: Array, transposed: bool = False) -> Array:
    """Solve L X = right (n, ·) for a lower triangular L (n, n), or LᵀX = right; n may be 0."""
    from scipy.linalg import solve_triangular

    if not len(factor):
        return right
    out: Array = solve_triangular(
        factor, right, lower=True, trans=int(transposed), check_finite=False
    )
    return out


def _add_products(M: Array, errors: list[tuple[Array, slice, Array, Array]]) -> None:
    """Add JᵀN J of movement and readings' errors to the upper half of M.

    Operators on the same states are combined, epoch by epoch, by the root of their joint weights,
    as the product of a matrix with itself takes half the work.
    """
    groups: dict[int, list[tuple[Array, slice, Array, Array]]] = {}
    for error in errors:
        groups.setdefault(error[1].start, []).append(error)
    own = list(groups.values())
    for g, group in enumerate(own):
        weights = np.stack([[dN @ d for _, _, d, _ in group] for _, _, _, dN in group])  # (k, k, E)
        size, turn = np.linalg.eigh(np.moveaxis(weights, 2, 0))  # not Cholesky: it may be singular
        root = turn * np.sqrt(np.maximum(size, 0.0))[:, None, :]
        here = group[0][1]
        for part in np.moveaxis(root, 2, 0):
            half = sum(part[:, k, None] * operator for k, (operator, *_) in enumerate(group))
            M[here, here] += half.T @ half
        for operator, _, _, dN in group:
            for far, there, d, _ in (error for others in own[g + 1 :] for error in others):
                M[here, there] += (operator * (dN @ d)[:, None]).T @ far
