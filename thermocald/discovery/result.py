"""The result of a discovery: verdict, effects with sentences and evidence, gaps, alternatives.

What the test field did while the camera was watched: boards that moved, targets that wander.

What the mount did while the camera was watched: its movement, and when it was knocked.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery import criteria
from thermocald.discovery.entries import (
    EffectFound,
    acts_on,
    compare_shift_and_tilt,
    estimate_term,
    lagging_thermometer,
    list_image_effects,
    list_image_places,
)
from thermocald.discovery.examination import Examination, examine_series
from thermocald.discovery.gap import Gap, fit_first, measure_gap
from thermocald.discovery.search import enrich_term
from thermocald.discovery.unnamed import NO_PROPOSAL, describe_unnamed, propose_entry, resolve
from thermocald.discovery.validation import cross_validation
from thermocald.physics import catalogue
from thermocald.result import jsonable

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.discovery.search import Solution
    from thermocald.thermal.hypothesis import Fit, Term
    from thermocald.thermal.series import ReducedSeries


def field_of(x: Examination) -> dict[str, Any] | None:
    """Describe the movements for the document; None where the field stood still."""
    movements = [
        {"recording": e.source.name, **m.as_dict()}
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
    """Describe the movements of the test field for people."""
    return [
        f"{m.sentence} in {e.source.name}; this is not counted as an effect"
        for e, found in zip(x.original, x.field_movements, strict=True)
        for m in found
    ]


def mount_of(x: Examination) -> dict[str, Any] | None:
    """Describe movement and knocks for the document; None where the mount stands still.

    movement_px: RMS over image points and time; knocks: recording, time s from its start, size_px.
    """
    if x.mount is None:
        return None
    knocks = [k for number, term in enumerate(x.base.terms) if term in x.knocks
              for k in _list_steps(x, number, term)]  # fmt: skip
    return {
        "movement_px": [x.mount.size_px(e) for e in x.fitter.series],
        "knocks": knocks,
        "note": "movement of the mount is estimated with the effects and is none of the camera's",
    }


def _list_steps(x: Examination, number: int, term: Term) -> list[dict[str, Any]]:
    """Describe the steps of one event, one for each series in which it came."""
    out = []
    fit = x.base.fit
    for block in fit.blocks:
        if block.term != number or block.series is None:
            continue
        e = x.fitter.series[block.series]
        values = term.values(block.series) or {}
        first, time, sd = e.locate(float(next(iter(values.values()))))
        seen = e.weights[..., 0].any(axis=0)
        moved = np.einsum("tij,j->ti", e.columns[seen], fit.direction(block)[0])
        out.append(
            {
                "recording": e.source.name,
                "time_s": time,
                "sd_time_s": sd,
                "epoch": int(e.numbers[first]),
                "size_px": float(np.sqrt(np.mean(moved**2))),
            }
        )
    return out


def mount_lines(x: Examination) -> list[str]:
    """Describe the movement of the mount for people."""
    found = mount_of(x)
    if found is None:
        return []
    sizes = " and ".join(f"{v:.3f}" for v in found["movement_px"])
    lines = [f"the camera moves on its mount by {sizes} px RMS; this is not counted as an effect"]
    lines += [
        f"    a knock of {k['size_px']:.3f} px at {k['time_s']:.0f} s (epoch {k['epoch']}) in "
        f"{k['recording']}"
        for k in found["knocks"]
    ]
    return lines


@dataclass(frozen=True, eq=False)
class Stage:
    """One step: what was added, the gap then on M1 (fit), on each further recording (others)."""

    added: str
    fit: Gap
    others: tuple[Gap, ...] = ()

    @property
    def verify(self) -> Gap | None:
        """The gap on M2, the first of the others; None where there is none."""
        return self.others[0] if self.others else None


def measure_stage(x: Examination, added: str, fit: Fit, known: int) -> Stage:
    """Measure the gaps at a fit when the first `known` effects of image space are in the model."""
    first, *others = (measure_gap_of(x, fit, s, known) for s in range(len(x.fitter.series)))
    return Stage(added, first, tuple(others))


def measure_gap_of(
    x: Examination, fit: Fit, series: int, known: int, explained: float = 0.0
) -> Gap:
    """Measure the gap of one series; explained: χ² that a bridge takes up alongside the model."""
    order = list_image_places(x)[:known]
    noise = x.noise_growth.noise[series] if x.noise_growth else None
    return measure_gap(
        x.fitter, fit, series,
        x.displaced[series], "targets" in order, noise, "noise" in order, explained,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Discovery:
    """Verdict, effects, the staircase of the gap; fits: base and final, constants from M1 alone.

    doubts: what cannot have been meant in what was recorded, a sentence each.
    """

    verdict: str
    effects: tuple[EffectFound, ...]
    stages: tuple[Stage, ...]
    examination: Examination
    base_fit: Fit
    final_fit: Fit
    cross_validation: tuple[float, float]
    doubts: tuple[str, ...] = ()

    def excess_closed(self) -> float | None:
        """Return the share of the excess of reduced χ² over the floor that is closed on M2."""
        before, after = self.stages[0].verify, self.stages[-1].verify
        if before is None or after is None or before.chi2_reduced - before.floor < criteria.EXCESS:
            return None
        return 1.0 - (after.chi2_reduced - after.floor) / (before.chi2_reduced - before.floor)

    def as_dict(self) -> dict[str, Any]:
        """Return what `discover --json` writes, CONVENTIONS §4.

        What the mount and the test field did stands under `mount` and `field`.
        """
        mount, field = mount_of(self.examination), field_of(self.examination)
        first, last = self.stages[0], self.stages[-1]
        others = [
            {"recording": e.source.name, "before": b, "after": a}
            for e, b, a in zip(
                self.examination.fitter.series[1:], first.others, last.others, strict=True
            )
        ]
        verify = {k: others[0][k] for k in ("before", "after")} if others else None
        effects = [jsonable(e) for e in self.effects]
        if effects:  # where the base model is wrong stands with the first of its causes
            misfit = resolve(self.examination)
            effects[0]["evidence"] = {**effects[0]["evidence"], "base_misfit": misfit}
        document = {
            "format": "thermocald-discovery/1",
            "verdict": self.verdict,
            "effects": effects,
            "gap": {
                "fit": {"before": first.fit, "after": last.fit},
                "verify": verify,
                **({"verify_each": others} if len(others) > 1 else {}),
            },
            "model": None,
            "doubts": list(self.doubts),
            **({"mount": mount} if mount is not None else {}),
            **({"field": field} if field is not None else {}),
        }
        written: dict[str, Any] = jsonable(document)
        return written

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
    """Put an examination into words and numbers."""
    terms = x.best.terms if x.adequate else x.base.terms
    known = len(x.base.terms)
    fits = [fit_first(x.fitter, terms[:k]) for k in range(known, len(terms) + 1)]
    stages = [measure_stage(x, "", fits[0], 0)]
    found = list_image_effects(x, stages[0].fit)
    for k, entry in enumerate(found):
        stages.append(measure_stage(x, entry.effect, fits[0], k + 1))
        entry = replace(entry, gap_before=stages[-2].fit, gap_after=stages[-1].fit)
        found[k] = entry
    n = len(found)
    if not x.adequate:
        return _conclude_unexplained(x, fits[0], stages, n, progress)
    for k in range(known, len(terms)):
        fit = fits[k + 1 - known]
        stages.append(measure_stage(x, terms[k].effect, fit, n))
        found.append(_make_entry(x, fits[-1], k, stages[-2].fit, stages[-1].fit, len(found) == n))
    blocks = cross_validation(x.fitter, fits[-1]) if found else (float("nan"), float("nan"))
    verdict = "effects_found" if found else "adequate"
    return Discovery(verdict, tuple(found), tuple(stages), x, fits[0], fits[-1], blocks)


def _make_entry(
    x: Examination, fit: Fit, k: int, before: Gap, after: Gap, first: bool
) -> EffectFound:
    term = fit.terms[k]
    e = x.fitter.series[0]
    effect = catalogue.get(term.effect)
    estimates = _widen_estimates(x, fit, k, estimate_term(fit, k, e))
    without = _measure_score_without(x, k)
    blocks = [float(g) for g in x.cross_validation[k - len(x.base.terms)]]
    evidence: dict[str, Any] = {
        "score_gain": without,
        "penalty": x.best.penalties[k],
        "absolute_test": jsonable(x.adequacy),
        "cross_validation": blocks,
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
    part = compare_shift_and_tilt(x.fitter, x.best.fit, k)
    if part is not None:
        evidence["shift_and_tilt"], said = part
        statement += said
    alternatives = _list_alternatives(x, term, first)
    if alternatives:
        statement += f". Not excluded instead: {', '.join(a['effect'] for a in alternatives)}"
    if (lags := lagging_thermometer(fit, k)) is not None:
        alternatives.append(lags)
        statement += f". Or {lags['statement']}"
    if len(x.adequacy) < 2:
        evidence["note"] = "one series only: the constants were not verified on another"
    return EffectFound(
        term.effect,
        statement,
        {
            "parameters": acts_on(term.parameters),
            "epochs": _find_epochs(x, fit, k),
            "image_region": None,
        },
        estimates, evidence, alternatives, before, after, term,
    )  # fmt: skip


def _widen_estimates(
    x: Examination, fit: Fit, k: int, estimates: dict[str, dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Give estimates the standard deviations they have alongside one coefficient more.

    That a lens's A2 drifts by less than the data show does not make A1 as sure as if A2 stood
    still.
    """
    richer = enrich_term(fit.terms[k])
    if richer is None:
        return estimates
    terms = (*fit.terms[:k], richer, *fit.terms[k + 1 :])
    other = estimate_term(fit_first(x.fitter, terms), k, x.fitter.series[0])
    return {
        name: {**e, "sd": max(e["sd"], other[name]["sd"])} if e["sd"] is not None else e
        for name, e in estimates.items()
    }


