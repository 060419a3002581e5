"""The search: candidates compete, combinations grow effect by effect, superfluous ones are dropped.

A candidate is an effect of the catalogue with a parameter set and a grid. In place of a good start
value, each non-linear parameter is scanned over all values that the recording could show. A scan
takes one matrix product on the epochs' normal equations; the best candidates are fitted in full,
with the thermometer's errors propagated through them. The score is

    -2 log L + Σ over effects (coefficients · ln n + 2 ln(trials) + 2 ln(candidates) + margin),

where n is the number of epochs and trials the number of independent values in the scan.

Source: Schwarz (1978), Annals of Statistics 6, 461-464; the trials: Gross, Vitells (2010),
European Physical Journal C 70, 525-530 (look-elsewhere effect).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery import criteria
from thermocald.physics import catalogue
from thermocald.thermal.hypothesis import BASE, Candidate, Term, make_candidate, make_known_term
from thermocald.thermal.scan import count_trials, scan_candidate

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.physics.model import ModelEffect
    from thermocald.thermal.fit import HypothesisFitter
    from thermocald.thermal.hypothesis import Fit
    from thermocald.thermal.movement import Mount
    from thermocald.thermal.scan import Scan
    from thermocald.thermal.series import ReducedSeries

MOUNT = ("omega", "phi", "kappa")


def list_candidates(series: Sequence[ReducedSeries]) -> list[Candidate]:
    """List the candidates that the recordings could show."""
    first = series[0]
    out: list[Candidate] = []
    for name in catalogue.names():
        effect = catalogue.get(name)
        if effect.seen_in != "trajectory" or (effect.kind == "image" and not effect.columns):
            continue  # is found in image space
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


def _varies(evidence: ReducedSeries, channel: str) -> bool:
    instrument = evidence.thermometers.get(channel)
    return instrument is not None and float(np.nanstd(instrument.trajectory)) > 3 * instrument.noise


@dataclass(frozen=True, eq=False)
class Scanned:
    """The best term in a candidate's scan; net: its gain in χ² less its penalty."""

    term: Term
    net: float
    penalty: float


