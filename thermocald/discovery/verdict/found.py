"""One effect that was found: sentence, numbers, evidence, alternatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from thermocald.discovery.verdict.gap import Gap
    from thermocald.reduction.hypothesis import Term

__all__ = ["EffectFound"]


@dataclass(frozen=True, eq=False)
class EffectFound:
    """One entry of `effects` in CONVENTIONS §4."""

    effect: str
    statement: str
    where: dict[str, Any]
    estimates: dict[str, dict[str, Any]]
    evidence: dict[str, Any]
    alternatives: list[dict[str, Any]]
    gap_before: Gap
    gap_after: Gap
    term: Term | None = None

    @property
    def alternative_names(self) -> list[str]:
        """Effects that the data cannot exclude."""
        return [a["effect"] for a in self.alternatives if not a.get("resembles")]

    def as_json(self) -> dict[str, Any]:
        """As the document has it."""
        return {
            "effect": self.effect,
            "statement": self.statement,
            "where": self.where,
            "estimates": self.estimates,
            "evidence": self.evidence,
            "alternatives": self.alternatives,
            "gap_before": self.gap_before.as_json(),
            "gap_after": self.gap_after.as_json(),
        }
