"""The search for effects of a camera that moves on its mount.

Each hypothesis is fitted beside a movement of the mount, whose size is estimated from what the
hypothesis leaves unexplained, so that a cause is compared with a mount that moves by chance. A
knock of the mount is a step that a rotation and a shift of the camera explain at least as well as a
slip inside it. Knocks are no effects: they are added to the base model and reported with time and
size.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.discovery import criteria
from thermocald.discovery.search import Search, Solution, by_score, say_searched
from thermocald.photogrammetry.camera.camera_model import EOP_NAMES, PARAMETER_NAMES
from thermocald.photogrammetry.linalg import explained
from thermocald.physics import catalogue
from thermocald.physics.formula import Proportional
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import BASE, Term
from thermocald.thermal.movement import (
    Mount,
    add_tremble,
    estimate_mount_motion,
    find_combinations,
    guess_mount_motion,
)
from thermocald.thermal.scan import ORDERS
from thermocald.thermal.series import cosines, unit_directions

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.physics.model import ModelEffect

_WIDTH = 4  # solutions of a level whose movement is estimated
_LEVELS = 5
_EFFECTS = 3
KNOCKS = 3
_PROMISE = 0.3  # share of a further effect's least gain that a scan before it must promise
_CORNERS = (0.0, 3.0)
_REST = 0.05  # share of the movement before that is added to a first guess
# iterations of the movement without an effect, and the share of the distance to the score with an
# effect that each must gain
_TURNS = 5
_SETTLED = 0.1


def search_beside_mount(
    fitter: HypothesisFitter,
    say: Callable[[str], None],
    given: Sequence[ModelEffect],
    walks: bool,
) -> tuple[Solution, list[Solution], list[Solution], Search]:
    """Add effects and knocks one by one while the penalised likelihood improves.

    walks: whether the tremble is the fast part of a movement. Returns the best solution, the single
    effects by score, all solutions tried, each with its movement, and a search whose trajectories
    can be reused in the best solution's fitter.
    """
    first = Search(fitter)
    start = first.base(given)
    W = find_combinations(fitter.series)
    # beside a movement as large as the whole misfit, a scan would find no effect
    guess = guess_mount_motion(fitter, start.fit, W, walks=False)
    say("estimating how the camera moves on its mount")
    trials = [_fit_beside(start, Mount(W, guess, corner, walks), 4) for corner in _CORNERS]
    plain = best = min(trials, key=by_score)
    ranking, seen = list[Solution](), list[Solution]()
    for level in range(_LEVELS):
        say(say_searched(" with ".join(best.names)))
        search = Search(best.fitter, like=first)
        grown: list[Solution] = []
        # a scan is accurate to a few percent, and a further effect must gain much
        further = any(not t.kind.is_event for t in best.terms[len(start.terms) :])
        least = _PROMISE * _least_further(plain, best) if further else 0.0
        solutions = search.expand(best, 6, least)[:_WIDTH]
        # the other kind of delay: a scan without the movement of the mount may miss it
        others = filter(None, map(search.with_other_delay, solutions))
        if (other := next(others, None)) and other.names not in [s.names for s in solutions]:
            solutions.append(other)
        for solution in solutions:
            trial = _profile(best, solution)
            grown.append(_try_knock(best, trial) or trial)
        if not grown:
            break
        if level == 0:
            ranking = sorted(grown, key=by_score)
            # after the scan: a converged movement explains drifts too, and a scan would find none
            plain = best = _settle(plain, ranking[0].score)
        seen += grown
        allowed = [g for g in grown if _is_allowed(g, best, plain, len(start.terms))]
        if not allowed:
            break
        best = min(allowed, key=by_score)
    return best, ranking, seen, first


def _fit_beside(solution: Solution, mount: Mount, turns: int) -> Solution:
    own, fit, mount = estimate_mount_motion(
        solution.fitter, solution.terms, mount, solution.fit.coefficients, turns
    )
    return Solution(fit, solution.penalties, own, mount)


def fit_beside_walk(solution: Solution) -> Solution:
    """Fit a solution beside a random walk of the camera, as large as the solution leaves it."""
    fitter = HypothesisFitter(add_tremble(solution.fitter, solution.fit))
    fit = fitter.fit(solution.terms, solution.fit.coefficients)
    W = find_combinations(fitter.series)
    mount = Mount(W, guess_mount_motion(fitter, fit, W, walks=True), 0.0)
    return _fit_beside(replace(solution, fit=fit, fitter=fitter), mount, 5)


def _settle(solution: Solution, best: float) -> Solution:
    """Estimate the movement again from its residuals while the score may come below `best`.

    A direction that the first estimate sets to zero would otherwise stay zero.
    """
    for _ in range(_TURNS):
        if solution.score < best:
            break
        more = _profile(solution, solution)
        if more.score > solution.score:
            break
        change, solution = solution.score - more.score, more
        if change < _SETTLED * (solution.score - best):
            break
    return solution


def _profile(best: Solution, solution: Solution) -> Solution:
    """Fit a solution beside the movement that it leaves, and refine its non-linear parameters.

    best: the solution that it extends, in the same fitter, with its movement.
    """
    assert best.mount is not None
    W, walks = best.mount.combinations, best.mount.walks
    guess = guess_mount_motion(best.fitter, solution.fit, W, walks)
    # with a share of the movement before, since a direction that starts at zero stays zero
    mount = replace(best.mount, covariance=guess + _REST * best.mount.covariance)
    fitted = _fit_beside(solution, mount, 5)
    fit = fitted.fitter.refine(fitted.fit, max_iterations=3)
    return replace(fitted, fit=fit, as_slips=best.as_slips)


def _try_knock(best: Solution, trial: Solution) -> Solution | None:
    """Explain an event as a knock of the mount; None if that explains it less well."""
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
    if len(own) > _EFFECTS or knocks > KNOCKS or gain <= 0:
        return False
    if grown.terms[-1].kind.is_event or len(own) == 1:
        return True
    return gain > _least_further(plain, best)


def _least_further(plain: Solution, best: Solution) -> float:
    """Return the least gain of an effect after the first."""
    return max(criteria.MOUNT_FURTHER, criteria.MOUNT_SHARE * (plain.score - best.score))


def split_knocks(
    solution: Solution, given: int, slips: bool = False
) -> tuple[Solution, Solution, tuple[Term, ...]]:
    """Fit the base model with the knocks, and the whole solution; also return the knocks.

    given: number of terms that the model has already; slips: treat steps inside the camera as
    nuisances too.
    """
    every = list(zip(solution.terms, solution.penalties, strict=True))
    first, rest = every[:given], every[given:]
    knocks = [x for x in rest if x[0].kind.is_event and (slips or x[0].parameters == EOP_NAMES)]
    effects = [x for x in rest if x not in knocks]

    def fit_terms(parts: list[tuple[Term, float]]) -> Solution:
        fitter = solution.fitter
        fit = fitter.refine(fitter.fit([t for t, _ in parts]), max_iterations=3)
        return replace(solution, fit=fit, penalties=tuple(p for _, p in parts))

    base = fit_terms(first + knocks)
    whole = fit_terms(first + knocks + effects) if effects else base
    return base, whole, tuple(t for t, _ in knocks)


def is_convincing(base: Solution, best: Solution) -> bool:
    """Test whether the effects of `best` gain more than their penalties, and in every series.

    Constants from all other series are tested on each series; events are estimated anew in each.
    """
    if base.score <= best.score:
        return False
    fitter = best.fitter
    every = range(len(fitter.series))
    if len(every) < 2 or all(t.is_separate for t in best.terms[len(base.terms) :]):
        return True
    inside, outside = [], []  # gains in χ² in the fitted series, per series, and in the other
    for left in every:
        rest = [s for s in every if s != left]
        without = fitter.fit(base.terms, only=rest)
        whole = fitter.refine(fitter.fit(best.terms, only=rest), only=rest)
        inside.append(sum(without.chi2_of(s) - whole.chi2_of(s) for s in rest) / len(rest))
        outside.append(without.chi2_of(left) - whole.chi2_of(left))
    least = criteria.MOUNT_WORSE * max(inside)
    return min(outside) > -least and sum(outside) > least


def make_own_rates(series: int, count: int) -> Term:
    """Make the term of rates that one of `count` series has for itself."""
    along_T = catalogue.find(lambda k: getattr(k, "formula", "") == Proportional.formula).name
    fresh = tuple(() if k == series else None for k in range(count))
    return Term(along_T, BASE, fresh=fresh, through_drive=True)


def moves_interior(fitter: HypothesisFitter, terms: Sequence[Term], walks: bool) -> bool:
    """Test whether terms leave a slow movement that moves more than the exterior orientation.

    It is no movement of a mount, which moves the whole camera. In many epochs its smoothness tells
    more, since errors of the temperature move the interior too. fitter: of the series without one;
    walks: whether the camera is taken to move only since an effect may be a random walk.
    """
    if max(len(e.times) for e in fitter.series) >= criteria.NO_WALK_EACH and not walks:
        return False
    most = criteria.INTERIOR_OF_WALK if walks else criteria.INTERIOR
    fit = fitter.fit(terms)
    own = np.array([PARAMETER_NAMES.index(name) for name in EOP_NAMES])
    for e, weighting, (C, V, index) in zip(fitter.series, fit.weightings, fit.designs, strict=True):
        trajectories = cosines(e.times, min(ORDERS, len(e.times) // 2))[:, :, None]
        A, c, B = weighting.scan(trajectories, unit_directions(PARAMETER_NAMES), (C, V))
        rest = (c - B @ fit.coefficients[index])[..., None]
        whole = explained(A, rest, 1e-9)
        camera = explained(A[:, own[:, None], own], rest[:, own], 1e-9)
        free = len(c) * (len(PARAMETER_NAMES) - len(own))
        if float(np.sum(whole - camera)) - free > most * np.sqrt(2.0 * free):
            return True
    return False


def contradict(best: Solution) -> bool:
    """Test whether a further series needs rates of its own, however much the mount moves.

    A movement that is estimated from all series may be as large as their contradiction.
    """
    count = len(best.fitter.series)
    shared = _profile(best, best).fit.objective
    for s in range(1, count):
        fit = best.fitter.fit((*best.terms, make_own_rates(s, count)))
        trial = _profile(best, replace(best, fit=fit))
        if shared - trial.fit.objective > criteria.MOUNT_FURTHER:
            return True
    return False
