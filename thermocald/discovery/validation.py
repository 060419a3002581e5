"""The validation of an effect: blocks of time left out, and surrogates with noise but no cause.

Surrogates. The residuals of the best hypothesis are moved in time against the temperatures (shifted
cyclically, reversed, inverted in sign, or cut into blocks that are permuted), added to the model
without the effect, and searched again with every candidate. The probability of a false name, after
the search, is the share of surrogates whose largest penalised gain reaches the effect's. If one of
the first few surrogates reaches it, the effect is not named, and the probability is that of a
sequential test.

Source: Theiler et al. (1992), Physica D 58, 77-94 (surrogate data); Davison, Hinkley (1997),
Bootstrap Methods, section 8.2 (blocks) and 4.2 (p-values from simulations); Besag, Clifford (1991),
Biometrika 78, 301-304 (sequential p-values).

Cross-validation. Each series is cut into blocks. One block of every series is left out, the
coefficients are fitted to the others, and the block's likelihood is evaluated with them and a level
of its own. An effect that only follows the noise, or imitates another trajectory, predicts nothing.

Source: cross-validation in blocks, Burman, Chow, Nolan (1994), Biometrika 81, 351-358.
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
from thermocald.thermal.scan import gains_beside, scan_candidate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.discovery.search import Search, Solution
    from thermocald.thermal.hypothesis import Candidate, Fit
    from thermocald.thermal.scan import Scan

BLOCKS = 6
_PRIOR = 1e-6  # share of a coefficient's information, in case the other blocks hold none


def _predict_blocks(fitter: HypothesisFitter, fit: Fit) -> Array:
    """Return -2 log likelihood (blocks,) of each block, predicted from the others.

    Non-linear parameters are held. The prediction includes the coefficients' uncertainty, so that a
    step within the block, which the others cannot predict, does not count against its cause.
    """
    objective = np.zeros(BLOCKS)
    for k in range(BLOCKS):
        masks = []
        for e in fitter.series:
            edges = np.linspace(0, len(e.times), BLOCKS + 1).astype(int)
            place = np.arange(len(e.times))
            masks.append((place >= edges[k]) & (place < edges[k + 1]))
        trained = _keep_epochs(fitter, [~m for m in masks]).fit(fit.terms, fit.coefficients, 1)
        tested = _keep_epochs(fitter, masks).fit(fit.terms, fit.coefficients, 1)
        known = trained.normals()[0] + np.diag(_PRIOR * np.diag(fit.normals()[0]))
        B, c = tested.normals()
        g = c - B @ trained.coefficients
        both = np.linalg.slogdet(known + B)[1] - np.linalg.slogdet(known)[1]
        chi2 = sum(tested.chi2_of(s, trained.coefficients) for s in range(len(masks)))
        objective[k] = chi2 - float(g @ np.linalg.solve(known + B, g)) + both + tested.logdet
    return objective


def measure_block_gains(fitter: HypothesisFitter, fit: Fit, kept: int = 0) -> list[Array]:
    """Return the gains (blocks,) of each effect beyond the first `kept` in predicting blocks.

    A gain is in -2 log likelihood, of all series, relative to the other effects fitted without it.
    """
    whole = _predict_blocks(fitter, fit)
    out = []
    for i in range(kept, len(fit.terms)):
        fewer = fitter.fit(fit.terms[:i] + fit.terms[i + 1 :])
        out.append(_predict_blocks(fitter, fitter.refine(fewer)) - whole)
    return out


def is_confirmed(gain: Array) -> bool:
    """Test whether a cause improves the prediction of the blocks and worsens none of them."""
    total = float(gain.sum())
    return total > 0 and float(gain.min()) > -(
        criteria.BLOCK_WORSE + criteria.BLOCK_WORSE_SHARE * total
    )


def _keep_epochs(fitter: HypothesisFitter, masks: Sequence[NDArray[np.bool_]]) -> HypothesisFitter:
    """Return a fitter with the weights of some epochs only and the same trajectories."""
    pairs = zip(fitter.series, masks, strict=True)
    part = [replace(e.weighted(m.astype(float)), n=e.n * m) for e, m in pairs]
    return HypothesisFitter(part, like=fitter)


_FIRST = 20  # surrogates, one of which suffices to drop a name
_SEED = 20


@dataclass(frozen=True, eq=False)
class SurrogateTest:
    """The test of an effect against surrogates: its penalised gain, and theirs (S,)."""

    gain: float
    surrogates: Array

    @property
    def p(self) -> float:
        """The probability of a false name: the share of surrogates that reach the gain."""
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
    """Test one effect; `without` is the best solution without it, in the same fitter.

    gain: improvement of the penalised score by the effect; jobs: number of candidates tried at a
    time; the result is the same for any number.
    """
    rng = np.random.default_rng(_SEED)
    scans: list[tuple[Candidate, Scan, float]] = []
    for candidate in search.candidates:
        if candidate.effect not in without.names:
            scan = scan_candidate(search.fitter, candidate, without.fit)
            scans.append((candidate, scan, search.promise(candidate, scan).penalty))
    without.fit.forget()
    tops = np.zeros(0)
    for few in (min(_FIRST, count), count - min(_FIRST, count)):
        if few and not np.any(tops >= gain):
            every = range(len(best.weightings))
            data = [_draw_data(search, best, without.fit, s, rng, few) for s in every]
            gains = partial(_measure_gains, without.fit, data)
            # threads, since nearly all is linear algebra and processes would copy the stacks
            with ThreadPoolExecutor(jobs) as pool:
                every_gain = list(pool.map(gains, scans) if jobs > 1 else map(gains, scans))
            tops = np.append(tops, np.max(every_gain, axis=0))
    return SurrogateTest(gain, tops)


def _draw_data(
    search: Search, best: Fit, without: Fit, series: int, rng: np.random.Generator, count: int
) -> Array:
    """Draw weighted data (E, P, count) of surrogates; summed along trajectories they are right-hand
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
    """Move a trajectory (E, m) in time: shifted, reversed or in permuted blocks, of either sign."""
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
    """Return a candidate's largest penalised gain (count,) over its grid.

    All of its scan but the right-hand sides is valid for any data.
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
