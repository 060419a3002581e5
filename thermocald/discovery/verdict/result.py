"""The result of a discovery: verdict, effects with sentences and evidence, gaps, alternatives."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery.search.candidates import richer_set
from thermocald.discovery.search.cross_validation import cross_validation
from thermocald.discovery.search.examination import Examination, examine_series
from thermocald.discovery.verdict.estimates import acts_on, term_estimates
from thermocald.discovery.verdict.field import field_of
from thermocald.discovery.verdict.found import EffectFound
from thermocald.discovery.verdict.gap import Gap, fit_first
from thermocald.discovery.verdict.image_effects import image_effects
from thermocald.discovery.verdict.misfit import resolve
from thermocald.discovery.verdict.mount import mount_of
from thermocald.discovery.verdict.proposed import NO_PROPOSAL, proposed
from thermocald.discovery.verdict.separable import shift_or_tilt
from thermocald.discovery.verdict.stages import Stage, gap_at, stage_of
from thermocald.discovery.verdict.unnamed import describe_unnamed
from thermocald.simulation import effects as catalogue

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.discovery.search.search import Solution
    from thermocald.reduction.hypothesis import Fit, Term
    from thermocald.reduction.series import ReducedSeries

__all__ = ["Discovery", "discover_series"]


@dataclass(frozen=True, eq=False)
class Discovery:
    """Verdict, effects, the staircase of the gap; fits: base and final, constants from M1 alone."""

    verdict: str
    effects: tuple[EffectFound, ...]
    stages: tuple[Stage, ...]
    examination: Examination
    base_fit: Fit
    final_fit: Fit
    cross_validation: tuple[float, float]

    def excess_closed(self) -> float | None:
        """Share of the excess of reduced χ² over the floor that is closed on M2."""
        before, after = self.stages[0].verify, self.stages[-1].verify
        if before is None or after is None or before.chi2_reduced - before.floor < 0.02:
            return None
        return 1.0 - (after.chi2_reduced - after.floor) / (before.chi2_reduced - before.floor)

    def as_json(self, model: str | None) -> dict[str, Any]:
        """CONVENTIONS §4; what the mount and the test field did stands under `mount`, `field`."""
        mount, field = mount_of(self.examination), field_of(self.examination)
        first, last = self.stages[0], self.stages[-1]
        others = [
            {"recording": e.source.name, "before": b.as_json(), "after": a.as_json()}
            for e, b, a in zip(
                self.examination.fitter.series[1:], first.others, last.others, strict=True
            )
        ]
        verify = {k: others[0][k] for k in ("before", "after")} if others else None
        effects = [e.as_json() for e in self.effects]
        if effects:  # where the base model is wrong, told with the first of its causes
            misfit = resolve(self.examination).as_json()
            effects[0]["evidence"] = {**effects[0]["evidence"], "base_misfit": misfit}
        return {
            "format": "thermocald-discovery/1",
            "verdict": self.verdict,
            "effects": effects,
            "gap": {
                "fit": {"before": first.fit.as_json(), "after": last.fit.as_json()},
                "verify": verify,
                **({"verify_each": others} if len(others) > 1 else {}),
            },
            "model": model,
            **({"mount": mount} if mount is not None else {}),
            **({"field": field} if field is not None else {}),
        }

    @property
    def headline(self) -> str:
        """Verdict and names in one line: A or B where B cannot be excluded."""
        names = [" or ".join([e.effect, *e.alternative_names]) for e in self.effects]
        return f"{self.verdict}: {', and '.join(names)}" if names else self.verdict


def discover_series(
    series: Sequence[ReducedSeries],
    progress: Callable[[str], None] | None = None,
    given: Sequence[tuple[str, dict[str, Any]]] = (),
    jobs: int = 1,
) -> Discovery:
    """Examine M1, or M1 and others, and put what was found into words and numbers.

    jobs: candidates that surrogates try at a time, with the same bits for any number.
    """
    x = examine_series(series, progress, given, jobs)
    return conclude(x, progress)


def conclude(x: Examination, progress: Callable[[str], None] | None = None) -> Discovery:
    """Words and numbers for an examination."""
    terms = x.best.terms if x.adequate else x.base.terms
    known = len(x.base.terms)
    fits = [fit_first(x.fitter, terms[:k]) for k in range(known, len(terms) + 1)]
    stages = [stage_of(x, "", fits[0], 0)]
    found = image_effects(x, stages[0].fit)
    for k, entry in enumerate(found):
        stages.append(stage_of(x, entry.effect, fits[0], k + 1))
        entry = replace(entry, gap_before=stages[-2].fit, gap_after=stages[-1].fit)
        found[k] = entry
    n = len(found)
    if not x.adequate:
        return _unexplained(x, fits[0], stages, n, progress)
    for k in range(known, len(terms)):
        fit = fits[k + 1 - known]
        stages.append(stage_of(x, terms[k].effect, fit, n))
        found.append(_entry(x, fits[-1], k, stages[-2].fit, stages[-1].fit, len(found) == n))
    blocks = cross_validation(x.fitter, fits[-1]) if found else (float("nan"), float("nan"))
    verdict = "effects_found" if found else "adequate"
    return Discovery(verdict, tuple(found), tuple(stages), x, fits[0], fits[-1], blocks)


def _entry(x: Examination, fit: Fit, k: int, before: Gap, after: Gap, first: bool) -> EffectFound:
    term = fit.terms[k]
    e = x.fitter.series[0]
    effect = catalogue.get(term.effect)
    estimates = _undecided(x, fit, k, term_estimates(fit, k, e))
    without = _score_without(x, k)
    blocks = [float(g) for g in x.cross_validation[k - len(x.base.terms)]]
    evidence: dict[str, Any] = {
        "score_gain": without,
        "penalty": x.best.penalties[k],
        "absolute_test": [
            {"sigmas": float(a.significance), "misfit_px": float(a.misfit_px)} for a in x.adequacy
        ],
        "cross_validation": blocks,
        "left_out_blocks_gain": blocks,  # its name until the next version
        "inflation_for_correlated_noise": e.correlation,
    }
    if x.surrogates:
        test = x.surrogates[k - len(x.base.terms)]
        evidence["false_alarm_probability"] = test.p
        evidence["surrogates"] = {
            "count": len(test.surrogates),
            "gain": float(test.gain),
            "gains_of_surrogates": [float(g) for g in np.sort(test.surrogates)],
        }
    statement = effect.sentence(estimates)
    part = shift_or_tilt(x.fitter, x.best.fit, k)
    if part is not None:
        statement += part.sentence
        evidence["shift_and_tilt"] = part.as_json()
    others = [a["effect"] for a in _alternatives(x, term, first)]
    if others:
        statement += f". Not excluded instead: {', '.join(others)}"
    if len(x.adequacy) < 2:
        evidence["note"] = "one series only: the constants were not verified on another"
    return EffectFound(
        term.effect,
        statement,
        {
            "parameters": acts_on(term.parameters),
            "epochs": _when(x, fit, k),
            "image_region": None,
        },
        estimates, evidence, _alternatives(x, term, first), before, after, term,
    )  # fmt: skip


def _undecided(
    x: Examination, fit: Fit, k: int, estimates: dict[str, dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Estimates with the standard deviations they have alongside one coefficient more.

    That a lens's A2 drifts by less than the data show does not make A1 as sure as if A2 stood
    still.
    """
    richer = richer_set(fit.terms[k])
    if richer is None:
        return estimates
    terms = (*fit.terms[:k], richer, *fit.terms[k + 1 :])
    other = term_estimates(fit_first(x.fitter, terms), k, x.fitter.series[0])
    return {
        name: {**e, "sd": max(e["sd"], other[name]["sd"])} if e["sd"] is not None else e
        for name, e in estimates.items()
    }


