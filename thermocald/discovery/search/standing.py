"""The search where the mount stands still: combinations grow while the score improves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.discovery.search.search import Solution
from thermocald.reduction.adequacy import Adequacy, examine

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.discovery.search.search import Search
    from thermocald.reduction.fit import HypothesisFitter

__all__ = ["BAND", "SWAP_BAND", "Standing", "adequacies", "adequate", "search_standing"]

_EFFECTS = 3
_COMBINATIONS = 8  # of a level that are fitted in full
# how much worse a solution may score and still not be excluded
BAND = 14.0
# a model that leaves less than this share of what the base left has the cause
_LEFT = 0.03
# by how much worse (χ²) another way of following the temperature may fit and not be excluded
SWAP_BAND = 120.0
# a second effect alongside an adequate one has to explain as much, in px RMS and as a share of the
# first: below that, it is the first one's finer points
_LEFT_PX, _LEFT_SHARE = 0.005, 0.15
# px to which the curvature of the projection is known where the image moves by ten
_CURVATURE_PX = 0.001


@dataclass(frozen=True, eq=False)
class Standing:
    """What the search found: base, best; ranking: single effects by score; seen: every solution
    that was looked at.
    """

    search: Search
    base: Solution
    best: Solution
    ranking: tuple[Solution, ...]
    seen: tuple[Solution, ...]
    base_adequacy: tuple[Adequacy, ...]

    def adequate(self, solution: Solution) -> bool:
        """Whether a solution leaves nothing."""
        return adequate(adequacies(self.search.fitter, solution), self.base_adequacy)

    def rivals(self, best: Solution) -> tuple[Solution, ...]:
        """Solutions that cannot be excluded in favour of the best, best first."""
        out: list[Solution] = []
        for s in sorted(self.seen, key=lambda s: s.score):
            different = sorted(s.names) != sorted(best.names)
            close = s.score < best.score + BAND
            if _swapped(best, s):
                close = s.fit.chi2 < best.fit.chi2 + SWAP_BAND
            if different and close and s.names not in [r.names for r in out]:
                out.append(s)
        return tuple(out)


def search_standing(search: Search, base: Solution, say: Callable[[str], None]) -> Standing:
    """The search itself, in the trajectories of the parameters."""
    fitter = search.fitter
    kept = len(base.terms)
    base_adequacy = adequacies(fitter, base)
    best, ranking, seen = base, list[Solution](), list[Solution]()
    frontier = [base]
    complete = False
    for level in range(1, _EFFECTS + 1):
        say(f"effect {level}: alongside {' or '.join(', '.join(s.names) for s in frontier)}"
            if level > 1 else "effect 1: alongside the base")  # fmt: skip
        if level == 1:
            grown = search.expand(base)
            ranking = grown
        else:
            # once nothing is left over, other effects have to promise more than the best explains
            below = best.score if complete else np.inf
            more = search.expand_all(frontier, 4, _COMBINATIONS, below)
            grown = [search.shrink(s, kept) for s in more]
        seen += grown
        if complete:
            equal = [s for s in frontier if s.score < best.score + BAND]
            grown = [s for s in grown if _worth_it(fitter, base, best, equal, s)]
        if not grown:
            break
        champion = min(grown, key=lambda s: s.score)
        if champion.score >= best.score:
            break
        best = search.with_events_moved(champion)
        seen.append(best)
        complete = adequate(adequacies(fitter, best), base_adequacy)
        # what is adequate may still lack something too fast for the absolute test, and one effect
        # with many coefficients may stand for two others that nobody has tried together yet
        frontier = _frontier(grown) if complete or level == 1 else [best]
    # larger combinations that were not accepted are no rivals
    seen = [s for s in seen if len(s.terms) <= len(best.terms)]
    if len(best.terms) > kept:
        best, seen = _contest(search, best, seen)
        best, seen = _lag_or_delay(search, best, seen)
    return Standing(search, base, best, tuple(ranking), tuple(seen), base_adequacy)


def _lag_or_delay(
    search: Search, best: Solution, seen: list[Solution]
) -> tuple[Solution, list[Solution]]:
    """Of a lag and a delay the one that fits better, and both among the solutions seen.

    The likelihood holds every trajectory of the temperature for equally probable. A lag smooths the
    thermometer's noise, a delay does not; so a smooth image, which all temperatures give, would
    speak for a lag whatever the cause. Between these two the fit alone decides.
    """
    other = search.with_other_delay(best)
    if other is None:
        return best, seen
    if other.fit.chi2 < best.fit.chi2 - 0.5 * SWAP_BAND:
        return other, [*seen, other]
    return best, [*seen, other]


def _swapped(one: Solution, other: Solution) -> bool:
    """Whether the two differ in one way of following the temperature for another only."""
    mine = [t for t in one.terms if t.effect not in other.names]
    theirs = [t for t in other.terms if t.effect not in one.names]
    return len(mine) == len(theirs) == 1 and mine[0].is_drive and theirs[0].is_drive


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


def _worth_it(
    fitter: HypothesisFitter,
    base: Solution,
    best: Solution,
    equal: Sequence[Solution],
    champion: Solution,
) -> bool:
    """Whether effects are told in place of `best`, which explains all, or of one `equal` to it.

    One effect more has to be worth more than the finer points of the others; others in their
    place have to exclude them, and to fit better: a smoother temperature alone is no reason.
    """
    fewer = [s for s in equal if set(s.names) <= set(champion.names)]
    if not fewer:
        more = _size_px(fitter, best, champion) >= _CURVATURE_PX
        return more and champion.score < best.score - BAND and champion.fit.chi2 < best.fit.chi2
    least = max(_LEFT_PX, _LEFT_SHARE * _size_px(fitter, base, best))
    return all(_size_px(fitter, s, champion) >= least for s in fewer)


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


def adequacies(fitter: HypothesisFitter, solution: Solution) -> tuple[Adequacy, ...]:
    """The absolute test of a solution in each series."""
    return tuple(examine(fitter, solution.fit, s) for s in range(len(fitter.series)))


def adequate(now: Sequence[Adequacy], base: Sequence[Adequacy]) -> bool:
    """Whether a solution leaves nothing, or next to nothing of what the base left."""
    return all(
        a.adequate or a.misfit_px < _LEFT * b.misfit_px for a, b in zip(now, base, strict=True)
    )
