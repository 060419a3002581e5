"""False alarms, measured on the recording itself: surrogates that keep the noise, not the cause.

What the best hypothesis leaves over is moved in time against the temperatures (shifted in a circle,
reversed, its sign turned, or cut into blocks that change places), put on top of the model without
the effect in question, and searched again with every candidate. How often the largest penalised
gain among all candidates reaches the one that was found is the probability of a false name, after
the search.

One surrogate among the first few that reaches it decides that there is no name: the probability is
then that of a sequential test.

Source: Theiler et al. (1992), Physica D 58, 77-94 (surrogate data); Davison, Hinkley (1997),
Bootstrap Methods, section 8.2 (blocks) and 4.2 (p-values from simulations); Besag, Clifford (1991),
Biometrika 78, 301-304 (sequential p-values).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.reduction.hypothesis import BASE
from thermocald.reduction.series import COLUMNS

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.discovery.search.search import Search, Solution
    from thermocald.reduction.candidate import Candidate
    from thermocald.reduction.hypothesis import Fit
    from thermocald.reduction.likelihood import Weighting

__all__ = ["FALSE_ALARM", "SurrogateTest", "surrogate_test"]

FALSE_ALARM = 0.01
"""The probability of a false name from which on an effect is not named."""
_COUNT = 119
_FIRST = 20  # surrogates after which a name that one of them reaches is given up
_SEED = 20


@dataclass(frozen=True, eq=False)
class SurrogateTest:
    """One effect against surrogates: its penalised gain, those of the surrogates (S,)."""

    gain: float
    surrogates: Array

    @property
    def p(self) -> float:
        """Probability of a false name: share of surrogates that reach the gain."""
        return (1 + int(np.sum(self.surrogates >= self.gain))) / (1 + len(self.surrogates))

    @property
    def passed(self) -> bool:
        """Whether the effect may be named."""
        return self.p < FALSE_ALARM


def surrogate_test(
    search: Search,
    best: Fit,
    without: Solution,
    gain: float,
    count: int = _COUNT,
    jobs: int = 1,
) -> SurrogateTest:
    """Test one effect: `without` is the best solution without it, in the same fitter.

    gain: by how much the penalised score improves with it; jobs: candidates tried at a time, with
    the same bits for any number.
    """
    rng = np.random.default_rng(_SEED)
    scans = _prepared(search, without)
    tops = np.zeros(0)
    for few in (min(_FIRST, count), count - min(_FIRST, count)):
        if few and not np.any(tops >= gain):
            every = range(len(best.weightings))
            data = [_data(search, best, without.fit, s, rng, few) for s in every]
            tops = np.append(tops, _largest(scans, without, data, jobs))
    return SurrogateTest(gain, tops)


def _data(
    search: Search, best: Fit, without: Fit, series: int, rng: np.random.Generator, count: int
) -> tuple[Array, Array]:
    """Right-hand sides of surrogates: b (count, E, P) and of hidden targets (count, S)."""
    e = search.fitter.series[series]
    C, V, index = best.designs[series]
    w = best.weightings[series]
    size, U = np.linalg.eigh(e.N.mean(axis=0))
    good = size > 1e-6 * np.median(size)
    W = U[:, good] / np.sqrt(size[good])
    rest = w.b - np.einsum("epq,eq->ep", w.N, (C * best.coefficients[index]) @ V.T)
    level = np.linalg.lstsq(w.N.sum(axis=0), rest.sum(axis=0), rcond=1e-12)[0]
    z = (rest - w.N @ level) @ W
    normal = np.einsum("pi,epq,qj->eij", W, w.N, W) + 0.1 * np.eye(W.shape[1])
    y = 1.1 * np.linalg.solve(normal, z[..., None])[..., 0]
    C, V, index = without.designs[series]
    model = (C * without.coefficients[index]) @ V.T
    moved = np.stack([_moved(y, rng) for _ in range(count)])
    parameters = model + moved @ W.T
    w = without.weightings[series]
    b = np.einsum("epq,seq->sep", w.N, parameters)
    return b, w.effects.onto(np.moveaxis(parameters, 0, 2)).T


def _moved(y: Array, rng: np.random.Generator) -> Array:
    """A trajectory (E, m) moved in time in one of four ways."""
    E = len(y)
    way = rng.integers(3)
    if way == 2:
        size = int(rng.integers(max(E // 10, 2), max(E // 4, 3)))
        blocks = [y[k : k + size] for k in range(0, E, size)]
        y = np.concatenate([blocks[k] for k in rng.permutation(len(blocks))])
    else:
        y = np.roll(y, int(rng.integers(E // 10, E - E // 10 + 1)), axis=0)
    if way == 1 or rng.random() < 0.5:
        y = y[::-1]
    return y if rng.random() < 0.5 else -y


@dataclass(frozen=True, eq=False)
class _Scan:
    """What a scan of one candidate needs, whatever the data: per series the stack, directions
    (P, k), A (G, mk, mk), B (G, mk, K); penalty.
    """

    candidate: Candidate
    stacks: list[Array]
    directions: Array
    parts: list[tuple[Array, Array]]
    penalty: float


def _prepared(search: Search, without: Solution) -> list[_Scan]:
    """The scans of all candidates but those that the solution has."""
    fit = without.fit
    K = len(fit.coefficients)
    out = []
    for candidate in search.candidates:
        if candidate.effect in without.names:
            continue
        directions = np.zeros((len(COLUMNS), len(candidate.parameters)))
        for j, name in enumerate(candidate.parameters):
            directions[COLUMNS.index(name), j] = 1.0
        stacks, parts = [], []
        for s, own in enumerate(fit.weightings):
            C, V, index = fit.designs[s]
            stacks.append(search.scanner.stack(candidate, s, fit))
            A, _, B = own.scan(stacks[-1], directions, (C, V))
            full = np.zeros((*B.shape[:2], K))
            full[..., index] = B
            parts.append((A, full))
        penalty = search.scan(candidate, without).penalty
        out.append(_Scan(candidate, stacks, directions, parts, penalty))
    return out


def _largest(
    scans: list[_Scan], without: Solution, data: list[tuple[Array, Array]], jobs: int
) -> Array:
    """The largest penalised gain (count,) of any candidate."""

    def gain(scan: _Scan) -> Array:
        return _gain_of(scan, without.fit, data) - scan.penalty

    top = np.full(len(data[0][0]), -np.inf)
    # threads: nearly all of it is linear algebra, and the stacks would have to be copied
    with ThreadPoolExecutor(jobs) as pool:
        for found in pool.map(gain, scans) if jobs > 1 else map(gain, scans):
            top = np.maximum(top, found)
    return top


def _gain_of(scan: _Scan, fit: Fit, data: list[tuple[Array, Array]]) -> Array:
    """The largest gain (count,) of one candidate over its grid."""
    candidate = scan.candidate
    K, count = len(fit.coefficients), len(data[0][0])
    base_A, base_c = np.zeros((K, K)), np.zeros((K, count))
    parts = []
    for s, (b, hidden) in enumerate(data):
        C, V, index = fit.designs[s]
        c, cb = _right_hand_sides(
            fit.weightings[s], scan.stacks[s], scan.directions, (C, V), b, hidden
        )
        parts.append((scan.parts[s][0], c, scan.parts[s][1]))
        base_A[np.ix_(index, index)] += fit.reduced[s].A
        base_c[index] += cb
    whole = _explained(base_A, base_c)
    rest = whole
    if candidate.kind.is_drive:  # it takes the place of T: the base's own rates leave
        keep = np.arange(len(BASE), K)
        base_A, base_c = base_A[np.ix_(keep, keep)], base_c[keep]
        parts = [(A, c, B[..., keep]) for A, c, B in parts]
        rest = _explained(base_A, base_c)
    if candidate.kind.is_event or (candidate.kind.is_periodic and len(parts) > 1):
        gains = np.sum([_gains([p], base_A, base_c).max(axis=0) for p in parts], axis=0)
    else:
        gains = _gains(parts, base_A, base_c).max(axis=0)
    out: Array = gains + rest - whole
    return out


def _explained(A: Array, c: Array) -> Array:
    """χ² (count,) that regressors with right-hand sides c (K, count) explain."""
    if not len(c):
        return np.zeros(c.shape[1])
    d = np.sqrt(np.maximum(np.diag(A), 1e-300))
    x = np.linalg.solve(A / np.outer(d, d) + 1e-12 * np.eye(len(A)), c / d[:, None])
    out: Array = np.sum(c / d[:, None] * x, axis=0)
    return out


def _right_hand_sides(
    w: Weighting,
    stack: Array,
    directions: Array,
    base: tuple[Array, Array],
    b: Array,
    hidden: Array,
) -> tuple[Array, Array]:
    """Right-hand sides of many data: of the candidates (G, mk, count), of the base (R, count)."""
    from scipy.linalg import solve_triangular

    G, E, m = stack.shape
    k = directions.shape[1]
    s = np.moveaxis(stack, 0, 1).reshape(E, G * m)
    C, V = base
    level_b = b.sum(axis=1).T  # (P, count)
    c = np.tensordot(s, b @ directions, axes=(0, 1))  # (G m, count, k)
    c = np.swapaxes(c, 1, 2).reshape(G, m * k, len(b))
    cb = np.einsum("er,ser->rs", C, b @ V, optimize=True)
    NV = w.N @ directions
    K = (s.T @ NV.reshape(E, -1)).reshape(G * m, -1, k).transpose(1, 0, 2).reshape(-1, G * m * k)
    Kb = (w.N @ (C[:, None, :] * V)).sum(axis=0)
    if w.factor is not None:
        right = np.zeros((len(w.factor), len(b)))
        for operator, at, d in zip(w.operators, w.places, w.directions, strict=True):
            right[at] += operator.T @ (b @ d).T
        right[: len(w.effects)] = hidden.T
        data = solve_triangular(w.factor, right, lower=True, check_finite=False)
        U = w.carried_stack(s, directions)
        Ub = w.carried(C, V)
        c = c - (U.T @ data).reshape(G, m * k, len(b))
        cb = cb - Ub.T @ data
        K, Kb = K - w.level.T @ U, Kb - w.level.T @ Ub
        level_b = level_b - w.level.T @ data
    Q = solve_triangular(w.level_factor, np.column_stack([K, Kb, level_b]), lower=True)
    n, r = K.shape[1], Kb.shape[1]
    c = c - (Q[:, :n].T @ Q[:, n + r :]).reshape(G, m * k, len(b))
    return c, cb - Q[:, n : n + r].T @ Q[:, n + r :]


def _gains(parts: list[tuple[Array, Array, Array]], base_A: Array, base_c: Array) -> Array:
    """χ² explained beyond the base, (G, count)."""
    A = np.sum([p[0] for p in parts], axis=0)
    c = np.sum([p[1] for p in parts], axis=0)
    B = np.sum([p[2] for p in parts], axis=0)
    if len(base_c):
        d = np.sqrt(np.maximum(np.diag(base_A), 1e-300))
        inverse = np.linalg.inv(base_A / np.outer(d, d) + 1e-12 * np.eye(len(d)))
        inverse = inverse / np.outer(d, d)
        c = c - np.tensordot(B, inverse @ base_c, axes=(2, 0))
        A = A - B @ inverse @ np.swapaxes(B, 1, 2)
    scale = np.sqrt(np.maximum(np.einsum("gii->gi", A), 1e-12))
    own = A / scale[:, :, None] / scale[:, None, :] + 1e-9 * np.eye(A.shape[-1])
    right = c / scale[..., None]
    out = np.sum(right * np.linalg.solve(own, right), axis=1)
    weak = scale.min(axis=1) < 1e-3
    out[weak] = -np.inf
    gains: Array = out
    return gains
