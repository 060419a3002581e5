"""The candidates: every effect of the catalogue with its parameter sets and a grid to search.

The grid replaces a lucky start: each non-linear parameter is scanned over everything that the
recording could show, and how many independent trials that makes is part of the penalty.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.reduction.grid import trial_values
from thermocald.reduction.hypothesis import BASE, Term
from thermocald.simulation import effects as catalogue

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.reduction.series import ReducedSeries
    from thermocald.simulation.effects import Effect

    Array = NDArray[np.float64]

__all__ = ["MOUNT", "Candidate", "candidates", "richer_set"]

MOUNT = ("omega", "phi", "kappa")


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect acting on one set of parameters.

    name: of the searched non-linear parameter, "" where there is none; grid: its values.
    """

    effect: str
    parameters: tuple[str, ...]
    name: str
    grid: Array
    fixed: tuple[tuple[str, Any], ...] = ()

    @property
    def kind(self) -> Effect:
        """The effect itself."""
        return catalogue.get(self.effect)

    @property
    def is_drive(self) -> bool:
        """Whether it replaces the temperature behind the linear terms."""
        return self.kind.is_drive

    @property
    def is_event(self) -> bool:
        """Whether it happens at one time of a series, or not at all."""
        return self.kind.is_event

    @property
    def is_periodic(self) -> bool:
        """Whether it cycles, with a phase of its own in each series."""
        return self.kind.is_periodic

    def term(self, value: float | None, series: int) -> Term:
        """The term at one value of the grid; `series`: how many series there are."""
        if self.is_event:
            return Term(self.effect, self.parameters, self.fixed, ((),) * series)
        own = () if value is None else ((self.name, float(value)),)
        return Term(self.effect, self.parameters, self.fixed + own)


def candidates(series: Sequence[ReducedSeries]) -> list[Candidate]:
    """All candidates that the recordings could show."""
    first = series[0]
    out = []
    for name in catalogue.names():
        effect = catalogue.get(name)
        if effect.seen_in != "trajectory" or (effect.kind == "image" and not effect.columns):
            continue  # found in image space
        sets: tuple[tuple[str, ...], ...] = effect.parameter_sets or (effect.usual or BASE,)
        if effect.is_drive:
            sets = (BASE,)
        if effect.moves_mount:
            sets = (*sets, MOUNT)
        searched = {
            k: p
            for k, p in effect.nonlinear.items()
            if not p.text and (k not in effect.fresh or p.role == "event")
        }
        channels: Sequence[tuple[tuple[str, Any], ...]] = [()]
        if any(p.text for p in effect.nonlinear.values()):
            channels = [
                (("channel", c),)
                for c in first.history.readings
                if c != first.history.reference and all(_varies(e, c) for e in series)
            ]
        for fixed in channels:
            for parameters in sets:
                columns = tuple(effect.column(p) for p in parameters)
                if searched:
                    key, parameter = next(iter(searched.items()))
                    grid = trial_values(parameter, series)
                    out.append(Candidate(name, columns, key, grid, fixed))
                else:
                    out.append(Candidate(name, columns, "", np.zeros(0), fixed))
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
