"""The candidates: every effect of the catalogue with its parameter sets and a grid to search.

The grid replaces a lucky start: each non-linear parameter is scanned over everything that the
recording could show, and how many independent trials that makes is part of the penalty.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.reduction.candidate import Candidate, candidate_of
from thermocald.reduction.hypothesis import BASE, Term
from thermocald.simulation import effects as catalogue

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.reduction.series import ReducedSeries

__all__ = ["MOUNT", "candidates", "richer_set"]

MOUNT = ("omega", "phi", "kappa")


def candidates(series: Sequence[ReducedSeries]) -> list[Candidate]:
    """All candidates that the recordings could show."""
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
        out += [candidate_of(effect, p, series, fixed) for fixed in channels for p in sets]
        if effect.optional:
            out.append(candidate_of(effect, sets[0], series, (), plain=True))
    return out


def richer_set(term: Term) -> Term | None:
    """The term with a parameter set of one coefficient more; None where there is none."""
    for parameters in term.kind.parameter_sets:
        more = len(parameters) == len(term.parameters) + 1
        if more and set(term.parameters) < set(parameters):
            return replace(term, parameters=parameters)
    return None


def _varies(evidence: ReducedSeries, channel: str) -> bool:
    instrument = evidence.thermometers.get(channel)
    return instrument is not None and float(np.nanstd(instrument.trajectory)) > 3 * instrument.noise
