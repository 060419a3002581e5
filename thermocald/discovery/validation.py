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
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from thermocald.discovery import criteria
from thermocald.photogrammetry.linalg import orthonormal_combinations, subtract_level
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.movement import solve_combinations
from thermocald.thermal.scan import gains_beside

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.discovery.search import Search, Solution
    from thermocald.thermal.hypothesis import Candidate, Fit
    from thermocald.thermal.scan import Scan

BLOCKS = 6
_PRIOR = 1e-6  # of a coefficient's whole information, where the other blocks hold none


def _predict_blocks(
    fitter: HypothesisFitter, fit: Fit, series: Sequence[int]
) -> tuple[Array, Array]:
    """Return χ² and -2 log likelihood (blocks,) of the blocks as predicted without them.

    series: those that take part. Non-linear parameters stay as they are. The coefficients' own
    uncertainty is in the prediction: a step that happened in the block itself is not foreseen, and
    not held against its cause.
    """
    chi2, objective = np.zeros(BLOCKS), np.zeros(BLOCKS)
    for k in range(BLOCKS):
        masks = []
        for e in fitter.series:
            edges = np.linspace(0, len(e.times), BLOCKS + 1).astype(int)
            place = np.arange(len(e.times))
            masks.append((place >= edges[k]) & (place < edges[k + 1]))
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
            objective[k] += tested.weightings[s].logdet
        chi2[k] -= float(g @ np.linalg.solve(known + B, g))
        objective[k] += chi2[k] + both
    return chi2, objective


def measure_block_gains(fitter: HypothesisFitter, fit: Fit, kept: int = 0) -> list[Array]:
    """Return by how much each effect beyond the first `kept` improves the prediction of blocks
    (blocks,).

    The others are fitted again without it; in -2 log likelihood, all series together.
    """
    every = range(len(fitter.series))
    whole = _predict_blocks(fitter, fit, every)[1]
    out = []
    for i in range(kept, len(fit.terms)):
        fewer = fitter.fit([t for j, t in enumerate(fit.terms) if j != i])
        out.append(_predict_blocks(fitter, fitter.refine(fewer), every)[1] - whole)
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
    outside = float(_predict_blocks(fitter, fit, [0])[0].sum())
    free = e.rank * float((e.n > 0).sum())
    return outside / max(free - BLOCKS * e.rank, 1.0), fit.chi2_of(0) / max(free - e.rank, 1.0)


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
    scans: list[tuple[Candidate, Scan, float]] = []
    for candidate in search.candidates:
        if candidate.effect not in without.names:
            scan = search.scanner.scan(candidate, without.fit)
            scans.append((candidate, scan, search.promise(candidate, scan).penalty))
    without.fit.forget()
    tops = np.zeros(0)
    for few in (min(_FIRST, count), count - min(_FIRST, count)):
        if few and not np.any(tops >= gain):
            every = range(len(best.weightings))
            data = [_draw_data(search, best, without.fit, s, rng, few) for s in every]
            gains = partial(_measure_gains, without.fit, data)
            # threads: nearly all of it is linear algebra, and the stacks would have to be copied
            with ThreadPoolExecutor(jobs) as pool:
                found = list(pool.map(gains, scans) if jobs > 1 else map(gains, scans))
            tops = np.append(tops, np.max(found, axis=0))
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
    rest = subtract_level(w.N, w.left(best.parameters(series)))
    y = 1.1 * solve_combinations(w.N, rest, W)[1]
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


def _measure_gains(fit: Fit, data: list[Array], tried: tuple[Candidate, Scan, float]) -> Array:
    """Return the largest penalised gain (count,) of one candidate over its grid.

    Of its scan all but the right-hand sides serves any data.
    """
    candidate, scan, penalty = tried
    base_c = np.zeros((len(fit.coefficients), data[0].shape[2]))
    parts = []
    for s, weighted in enumerate(data):
        C, V, index = fit.designs[s]
        A, _, B = scan.parts[s]
        stack = scan.stacks[s]
        # right-hand sides (G, mk, count) of trajectories (G, E, m) along the directions (P, k)
        G, E, m = stack.shape
        along = candidate.directions.T @ weighted  # (E, k, count)
        _, k, count = along.shape
        by_time = np.moveaxis(stack, 0, 1).reshape(E, G * m)
        right = (by_time.T @ along.reshape(E, -1)).reshape(G, m * k, count)
        parts.append((A, right, B))
        base_c[index] += np.einsum("er,pr,eps->rs", C, V, weighted, optimize=True)
    gains = gains_beside(candidate, parts, fit.normals()[0], base_c)
    return np.asarray(sum(g.max(axis=0) for g in gains)) - penalty
