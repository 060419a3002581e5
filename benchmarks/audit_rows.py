"""A row of the audit: a ratio of error to standard deviation, or a share of false alarms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """One line of the page: a ratio of error to sd, or a share of false alarms at 5 %."""

    printed_by: str
    what: str
    holds: str
    value: float
    sd: float
    draws: int
    is_share: bool = False
    low: float = 0.9

    @property
    def met(self) -> bool:
        if self.is_share:
            return self.value <= 0.05 + 3 * self.sd
        return self.low - 3 * self.sd <= self.value <= 1.1 + 3 * self.sd

    def text(self, seed: int) -> str:
        shown = (
            f"{100 * self.value:.1f} %" if self.is_share else f"{self.value:.2f} ± {self.sd:.2f}"
        )
        return (
            f"| {self.printed_by} | {self.what} | {self.holds} | {shown} | {self.draws} | {seed} |"
        )


def ratio(printed_by: str, what: str, holds: str, standardised: Array, low: float = 0.9) -> Row:
    """A row from errors over sds (draws,) or (draws, k), whose k are taken together."""
    off = np.asarray(standardised, dtype=float)
    draws = len(off)
    value = float(np.sqrt(np.mean(off**2)))
    return Row(printed_by, what, holds, value, value / np.sqrt(2 * draws), draws, low=low)


def share(printed_by: str, what: str, holds: str, alarms: list[bool]) -> Row:
    n = len(alarms)
    return Row(
        printed_by, what, holds, float(np.mean(alarms)), np.sqrt(0.05 * 0.95 / n), n, is_share=True
    )
