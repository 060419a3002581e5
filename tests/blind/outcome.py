"""What came of one blind case."""

from __future__ import annotations

from dataclasses import dataclass, field

from tests.blind.case import Case


@dataclass
class Outcome:
    """found: names said; listed: alternatives not excluded; pulls: (estimate - truth) / sd;
    gap_closed: share of M2's excess of reduced χ²; seconds: CPU.
    """

    case: Case
    found: tuple[str, ...]
    verdict: str
    listed: tuple[str, ...]
    right: bool
    right_or_listed: bool
    pulls: dict[str, float] = field(default_factory=dict)
    gap_closed: float | None = None
    seconds: float = 0.0
    misfit_px: float = 0.0