@dataclass(frozen=True, eq=False)
class Solution:
    """A fitted hypothesis with its penalties and its fitter; a lower score is better.

    mount: the movement beside it, which the fitter's series include, None if the mount stands
    still; as_slips: for each knock of the mount in order, whether a slip inside the camera explains
    it equally well.
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


def say_searched(beside: str) -> str:
    """Say what is searched; beside: the effects found so far, if any."""
    return f"looking for an effect beside {beside}" if beside else "looking for an effect"


by_score = attrgetter("score")
"""The order of solutions, the best one first."""


class Search:
    """A search for effects in a fitter's series."""

    def __init__(
        self,
        fitter: HypothesisFitter,
        progress: Callable[[str], None] | None = None,
        like: Search | None = None,
    ) -> None:
        """Prepare a search; like: one in the same histories, whose candidates are reused."""
        self.fitter = fitter
        self.candidates: list[Candidate] = (
            like.candidates if like else list_candidates(fitter.series)
        )
        self.epochs = sum(int((e.n > 0).sum()) for e in fitter.series)
        # the more the noise is correlated, the less certain is its model
        self.margin = criteria.MARGIN * max(e.correlation for e in fitter.series)
        self.progress = progress or (lambda _: None)
        self._trials: dict[tuple[str, tuple[str, ...]], float] = {}
        self._scanned: dict[Fit, list[Scanned]] = {}
        self._refined: dict[tuple[Term, ...], Fit] = {}
        self._known: dict[frozenset[tuple[str, tuple[str, ...]]], Solution] = {}

    def base(self, given: Sequence[ModelEffect] = ()) -> Solution:
        """Fit the base model with the effects that the model has already."""
        count = len(self.fitter.series)
        terms = [make_known_term(e.name, e.values, count) for e in given]
        fit = self.fitter.fit(terms)
        fit = self.fitter.refine(fit) if terms else fit
        return Solution(fit, (0.0,) * len(terms), self.fitter)

    # -- scanning --------------------------------------------------------------------------

    def promise(self, candidate: Candidate, scan: Scan) -> Scanned:
        """Return the best term of a candidate's scan."""
        once = 2 * float(np.log(len(self.candidates))) + self.margin
        count, each = scan.coefficients, float(np.log(self.epochs))
        if not candidate.kind.is_event:
            key = (candidate.effect, candidate.parameters)
            if key not in self._trials:
                self._trials[key] = count_trials(self.fitter, candidate)
            best = scan.best
            value = float(candidate.grid[best]) if len(candidate.grid) else None
            penalty = (count + (value is not None)) * each + once
            penalty += 2 * float(np.log(max(self._trials[key], 1.0)))
            term = candidate.term(value, len(self.fitter.series))
            return Scanned(term, sum(float(g[best]) for g in scan.gains) - penalty, penalty)
        # an event occurs in the first series, and in others if it shows there, at its own time
        fresh: list[tuple[tuple[str, float], ...] | None] = []
        total, penalty, single = 0.0, once, (count + 2) * each
        for s, gains in enumerate(scan.gains):
            best = int(np.argmax(gains))
            if gains[best] > single + self.margin or s == 0:
                fresh.append(((candidate.name, float(self.fitter.series[s].times[best + 1])),))
                total += float(gains[best])
                penalty += single
            else:
                fresh.append(None)
        term = replace(candidate.term(None, len(scan.gains)), fresh=tuple(fresh))
        return Scanned(term, total - penalty, penalty)

    # -- growing and shrinking ----------------------------------------------------------------

    def refine(self, terms: Sequence[Term], penalties: Sequence[float]) -> Solution:
        """Fit a hypothesis in full, only once; its penalties depend on how it was found."""
        key = tuple(terms)
        if key not in self._refined:
            self._refined[key] = self.fitter.refine(self.fitter.fit(terms), max_iterations=5)
        solution = Solution(self._refined[key], tuple(penalties), self.fitter)
        kinds = _kinds(terms)
        if kinds not in self._known or solution.score < self._known[kinds].score:
            self._known[kinds] = solution
        return solution

    def expand(self, solution: Solution, width: int = 6, least: float = 0.0) -> list[Solution]:
        """Find the best extensions of a solution by one effect, best first.

        least: gain beyond its penalty that a scan must promise, except for an event.
        """
        grown = [self._with(solution, p) for p in self._promises(solution, width, least)]
        return sorted(grown, key=by_score)

    def expand_all(
        self, solutions: Sequence[Solution], width: int, most: int, below: float
    ) -> list[Solution]:
        """Find the best extensions of several solutions by one effect, at most `most` sets.

        below: the score that a scan must promise to reach.
        """
        every = [(s, p) for s in solutions for p in self._promises(s, width)]
        pairs = [(s, p) for s, p in every if s.score - p.net < below]
        pairs.sort(key=lambda pair: pair[0].score - pair[1].net)
        grown: dict[frozenset[str], Solution] = {}
        for s, p in pairs:
            names = frozenset((*s.names, p.term.effect))
            if len(grown) < most and names not in grown:
                grown[names] = self._with(s, p)
        return sorted(grown.values(), key=by_score)

    def _with(self, solution: Solution, promise: Scanned) -> Solution:
        penalties = (*solution.penalties, promise.penalty)
        return self.refine((*solution.terms, promise.term), penalties)

    def _promises(self, solution: Solution, width: int, least: float = 0.0) -> list[Scanned]:
        """Return the `width` most promising effects beside a solution, best first.

        Each comes with all parameter sets that promise about as much as its best one. A scan is
        accurate to a few percent, for a drive to half: what promises a tenth cannot win.
        """
        if solution.fit not in self._scanned:
            self._scanned[solution.fit] = [
                self.promise(c, scan_candidate(self.fitter, c, solution.fit))
                for c in self.candidates
                if c.effect not in solution.names
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
        """Replace a solution's delay of the temperature by the best other kind; None if none."""
        for i, term in enumerate(solution.terms):
            if not term.kind.delay:
                continue
            seconds = float(dict(term.nonlinear)[term.kind.delay])
            # an offset as long as the series leaves its temperature constant and its rates free
            others = [
                c.term(seconds, len(self.fitter.series))
                for c in self.candidates
                if c.kind.delay and c.effect not in solution.names and seconds <= c.grid[-1]
            ]
            if seconds <= 0:
                return None
            before, after = solution.terms[:i], solution.terms[i + 1 :]
            fits = [self.refine((*before, t, *after), solution.penalties) for t in others]
            return min(fits, key=lambda s: s.fit.chi2, default=None)
        return None

    def with_events_moved(self, solution: Solution) -> Solution:
        """Move the events to the times at which they explain most beside the other effects.

        They were found without some of these: a further series may seem to hold an event because
        that of the first one distorted their common rates. It is dropped if it is not worth it.
        """
        for i, term in enumerate(solution.terms):
            if not term.kind.is_event:
                continue
            key = term.effect, term.parameters
            candidate = next((c for c in self.candidates if (c.effect, c.parameters) == key), None)
            if candidate is None:  # a knock of the mount
                continue
            gains = scan_candidate(self.fitter, candidate, solution.fit).gains
            for s, now in enumerate(term.fresh):
                if now is None:
                    continue
                time = float(self.fitter.series[s].times[int(np.argmax(gains[s])) + 1])
                single = (len(term.parameters) + 2) * float(np.log(self.epochs))
                choices = [(((candidate.name, time),), 0.0), (None, single)]
                for own, less in choices if s > 0 else choices[:1]:  # the first series has it
                    moved = replace(term, fresh=(*term.fresh[:s], own, *term.fresh[s + 1 :]))
                    terms = (*solution.terms[:i], moved, *solution.terms[i + 1 :])
                    penalties = list(solution.penalties)
                    penalties[i] -= less
                    trial = self.refine(terms, penalties)
                    if trial.score < solution.score:
                        solution, term = trial, moved
        return solution

    def shrink(self, solution: Solution, kept: int) -> Solution:
        """Drop effects that gain less than their penalty; the first `kept` stay."""
        while len(solution.terms) > kept + 1:
            fewer = []
            for number in range(kept, len(solution.terms)):
                terms = solution.terms[:number] + solution.terms[number + 1 :]
                penalties = solution.penalties[:number] + solution.penalties[number + 1 :]
                # the rest may have been fitted before, perhaps with a better score
                fewer.append(self._known.get(_kinds(terms)) or self.refine(terms, penalties))
            best = min(fewer, key=by_score)
            if best.score > solution.score:
                break
            solution = best
        return solution


def _kinds(terms: Sequence[Term]) -> frozenset[tuple[str, tuple[str, ...]]]:
    """Return the effects and parameters of a hypothesis, without their values."""
    return frozenset((t.effect, t.parameters) for t in terms)
