"""One effect that was found: sentence, numbers, evidence, alternatives; and effects of models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from thermocald.discovery.verdict.estimates import model_values
from thermocald.simulation import effects as catalogue
from thermocald.simulation.model import ModelEffect, ThermalModel

if TYPE_CHECKING:
    from thermocald.discovery.verdict.gap import Gap
    from thermocald.reduction.hypothesis import Term

__all__ = ["EffectFound", "effects_of", "terms_of"]


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
        """Effects of the catalogue that the data cannot exclude."""
        others = ("resembles", "formula")
        return [a["effect"] for a in self.alternatives if not any(a.get(k) for k in others)]

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


def effects_of(found: EffectFound) -> list[ModelEffect]:
    """What was found as effects of a model; none where it has no name and no formula."""
    if found.term is None and found.effect not in catalogue.names():
        return []
    name = found.effect if found.effect in catalogue.names() or not found.term else (
        found.term.effect
    )  # fmt: skip
    numbers, sds = model_values(found.estimates, found.term.parameters if found.term else ())
    known = catalogue.get(name).units()
    return [
        ModelEffect(
            name,
            {k: v for k, v in numbers.items() if k in known},
            {k: v for k, v in sds.items() if k in known},
        )
    ]


def terms_of(model: ThermalModel) -> list[tuple[str, dict[str, Any]]]:
    """The effects of a model that act on trajectories of parameters, with their values."""
    return [
        (e.name, dict(e.values))
        for e in model.effects
        if catalogue.get(e.name).seen_in == "trajectory"
    ]
