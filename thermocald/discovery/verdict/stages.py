"""The staircase of the gap: what was added, and what simulation and measurement differ by then."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from thermocald.discovery.verdict.gap import Gap, gap_of
from thermocald.discovery.verdict.image_effects import image_places

if TYPE_CHECKING:
    from thermocald.discovery.search.examination import Examination
    from thermocald.reduction.hypothesis import Fit

__all__ = ["Stage", "gap_at", "stage_of"]


@dataclass(frozen=True, eq=False)
class Stage:
    """One step: what was added, the gap then on M1 (fit), on each further recording (others)."""

    added: str
    fit: Gap
    others: tuple[Gap, ...] = ()

    @property
    def verify(self) -> Gap | None:
        """The gap on M2, the first of the others; None where there is none."""
        return self.others[0] if self.others else None


def stage_of(x: Examination, added: str, fit: Fit, known: int) -> Stage:
    """The gaps at a fit when the first `known` effects of image space are in the model."""
    first, *others = (gap_at(x, fit, s, known) for s in range(len(x.fitter.series)))
    return Stage(added, first, tuple(others))


def gap_at(x: Examination, fit: Fit, series: int, known: int, explained: float = 0.0) -> Gap:
    """The gap of one series; explained: χ² that a bridge takes up alongside the model."""
    order = image_places(x)[:known]
    noise = x.noise_growth.noise[series] if x.noise_growth else None
    return gap_of(
        x.fitter, fit, series,
        x.displaced[series], "targets" in order, noise, "noise" in order, explained,
    )  # fmt: skip
