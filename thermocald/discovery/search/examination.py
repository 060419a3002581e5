"""The examination: from evidence to the effects that explain it, or to none."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery.evidence.image_space import Displaced, displaced_targets
from thermocald.discovery.search.cross_validation import confirmed, gains
from thermocald.discovery.search.mounted import convincing, search_beside_mount, without_slips
from thermocald.discovery.search.search import Search, Solution
from thermocald.discovery.search.surrogates import SurrogateTest, surrogate_test
from thermocald.reduction.adequacy import Adequacy, examine
from thermocald.reduction.blocks import in_blocks
from thermocald.reduction.calibrated import calibrated_thermometers
from thermocald.reduction.curvature import curved
from thermocald.reduction.fit import HypothesisFitter
from thermocald.reduction.movement import combinations, steadied
from thermocald.reduction.noise import noisier, trembling, with_correlated_noise
from thermocald.reduction.noise_growth import NoiseGrowth, noise_growth
from thermocald.reduction.reduce import reweighted

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from thermocald.reduction.hypothesis import Term
    from thermocald.reduction.movement import Mount
    from thermocald.reduction.series import ReducedSeries

    Array = NDArray[np.float64]

__all__ = ["Examination", "examine_series"]

MAX_EFFECTS = 3
# variance of slow trajectories over that of white noise from which on a mount is asked for
_MEMORY = 1.9
# how much more a movement has in its slowest half-waves than a random walk has
_SMOOTH = 30.0
# how much worse a solution may score and still not be excluded
BAND = 14.0
# a model that leaves less than this share of what the base left has the cause
_LEFT = 0.03
# by how much worse (χ²) another way of following the temperature may fit and not be excluded
_SWAP_BAND = 120.0
# slow variances over those of white noise: beyond, what one series shows has to be seen in another
_WANDERING = 3.0
# a second effect alongside an adequate one has to explain as much, in px RMS and as a share of the
# first: below that, it is the first one's finer points
_LEFT_PX, _LEFT_SHARE = 0.005, 0.15


@dataclass(frozen=True, eq=False)
class Examination:
    """What the search found.

    fitter: the series as examined, displaced targets out and noise weighted; base, best: solutions;
    ranking: singles by score; rivals: solutions that cannot be excluded; adequacy: of best, per
    series; cross_validation: gains (blocks,) of its effects on blocks of time left out; surrogates:
    each of its effects against surrogates; mount: its movement, where it moves; knocks: of the
    mount, terms of the base.
    """

    fitter: HypothesisFitter
    base: Solution
    best: Solution
    ranking: tuple[Solution, ...]
    rivals: tuple[Solution, ...]
    base_adequacy: tuple[Adequacy, ...]
    adequacy: tuple[Adequacy, ...]
    adequate: bool
    cross_validation: tuple[Array, ...] = ()
    displaced: tuple[tuple[Displaced, ...], ...] = ()
    noise_growth: NoiseGrowth | None = None
    surrogates: tuple[SurrogateTest, ...] = ()
    mount: Mount | None = None
    knocks: tuple[Term, ...] = ()
    original: tuple[ReducedSeries, ...] = ()


def examine_series(
    series: Sequence[ReducedSeries],
    progress: Callable[[str], None] | None = None,
    given: Sequence[tuple[str, dict[str, Any]]] = (),
) -> Examination:
    """Examine one series, or M1 with M2, which share their physical constants.

    given: effects that the model has already, with their values; they are fitted again and stay.
    """
    say = progress or (lambda _: None)
    say("targets that moved")
    displaced, cleaned = [], []
    for e in series:
        groups, without = displaced_targets(e)
        displaced.append(tuple(groups))
        cleaned.append(without)
    say("measuring noise")
    growth = noise_growth(cleaned)
    if growth is not None:
        cleaned = [reweighted(e, n) for e, n in zip(cleaned, growth.noise, strict=True)]
    calibrated = calibrated_thermometers(cleaned)
    ready = [in_blocks(with_correlated_noise(e)) for e in calibrated]
    found = None
    if max(e.correlation for e in calibrated) > _MEMORY:
        found = _beside_mount(calibrated, say, given)
    if found is None:
        found = _still(ready, say, given)
    return replace(found, displaced=tuple(displaced), noise_growth=growth, original=tuple(series))


def _still(
    ready: list[ReducedSeries],
    say: Callable[[str], None],
    given: Sequence[tuple[str, dict[str, Any]]],
) -> Examination:
    """The search where the mount stands still."""
    found = _searched(HypothesisFitter(ready), say, given)
    bent = curved(found.fitter, found.best.fit)
    if bent is not None:
        say("curvature of the projection: once more")
        found = _searched(HypothesisFitter(bent), say, given)
    noisy = noisier(found.fitter, found.best.fit)
    if noisy is not None:
        say("noise that targets share: once more")
        found = _searched(HypothesisFitter(noisy), say, given)
    return found


def _beside_mount(
    calibrated: list[ReducedSeries],
    say: Callable[[str], None],
    given: Sequence[tuple[str, dict[str, Any]]],
) -> Examination | None:
    """The search alongside a mount that moves; None where the movement is not one of a mount.

    A smooth influence that nobody recorded is not a wander of a mount.
    """
    fitter = HypothesisFitter([in_blocks(replace(e, correlation=1.0)) for e in calibrated])
    fitter = HypothesisFitter(steadied(fitter, fitter.fit(()), combinations(fitter.series)))
    shaken = trembling(fitter, fitter.fit(()))
    found = search_beside_mount(HypothesisFitter(shaken), say, given)
    if found.mount.smoothness(found.fitter, found.best.fit) > _SMOOTH:
        return None
    search = Search(found.fitter, say)
    best, blocks, tests = _named(search, found.base, found.best)
    if any(t.kind.is_event and t not in best.terms for t in found.best.terms):
        found = without_slips(found, len(given))  # steps that cannot be named are still there
        best, blocks, tests = _named(search, found.base, found.best)
    base = found.base
    if not convincing(found.fitter, base, best):
        best, blocks, tests = base, [], ()
    adequacy = _adequacies(found.fitter, best)
    rivals: list[Solution] = []
    for s in sorted(found.seen, key=lambda s: s.score):
        names = [t.effect for t in s.terms if t not in found.knocks]
        own = [t.effect for t in best.terms if t not in found.knocks]
        # between two readings nobody knows the temperature: a delay and its rate look alike
        differ = [t for t in (*s.terms, *best.terms) if (t in s.terms) != (t in best.terms)]
        band = _SWAP_BAND if any(t.kind.delay for t in differ) else BAND
        close = s.score < best.score + band and len(names) <= len(own)
        if close and sorted(names) != sorted(own) and s.names not in [r.names for r in rivals]:
            rivals.append(s)
    return Examination(
        found.fitter, base, best, found.ranking, tuple(rivals), _adequacies(found.fitter, base),
        adequacy, True, tuple(blocks), surrogates=tests, mount=found.mount, knocks=found.knocks,
    )  # fmt: skip


def _searched(
    fitter: HypothesisFitter,
    say: Callable[[str], None],
    given: Sequence[tuple[str, dict[str, Any]]],
) -> Examination:
    """The search itself, in the trajectories of the parameters."""
    say("base model")
    search = Search(fitter, say)
    base = search.base(given)
    base_adequacy = _adequacies(fitter, base)
    best, ranking = base, []
    frontier = [base]
    seen: list[Solution] = []
    adequate = False
    for level in range(1, MAX_EFFECTS + 1):
        grown: list[Solution] = []
        for solution in frontier:
            say(f"effect {level}: alongside {', '.join(solution.names) or 'the base'}")
            wide = 6 if level == 1 else 4
            kept = len(base.terms)
            grown += [search.shrink(s, kept) for s in search.expand(solution, wide)]
        if level == 1:
            ranking = sorted(grown, key=lambda s: s.score)
        seen += grown
        if not grown:
            break
        champion = min(grown, key=lambda s: s.score)
        if champion.score >= best.score:
            break
        if level > 1 and adequate:
            least = max(_LEFT_PX, _LEFT_SHARE * _size_px(fitter, base, best))
            if _size_px(fitter, best, champion) < least:
                break
        best = champion
        adequate = _adequate(_adequacies(fitter, best), base_adequacy)
        # what is adequate may still lack something too fast for the absolute test
        frontier = [best] if adequate or level > 1 else _frontier(grown)
    # larger combinations that were not accepted are no rivals
    seen = [s for s in seen if len(s.terms) <= len(best.terms)]
    if len(best.terms) > len(base.terms):
        best, seen = _contest(search, best, seen)
        best, seen = _lag_or_delay(search, best, seen)
    best, blocks = _confirmed(search, base, best)
    tests: tuple[SurrogateTest, ...] = ()
    if _adequate(_adequacies(fitter, best), base_adequacy):
        best, blocks, tests = _named(search, base, best)
    adequacy = _adequacies(fitter, best)
    adequate = _adequate(adequacy, base_adequacy)
    if len(best.terms) > len(base.terms) and _unverified(fitter.series):
        adequate = False
    rivals: list[Solution] = []
    for s in sorted(seen, key=lambda s: s.score):
        different = sorted(s.names) != sorted(best.names)
        close = s.score < best.score + BAND
        if _swapped(best, s):
            close = s.fit.chi2 < best.fit.chi2 + _SWAP_BAND
        if different and close and s.names not in [r.names for r in rivals]:
            rivals.append(s)
    return Examination(
        fitter, base, best, tuple(ranking), tuple(rivals), base_adequacy, adequacy, adequate,
        tuple(blocks), surrogates=tests,
    )  # fmt: skip


def _lag_or_delay(
    search: Search, best: Solution, seen: list[Solution]
) -> tuple[Solution, list[Solution]]:
    """Of a lag and a delay the one that fits better, and both among the solutions seen.

    The likelihood holds every trajectory of the temperature for equally probable. A lag smooths the
    thermometer's noise, a delay does not; so a smooth image, which all temperatures give, would
    speak for a lag whatever the cause. Between these two the fit alone decides.
    """
    other = _with_the_other(search, best)
    if other is None:
        return best, seen
    if other.fit.chi2 < best.fit.chi2 - 0.5 * _SWAP_BAND:
        return other, [*seen, other]
    return best, [*seen, other]


def _with_the_other(search: Search, solution: Solution) -> Solution | None:
    """The solution with another effect that delays the temperature in place of the one it has."""
    delays = [c for c in search.candidates if c.kind.delay]
    for i, term in enumerate(solution.terms):
        if not term.kind.delay:
            continue
        seconds = float(dict(term.nonlinear)[term.kind.delay])
        others = [c for c in delays if c.effect not in solution.names]
        if seconds <= 0 or not others:
            return None
        found = []
        for candidate in others:
            swapped = candidate.term(seconds, len(search.fitter.series))
            terms = (*solution.terms[:i], swapped, *solution.terms[i + 1 :])
            found.append(search.refine(terms, solution.penalties))
        return min(found, key=lambda s: s.fit.chi2)
    return None


def _swapped(one: Solution, other: Solution) -> bool:
    """Whether the two differ in one way of following the temperature for another only."""
    mine = [t for t in one.terms if t.effect not in other.names]
    theirs = [t for t in other.terms if t.effect not in one.names]
    return len(mine) == len(theirs) == 1 and mine[0].is_drive and theirs[0].is_drive


def _unverified(series: Sequence[ReducedSeries]) -> bool:
    """Single targets wander so much that one series alone carries no name."""
    return len(series) < 2 and max(e.correlation for e in series) > _WANDERING


def _named(
    search: Search, base: Solution, best: Solution
) -> tuple[Solution, list[Array], tuple[SurrogateTest, ...]]:
    """The solution without effects that blocks left out or surrogates speak against."""
    kept = len(base.terms)
    best, blocks = _confirmed(search, base, best)
    while len(best.terms) > kept:
        tests = []
        for i in range(kept, len(best.terms)):
            without = _without(search, base, best, i)
            gain = without.score - best.score
            tests.append(surrogate_test(search, best.fit, without, gain))
        worst = max(range(len(tests)), key=lambda i: tests[i].p)
        if tests[worst].passed:
            return best, blocks, tuple(tests)
        search.progress(f"{best.names[kept + worst]} is not more than noise may give")
        best, blocks = _confirmed(search, base, _without(search, base, best, kept + worst))
    return best, blocks, ()


def _without(search: Search, base: Solution, best: Solution, number: int) -> Solution:
    """The solution without one of its effects, the others fitted again."""
    terms = [t for i, t in enumerate(best.terms) if i != number]
    penalties = [p for i, p in enumerate(best.penalties) if i != number]
    return search.refine(terms, penalties) if len(terms) > len(base.terms) else base


def _confirmed(search: Search, base: Solution, best: Solution) -> tuple[Solution, list[Array]]:
    """The solution without effects that do not predict blocks left out, and what the others gain
    on each block.
    """
    kept = len(base.terms)
    while len(best.terms) > kept:
        blocks = gains(search.fitter, best.fit, kept)
        bad = [i for i, g in enumerate(blocks) if not confirmed(g)]
        if not bad:
            return best, blocks
        worst = kept + min(bad, key=lambda i: float(blocks[i].sum()))
        search.progress(f"{best.names[worst]} does not predict the blocks left out")
        best = _without(search, base, best, worst)
    return best, []


def _contest(
    search: Search, best: Solution, seen: list[Solution]
) -> tuple[Solution, list[Solution]]:
    """Near ties again, each under the thermometer noise that suits it best."""
    close = {s.terms: s for s in seen if s.score < best.score + 60.0}
    if len({s.names for s in close.values()}) < 2:
        return best, seen
    fitter = search.fitter
    again: list[Solution] = []
    for s in sorted(close.values(), key=lambda s: s.score)[:6]:
        _, objective = fitter.thermometer_scale(s.fit)
        again.append(replace(s, fit=replace(s.fit, logdet=objective - s.fit.chi2)))
    again.sort(key=lambda s: s.score)
    others = [s for s in seen if s.terms not in close]
    return again[0], [*again, *others]


def _size_px(fitter: HypothesisFitter, without: Solution, with_it: Solution) -> float:
    """RMS px that one more effect explains."""
    gain = max(without.score - with_it.score, 0.0)
    coordinates = 2.0 * sum(float(e.n.sum()) for e in fitter.series)
    weights = np.concatenate([e.weights[..., 0].ravel() for e in fitter.series])
    return float(np.sqrt(gain / coordinates / np.mean(weights[weights > 0])))


def _frontier(grown: list[Solution], width: int = 4) -> list[Solution]:
    """The best solutions of a level, one per set of names."""
    out: list[Solution] = []
    for s in sorted(grown, key=lambda s: s.score):
        if all(sorted(s.names) != sorted(o.names) for o in out):
            out.append(s)
    return out[:width]


def _adequacies(fitter: HypothesisFitter, solution: Solution) -> tuple[Adequacy, ...]:
    return tuple(examine(fitter, solution.fit, s) for s in range(len(fitter.series)))


def _adequate(now: Sequence[Adequacy], base: Sequence[Adequacy]) -> bool:
    return all(
        a.adequate or a.misfit_px < _LEFT * b.misfit_px for a, b in zip(now, base, strict=True)
    )
