"""The outcome of one case, blind or on real corners."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from thermocald.discovery.result import Discovery

EXCESS = 0.02  # of reduced χ²: a smaller excess is its own scatter and cannot be closed


@dataclass
class Outcome:
    """The discovery of one case, compared with the truth.

    found: names; listed: alternatives not excluded; pulls: (estimate - truth) / sd; gap_closed:
    share of M2's excess of reduced χ²; seconds: CPU time.
    """

    case: Any
    found: tuple[str, ...]
    verdict: str
    listed: tuple[str, ...]
    right: bool
    right_or_listed: bool
    pulls: dict[str, float] = field(default_factory=dict)
    gap_closed: float | None = None
    seconds: float = 0.0
    misfit_px: float = 0.0


def excess_closed(discovery: Discovery) -> float | None:
    """Return the share of reduced χ²'s excess over the floor in M2 that the effects explain."""
    before, after = discovery.stages[0].verify, discovery.stages[-1].verify
    if before is None or after is None or before.chi2_reduced - before.floor < EXCESS:
        return None
    return 1.0 - (after.chi2_reduced - after.floor) / (before.chi2_reduced - before.floor)


def compare(
    case: Any, discovery: Discovery, seconds: float, accepted: tuple[tuple[str, ...], ...] = ()
) -> Outcome:
    """Compare the discovery with the hidden effects, or with other `accepted` names."""
    found = tuple(sorted(e.effect for e in discovery.effects))
    listed = tuple(a for e in discovery.effects for a in e.alternative_names)
    hidden = tuple(sorted(case.effects))
    right = found in (accepted or (hidden,))
    right &= (discovery.verdict == "unexplained") is (found == ("unnamed",))
    close = right
    if not right and len(found) == len(hidden):
        wrong = [h for h in hidden if h not in found]
        close = all(any(w in a.split("+") for a in listed) for w in wrong)
    return Outcome(
        case, found, discovery.verdict, listed, right, close, {}, excess_closed(discovery),
        seconds, max(a.misfit_px for a in discovery.examination.adequacy),
    )  # fmt: skip
