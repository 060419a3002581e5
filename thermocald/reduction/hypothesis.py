"""A hypothesis: the base model with some effects added, and its fit to series together.

Physical constants are shared by the series; levels belong to each series, and so do the times
and phases that an effect calls fresh.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.reduction.series import COLUMNS
from thermocald.simulation import effects as catalogue

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.reduction.weighting import NormalEquations, Weighting
    from thermocald.simulation.effects import Effect

__all__ = ["BASE", "Block", "Fit", "Term", "known_term"]

BASE = ("c", "x0", "y0")


@dataclass(frozen=True)
class Term:
    """One effect of a hypothesis.

    parameters: the columns it acts on; nonlinear: shared values; fresh: per series, None where
    the effect does not occur; through_drive: a trajectory of T that follows the drive instead of T.
    """

    effect: str
    parameters: tuple[str, ...] = BASE
    nonlinear: tuple[tuple[str, Any], ...] = ()
    fresh: tuple[tuple[tuple[str, Any], ...] | None, ...] = ()
    through_drive: bool = False

    @property
    def kind(self) -> Effect:
        """The effect itself."""
        return catalogue.get(self.effect)

    @property
    def is_drive(self) -> bool:
        """Whether it replaces the temperature behind the linear terms."""
        return self.kind.is_drive

    @property
    def is_separate(self) -> bool:
        """Whether each series has coefficients of its own: a height, or amplitude and phase."""
        return self.kind.is_event or self.kind.is_periodic

    def values(self, series: int) -> dict[str, Any] | None:
        """Non-linear values in one series; None where the effect does not occur there."""
        if not self.fresh:
            return dict(self.nonlinear)
        own = self.fresh[series]
        return None if own is None else {**dict(self.nonlinear), **dict(own)}

    def with_value(self, name: str, value: float) -> Term:
        """A copy with one shared non-linear value changed."""
        return replace(
            self, nonlinear=tuple((k, value if k == name else v) for k, v in self.nonlinear)
        )


@dataclass(frozen=True, eq=False)
class Block:
    """Where the coefficients of one term stand: columns of trajectories and of the unknowns."""

    term: int  # -1: the base's rates
    series: int | None  # None: shared
    start: int
    trajectories: int
    parameters: tuple[str, ...]

    @property
    def stop(self) -> int:
        return self.start + self.trajectories * len(self.parameters)


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted hypothesis.

    coefficients (K,) px-scaled; covariance (K + L, K + L) of coefficients and the L shared
    non-linear parameters `searched` [(term, name)]; chi2, logdet: sums over series; parts: normal
    equations per series; objective: -2 log L but for a constant.
    """

    terms: tuple[Term, ...]
    blocks: tuple[Block, ...]
    coefficients: Array
    covariance: Array
    chi2: float
    logdet: float
    weightings: tuple[Weighting, ...]
    designs: tuple[tuple[Array, Array, NDArray[np.int64]], ...]
    reduced: tuple[NormalEquations, ...]
    searched: tuple[tuple[int, str], ...] = field(default=())

    @property
    def objective(self) -> float:
        return self.chi2 + self.logdet

    def direction(self, block: Block) -> Array:
        """Coefficients of one block as (trajectories, P) in px-scaled columns."""
        out = np.zeros((block.trajectories, len(COLUMNS)))
        part = self.coefficients[block.start : block.stop].reshape(block.trajectories, -1)
        out[:, [COLUMNS.index(p) for p in block.parameters]] = part
        return out

    def forget(self) -> None:
        """Let go of what was whitened for scans: of a long series, much."""
        for weighting in self.weightings:
            weighting.kept.clear()

    def chi2_of(self, series: int, coefficients: Array | None = None) -> float:
        """χ² of one series at some coefficients (default: the fitted)."""
        x = self.coefficients if coefficients is None else coefficients
        _, _, index = self.designs[series]
        r, part = self.reduced[series], x[index]
        return float(r.yy - 2 * part @ r.c + part @ r.A @ part)


def known_term(name: str, values: Mapping[str, Any], series: int) -> Term:
    """A term of an effect whose values are known, as a start; series: how many there are.

    An event is the first series'; what a cycle has of its own is not searched.
    """
    effect = catalogue.get(name)
    parameters = tuple(effect.column(p) for p in effect.linear if p in values)
    shared = tuple(
        (k, v if isinstance(v, str) else float(v))
        for k, v in values.items()
        if k in effect.nonlinear and k not in effect.fresh
    )
    fresh: tuple[tuple[tuple[str, Any], ...] | None, ...] = ()
    if effect.is_event:
        own = tuple((k, float(values[k])) for k in effect.fresh if k in values)
        fresh = (own, *(None,) * (series - 1))
    return Term(name, parameters or BASE, shared, fresh)