def _score_without(x: Examination, k: int) -> float:
    """By how much the score worsens without one effect, the others fitted again."""
    terms = tuple(t for i, t in enumerate(x.best.terms) if i != k)
    fit = x.fitter.refine(x.fitter.fit(terms))
    score = fit.objective + sum(p for i, p in enumerate(x.best.penalties) if i != k)
    return float(score - x.best.score)


def _when(x: Examination, fit: Fit, k: int) -> list[int]:
    """First and last epoch in which the effect moves the image by a quarter of its most."""
    e = x.fitter.series[0]
    C, V, index = fit.designs[0]
    model = (C * fit.coefficients[index]) @ V.T
    fewer = tuple(t for i, t in enumerate(fit.terms) if i != k)
    other = x.fitter.fit(fewer, only=[0])
    C, V, index = other.designs[0]
    r = model - (C * other.coefficients[index]) @ V.T
    level = np.linalg.lstsq(e.N.sum(axis=0), np.einsum("epq,eq->p", e.N, r), rcond=1e-12)[0]
    size = np.sqrt(np.maximum(np.einsum("ep,epq,eq->e", r - level, e.N, r - level), 0))
    large = np.flatnonzero(size > 0.25 * size.max())
    return [int(e.numbers[large[0]]), int(e.numbers[large[-1]])]


