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
def _sum_tremble(still: _Still) -> Sums:
    """Sum a series with what trembles from epoch to epoch."""
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
def sum_series(evidence: ReducedSeries) -> Sums:
    """Sum a series with what moves: first the movement, then hidden targets."""
    return _sum_tremble(_Still(evidence)).alongside(evidence.movement)


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

    def left(self, parameters: Array) -> Array:
        """Return what a movement (E, P) of the parameters leaves of the right-hand sides (E, P)."""
        rest: Array = self.b - np.einsum("epq,eq->ep", self.N, parameters)
        return rest

    def carried(self, trajectories: Array, directions: Array) -> Array:
        """Return L⁻¹ Jᵀ of regressors: trajectories (E, R), directions (P, R) → (states, R)."""
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
        """Return L⁻¹ Jᵀ of every trajectory (E, G) along every direction (P, k) → (states, G k)."""
        E, G = s.shape
        if G < _MANY * E:
            columns = np.repeat(s, directions.shape[1], axis=1)
            return self.carried(columns, np.tile(directions, G))
        parts = [self.by_epoch(d) @ s for d in directions.T]
        return np.stack(parts, axis=2).reshape(len(parts[0]), -1)

    def by_epoch(self, direction: Array) -> Array:
        """Return L⁻¹ Jᵀ (states, E) of shifts of single epochs along a direction (P,); keep it."""
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
        """Return images (E, P, R) of trajectories of all parameters (E, P, R) under S⁻¹ after the
        levels: their sums along other trajectories are inner products.
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
        """Return normal equations alongside the levels: A (R, R), c (R,), K (P, R).

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
        """Return normal equations after the levels: trajectories (E, R), directions (P, R)."""
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
        """Try many candidates: trajectories (G, E, m), directions (P, k); m·k columns each.

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
    from scipy.linalg import cholesky, solve_triangular

    sums = _blur_unresolved(evidence, carried)
    touched = _find_touched(sums.N, carried)
    P = sums.N.shape[1]
    fixed = len(sums.right)
    if not carried and not fixed:
        k0, N0 = sums.b.sum(axis=0), sums.N.sum(axis=0)
        return Weighting(
            sums.N, sums.b, sums.yy, sums.logdet, (), (), (), (), 0, sums.cross, None,
            np.zeros(0), np.zeros((0, P)), N0, k0, _factorise_levels(N0),
        )  # fmt: skip
    places: dict[str, slice] = {}
    sds, deviations = [], {}
    start = fixed
    for name in dict.fromkeys(c.channel for c in carried):
        sd = evidence.state_sd(name)[touched[name]] * thermometer_factor
        places[name] = slice(start, start + len(sd))
        deviations[name] = evidence.state_deviation(name)[touched[name]]
        sds.append(sd)
        start += len(sd)
    # the readings' own deviation from the smooth trajectory, carried to the camera
    shift = np.zeros((len(sums.N), P))
    states = [(c.direction, c.operator[:, touched[c.channel]], places[c.channel]) for c in carried]
    for item, (direction, operator, _) in zip(carried, states, strict=True):
        shift += np.outer(operator @ deviations[item.channel], direction)
    own = _factorise_own(evidence) if sums is sum_series(evidence) else _factorise(sums)
    sums = sums.shifted(shift)
    dN = [sums.N @ c.direction for c in carried]
    factor = np.zeros((start, start))
    factor[:fixed, :fixed] = own
    logdet = sums.logdet + 2 * float(np.sum(np.log(np.diag(own))))
    if carried:
        whole = np.concatenate(sds)
        inner = [slice(at.start - fixed, at.stop - fixed) for _, _, at in states]
        M = np.diag(1.0 / whole**2)
        _add_products(M, [o for _, o, _ in states], inner, [d for d, _, _ in states], dN)
        beside = np.zeros((fixed, start - fixed))
        for (d, operator, _), here in zip(states, inner, strict=True):
            beside[:, here] += sums.cross.along(d) @ operator
        if fixed:
            low = solve_triangular(own, beside, lower=True, check_finite=False)
            M -= low.T @ low
            factor[fixed:, :fixed] = low.T
        last = cholesky(M.T, lower=True, overwrite_a=True, check_finite=False)
        factor[fixed:, fixed:] = last
        logdet += 2 * float(np.sum(np.log(np.diag(last) * whole)))
    right = np.zeros((start, P + 1))
    for (d, operator, at), w in zip(states, dN, strict=True):
        right[at] += operator.T @ np.column_stack([w, sums.b @ d])
    right[:fixed, :P] = sums.cross.total()
    right[:fixed, P] = sums.right
    right = solve_triangular(factor, right, lower=True, check_finite=False)
    level, data = right[:, :P], right[:, P]
    N0 = sums.N.sum(axis=0) - level.T @ level
    k0 = sums.b.sum(axis=0) - level.T @ data
    held = _factorise_levels(N0)
    moving = len(evidence.movement) if evidence.movement is not None else 0
    if moving:  # the movement's size is estimated: the levels' share counts (restricted)
        logdet += 2 * float(np.sum(np.log(np.diag(held))))
    return Weighting(
        sums.N, sums.b, sums.yy - float(data @ data), logdet, tuple(o for _, o, _ in states),
        tuple(at for _, _, at in states), tuple(d for d, _, _ in states), tuple(dN),
        moving, sums.cross, factor, data, level, N0, k0, held,
    )  # fmt: skip


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


def _add_products(
    M: Array, operators: list[Array], places: list[slice], directions: list[Array], dN: list[Array]
) -> None:
    """Add JᵀN J of the readings' errors to the upper half of M.

    Operators on the same states are combined by the root of what they weigh together, epoch by
    epoch: a product of a matrix with itself takes half the work.
    """
    groups: dict[int, list[int]] = {}
    for i, at in enumerate(places):
        groups.setdefault(at.start, []).append(i)
    own = list(groups.values())
    for g, rows in enumerate(own):
        weights = np.stack([[dN[i] @ directions[j] for j in rows] for i in rows])  # (k, k, E)
        size, turn = np.linalg.eigh(np.moveaxis(weights, 2, 0))  # it may be singular
        root = turn * np.sqrt(np.maximum(size, 0.0))[:, None, :]
        here = places[rows[0]]
        for r in range(len(rows)):
            half = _combine([operators[i] for i in rows], root[:, :, r])
            M[here, here] += half.T @ half
        for others in own[g + 1 :]:
            for i in rows:
                shares = np.stack([dN[i] @ directions[j] for j in others], axis=1)
                far = _combine([operators[j] for j in others], shares)
                M[here, places[others[0]]] += operators[i].T @ far


def _combine(operators: list[Array], shares: Array) -> Array:
    """Sum operators (E, R) with shares (E, k) at each epoch."""
    out = shares[:, :1] * operators[0]
    for k, operator in enumerate(operators[1:], 1):
        out += shares[:, k, None] * operator
    return out


def _blur_unresolved(evidence: ReducedSeries, carried: list[ReadingErrorTerm]) -> Sums:
    """Sum a series, with what no reading resolves as noise of single epochs."""
    unresolved = [(c.direction, c.unresolved) for c in carried if c.unresolved is not None]
    sums = sum_series(evidence)
    for direction, sd in unresolved:
        if sd.any():
            bent = np.flatnonzero(sd)
            sums = sums.blurred(sd[bent, None, None] * direction[:, None], bent)
    return sums


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


def _factorise_levels(N0: Array) -> Array:
    """Factorise; the levels that the field cannot tell apart are held by 1000 px, or as
    loosely as rounding lets them.
    """
    held = 1e-6 + 1e-13 * float(np.trace(N0))
    factor = np.linalg.cholesky(N0 + held * np.eye(len(N0)))
    return np.asarray(factor, dtype=float)
