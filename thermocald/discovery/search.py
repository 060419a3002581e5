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
    """What a scan of one candidate promises: the best term, gain in χ², penalty."""

    candidate: Candidate
    term: Term
    gain: float
    penalty: float

    @property
    def net(self) -> float:
        return self.gain - self.penalty


@dataclass(frozen=True, eq=False)
class Solution:
    """A fitted hypothesis with its penalty; the smaller the score the better."""

    fit: Fit
    penalties: tuple[float, ...]

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
        if not given:
            return Solution(self.fitter.fit(()), ())
        terms = tuple(
            make_known_term(name, values, len(self.fitter.series)) for name, values in given
        )
        return Solution(self.fitter.refine(self.fitter.fit(terms)), (0.0,) * len(terms))

    # -- scanning --------------------------------------------------------------------------

    def scan(self, candidate: Candidate, solution: Solution) -> Scanned:
        """Find the best place of one candidate added to a solution."""
        return self.promise(candidate, self.scanner.scan(candidate, solution.fit))

    def promise(self, candidate: Candidate, found: Scan) -> Scanned:
        """Return what a scan of a candidate promises."""
        if candidate.kind.is_event:
            return self._event(candidate, found)
        value = float(candidate.grid[found.best]) if len(candidate.grid) else None
        term = candidate.term(value, len(self.fitter.series))
        penalty = self._penalty(candidate, found.coefficients)
        return Scanned(candidate, term, float(found.gains[found.best]), penalty)

    def _event(self, candidate: Candidate, found: Scan) -> Scanned:
        """Place an event in each series, at its own time, or in none."""
        fresh: list[tuple[tuple[str, float], ...] | None] = []
        total, penalty = 0.0, 0.0
        single = found.coefficients * np.log(self.epochs) + 2 * np.log(self.epochs)
        for s, gains in enumerate(found.events):
            best = int(np.argmax(gains))
            if gains[best] > single + self.margin or s == 0:
                fresh.append(((candidate.name, float(self.fitter.series[s].times[best + 1])),))
                total += float(gains[best])
                penalty += single
            else:
                fresh.append(None)
        term = replace(candidate.term(None, len(found.events)), fresh=tuple(fresh))
        return Scanned(candidate, term, total, penalty + self._once())

    def _once(self) -> float:
        return 2 * float(np.log(len(self.candidates))) + self.margin

    def _penalty(self, candidate: Candidate, count: int) -> float:
        key = (candidate.effect, candidate.parameters)
        if key not in self._trials:
            self._trials[key] = self.scanner.trials(candidate)
        searched = np.log(self.epochs) if len(candidate.grid) else 0.0
        return float(
            count * np.log(self.epochs)
            + searched
            + 2 * np.log(max(self._trials[key], 1.0))
            + self._once()
        )

    # -- growing and shrinking ----------------------------------------------------------------

    def refine(self, terms: Sequence[Term], penalties: Sequence[float]) -> Solution:
        """Fit a hypothesis in full, once; its penalties depend on how it was found."""
        key = tuple(terms)
        if key not in self._refined:
            self._refined[key] = self.fitter.refine(self.fitter.fit(terms), max_iterations=5)
        found = Solution(self._refined[key], tuple(penalties))
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
            names = frozenset((*solution.names, promise.candidate.effect))
            if len(grown) < most and names not in grown:
                grown[names] = self._with(solution, promise)
        return sorted(grown.values(), key=lambda s: s.score)

    def _with(self, solution: Solution, promise: Scanned) -> Solution:
        penalties = (*solution.penalties, promise.penalty)
        return self.refine((*solution.terms, promise.term), penalties)

    def _promises(self, solution: Solution, width: int, least: float = 0.0) -> list[Scanned]:
        """Scan every candidate that a solution does not have; the most promising come first."""
        if solution.fit not in self._scanned:
            self._scanned[solution.fit] = [
                self.scan(c, solution) for c in self.candidates if c.effect not in solution.names
            ]
            solution.fit.forget()
        promises = []
        for found in self._scanned[solution.fit]:
            enough = found.net > (0.0 if found.candidate.kind.is_event else least)
            if np.isfinite(found.gain) and enough:
                promises.append(found)
        return _worth_fitting(promises, width)

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
            fewer = [self._without(solution, i) for i in range(kept, len(solution.terms))]
            best = min(fewer, key=lambda s: s.score)
            if best.score > solution.score:
                break
            solution = best
        return solution

    def _without(self, solution: Solution, number: int) -> Solution:
        """Drop one effect; as it was found before, where the rest was fitted already."""
        terms = tuple(t for j, t in enumerate(solution.terms) if j != number)
        known = self._known.get(_kinds(terms))
        penalties = [p for j, p in enumerate(solution.penalties) if j != number]
        return known or self.refine(terms, penalties)


def _kinds(terms: Sequence[Term]) -> frozenset[tuple[str, tuple[str, ...]]]:
    """Return what a hypothesis consists of, whatever its numbers."""
    return frozenset((t.effect, t.parameters) for t in terms)


def _worth_fitting(promises: Sequence[Scanned], width: int) -> list[Scanned]:
    """Choose the `width` most promising effects, each with the sets that promise as much as its
    best.

    A scan is right to some percent, with a drive to half: what promises a tenth cannot win.
    """
    ordered = sorted((p for p in promises if p.net > 0), key=lambda p: -p.net)
    out: list[Scanned] = []
    best: dict[str, float] = {}
    for p in ordered:
        name = p.candidate.effect
        if name in best:
            if p.net > criteria.SET_SHARE * best[name]:
                out.append(p)
        elif len(best) < width and (len(best) < 3 or p.net >= 0.1 * ordered[0].net):
            best[name] = p.net
            out.append(p)
    return out