def _measure_score_without(x: Examination, k: int) -> float:
    """Return by how much the score worsens without one effect, the others fitted again."""
    terms = tuple(t for i, t in enumerate(x.best.terms) if i != k)
    fit = x.fitter.refine(x.fitter.fit(terms))
    score = fit.objective + sum(p for i, p in enumerate(x.best.penalties) if i != k)
    return float(score - x.best.score)


def _find_epochs(x: Examination, fit: Fit, k: int) -> list[int]:
    """Return first and last epoch in which the effect moves the image by a quarter of its most."""
    e = x.fitter.series[0]
    other = x.fitter.fit([t for i, t in enumerate(fit.terms) if i != k], only=[0])
    size = np.sqrt(np.maximum(e.squares(fit.parameters(0) - other.parameters(0)), 0.0))
    large = np.flatnonzero(size > 0.25 * size.max())
    return [int(e.numbers[large[0]]), int(e.numbers[large[-1]])]


def _list_alternatives(x: Examination, term: Term, first: bool) -> list[dict[str, Any]]:
    """List solutions that the data cannot exclude, at the effect that they replace."""
    out = []
    for rival in x.rivals:
        mine, theirs = list(x.best.names), list(rival.names)
        replaced = [n for n in mine if n not in theirs]
        instead = [n for n in theirs if n not in mine]
        if not instead or (term.effect not in replaced and not (first and not replaced)):
            continue
        out.append(_describe_alternative(term.effect, rival, instead, rival.score - x.best.score))
    return out


