"""What the test field did while the camera was watched: boards that moved, targets that wander."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from thermocald.discovery.search.examination import Examination

__all__ = ["field_lines", "field_of"]


def field_of(x: Examination) -> dict[str, Any] | None:
    """The movements for the document; None where the field stood still."""
    movements = [
        {"recording": e.source.name, **m.as_json()}
        for e, found in zip(x.original, x.field_movements, strict=True)
        for m in found
    ]
    if not movements:
        return None
    return {
        "movements": movements,
        "note": "boards are put back where they were, wandering targets are left out; neither is "
        "the camera's",
    }


def field_lines(x: Examination) -> list[str]:
    """The same for people."""
    return [
        f"{m.sentence} in {e.source.name}; this is not counted as an effect"
        for e, found in zip(x.original, x.field_movements, strict=True)
        for m in found
    ]
