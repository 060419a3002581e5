"""Proof of an effect: blocks of time left out, and surrogates that keep the noise, not the cause.

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

Cross-validation in blocks of time: does what was fitted to the rest predict them?

Each series is cut into blocks; a block of every series is left out, the coefficients are fitted to
the others, and the likelihood of the block is taken at them, with a level of its own. An effect
that only follows the noise, or bends to a trajectory that is not its own, predicts nothing.

Source: cross-validation in blocks as Burman, Chow, Nolan (1994), Biometrika 81, 351-358.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.discovery import criteria
from thermocald.photogrammetry.linalg import best_level, orthonormal_combinations
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.scan import gains_beside

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.discovery.search import Search, Solution
    from thermocald.thermal.hypothesis import Candidate, Fit
    from thermocald.thermal.scan import Scan
    from thermocald.thermal.series import ReducedSeries

BLOCKS = 6
_PRIOR = 1e-6  # of a coefficient's whole information, where the other blocks hold none


def predict_blocks(
    fitter: HypothesisFitter, fit: Fit, series: Sequence[int], blocks: int = BLOCKS
) -> tuple[Array, Array]:
    """Return χ² and -2 log likelihood (blocks,) of the blocks as predicted without them.

    series: those that take part. Non-linear parameters stay as they are. The coefficients' own
    uncertainty is in the prediction: a step that happened in the block itself is not foreseen, and
    not held against its cause.
    """
    chi2, objective = np.zeros(blocks), np.zeros(blocks)
    for k in range(blocks):
        masks = [_mark_block(e, k, blocks) for e in fitter.series]
        trained = _keep_epochs(fitter, [~m for m in masks]).fit(
            fit.terms, fit.coefficients, 1, series
        )
        tested = _keep_epochs(fitter, masks).fit(fit.terms, fit.coefficients, 1, series)
        whole = np.diag(fit.normals(series)[0])
        own = np.where(whole > 0, _PRIOR * whole, 1.0)  # 1: of a series that takes no part
        known = trained.normals(series)[0] + np.diag(own)
        B, c = tested.normals(series)
        g = c - B @ trained.coefficients
        both = np.linalg.slogdet(known + B)[1] - np.linalg.slogdet(known)[1]
        for s in series:
            chi2[k] += tested.chi2_of(s, trained.coefficients)
            objective[k] += tested.reduced[s].logdet
        chi2[k] -= float(g @ np.linalg.solve(known + B, g))
        objective[k] += chi2[k] + both
    return chi2, objective


def measure_block_gains(fitter: HypothesisFitter, fit: Fit, kept: int = 0) -> list[Array]:
    """Return by how much each effect beyond the first `kept` improves the prediction of blocks
    (blocks,).

    The others are fitted again without it; in -2 log likelihood, all series together.
    """
    every = range(len(fitter.series))
    whole = predict_blocks(fitter, fit, every)[1]
    out = []
    for i in range(kept, len(fit.terms)):
        fewer = fitter.fit([t for j, t in enumerate(fit.terms) if j != i])
        out.append(predict_blocks(fitter, fitter.refine(fewer), every)[1] - whole)
    return out


def is_confirmed(gain: Array) -> bool:
    """Test whether a cause predicts blocks it has not seen, and makes none of them worse."""
    total = float(gain.sum())
    return total > 0 and float(gain.min()) > -(
        criteria.BLOCK_WORSE + criteria.BLOCK_WORSE_SHARE * total
    )


def cross_validation(fitter: HypothesisFitter, fit: Fit) -> tuple[float, float]:
    """Return χ² per degree of freedom on blocks of M1 that the fit did not see, and on M1."""
    e = fitter.series[0]
    outside = float(predict_blocks(fitter, fit, [0])[0].sum())
    free = e.rank * float((e.n > 0).sum())
    return outside / max(free - BLOCKS * e.rank, 1.0), fit.chi2_of(0) / max(free - e.rank, 1.0)


def _mark_block(evidence: ReducedSeries, number: int, blocks: int) -> NDArray[np.bool_]:
    edges = np.linspace(0, len(evidence.times), blocks + 1).astype(int)
    inside = np.zeros(len(evidence.times), dtype=bool)
    inside[edges[number] : edges[number + 1]] = True
    return inside


def _keep_epochs(fitter: HypothesisFitter, masks: Sequence[NDArray[np.bool_]]) -> HypothesisFitter:
    """Keep the weight of some epochs alone; trajectories are the same."""
    pairs = zip(fitter.series, masks, strict=True)
    part = HypothesisFitter([replace(e.weighted(m.astype(float)), n=e.n * m) for e, m in pairs])
    part.thermometer_factor = fitter.thermometer_factor
    part.share_trajectories(fitter)
    return part


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
        return self.p < criteria.FALSE_ALARM


def compare_with_surrogates(
    search: Search,
    best: Fit,
    without: Solution,
    gain: float,
    count: int = criteria.SURROGATES,
    jobs: int = 1,
) -> SurrogateTest:
    """Test one effect: `without` is the best solution without it, in the same fitter.

    gain: by how much the penalised score improves with it; jobs: candidates tried at a time, with
    the same bits for any number.
    """
    rng = np.random.default_rng(_SEED)
    scans = _prepare_scans(search, without)
    tops = np.zeros(0)
    for few in (min(_FIRST, count), count - min(_FIRST, count)):
        if few and not np.any(tops >= gain):
            every = range(len(best.weightings))
            data = [_draw_data(search, best, without.fit, s, rng, few) for s in every]
            tops = np.append(tops, _find_largest_gains(scans, without, data, jobs))
    return SurrogateTest(gain, tops)


def _draw_data(
    search: Search, best: Fit, without: Fit, series: int, rng: np.random.Generator, count: int
) -> Array:
    """Draw data of surrogates (E, P, count) as weighted: summed along trajectories, right-hand
    sides.
    """
    w = best.weightings[series]
    W, good = orthonormal_combinations(search.fitter.series[series].N.mean(axis=0))
    W = W[:, good]
    rest = w.left(best.parameters(series))
    z = (rest - w.N @ best_level(w.N, rest)) @ W
    normal = np.einsum("pi,epq,qj->eij", W, w.N, W) + 0.1 * np.eye(W.shape[1])
    y = 1.1 * np.linalg.solve(normal, z[..., None])[..., 0]
    moved = np.stack([_move_in_time(y, rng) for _ in range(count)])
    parameters = without.parameters(series) + moved @ W.T
    return without.weightings[series].weighted(np.moveaxis(parameters, 0, 2))


def _move_in_time(y: Array, rng: np.random.Generator) -> Array:
    """Move a trajectory (E, m) in time in one of four ways."""
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


def _prepare_scans(search: Search, without: Solution) -> list[_Scan]:
    """Scan all candidates but those that the solution has."""
    out = []
    for candidate in search.candidates:
        if candidate.effect not in without.names:
            scan = search.scanner.scan(candidate, without.fit)
            out.append(_Scan(candidate, scan, search.judged(candidate, scan).penalty))
    without.fit.forget()
    return out


def _find_largest_gains(
    scans: list[_Scan], without: Solution, data: list[Array], jobs: int
) -> Array:
    """Return the largest penalised gain (count,) of any candidate."""

    def gain(scan: _Scan) -> Array:
        return _measure_gains(scan, without.fit, data) - scan.penalty

    top = np.full(data[0].shape[2], -np.inf)
    # threads: nearly all of it is linear algebra, and the stacks would have to be copied
    with ThreadPoolExecutor(jobs) as pool:
        for found in pool.map(gain, scans) if jobs > 1 else map(gain, scans):
            top = np.maximum(top, found)
    return top


def _measure_gains(scan: _Scan, fit: Fit, data: list[Array]) -> Array:
    """Return the largest gain (count,) of one candidate over its grid."""
    candidate = scan.candidate
    base_c = np.zeros((len(fit.coefficients), data[0].shape[2]))
    parts = []
    for s, weighted in enumerate(data):
        C, V, index = fit.designs[s]
        A, _, B = scan.scan.parts[s]
        parts.append(
            (A, _sum_right_hand_sides(scan.scan.stacks[s], candidate.directions, weighted), B)
        )
        base_c[index] += np.einsum("er,pr,eps->rs", C, V, weighted, optimize=True)
    gains = gains_beside(candidate, parts, fit.normals()[0], base_c)
    return np.asarray(sum(g.max(axis=0) for g in gains))


def _sum_right_hand_sides(stack: Array, directions: Array, weighted: Array) -> Array:
    """Return right-hand sides (G, mk, count) of trajectories (G, E, m) along directions (P, k)."""
    G, E, m = stack.shape
    along = directions.T @ weighted  # (E, k, count)
    _, k, count = along.shape
    s = np.moveaxis(stack, 0, 1).reshape(E, G * m)
    out: Array = (s.T @ along.reshape(E, -1)).reshape(G, m * k, count)
    return out