def _alternatives(x: Examination, term: Term, first: bool) -> list[dict[str, Any]]:
    """Solutions that the data cannot exclude, told at the effect that they replace."""
    out = []
    for rival in x.rivals:
        mine, theirs = list(x.best.names), list(rival.names)
        replaced = [n for n in mine if n not in theirs]
        instead = [n for n in theirs if n not in mine]
        if not instead or (term.effect not in replaced and not (first and not replaced)):
            continue
        out.append(_alternative(term.effect, rival, instead, rival.score - x.best.score))
    return out


def _alternative(
    name: str, rival: Solution, instead: list[str], difference: float
) -> dict[str, Any]:
    effect = catalogue.get(name)
    searched = {k: v for t in rival.terms if t.effect in instead for k, v in t.nonlinear}
    return {
        "effect": "+".join(instead),
        "score_difference": float(difference),
        "values": searched,
        "experiment": effect.experiment_against(catalogue.get(instead[0])),
    }


def _unexplained(
    x: Examination,
    base: Fit,
    stages: list[Stage],
    known: int,
    progress: Callable[[str], None] | None,
) -> Discovery:
    """What the catalogue does not explain: a formula where the data allow one, else described and
    bridged, not named.
    """
    description = describe_unnamed(x)
    resembling = [
        {
            "effect": s.names[0],
            "resembles": True,
            "score_difference": float(s.score - x.best.score),
            "misfit_px_left": None,
        }
        for s in x.ranking[:4]
    ]
    nan = float("nan")
    found = proposed(x, description, progress)
    if found is not None:
        y = found.examination
        fits = (found.base_fit, found.final_fit)
        added = (stages[-1].added, "unnamed")
        stages[-1:] = [stage_of(y, a, f, known) for a, f in zip(added, fits, strict=True)]
        entry = EffectFound(
            "unnamed", found.statement, found.where, found.estimates, found.evidence,
            [*found.alternatives, *resembling], stages[-2].fit, stages[-1].fit, found.term,
        )  # fmt: skip
        return Discovery("unexplained", (entry,), tuple(stages), y, *fits, (nan, nan))
    bridge = sum(a.excess for a in x.base_adequacy[:1])
    before = stage_of(x, "unnamed", base, known)
    stages.append(replace(before, fit=gap_at(x, base, 0, known, bridge)))
    entry = EffectFound(
        "unnamed", f"{description.statement}; {NO_PROPOSAL[len(x.fitter.series) > 1]}",
        description.where, description.estimates,
        {
            **description.evidence,
            "proposal": None,
            "absolute_test_of_best_combination": {
                "effects": list(x.best.names),
                "sigmas": [float(a.significance) for a in x.adequacy],
                "misfit_px": [float(a.misfit_px) for a in x.adequacy],
            },
            "image_space": [e.effect for e in image_effects(x, before.fit)],
        },
        resembling, before.fit, stages[-1].fit,
    )  # fmt: skip
    return Discovery("unexplained", (entry,), tuple(stages), x, base, base, (nan, nan))
