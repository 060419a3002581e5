"""The likelihood of a hypothesis about one series, with the thermometer's error in it.

Per epoch the evidence is a small normal matrix N_e over camera parameters. A hypothesis moves the
parameters along directions v (P,) with trajectories c (E,): Σ v c(t). Trajectories that are made
from temperatures carry the thermometer's error δ (R,) through their own operator O (E, R): what is
observed is d·O δ alongside the image noise. δ is integrated out exactly (Woodbury), so neither
white nor lagged thermometer noise is mistaken for an effect:

    S = N⁻¹ + J C Jᵀ,  J = Σ_k d_k ⊗ O_k,   S⁻¹ = N - N J (C⁻¹ + JᵀN J)⁻¹ JᵀN

The level of every parameter belongs to the series and is eliminated here; offsets of targets that
are hidden for long, and the mount's movement, are integrated out with δ (`random_effects`).

Source: Fuller (1987), Measurement Error Models, section 3.2; Rasmussen, Williams (2006), Gaussian
Processes for Machine Learning, section 2.7 for marginalised linear terms.

One series under a fixed covariance: inner products of trajectories, alone or many at once.

What is integrated out (`likelihood`) stands in one triangular factor; trajectories are whitened by
it, one by one where they are few, else through the epochs, which all trajectories share.

Normal equations of the epochs' parameters, of the random effects (movement of the mount, offsets of
hidden targets), and their couplings; with shifts of single epochs, which trembling or a temperature
was not read makes, as part of the noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from thermocald.thermal.random_effects import Couplings, Movement

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.thermal.series import ReducedSeries


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
        """Let some epochs (n,) shift at random with unit variance along D (n, P, t): Woodbury."""
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
        """Take shifts (E, P) of the parameters off the data."""
        moved = np.einsum("epq,eq->ep", self.N, shift)
        yy = self.yy - 2 * float(np.sum(shift * self.b)) + float(np.sum(shift * moved))
        right = self.right - self.cross.onto(shift[..., None])[:, 0]
        return Sums(self.N, self.b - moved, yy, self.logdet, self.cross, self.normal, right)

    def alongside(self, movement: Movement | None) -> Sums:
        """Add a movement as random effects before the others."""
        if movement is None:
            return self
        own = movement.own(self.N) + np.eye(len(movement))
        between = movement.onto(self.cross.others)
        return replace(
            self,
            cross=Couplings(
                movement.directions.T @ self.N,
                movement.operator,
                movement.spans,
                self.cross.others,
            ),
            normal=np.block([[own, between.T], [between, self.normal]]),
            right=np.concatenate([movement.onto(self.b[None])[0], self.right]),
        )


@lru_cache(maxsize=4)
def sum_series(evidence: ReducedSeries) -> Sums:
    """Sum a series with what moves: first the movement, then hidden targets; and what trembles from
    epoch to epoch.
    """
    hidden = evidence.hidden
    E, P = evidence.b.shape
    cross, normal, right = np.zeros((0, E, P)), np.zeros((0, 0)), np.zeros(0)
    if hidden is not None:
        cross, normal, right = hidden.cross, np.diag(hidden.normal), hidden.right.sum(axis=1)
    still = Couplings(np.zeros((E, 0, P)), np.zeros((E, 0)), (), cross)
    sums = Sums(evidence.N, evidence.b, float(evidence.yy.sum()), 0.0, still, normal, right)
    if evidence.tremble is not None:
        D = np.broadcast_to(evidence.tremble, (E, *evidence.tremble.shape))
        sums = sums.blurred(D, np.arange(E))
    return sums.alongside(evidence.movement)


_MANY = 0.15  # trajectories per epoch above which epochs are whitened, for all that follow


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
    # of each reading error: operator (E, states), places of its states, d (P,), dᵀN_e (E, P)
    errors: tuple[tuple[Array, slice, Array, Array], ...]
    moving: int
    effects: Couplings
    factor: Array  # L (states, states), lower
    data: Array  # L⁻¹ Jᵀ b (R,)
    level: Array  # L⁻¹ Jᵀ constants (R, P)
    level_normal: Array  # inverse-ready (P, P) of the constants, thermometer included
    level_b: Array
    level_factor: Array
    kept: dict[bytes, Array] = field(default_factory=dict)  # of `by_epoch`

    def left(self, parameters: Array) -> Array:
        """Return what a movement (E, P) of the parameters leaves of the right-hand sides (E, P)."""
        rest: Array = self.b - np.einsum("epq,eq->ep", self.N, parameters)
        return rest

    def carried(self, trajectories: Array, directions: Array) -> Array:
        """Return L⁻¹ Jᵀ of regressors: trajectories (E, R), directions (P, R) → (states, R)."""
        total = np.zeros((len(self.factor), trajectories.shape[1]))
        for operator, at, _, dN in self.errors:
            total[at] += operator.T @ ((dN @ directions) * trajectories)
        if len(self.effects):
            total[: len(self.effects)] = self.effects.driven(trajectories, directions)
        return whiten(self.factor, total)

    def carried_stack(self, s: Array, directions: Array) -> Array:
        """Return L⁻¹ Jᵀ of every trajectory (E, G) along every direction (P, k) → (states, G k)."""
        E, G = s.shape
        if G < _MANY * E:
            columns = np.repeat(s, directions.shape[1], axis=1)
            return self.carried(columns, np.tile(directions, G))
        parts = [self.by_epoch(d) @ s for d in directions.T]
        return np.stack(parts, axis=2).reshape(len(parts[0]), -1)

    def by_epoch(self, direction: Array) -> Array:
        """Return L⁻¹ Jᵀ (states, E) of shifts of single epochs along a direction (P,); keep it."""
        key = direction.tobytes()
        if key not in self.kept:
            total = np.zeros((len(self.factor), len(self.N)))
            for operator, at, _, dN in self.errors:
                total[at] += (operator * (dN @ direction)[:, None]).T
            if len(self.effects):
                total[: len(self.effects)] = self.effects.along(direction)
            self.kept[key] = whiten(self.factor, total)
        return self.kept[key]

    def weighted(self, parameters: Array) -> Array:
        """Return images (E, P, R) of trajectories of all parameters (E, P, R) under S⁻¹ after the
        levels: their sums along other trajectories are inner products.
        """
        from scipy.linalg import cho_solve

        b: Array = self.N @ parameters
        right, few = np.zeros((len(self.factor), b.shape[2])), len(self.effects)
        for operator, at, d, _ in self.errors:
            right[at] += operator.T @ (d @ b)
        right[:few] = self.effects.onto(parameters)
        carried = whiten(self.factor, right)
        level_b = b.sum(axis=0) - self.level.T @ carried
        level = cho_solve((self.level_factor, True), level_b)
        b = b - self.N @ level
        states = whiten(self.factor, carried - self.level @ level, transposed=True)
        for operator, at, _, dN in self.errors:
            b -= dN[:, :, None] * (operator @ states[at])[:, None, :]
        return b - self.effects.images(states[:few])

    def joint(self, trajectories: Array, directions: Array) -> tuple[Array, Array, Array]:
        """Return normal equations alongside the levels: A (R, R), c (R,), K (P, R).

        trajectories (E, R), directions (P, R); K couples them with the levels, whose own normal
        equations are `level_normal` and `level_b`.
        """
        NV = self.N @ directions
        VNV = directions.T @ NV
        A = np.sum(VNV * trajectories[:, :, None] * trajectories[:, None, :], axis=0)
        c = np.einsum("ei,ei->i", trajectories, self.b @ directions)
        K = np.einsum("epi,ei->pi", NV, trajectories)
        U = self.carried(trajectories, directions)
        return A - U.T @ U, c - U.T @ self.data, K - self.level.T @ U

    def reduce(self, trajectories: Array, directions: Array) -> NormalEquations:
        """Return normal equations after the levels: trajectories (E, R), directions (P, R)."""
        A, c, K = self.joint(trajectories, directions)
        Q = whiten(self.level_factor, np.column_stack([K, self.level_b]))
        Q, q = Q[:, :-1], Q[:, -1]
        return NormalEquations(A - Q.T @ Q, c - Q.T @ q, self.yy - float(q @ q), self.logdet)

    def scan(
        self, trajectories: Array, directions: Array, base: tuple[Array, Array]
    ) -> tuple[Array, Array, Array]:
        """Try many candidates: trajectories (G, E, m), directions (P, k); m·k columns each.

        base: trajectories (E, R), directions (P, R) of what the model holds already.
        Returns, after the levels: A (G, mk, mk), c (G, mk), cross with the base (G, mk, R).
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


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations after the levels: A (R, R), c (R,), yy, logdet."""

    A: Array
    c: Array
    yy: float
    logdet: float


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


def add_error_term(terms: list[ReadingErrorTerm], new: ReadingErrorTerm) -> list[ReadingErrorTerm]:
    """Add a term; two that carry the readings in the same way become one direction."""
    for i, old in enumerate(terms):
        alike = old.channel == new.channel and old.operator.shape == new.operator.shape
        plain = old.unresolved is None and new.unresolved is None
        if alike and plain and np.array_equal(old.operator, new.operator):
            both = replace(old, direction=old.direction + new.direction)
            return [*terms[:i], both, *terms[i + 1 :]]
    return [*terms, new]


def prepare(
    evidence: ReducedSeries, carried: list[ReadingErrorTerm], thermometer_factor: float = 1.0
) -> Weighting:
    """Fix the covariance of a series: image noise, the movement of the epochs, and the
    thermometers' noise carried by `carried`.

    thermometer_factor: multiplies the standard deviations of the readings.
    """
    from scipy.linalg import cholesky

    sums = sum_series(evidence)
    # what no reading resolves is noise of single epochs
    for c in carried:
        if c.unresolved is not None and c.unresolved.any():
            bent = np.flatnonzero(c.unresolved)
            sums = sums.blurred(c.unresolved[bent, None, None] * c.direction[:, None], bent)
    own = _factorise_own(evidence) if sums is sum_series(evidence) else _factorise(sums)
    touched = _find_touched(sums.N, carried)
    P, fixed = sums.N.shape[1], len(sums.right)
    places: dict[str, slice] = {}
    sds, deviations = [np.zeros(0)], {}
    start = fixed
    for name in dict.fromkeys(c.channel for c in carried):
        sd = evidence.state_sd(name)[touched[name]] * thermometer_factor
        places[name] = slice(start, start + len(sd))
        deviations[name] = evidence.state_deviation(name)[touched[name]]
        sds.append(sd)
        start += len(sd)
    whole = np.concatenate(sds)
    # the readings' own deviation from the smooth trajectory, carried to the camera
    shift = np.zeros((len(sums.N), P))
    errors = []
    for item in carried:
        operator = item.operator[:, touched[item.channel]]
        shift += np.outer(operator @ deviations[item.channel], item.direction)
        dN = sums.N @ item.direction
        errors.append((operator, places[item.channel], item.direction, dN))
    sums = sums.shifted(shift)
    factor = np.zeros((start, start))
    factor[:fixed, :fixed] = own
    logdet = sums.logdet + 2 * float(np.sum(np.log(np.diag(own))))
    if errors:
        M, beside = np.diag(1.0 / whole**2), np.zeros((fixed, start - fixed))
        inner = [(o, slice(at.start - fixed, at.stop - fixed), d, w) for o, at, d, w in errors]
        _add_products(M, inner)
        for operator, here, d, _ in inner:
            beside[:, here] += sums.cross.along(d) @ operator
        low = whiten(own, beside)
        M -= low.T @ low
        factor[fixed:, :fixed] = low.T
        last = cholesky(M.T, lower=True, overwrite_a=True, check_finite=False)
        factor[fixed:, fixed:] = last
        logdet += 2 * float(np.sum(np.log(np.diag(last) * whole)))
    right = np.zeros((start, P + 1))
    for operator, at, d, dN in errors:
        right[at] += operator.T @ np.column_stack([dN, sums.b @ d])
    right[:fixed, :P] = sums.cross.total()
    right[:fixed, P] = sums.right
    right = whiten(factor, right)
    level, data = right[:, :P], right[:, P]
    N0 = sums.N.sum(axis=0) - level.T @ level
    # levels that the field cannot tell apart are held by 1000 px, or as loosely as rounding allows
    held = 1e-6 + 1e-13 * float(np.trace(N0))
    level_factor = np.linalg.cholesky(N0 + held * np.eye(P))
    moving = len(evidence.movement) if evidence.movement is not None else 0
    if moving:  # the movement's size is estimated: the levels' share counts (restricted)
        logdet += 2 * float(np.sum(np.log(np.diag(level_factor))))
    return Weighting(
        sums.N, sums.b, sums.yy - float(data @ data), logdet, tuple(errors), moving, sums.cross,
        factor, data, level, N0, sums.b.sum(axis=0) - level.T @ data, level_factor,
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


def _find_touched(
    N: Array, carried: list[ReadingErrorTerm]
) -> dict[str, NDArray[np.int64] | slice]:
    """Find the errors of each channel that reach an epoch with weight; the others change
    nothing.
    """
    seen = N.any(axis=(1, 2))
    if seen.all():
        return {c.channel: slice(None) for c in carried}
    reached: dict[str, NDArray[np.bool_]] = {}
    for c in carried:
        before = reached.get(c.channel, np.zeros(c.operator.shape[1], dtype=bool))
        reached[c.channel] = np.logical_or(before, np.any(c.operator[seen] != 0.0, axis=0))
    # one at least, where there are no epochs at all
    return {name: np.flatnonzero(r) if r.any() else slice(1) for name, r in reached.items()}


def _add_products(M: Array, errors: list[tuple[Array, slice, Array, Array]]) -> None:
    """Add JᵀN J of the readings' errors to the upper half of M.

    Operators on the same states are combined by the root of what they weigh together, epoch by
    epoch: a product of a matrix with itself takes half the work.
    """
    groups: dict[int, list[tuple[Array, slice, Array, Array]]] = {}
    for error in errors:
        groups.setdefault(error[1].start, []).append(error)
    own = list(groups.values())
    for g, group in enumerate(own):
        weights = np.stack([[dN @ d for _, _, d, _ in group] for _, _, _, dN in group])  # (k, k, E)
        size, turn = np.linalg.eigh(np.moveaxis(weights, 2, 0))  # it may be singular
        root = turn * np.sqrt(np.maximum(size, 0.0))[:, None, :]
        here = group[0][1]
        for r in range(len(group)):
            half = _combine([operator for operator, *_ in group], root[:, :, r])
            M[here, here] += half.T @ half
        for others in own[g + 1 :]:
            for operator, _, _, dN in group:
                shares = np.stack([dN @ d for _, _, d, _ in others], axis=1)
                far = _combine([o for o, *_ in others], shares)
                M[here, others[0][1]] += operator.T @ far


def _combine(operators: list[Array], shares: Array) -> Array:
    """Sum operators (E, R) with shares (E, k) at each epoch."""
    out = shares[:, :1] * operators[0]
    for k, operator in enumerate(operators[1:], 1):
        out += shares[:, k, None] * operator
    return out


@lru_cache(maxsize=4)
def _factorise_own(evidence: ReducedSeries) -> Array:
    """Factorise the normal matrix of the random effects, which no hypothesis changes."""
    return _factorise(sum_series(evidence))


def _factorise(sums: Sums) -> Array:
    """Return the Cholesky factor (F, F) of the normal matrix of the random effects."""
    from scipy.linalg import cholesky

    if not len(sums.right):
        return sums.normal
    factor: Array = cholesky(sums.normal, lower=True, check_finite=False)
    return factor
