"""The search where the camera moves on its mount: each hypothesis alongside the movement it leaves.

What no effect explains is a wander of the mount with a size of its own for each hypothesis, so that
a cause is held against what a moving mount would do by chance. Knocks of the mount, steps that a
turn and a shift of the camera explain as well as a slip inside of it, are no effects: they are
found, kept alongside the base model, and reported with time and size.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from thermocald.discovery import criteria
from thermocald.discovery.search import Search, Solution
from thermocald.photogrammetry.camera.camera_model import EOP_NAMES
from thermocald.thermal.movement import (
    Mount,
    estimate_mount_motion,
    find_combinations,
    guess_mount_motion,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.thermal.fit import HypothesisFitter
    from thermocald.thermal.hypothesis import Term

_WIDTH = 4  # solutions of a level whose movement is estimated
_LEVELS = 5
_EFFECTS = 3
_KNOCKS = 3
_PROMISE = 0.3  # of which a scan has to promise, in the noise before
_CORNERS = (0.0, 3.0)
_REST = 0.05
# further estimates of the movement without an effect, and the share by which one has to come nearer
# to the score with an effect
_TURNS = 5
_SETTLED = 0.1


def search_beside_mount(
    fitter: HypothesisFitter,
    say: Callable[[str], None],
    given: Sequence[tuple[str, dict[str, Any]]] = (),
) -> tuple[Solution, list[Solution], list[Solution], Search]:
    """Add effects and knocks, one by one, while the penalised likelihood improves.

    Returns the best, single effects by score, every solution that was looked at, each with its
    movement, and a search whose trajectories serve in the fitter of the best.
    """
    first = Search(fitter)
    start = first.base(given)
    W = find_combinations(fitter.series)
    guess = guess_mount_motion(fitter, start.fit, W)
    say("movement of the mount")
    trials = [_fit_beside(start, Mount(W, guess, corner), 4) for corner in _CORNERS]
    plain = best = min(trials, key=lambda t: t.score)
    ranking, seen = list[Solution](), list[Solution]()
    for level in range(_LEVELS):
        say(f"alongside the mount: {', '.join(best.names) or 'the base'}")
        search = Search(best.fitter, like=first)
        grown: list[Solution] = []
        # a scan is right to some percent, and a further effect has to be worth much
        further = any(not t.kind.is_event for t in best.terms[len(start.terms) :])
        least = _PROMISE * _least_further(plain, best) if further else 0.0
        for solution in _add_delays(search, search.expand(best, 6, least)[:_WIDTH]):
            trial = _profile(best, solution)
            grown.append(_try_knock(best, trial) or trial)
        if not grown:
            break
        if level == 0:
            ranking = sorted(grown, key=lambda s: s.score)
            # a movement estimated to its end takes up drifts too: a scan would find nothing in it
            plain = best = _settle(plain, ranking[0].score)
        seen += grown
        allowed = [g for g in grown if _is_allowed(g, best, plain, len(start.terms))]
        if not allowed:
            break
        best = min(allowed, key=lambda g: g.score)
    return best, ranking, seen, first


def _add_delays(search: Search, solutions: list[Solution]) -> list[Solution]:
    """Add, for the first delay of the temperature, the other kind of delay too: a scan
    without the movement of the mount may leave it out.
    """
    for solution in solutions:
        other = search.with_other_delay(solution)
        if other is not None:
            names = [s.names for s in solutions]
            return solutions if other.names in names else [*solutions, other]
    return solutions


def _fit_beside(solution: Solution, mount: Mount, turns: int) -> Solution:
    own, fit, mount = estimate_mount_motion(
        solution.fitter, solution.terms, mount, solution.fit.coefficients, turns
    )
    return Solution(fit, solution.penalties, own, mount)


def _settle(found: Solution, best: float) -> Solution:
    """Estimate the movement again from what it leaves over, while it may come below another score:
    a direction that the first estimate has at zero stays there.
    """
    for _ in range(_TURNS):
        if found.score < best:
            break
        more = _profile(found, found)
        if more.score > found.score:
            break
        change, found = found.score - more.score, more
        if change < _SETTLED * (found.score - best):
            break
    return found


def _profile(best: Solution, solution: Solution) -> Solution:
    """Fit a solution with the movement that it leaves; its non-linear parameters refined in it.

    best: what it was found beside, in the same fitter, with its movement.
    """
    assert best.mount is not None
    guess = guess_mount_motion(best.fitter, solution.fit, best.mount.combinations)
    # a share of the movement before: what starts at zero stays there
    mount = replace(best.mount, covariance=guess + _REST * best.mount.covariance)
    found = _fit_beside(solution, mount, 5)
    fit = found.fitter.refine(found.fit, max_iterations=3)
    return replace(found, fit=fit, as_slips=best.as_slips)


def _try_knock(best: Solution, trial: Solution) -> Solution | None:
    """Explain the same event as a knock of the mount, where that does as well; else None."""
    term = trial.terms[-1]
    if not term.kind.is_event:
        return None
    terms = (*trial.terms[:-1], replace(term, parameters=EOP_NAMES))
    more = len(EOP_NAMES) / max(len(term.parameters), 1)
    penalties = (*trial.penalties[:-1], trial.penalties[-1] * more)
    knock = _profile(best, Solution(best.fitter.fit(terms), penalties, best.fitter))
    worse = knock.fit.objective - trial.fit.objective
    if worse < criteria.SLIP_NOT_KNOCK:
        alike = worse > -criteria.SLIP_NOT_KNOCK
        return replace(knock, as_slips=(*best.as_slips, alike))
    return None


def _is_allowed(grown: Solution, best: Solution, plain: Solution, given: int) -> bool:
    """Decide whether a solution improves enough on the one before."""
    gain = best.score - grown.score
    own = [t for t in grown.terms[given:] if not t.kind.is_event]
    knocks = len(grown.terms) - given - len(own)
    if len(own) > _EFFECTS or knocks > _KNOCKS or gain <= 0:
        return False
    if grown.terms[-1].kind.is_event or len(own) == 1:
        return True
    return gain > _least_further(plain, best)


def _least_further(plain: Solution, best: Solution) -> float:
    """Return what an effect after the first has to gain."""
    return max(criteria.MOUNT_FURTHER, criteria.MOUNT_SHARE * (plain.score - best.score))


def split_knocks(
    solution: Solution, given: int, slips: bool = False
) -> tuple[Solution, Solution, tuple[Term, ...]]:
    """Fit the base model with the knocks, and all of it, in its fitter; also return the knocks.

    given: how many terms the model has already; slips: take steps inside the camera for nuisances
    as knocks are.
    """
    every = list(zip(solution.terms, solution.penalties, strict=True))
    first, rest = every[:given], every[given:]
    knocks = [x for x in rest if x[0].kind.is_event and (slips or x[0].parameters == EOP_NAMES)]
    effects = [x for x in rest if x not in knocks]

    def fitted(parts: list[tuple[Term, float]]) -> Solution:
        fitter = solution.fitter
        fit = fitter.refine(fitter.fit([t for t, _ in parts]), max_iterations=3)
        return replace(solution, fit=fit, penalties=tuple(p for _, p in parts))

    base = fitted(first + knocks)
    whole = fitted(first + knocks + effects) if effects else base
    return base, whole, tuple(t for t, _ in knocks)


def is_convincing(base: Solution, best: Solution) -> bool:
    """Test whether the effects of `best` are worth their penalties, and hold in both series.

    Constants from all series but one are held against that one, and from two each against the
    other; events are new each time.
    """
    if base.score <= best.score:
        return False
    fitter = best.fitter
    every = range(len(fitter.series))
    if len(every) < 2 or all(t.is_separate for t in best.terms[len(base.terms) :]):
        return True
    own, there = [], []
    for left in every:
        rest = [s for s in every if s != left]
        without = fitter.fit(base.terms, only=rest)
        whole = fitter.refine(fitter.fit(best.terms, only=rest), only=rest)
        own.append(sum(without.chi2_of(s) - whole.chi2_of(s) for s in rest) / len(rest))
        there.append(without.chi2_of(left) - whole.chi2_of(left))
    least = criteria.MOUNT_WORSE * max(own)
    return min(there) > -least and sum(there) > least
