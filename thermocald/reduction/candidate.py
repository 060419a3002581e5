"""A candidate: one effect acting on one set of parameters, with the grid to search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.reduction.grid import trial_values
from thermocald.reduction.hypothesis import Term
from thermocald.reduction.series import COLUMNS
from thermocald.simulation import effects as catalogue

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array
    from thermocald.reduction.series import ReducedSeries
    from thermocald.simulation.effects import Effect

__all__ = ["Candidate", "candidate_of"]


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect acting on one set of parameters.

    parameters: columns of the reduced series; name: of the searched non-linear parameter, "" where
    there is none; grid: its trial values; fixed: non-linear values that are given.
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
    def directions(self) -> Array:
        """Its parameters as unit vectors (P, k)."""
        out = np.zeros((len(COLUMNS), len(self.parameters)))
        out[[COLUMNS.index(name) for name in self.parameters], range(len(self.parameters))] = 1.0
        return out

    def term(self, value: float | None, series: int) -> Term:
        """The term at one value of the grid; `series`: how many series there are."""
        if self.kind.is_event:
            return Term(self.effect, self.parameters, self.fixed, ((),) * series)
        own = () if value is None else ((self.name, float(value)),)
        return Term(self.effect, self.parameters, self.fixed + own)


def candidate_of(
    effect: Effect,
    parameters: tuple[str, ...],
    series: Sequence[ReducedSeries],
    fixed: tuple[tuple[str, Any], ...] = (),
    *,
    plain: bool = False,
) -> Candidate:
    """An effect on some of its coefficients; what belongs to a series but an event is not searched.

    fixed: non-linear values that are given; plain: without the parameters that a model may leave
    out.
    """
    given = dict(fixed)
    columns = tuple(effect.column(p) for p in parameters)
    for key, parameter in effect.nonlinear.items():
        own = key in effect.fresh and parameter.role != "event"
        left_out = plain and key in effect.optional
        if not (parameter.text or own or left_out or key in given):
            return Candidate(effect.name, columns, key, trial_values(parameter, series), fixed)
    return Candidate(effect.name, columns, "", np.zeros(0), fixed)
