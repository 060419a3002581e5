"""The search: all candidates compete, combinations grow step by step, superfluous effects go.

A scan over each candidate's grid costs one matrix product on the epochs' normal equations; the
best are fitted in full, with the thermometer's error carried through them. The score is

    -2 log L + Σ over effects (coefficients · ln n + 2 ln(trials) + 2 ln(candidates) + margin),

n the number of epochs, trials the number of independent places the scan looked at.

Source: Schwarz (1978), Annals of Statistics 6, 461-464; the trials as Gross, Vitells (2010),
European Physical Journal C 70, 525-530 (look-elsewhere effect).

The candidates: every effect of the catalogue with its parameter sets and a grid to search.

The grid replaces a lucky start: each non-linear parameter is scanned over everything that the
recording could show, and how many independent trials that makes is part of the penalty.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery import criteria
from thermocald.physics import catalogue
from thermocald.thermal.hypothesis import BASE, Candidate, Term, make_candidate, make_known_term
from thermocald.thermal.scan import Scanner

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.thermal.fit import HypothesisFitter
    from thermocald.thermal.hypothesis import Fit
    from thermocald.thermal.movement import Mount
    from thermocald.thermal.scan import Scan
    from thermocald.thermal.series import ReducedSeries

MOUNT = ("omega", "phi", "kappa")


def list_candidates(series: Sequence[ReducedSeries]) -> list[Candidate]:
    """List all candidates that the recordings could show."""
    first = series[0]
    out: list[Candidate] = []
    for name in catalogue.names():
        effect = catalogue.get(name)
        if effect.seen_in != "trajectory" or (effect.kind == "image" and not effect.columns):
            continue  # found in image space
        sets: tuple[tuple[str, ...], ...] = effect.parameter_sets or (effect.usual or BASE,)
        if effect.is_drive:
            sets = (BASE,)
        if effect.moves_mount:
            sets = (*sets, MOUNT)
        channels: Sequence[tuple[tuple[str, Any], ...]] = [()]
        if any(p.text for p in effect.nonlinear.values()):
            channels = [
                (("channel", c),)
                for c in first.history.readings
                if c != first.history.reference and all(_varies(e, c) for e in series)
            ]
        out += [make_candidate(effect, p, series, fixed) for fixed in channels for p in sets]
        if effect.optional:
            out.append(make_candidate(effect, sets[0], series, (), plain=True))
    return out


def enrich_term(term: Term) -> Term | None:
    """Return the term with a parameter set of one coefficient more; None where there is none."""
    for parameters in term.kind.parameter_sets:
        more = len(parameters) == len(term.parameters) + 1
        if more and set(term.parameters) < set(parameters):
            return replace(term, parameters=parameters)
    return None


def _varies(evidence: ReducedSeries, channel: str) -> bool:
    instrument = evidence.thermometers.get(channel)
    return instrument is not None and float(np.nanstd(instrument.trajectory)) > 3 * instrument.noise


@dataclass(frozen=True, eq=False)
class Scanned:
    """What a scan of one candidate promises: the best term, gain in χ² less penalty, penalty."""

    term: Term
    net: float
    penalty: float


@dataclass(frozen=True, eq=False)
class Solution:
    """A fitted hypothesis with its penalties, and the fitter that it was fitted in; the smaller the
    score the better.

    mount: the movement beside it, which the fitter's series have, None where the mount stands
    still; as_slips: whether a slip inside the camera explains each knock of the mount as well, in
    order.
    """

    fit: Fit
    penalties: tuple[float, ...]
    fitter: HypothesisFitter
    mount: Mount | None = None
    as_slips: tuple[bool, ...] = ()

    @property
    def terms(self) -> tuple[Term, ...]:
        return self.fit.terms

    @property
    def score(self) -> float:
        return self.fit.objective + sum(self.penalties)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(t.effect for t in self.fit.terms)


class Search:
    """One examination of a fitter's series."""

    def __init__(
        self,
        fitter: HypothesisFitter,
        progress: Callable[[str], None] | None = None,
        like: Search | None = None,
    ) -> None:
        """like: a search in the same histories under other noise, whose trajectories serve."""
        self.fitter = fitter
        self.candidates: list[Candidate] = (
            like.candidates if like else list_candidates(fitter.series)
        )
        self.scanner: Scanner = Scanner(fitter, like.scanner if like else None)
        self.epochs = sum(int((e.n > 0).sum()) for e in fitter.series)
        # the more noise is correlated, the less is known of it
        self.margin = criteria.MARGIN * max(e.correlation for e in fitter.series)
        self.progress = progress or (lambda _: None)
        self._trials: dict[tuple[str, tuple[str, ...]], float] = {}
        self._scanned: dict[Fit, list[Scanned]] = {}
        self._refined: dict[tuple[Term, ...], Fit] = {}
        self._known: dict[frozenset[tuple[str, tuple[str, ...]]], Solution] = {}

    def base(self, given: Sequence[tuple[str, dict[str, Any]]] = ()) -> Solution:
        """Fit the base model, with the effects that a model has already."""
        count = len(self.fitter.series)
        terms = [make_known_term(name, values, count) for name, values in given]
        fit = self.fitter.fit(terms)
        fit = self.fitter.refine(fit) if terms else fit
        return Solution(fit, (0.0,) * len(terms), self.fitter)

    # -- scanning --------------------------------------------------------------------------

    def scan(self, candidate: Candidate, solution: Solution) -> Scanned:
        """Find the best place of one candidate added to a solution."""
        return self.promise(candidate, self.scanner.scan(candidate, solution.fit))

    def promise(self, candidate: Candidate, found: Scan) -> Scanned:
        """Return what a scan of a candidate promises."""
        once = 2 * float(np.log(len(self.candidates))) + self.margin
        count, each = found.coefficients, float(np.log(self.epochs))
        if not candidate.kind.is_event:
            key = (candidate.effect, candidate.parameters)
            if key not in self._trials:
                self._trials[key] = self.scanner.trials(candidate)
            best = int(np.argmax(found.gains))
            value = float(candidate.grid[best]) if len(candidate.grid) else None
            penalty = (count + (value is not None)) * each + once
            penalty += 2 * float(np.log(max(self._trials[key], 1.0)))
            term = candidate.term(value, len(self.fitter.series))
            return Scanned(term, float(found.gains[best]) - penalty, penalty)
        # an event comes in each series at its own time, or in none but the first
        fresh: list[tuple[tuple[str, float], ...] | None] = []
        total, penalty, single = 0.0, once, (count + 2) * each
        for s, gains in enumerate(found.events):
            best = int(np.argmax(gains))
            if gains[best] > single + self.margin or s == 0:
                fresh.append(((candidate.name, float(self.fitter.series[s].times[best + 1])),))
                total += float(gains[best])
                penalty += single
            else:
                fresh.append(None)
        term = replace(candidate.term(None, len(found.events)), fresh=tuple(fresh))
        return Scanned(term, total - penalty, penalty)

    # -- growing and shrinking ----------------------------------------------------------------

    def refine(self, terms: Sequence[Term], penalties: Sequence[float]) -> Solution:
        """Fit a hypothesis in full, once; its penalties depend on how it was found."""
        key = tuple(terms)
        if key not in self._refined:
            self._refined[key] = self.fitter.refine(self.fitter.fit(terms), max_iterations=5)
        found = Solution(self._refined[key], tuple(penalties), self.fitter)
        same = _kinds(terms)
        if same not in self._known or found.score < self._known[same].score:
            self._known[same] = found
        return found

    def expand(self, solution: Solution, width: int = 6, least: float = 0.0) -> list[Solution]:
        """Find the best solutions with one effect more, best first.

        least: what a scan of an effect but an event has to promise beyond its penalty.
        """
        grown = [self._with(solution, p) for p in self._promises(solution, width, least)]
        return sorted(grown, key=lambda s: s.score)

    def expand_all(
        self, solutions: Sequence[Solution], width: int, most: int, below: float = np.inf
    ) -> list[Solution]:
        """Find the best with one effect more of several solutions: `most` sets of effects at most.

        below: the score that a scan has to promise.
        """
        every = [(s, p) for s in solutions for p in self._promises(s, width)]
        pairs = [(s, p) for s, p in every if s.score - p.net < below]
        pairs.sort(key=lambda pair: pair[0].score - pair[1].net)
        grown: dict[frozenset[str], Solution] = {}
        for solution, promise in pairs:
            names = frozenset((*solution.names, promise.term.effect))
            if len(grown) < most and names not in grown:
                grown[names] = self._with(solution, promise)
        return sorted(grown.values(), key=lambda s: s.score)

    def _with(self, solution: Solution, promise: Scanned) -> Solution:
        penalties = (*solution.penalties, promise.penalty)
        return self.refine((*solution.terms, promise.term), penalties)

    def _promises(self, solution: Solution, width: int, least: float = 0.0) -> list[Scanned]:
        """Scan every candidate that a solution does not have: the `width` most promising effects
        first, each with the sets that promise as much as its best.

        A scan is right to some percent, with a drive to half: what promises a tenth cannot win.
        """
        if solution.fit not in self._scanned:
            self._scanned[solution.fit] = [
                self.scan(c, solution) for c in self.candidates if c.effect not in solution.names
            ]
            solution.fit.forget()
        enough = [
            p
            for p in self._scanned[solution.fit]
            if np.isfinite(p.net) and p.net > (0.0 if p.term.kind.is_event else max(least, 0.0))
        ]
        ordered = sorted(enough, key=lambda p: -p.net)
        out: list[Scanned] = []
        best: dict[str, float] = {}
        for p in ordered:
            name = p.term.effect
            if name in best:
                if p.net > criteria.SET_SHARE * best[name]:
                    out.append(p)
            elif len(best) < width and (len(best) < 3 or p.net >= 0.1 * ordered[0].net):
                best[name] = p.net
                out.append(p)
        return out

    def with_other_delay(self, solution: Solution) -> Solution | None:
        """Put another kind of delay of the temperature in place of a solution's own."""
        delays = [c for c in self.candidates if c.kind.delay]
        for i, term in enumerate(solution.terms):
            if not term.kind.delay:
                continue
            seconds = float(dict(term.nonlinear)[term.kind.delay])
            others = [c for c in delays if c.effect not in solution.names]
            if seconds <= 0 or not others:
                return None
            found = []
            for candidate in others:
                swapped = candidate.term(seconds, len(self.fitter.series))
                terms = (*solution.terms[:i], swapped, *solution.terms[i + 1 :])
                found.append(self.refine(terms, solution.penalties))
            return min(found, key=lambda s: s.fit.chi2)
        return None

    def with_events_moved(self, solution: Solution) -> Solution:
        """Move the events to where they explain most now that the other effects are known
        too: they were found without some of them.
        """
        for i, term in enumerate(solution.terms):
            if not term.kind.is_event:
                continue
            same = (c for c in self.candidates if c.effect == term.effect)
            candidate = next(c for c in same if c.parameters == term.parameters)
            gains = self.scanner.scan(candidate, solution.fit).events
            for s, now in enumerate(term.fresh):
                if now is None:
                    continue
                time = float(self.fitter.series[s].times[int(np.argmax(gains[s])) + 1])
                at = ((candidate.name, time),)
                moved = replace(term, fresh=(*term.fresh[:s], at, *term.fresh[s + 1 :]))
                terms = (*solution.terms[:i], moved, *solution.terms[i + 1 :])
                trial = self.refine(terms, solution.penalties)
                if trial.score < solution.score:
                    solution, term = trial, moved
        return solution

    def shrink(self, solution: Solution, kept: int = 0) -> Solution:
        """Drop every effect that is no longer worth its penalty; the first `kept` stay."""
        while len(solution.terms) > kept + 1:
            fewer = []
            for number in range(kept, len(solution.terms)):
                terms = tuple(t for j, t in enumerate(solution.terms) if j != number)
                penalties = [p for j, p in enumerate(solution.penalties) if j != number]
                # as it was found before, where the rest was fitted already
                fewer.append(self._known.get(_kinds(terms)) or self.refine(terms, penalties))
            best = min(fewer, key=lambda s: s.score)
            if best.score > solution.score:
                break
            solution = best
        return solution


def _kinds(terms: Sequence[Term]) -> frozenset[tuple[str, tuple[str, ...]]]:
    """Return what a hypothesis consists of, whatever its numbers."""
    return frozenset((t.effect, t.parameters) for t in terms)
