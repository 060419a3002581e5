"""Solutions that the data cannot exclude beside the best one, and the choice among near ties."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.discovery import criteria
from thermocald.discovery.search import Search, Solution, by_score

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.thermal.hypothesis import Term
    from thermocald.thermal.series import ReducedSeries


def list_rivals(best: Solution, seen: Sequence[Solution]) -> tuple[Solution, ...]:
    """List the solutions that cannot be excluded beside the best one, best first."""
    out: list[Solution] = []
    for s in sorted(seen, key=by_score):
        mine = [t for t in best.terms if t.effect not in s.names]
        theirs = [t for t in s.terms if t.effect not in best.names]
        worse, band = s.score - best.score, criteria.BAND
        single = len(mine) == len(theirs) == 1
        # one drive in place of another is compared by the fit alone
        if single and mine[0].kind.is_drive and theirs[0].kind.is_drive:
            worse, band = s.fit.chi2 - best.fit.chi2, criteria.DRIVES_BAND
        # and so is a step that one epoch shows: any cause that begins there fits it as well, and
        # the determinant counts only how much the readings' errors blur this epoch
        elif any(_shows_once(t, best.fitter.series) for t in mine):
            worse = s.fit.chi2 - best.fit.chi2
        # the determinant counts how much the readings' errors blur a rate, which excludes none
        elif single and theirs[0].kind.follows_rate and not mine[0].kind.is_drive:
            worse -= s.fit.logdet - best.fit.logdet
        close = worse < band
        different = sorted(s.names) != sorted(best.names)
        if different and close and s.names not in [r.names for r in out]:
            out.append(s)
    # a larger one says nothing new if it contains another
    more = [s for s in out if len(s.terms) > len(best.terms)]
    said = [s for s in more if any(set(r.names) < set(s.names) for r in (best, *out))]
    return tuple(s for s in out if s not in said)


def _shows_once(term: Term, series: Sequence[ReducedSeries]) -> bool:
    """Test whether an event has one epoch before or after it, in each series in which it occurs."""
    if not term.kind.is_event:
        return False
    pairs = zip(series, term.fresh, strict=True)
    later = [e.times[e.n > 0] >= own[0][1] for e, own in pairs if own]
    return all(min(np.sum(after), np.sum(~after)) <= 1 for after in later)


def settle_ties(
    search: Search, best: Solution, larger: Solution, seen: list[Solution]
) -> tuple[Solution, list[Solution]]:
    """Choose among near ties; larger: the best combination with one more effect."""
    decides = does_better(larger, best, by=criteria.BAND)
    best, seen = _compare_ties(search, best, seen)
    if decides:  # its last effect is too small for a name, but shows which tie is right
        ties = [s for s in seen if s.score < best.score + criteria.BAND]
        inside = [s for s in ties if set(s.names) < set(larger.names)]
        best = min(inside, key=by_score, default=best)
    # The likelihood takes all trajectories of the temperature as equally probable. A lag smooths
    # the thermometer's noise, a delay does not, so a smooth image would always favour a lag: only
    # the fit decides.
    other = search.with_other_delay(best)
    if other is not None:
        seen = [*seen, other]
        best = other if other.fit.chi2 < best.fit.chi2 - 0.5 * criteria.DRIVES_BAND else best
    return best, seen


def _compare_ties(
    search: Search, best: Solution, seen: list[Solution]
) -> tuple[Solution, list[Solution]]:
    """Compare near ties again, each with the thermometer noise that fits it best."""
    close = {s.terms: s for s in seen if s.score < best.score + 60.0}
    if len({s.names for s in close.values()}) < 2:
        return best, seen

    def compare(solutions: list[Solution], most: int) -> list[Solution]:
        again = []
        for s in sorted(solutions, key=by_score)[:most]:
            objective = search.fitter.suit_thermometers(s.fit)
            again.append(replace(s, fit=replace(s.fit, logdet=objective - s.fit.chi2)))
        return sorted(again, key=by_score)

    small = compare([s for s in close.values() if len(s.terms) <= len(best.terms)], 6)
    large = compare([s for s in close.values() if len(s.terms) > len(best.terms)], 2)
    return small[0], [*small, *large, *(s for s in seen if s.terms not in close)]


def does_better(larger: Solution, best: Solution, by: float = 0.0) -> bool:
    """Test whether a larger combination without one of the best one's effects scores better."""
    return larger.score < best.score - by and not set(best.names) <= set(larger.names)


def may_replace(
    base: Solution, best: Solution, equal: Sequence[Solution], champion: Solution
) -> bool:
    """Decide whether a solution replaces `best`, which is adequate, or one `equal` to it.

    One more effect must explain more than a refinement of the others would; other effects must
    exclude these and also fit better, not only by a smoother temperature.
    """
    fewer = [s for s in equal if set(s.names) <= set(champion.names)]
    if not fewer:
        return (
            _measure_px(best, champion) >= criteria.CURVATURE_PX
            and champion.score < best.score - criteria.BAND
            and champion.fit.chi2 < best.fit.chi2
        )
    least = max(criteria.FURTHER_PX, criteria.FURTHER_SHARE * _measure_px(base, best))
    return all(_measure_px(s, champion) >= least for s in fewer)


def _measure_px(without: Solution, with_it: Solution) -> float:
    """Return the RMS that one more effect explains, px."""
    gain = max(without.score - with_it.score, 0.0)
    series = without.fitter.series
    coordinates = 2.0 * sum(float(e.n.sum()) for e in series)
    weights = np.concatenate([e.weights[..., 0].ravel() for e in series])
    return float(np.sqrt(gain / coordinates / np.mean(weights[weights > 0])))
