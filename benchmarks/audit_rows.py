"""A row of the audit: a ratio of error to standard deviation, or a share of false alarms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

HEADER = "| printed by | error / sd, or share of false alarms |\n|---|---|"


@dataclass(frozen=True)
class Row:
    """One line of the page: a ratio of error to sd, or a share of false alarms at a level."""

    printed_by: str
    what: str
    holds: str
    value: float
    sd: float
    draws: int
    level: float | None = None
    low: float = 0.9

    @property
    def met(self) -> bool:
        if self.level is not None:
            return self.value <= self.level + 3 * self.sd
        return self.low - 3 * self.sd <= self.value <= 1.1 + 3 * self.sd

    @property
    def shown(self) -> str:
        if self.level is not None:
            return f"{100 * self.value:.1f} ± {100 * self.sd:.1f} %"
        return f"{self.value:.2f} ± {self.sd:.2f}"

    def text(self, seed: int) -> str:
        return (
            f"{self.shown}  {self.printed_by}: {self.what} "
            f"(holds {self.holds or 'no more'}; {self.draws} draws, seed {seed})"
        )


def table(rows: list[Row]) -> str:
    """Return the rows as the page has them: a line per command, equal figures together."""
    lines = [HEADER]
    for printed_by in dict.fromkeys(row.printed_by for row in rows):
        figures: dict[str, list[str]] = {}
        for row in rows:
            if row.printed_by == printed_by:
                figures.setdefault(row.shown, []).append(row.what)
        cell = "<br>".join(f"{shown}: {' · '.join(whats)}" for shown, whats in figures.items())
        lines.append(f"| {printed_by} | {cell} |")
    return "\n".join(lines)


def ratio(printed_by: str, what: str, holds: str, standardised: Array, low: float = 0.9) -> Row:
    """A row from errors over sds (draws,) or (draws, k), whose k are taken together."""
    off = np.asarray(standardised, dtype=float)
    draws = len(off)
    value = float(np.sqrt(np.mean(off**2)))
    return Row(printed_by, what, holds, value, value / np.sqrt(2 * draws), draws, low=low)


def share(printed_by: str, what: str, holds: str, alarms: list[bool], level: float = 0.05) -> Row:
    """A row of false alarms; its sd is that of a share as large as the level."""
    n = len(alarms)
    sd = np.sqrt(level * (1 - level) / n)
    return Row(printed_by, what, holds, float(np.mean(alarms)), sd, n, level=level)
