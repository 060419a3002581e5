"""The effects of a thermal model as terms of a hypothesis, and back with standard deviations."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.physics import catalogue
from thermocald.thermal.hypothesis import BASE, Term, coefficients_of, make_candidate
from thermocald.thermal.scan import Scanner

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.physics.model import ModelEffect
    from thermocald.thermal.fit import HypothesisFitter
    from thermocald.thermal.hypothesis import Fit, Unknowns
    from thermocald.thermal.series import ReducedSeries

_EVENT_MARGIN = 16.0  # χ² that an event has to explain beyond what a search finds by chance


def make_term(fitter: HypothesisFitter, fit: Fit, effect: ModelEffect, search: bool) -> Term:
    """Return an effect as a term to add to a fitted hypothesis.

    search: search its non-linear parameters over their whole range, except those in `fitter.held`;
    the time of an event is always searched, in each series.
    """
    kind = catalogue.get(effect.name)
    given = tuple(n for n in kind.linear if n in effect.values) or kind.usual
    names = BASE if kind.is_drive else given
    text = {k: effect.values[k] for k, p in kind.nonlinear.items() if p.text and k in effect.values}
    numbers = {
        k: float(effect.values[k])
        for k, p in kind.nonlinear.items()
        if k in effect.values and not p.text and k not in kind.fresh
    }
    held = {k: v for k, v in numbers.items() if f"{effect.name}.{k}" in fitter.held}
    candidate = make_candidate(kind, names, fitter.series, (*text.items(), *held.items()))
    if kind.is_event:
        found = Scanner(fitter).scan(candidate, fit)
        fresh: list[tuple[tuple[str, Any], ...] | None] = []
        for s, gains in enumerate(found.events):
            best = int(np.argmax(gains))
            least = event_threshold(fitter.series[s], found.coefficients)
            time = float(fitter.series[s].times[best + 1])
            fresh.append(((candidate.name, time),) if gains[best] > least else None)
        return Term(effect.name, candidate.parameters, candidate.fixed, tuple(fresh))
    if search and candidate.name:
        found = Scanner(fitter).scan(candidate, fit)
        return candidate.term(float(candidate.grid[found.best]), len(fitter.series))
    return Term(effect.name, candidate.parameters, (*text.items(), *numbers.items()))


def event_threshold(series: ReducedSeries, coefficients: int) -> float:
    """Return the χ² that an event has to explain, given its coefficients and the times tried."""
    n = max(int((series.n > 0).sum()), 2)
    return float((coefficients + 2) * np.log(n) + _EVENT_MARGIN)


def without_chance_events(fitter: HypothesisFitter, fit: Fit) -> tuple[Term, ...]:
    """Return a fit's terms without events that explain no more than chance beside the others."""
    terms = list(fit.terms)
    for block in fit.blocks:
        if block.term < 0 or not terms[block.term].kind.is_event or block.series is None:
            continue
        place = slice(block.start, block.stop)
        heights, cofactor = fit.coefficients[place], fit.covariance[place, place]
        gain = float(heights @ np.linalg.solve(cofactor, heights))
        if gain <= event_threshold(fitter.series[block.series], len(heights)):
            fresh = list(terms[block.term].fresh)
            fresh[block.series] = None
            terms[block.term] = replace(terms[block.term], fresh=tuple(fresh))
    return tuple(terms)


def list_unknowns(fit: Fit, scale: Array) -> Unknowns:
    """Return all parameters that have a standard deviation in the fit, the rates first.

    scale (19,): px per unit of the columns.
    """
    rates = coefficients_of(fit, fit.blocks[:1], scale)
    found = {f"rates.{name}": number for name, number in rates.items()}
    for number, term in enumerate(fit.terms):
        for place, (i, key) in enumerate(fit.searched, len(fit.coefficients)):
            if i == number:
                row = np.eye(1, len(fit.covariance), place)[0]
                found[f"{term.effect}.{key}"] = float(dict(term.nonlinear)[key]), row
        names = {term.kind.column(n): n for n in term.kind.linear}
        blocks = [b for b in fit.blocks if b.term == number]
        for key, one in coefficients_of(fit, blocks, scale).items():
            column, at, k = key.partition("@")
            found[f"{term.effect}.{names.get(column, column)}{at}{k}"] = one
    return found
