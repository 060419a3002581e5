"""The effects of a thermal model as terms of a hypothesis, and back with standard deviations."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.physics import catalogue
from thermocald.thermal.hypothesis import BASE, Term, make_candidate
from thermocald.thermal.scan import Scanner
from thermocald.thermal.series import COLUMNS

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.physics.model import ModelEffect
    from thermocald.thermal.fit import HypothesisFitter
    from thermocald.thermal.hypothesis import Block, Fit
    from thermocald.thermal.series import ReducedSeries

_EVENT_MARGIN = 16.0  # χ² that an event has to explain beyond what its search may find by chance


Unknowns = dict[str, tuple[float, "Array"]]
"""Numbers of a model by their names there: value, and row (K + L,) of the fit's unknowns.

A name ends with `@k` where the number belongs to series k > 0.
"""


def term_of(fitter: HypothesisFitter, fit: Fit, effect: ModelEffect, search: bool) -> Term:
    """An effect as a term to add to a fitted hypothesis.

    search: its non-linear parameters are looked for over their whole range, but for those that
    `fitter.held` names; the time of an event always is, in each series.
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
            worth = event_worth(fitter.series[s], found.coefficients)
            time = float(fitter.series[s].times[best + 1])
            fresh.append(((candidate.name, time),) if gains[best] > worth else None)
        return Term(effect.name, candidate.parameters, candidate.fixed, tuple(fresh))
    if search and candidate.name:
        found = Scanner(fitter).scan(candidate, fit)
        return candidate.term(float(candidate.grid[found.best]), len(fitter.series))
    return Term(effect.name, candidate.parameters, (*text.items(), *numbers.items()))


def event_worth(series: ReducedSeries, coefficients: int) -> float:
    """χ² that an event has to explain: its coefficients and time, and every time was a trial."""
    n = max(int((series.n > 0).sum()), 2)
    return float((coefficients + 2) * np.log(n) + _EVENT_MARGIN)


def without_chance_events(fitter: HypothesisFitter, fit: Fit) -> tuple[Term, ...]:
    """The terms of a fit without events that explain no more than chance alongside the others."""
    terms = list(fit.terms)
    for block in fit.blocks:
        if block.term < 0 or not terms[block.term].kind.is_event or block.series is None:
            continue
        place = slice(block.start, block.stop)
        heights, cofactor = fit.coefficients[place], fit.covariance[place, place]
        gain = float(heights @ np.linalg.solve(cofactor, heights))
        if gain <= event_worth(fitter.series[block.series], len(heights)):
            fresh = list(terms[block.term].fresh)
            fresh[block.series] = None
            terms[block.term] = replace(terms[block.term], fresh=tuple(fresh))
    return tuple(terms)


def unknowns_of(fit: Fit, scale: Array) -> Unknowns:
    """All numbers that have a standard deviation in the fit, the rates first.

    scale (19,): px per unit of the columns.
    """
    found = _linear(fit, fit.blocks[0], scale, {n: f"rates.{n}" for n in BASE})
    for number, term in enumerate(fit.terms):
        kind = term.kind
        names = {kind.column(n): f"{term.effect}.{n}" for n in kind.linear}
        blocks = [b for b in fit.blocks if b.term == number]
        for place, (i, key) in enumerate(fit.searched, len(fit.coefficients)):
            if i == number:
                row = np.zeros(len(fit.covariance))
                row[place] = 1.0
                found[f"{term.effect}.{key}"] = float(dict(term.nonlinear)[key]), row
        if kind.is_periodic:
            found |= _oscillation(fit, blocks, scale, names)
            continue
        for block in blocks:
            suffix = f"@{block.series}" if block.series else ""
            found |= _linear(fit, block, scale, {k: n + suffix for k, n in names.items()})
    return found


def _linear(fit: Fit, block: Block, scale: Array, names: dict[str, str]) -> Unknowns:
    found: Unknowns = {}
    for place, parameter in enumerate(block.parameters, block.start):
        unit = scale[COLUMNS.index(parameter)]
        row = np.zeros(len(fit.covariance))
        row[place] = 1.0 / unit
        found[names[parameter]] = float(fit.coefficients[place] / unit), row
    return found


def _oscillation(fit: Fit, blocks: list[Block], scale: Array, names: dict[str, str]) -> Unknowns:
    """Amplitudes, which all series share, and a phase of each, from pairs of sine and cosine."""
    phase_name = names[blocks[0].parameters[0]].split(".")[0] + ".phase"
    size = len(fit.covariance)
    P = len(blocks[0].parameters)
    amplitudes, rows, weights = [], [], []
    phases: Unknowns = {}
    first: Array | None = None
    for block in blocks:
        pair = fit.coefficients[block.start : block.stop].reshape(2, -1)
        u, s, v = np.linalg.svd(pair, full_matrices=False)
        side, shape = u[:, 0], v[0]
        # the amplitude's sign is the first series'; there the phase lies within half a turn
        if (side[0] < 0) if first is None else (shape @ first < 0):
            side, shape = -side, -shape
        first = shape if first is None else first
        place = np.arange(block.start, block.stop).reshape(2, -1)
        own = np.zeros((P, size))
        own[np.arange(P), place[0]], own[np.arange(P), place[1]] = side
        across = np.zeros(size)
        across[place.ravel()] = np.kron([-side[1], side[0]], shape) / s[0]
        suffix = f"@{block.series}" if block.series else ""
        phases[phase_name + suffix] = float(np.arctan2(side[1], side[0])), across
        amplitudes.append(s[0] * shape)
        rows.append(own)
        weights.append(1.0 / np.trace(own @ fit.covariance @ own.T))
    w = np.array(weights) / np.sum(weights)
    mean, row = np.tensordot(w, amplitudes, 1), np.tensordot(w, rows, 1)
    out: Unknowns = {}
    for j, parameter in enumerate(blocks[0].parameters):
        unit = scale[COLUMNS.index(parameter)]
        out[names[parameter]] = float(mean[j] / unit), row[j] / unit
    return out | phases
