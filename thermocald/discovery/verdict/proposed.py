"""A formula in place of a name: its sentence, numbers and evidence, and the effects it makes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from thermocald.discovery.grammar.proposal import propose
from thermocald.discovery.verdict.estimates import term_estimates
from thermocald.discovery.verdict.gap import fit_first
from thermocald.discovery.verdict.trade_off import not_separable
from thermocald.reduction.adequacy import examine
from thermocald.simulation import effects as catalogue

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.discovery.grammar.proposal import Proposal
    from thermocald.discovery.search.examination import Examination
    from thermocald.discovery.verdict.unnamed import Description
    from thermocald.reduction.hypothesis import Fit, Term

__all__ = ["NO_PROPOSAL", "Proposed", "proposed"]

NO_PROPOSAL = {
    True: "no formula over what was recorded explains it on both recordings: its cause was not "
    "recorded, or it is none that the operators describe",
    False: "a formula is proposed only where a second recording can test it: give --verify",
}
"""Why there is no proposal, by whether there is a second recording."""
_EXPERIMENT = "record over a wider range of temperatures, and at other rates"
_RIVALS = 4
_BAND = 16.0  # score by which a formula may be worse and still not be excluded


@dataclass(frozen=True, eq=False)
class Proposed:
    """A formula as an entry of a discovery.

    examination: with the series it was found on; fits: base and whole, constants of M1 alone; the
    rest as EffectFound has it.
    """

    examination: Examination
    base_fit: Fit
    final_fit: Fit
    term: Term
    statement: str
    where: dict[str, Any]
    estimates: dict[str, dict[str, Any]]
    evidence: dict[str, Any]
    alternatives: list[dict[str, Any]]


def proposed(
    x: Examination, description: Description, progress: Callable[[str], None] | None = None
) -> Proposed | None:
    """The proposal for what an examination leaves unexplained; None where the data allow none."""
    found = propose(x, description.where["parameters"], progress)
    if found is None:
        return None
    base_fit = fit_first(found.fitter, found.base.terms)
    final_fit = fit_first(found.fitter, found.best.terms)
    adequacy = tuple(examine(found.fitter, found.best.fit, s) for s in range(2))
    examination = replace(
        x, fitter=found.fitter, base=found.base, best=found.best, adequacy=adequacy
    )
    term = found.terms[-1]
    e = found.fitter.series[0]
    estimates = term_estimates(final_fit, len(found.best.terms) - 1, e)
    sentence = catalogue.get(term.effect).sentence(estimates)
    together = not_separable(found.fitter, final_fit, len(found.best.terms) - 1)
    if together is not None:
        sentence += together.sentence
    alternatives = [
        {
            "effect": t.effect,
            "score_difference": d,
            "values": dict(t.nonlinear),
            "experiment": _EXPERIMENT,
            "formula": True,
        }
        for t, d in found.rivals[:_RIVALS]
        if d < _BAND
    ]
    return Proposed(
        examination,
        base_fit,
        final_fit,
        term,
        f"{sentence}; no effect of the catalogue, proposed from what was recorded",
        {**description.where, "parameters": list(term.parameters)},
        {**description.estimates, **estimates},
        {
            **{k: v for k, v in description.evidence.items() if k != "bridge"},
            "proposal": _document(found, term, examination),
            **({"not_separable": together.as_json()} if together is not None else {}),
        },
        alternatives,
    )


def _document(found: Proposal, term: Term, x: Examination) -> dict[str, Any]:
    by_m1, by_m2 = found.closed
    return {
        "formula": term.effect,
        "transferable": True,
        "closed_on_verify_by_fit": by_m1,
        "closed_on_fit_by_verify": by_m2 if by_m2 == by_m2 else None,
        "score_gain": float(found.base.score - found.best.score),
        "penalty": float(found.best.penalties[-1]),
        "false_alarm_probability": found.surrogates.p,
        "surrogates": {
            "count": len(found.surrogates.surrogates),
            "explained": float(found.surrogates.gain),
            "largest_of_surrogates": float(found.surrogates.surrogates.max()),
        },
        "absolute_test": [
            {"sigmas": float(a.significance), "misfit_px": float(a.misfit_px)} for a in x.adequacy
        ],
    }
