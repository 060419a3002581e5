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
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from thermocald.reduction.sums import Sums, sums_of
from thermocald.reduction.weighting import Weighting

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.reduction.series import ReducedSeries

__all__ = ["ReadingErrorTerm", "prepare", "with_error_term"]


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


def with_error_term(terms: list[ReadingErrorTerm], new: ReadingErrorTerm) -> list[ReadingErrorTerm]:
    """Terms with one more; two that carry the readings in the same way become one direction."""
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

    sums = _blurred(evidence, carried)
    touched = _touched(sums.N, carried)
    P = sums.N.shape[1]
    fixed = len(sums.right)
    if not carried and not fixed:
        k0, N0 = sums.b.sum(axis=0), sums.N.sum(axis=0)
        return Weighting(
            sums.N, sums.b, sums.yy, sums.logdet, (), (), (), (), 0, sums.cross, None,
            np.zeros(0), np.zeros((0, P)), N0, k0, _level_factor(N0),
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
    own = _own_factor(evidence) if sums is sums_of(evidence) else _factored(sums)
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
    held = _level_factor(N0)
    moving = len(evidence.movement) if evidence.movement is not None else 0
    if moving:  # the movement's size is estimated: the levels' share counts (restricted)
        logdet += 2 * float(np.sum(np.log(np.diag(held))))
    return Weighting(
        sums.N, sums.b, sums.yy - float(data @ data), logdet, tuple(o for _, o, _ in states),
        tuple(at for _, _, at in states), tuple(d for d, _, _ in states), tuple(dN),
        moving, sums.cross, factor, data, level, N0, k0, held,
    )  # fmt: skip


def _touched(N: Array, carried: list[ReadingErrorTerm]) -> dict[str, NDArray[np.int64] | slice]:
    """Of each channel the errors that reach an epoch that has weight; the others change nothing."""
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
            half = _combined([operators[i] for i in rows], root[:, :, r])
            M[here, here] += half.T @ half
        for others in own[g + 1 :]:
            for i in rows:
                shares = np.stack([dN[i] @ directions[j] for j in others], axis=1)
                far = _combined([operators[j] for j in others], shares)
                M[here, places[others[0]]] += operators[i].T @ far


def _combined(operators: list[Array], shares: Array) -> Array:
    """The sum of operators (E, R) with shares (E, k) at each epoch."""
    out = shares[:, :1] * operators[0]
    for k, operator in enumerate(operators[1:], 1):
        out += shares[:, k, None] * operator
    return out


def _blurred(evidence: ReducedSeries, carried: list[ReadingErrorTerm]) -> Sums:
    """The sums of a series, with what no reading resolves as noise of single epochs."""
    unresolved = [(c.direction, c.unresolved) for c in carried if c.unresolved is not None]
    sums = sums_of(evidence)
    for direction, sd in unresolved:
        if sd.any():
            bent = np.flatnonzero(sd)
            sums = sums.blurred(sd[bent, None, None] * direction[:, None], bent)
    return sums


@lru_cache(maxsize=4)
def _own_factor(evidence: ReducedSeries) -> Array:
    """Of the random effects, which no hypothesis changes."""
    return _factored(sums_of(evidence))


def _factored(sums: Sums) -> Array:
    """Cholesky factor (F, F) of the normal matrix of the random effects."""
    from scipy.linalg import cholesky

    if not len(sums.right):
        return sums.normal
    factor: Array = cholesky(sums.normal, lower=True, check_finite=False)
    return factor


def _level_factor(N0: Array) -> Array:
    """Cholesky factor; the levels that the field cannot tell apart are held by 1000 px, or as
    loosely as rounding lets them.
    """
    held = 1e-6 + 1e-13 * float(np.trace(N0))
    factor = np.linalg.cholesky(N0 + held * np.eye(len(N0)))
    return np.asarray(factor, dtype=float)
