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

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.discovery.search.search import Search, Solution
    from thermocald.reduction.candidate import Candidate
    from thermocald.reduction.hypothesis import Fit
    from thermocald.reduction.scan import Scan

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
) -> Array:
    """Data of surrogates (E, P, count) as weighted: summed along trajectories, right-hand sides."""
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
    return w.weighted(np.moveaxis(parameters, 0, 2))


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
    """A scan of one candidate, of which all but the right-hand sides serves any data; penalty."""

    candidate: Candidate
    scan: Scan
    penalty: float


def _prepared(search: Search, without: Solution) -> list[_Scan]:
    """The scans of all candidates but those that the solution has."""
    out = []
    for candidate in search.candidates:
        if candidate.effect not in without.names:
            scan = search.scanner.scan(candidate, without.fit)
            out.append(_Scan(candidate, scan, search.judged(candidate, scan).penalty))
    without.fit.forget()
    return out


def _largest(scans: list[_Scan], without: Solution, data: list[Array], jobs: int) -> Array:
    """The largest penalised gain (count,) of any candidate."""

    def gain(scan: _Scan) -> Array:
        return _gain_of(scan, without.fit, data) - scan.penalty

    top = np.full(data[0].shape[2], -np.inf)
    # threads: nearly all of it is linear algebra, and the stacks would have to be copied
    with ThreadPoolExecutor(jobs) as pool:
        for found in pool.map(gain, scans) if jobs > 1 else map(gain, scans):
            top = np.maximum(top, found)
    return top


def _gain_of(scan: _Scan, fit: Fit, data: list[Array]) -> Array:
    """The largest gain (count,) of one candidate over its grid."""
    candidate = scan.candidate
    K, count = len(fit.coefficients), data[0].shape[2]
    base_A, base_c = np.zeros((K, K)), np.zeros((K, count))
    parts = []
    for s, weighted in enumerate(data):
        C, V, index = fit.designs[s]
        A, _, B = scan.scan.parts[s]
        parts.append((A, _right_hand_sides(scan.scan.stacks[s], candidate.directions, weighted), B))
        base_A[np.ix_(index, index)] += fit.reduced[s].A
        base_c[index] += np.einsum("er,pr,eps->rs", C, V, weighted, optimize=True)
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


def _right_hand_sides(stack: Array, directions: Array, weighted: Array) -> Array:
    """Right-hand sides (G, mk, count) of trajectories (G, E, m) along directions (P, k)."""
    G, E, m = stack.shape
    along = directions.T @ weighted  # (E, k, count)
    _, k, count = along.shape
    s = np.moveaxis(stack, 0, 1).reshape(E, G * m)
    out: Array = (s.T @ along.reshape(E, -1)).reshape(G, m * k, count)
    return out


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
