"""A row of the audit: a ratio of error to standard deviation, or a share of false alarms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

HEADER = "| section | printed by | error / sd, or share of false alarms |\n|---|---|---|"
_FAR = 0.1  # ratios farther from 1 are named


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
            f"(includes {self.holds or 'nothing else'}; {self.draws} draws, seed {seed})"
        )


def table(section: str, rows: list[Row]) -> str:
    """Return a section's lines of the page: one per command, with its least and largest value."""
    lines = []
    for kind in dict.fromkeys((row.printed_by, row.level is None) for row in rows):
        alike = (r for r in rows if (r.printed_by, r.level is None) == kind)
        of_command = sorted(alike, key=lambda r: r.value)
        cell = " to ".join(dict.fromkeys(r.shown for r in (of_command[0], of_command[-1])))
        far = max(of_command, key=lambda r: abs(r.value - 1))
        if far.level is None and abs(far.value - 1) > _FAR:
            cell += f" ({far.what})"
        lines.append(f"| {section} | {kind[0]} | {cell} |")
    return "\n".join(lines)


def ratio(printed_by: str, what: str, holds: str, standardised: Array, low: float = 0.9) -> Row:
    """Return a row from errors over sds (draws,) or (draws, k), all pooled."""
    off = np.asarray(standardised, dtype=float)
    draws = len(off)
    value = float(np.sqrt(np.mean(off**2)))
    return Row(printed_by, what, holds, value, value / np.sqrt(2 * draws), draws, low=low)


def share(printed_by: str, what: str, holds: str, alarms: list[bool], level: float = 0.05) -> Row:
    """Return a row of false alarms; its sd is that of a share as large as the level."""
    n = len(alarms)
    sd = np.sqrt(level * (1 - level) / n)
    return Row(printed_by, what, holds, float(np.mean(alarms)), sd, n, level=level)