def _describe_alternative(
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


def _conclude_unexplained(
    x: Examination,
    base: Fit,
    stages: list[Stage],
    known: int,
    progress: Callable[[str], None] | None,
) -> Discovery:
    """Describe what the catalogue does not explain: a formula where the data allow one, else
    described and bridged, not named.
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
    found = propose_entry(x, description, stages[-1].fit, progress)
    if found is not None:
        y = found.examination
        fits = (found.base_fit, found.final_fit)
        added = (stages[-1].added, "unnamed")
        stages[-1:] = [measure_stage(y, a, f, known) for a, f in zip(added, fits, strict=True)]
        entry = replace(
            found.entry, alternatives=[*found.entry.alternatives, *resembling],
            gap_before=stages[-2].fit, gap_after=stages[-1].fit,
        )  # fmt: skip
        return Discovery("unexplained", (entry,), tuple(stages), y, *fits, (nan, nan))
    bridge = sum(a.excess for a in x.base_adequacy[:1])
    before = measure_stage(x, "unnamed", base, known)
    stages.append(replace(before, fit=measure_gap_of(x, base, 0, known, bridge)))
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
            "image_space": [e.effect for e in list_image_effects(x, before.fit)],
        },
        resembling, before.fit, stages[-1].fit,
    )  # fmt: skip
    return Discovery("unexplained", (entry,), tuple(stages), x, base, base, (nan, nan))
