"""The result of a discovery: verdict, effects with evidence and alternatives, gaps, and the model.

It also describes the movements of the test field and the mount during the series.

The model is the next version of a thermal model, which `simulate` runs, built from its fit as `fit`
builds one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.thermal.prediction_test import Moved
from thermocald.analysis.thermal.result import build_camera, with_covariance
from thermocald.discovery import criteria
from thermocald.discovery.entries import (
    EffectFound,
    compare_shift_and_tilt,
    effects_of,
    estimate_term,
    list_image_effects,
)
from thermocald.discovery.examination import Examination, examine_series
from thermocald.discovery.gap import Gap, Stage, fit_first, measure_gap, measure_stage
from thermocald.discovery.lag import lagging_thermometer
from thermocald.discovery.proposal import propose
from thermocald.discovery.search import by_score
from thermocald.discovery.unnamed import (
    NO_PROPOSAL,
    describe_misfit,
    describe_proposal,
    describe_unnamed,
    say_contradiction,
)
from thermocald.numbers import enumerated
from thermocald.physics import catalogue
from thermocald.physics.model import ModelEffect
from thermocald.result import jsonable
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import Term
from thermocald.thermal.noise import sharpen_trajectories
from thermocald.thermal.scan import examine, examine_all
from thermocald.thermal.series import FIELD_SCALES

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.physics.model import ThermalModel
    from thermocald.thermal.hypothesis import Fit
    from thermocald.thermal.series import ReducedSeries


def field_lines(x: Examination) -> list[str]:
    """Return a line for each movement of the test field."""
    return [
        f"{m.sentence} in {e.source.name}; this is not counted as an effect"
        for e, movements in zip(x.unblocked, x.field_movements, strict=True)
        for m in movements
    ]


def mount_lines(x: Examination) -> list[str]:
    """Return lines about the movement of the mount, its knocks and touches."""
    touches = [
        f"the camera was elsewhere for a moment, as if touched, in {t['recording']}; left out: "
        f"epoch{'s' if len(t['epochs']) > 1 else ''} {enumerated(list(map(str, t['epochs'])))}"
        for t in _list_touches(x)
    ]
    if x.mount is None and not x.knocks:
        return touches
    moves = "stands still but for knocks"
    if x.mount is not None:
        sizes = enumerated([f"{x.mount.size_px(e):.3f}" for e in x.fitter.series])
        moves = f"moves on its mount by {sizes} px RMS"
    return [
        f"the camera {moves}; this is not counted as an effect",
        *(
            f"    a knock of {k['size_px']:.3f} px at {k['time_s']:.0f} s (epoch {k['epoch']}) in "
            f"{k['recording']}" + ("; or a slip inside the camera" if k["not_excluded"] else "")
            for k in _list_knocks(x)
        ),
        *touches,
    ]


def say_adequate(x: Examination) -> str:
    """Return a sentence on what reproduces the recording if no effect was found."""
    if any(x.as_slips):
        return (
            "the model reproduces the recording except for steps, which are a knock of the mount "
            "or a slip inside the camera: a second camera on the same mount tells them apart"
        )
    if x.mount is not None:
        return (
            "the model and a moving mount reproduce the recording; an effect that moves the image "
            "as the mount does cannot be seen"
        )
    if x.knocks:
        return "the model and knocks of the mount reproduce the recording; no effect is missing"
    return "the model reproduces the recording; no effect that it can show is missing"


def _list_touches(x: Examination) -> list[dict[str, Any]]:
    """Return the epochs in which each series' camera was elsewhere for a moment."""
    return [
        {"recording": e.source.name, "epochs": e.source.numbers[e.touched].tolist()}
        for e in x.unblocked
        if e.touched.any()
    ]


def _list_knocks(x: Examination) -> list[dict[str, Any]]:
    """Return the document of each knock of the mount, in each series in which it occurred."""
    out = []
    fit = x.base.fit
    for block in fit.blocks:
        if block.term < 0 or block.series is None or fit.terms[block.term] not in x.knocks:
            continue
        term = fit.terms[block.term]
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
                "not_excluded": [term.kind.name] if x.as_slips[x.knocks.index(term)] else [],
            }
        )
    return out


@dataclass(frozen=True, eq=False, repr=False)
class Discovery:
    """The result of a discovery.

    stages: the gap before and after each effect; base_fit, final_fit: constants from M1 alone;
    doubts: probable mistakes in the recorded data, one sentence each; estimated: the
    estimate of the effects of the catalogue from M1 alone, None if there are none.
    """

    verdict: str
    effects: tuple[EffectFound, ...]
    stages: tuple[Stage, ...]
    examination: Examination
    base_fit: Fit
    final_fit: Fit
    doubts: tuple[str, ...] = ()
    estimated: tuple[HypothesisFitter, Fit] | None = None

    def effects_with_gaps(self) -> list[tuple[EffectFound, Gap, Gap]]:
        """Return each effect with the gap in M1 before and after it, from the last stages."""
        gaps = [stage.fit for stage in self.stages[-len(self.effects) - 1 :]]
        return list(zip(self.effects, gaps[:-1], gaps[1:], strict=True))

    def as_dict(self) -> dict[str, Any]:
        """Return what `discover --json` writes (CONVENTIONS §4).

        Movements of the mount and the test field are under `mount` and `field`.
        """
        x = self.examination
        gaps = zip(self.stages[0].gaps, self.stages[-1].gaps, strict=True)
        fit, *others = ({"before": before, "after": after} for before, after in gaps)
        effects = [
            {**jsonable(e), "gap_before": before, "gap_after": after}
            for e, before, after in self.effects_with_gaps()
        ]
        if effects:  # the misfit of the base model is given with the first of its causes
            effects[0]["evidence"]["base_misfit"] = describe_misfit(x)
        document: dict[str, Any] = {
            "format": "thermocald-discovery/1",
            "verdict": self.verdict,
            "effects": effects,
            "gap": {"fit": fit, "verify": others[0] if others else None},
            "model": None,
            "doubts": list(self.doubts),
        }
        if len(others) > 1:
            names = [e.source.name for e in x.fitter.series[1:]]
            document["gap"]["verify_each"] = [
                {"recording": name, **gap} for name, gap in zip(names, others, strict=True)
            ]
        touches = _list_touches(x)
        if x.mount is not None or x.knocks or touches:  # RMS over image points and time
            document["mount"] = {
                "movement_px": [x.mount.size_px(e) if x.mount else 0.0 for e in x.fitter.series],
                "knocks": _list_knocks(x),
                **({"touches": touches} if touches else {}),
                "note": "the movement of the mount is estimated with the effects and is not the "
                "camera's",
            }
        movements = [
            {"recording": e.source.name, **m.as_dict()}
            for e, moved in zip(x.unblocked, x.field_movements, strict=True)
            for m in moved
        ]
        if movements:
            document["field"] = {
                "movements": movements,
                "note": "moved boards are put back to their places and wandering targets are left "
                "out; neither movement is the camera's",
            }
        written: dict[str, Any] = jsonable(document)
        return written

    @property
    def headline(self) -> str:
        """Verdict and names in one line: `A or B` if B cannot be excluded; a knock likewise."""
        names = [" or ".join([e.effect, *e.alternative_names]) for e in self.effects]
        if any(self.examination.as_slips):
            names.append("slip or a knock of the mount")
        if len(names) > 1 and any(" or " in name for name in names):
            names = [f"{', '.join(names[:-1])}, and {names[-1]}"]
        return f"{self.verdict}: {enumerated(names)}" if names else self.verdict


def discover_series(
    series: Sequence[ReducedSeries],
    progress: Callable[[str], None] | None = None,
    given: Sequence[ModelEffect] = (),
    jobs: int = 1,
) -> Discovery:
    """Examine M1, or M1 and further series, and describe the effects found.

    given: the effects, with values, of the model to start from; jobs: number of candidates tested
    with surrogates at a time; the result is the same for any number.
    """
    x = examine_series(series, progress, given, jobs)
    terms = x.best.terms if x.adequate else x.base.terms
    known = len(x.base.terms)
    fits = [fit_first(x.fitter, terms[:k]) for k in range(known, len(terms) + 1)]
    stages = [measure_stage(x, "", fits[0], 0)]
    found = list_image_effects(x)
    n = len(found)
    for k, entry in enumerate(found, 1):
        stages.append(measure_stage(x, entry.effect, fits[0], k))
    if not x.adequate:
        return _conclude_unexplained(x, fits[0], stages, n, progress)
    estimated = estimate_first(x, fits[-1].terms) if len(terms) > known else None
    for k in range(known, len(terms)):
        stages.append(measure_stage(x, terms[k].effect, fits[k + 1 - known], n))
        assert estimated is not None
        found.append(_describe_effect(x, fits[-1], estimated[1], k))
    verdict = "effects_found" if found else "adequate"
    return Discovery(
        verdict, tuple(found), tuple(stages), x, fits[0], fits[-1], estimated=estimated
    )


def estimate_first(x: Examination, terms: Sequence[Term]) -> tuple[HypothesisFitter, Fit]:
    """Estimate a hypothesis from M1 alone, as `fit` does.

    A delay is an exception: where it puts the frames half-way between readings, the temperature
    estimated from the images would seem to determine it.
    """
    fitter = HypothesisFitter(x.fitter.series[:1])
    fit = fitter.fit([replace(t, fresh=t.fresh[:1]) for t in terms])
    fit = fitter.refine(fit, 20, least_squares=True)
    delayed = any(p.role == "delay" for t in terms for p in t.kind.nonlinear.values())
    return fitter, fit if delayed else fitter.refine_in(sharpen_trajectories(fitter, fit), fit)


def _describe_effect(x: Examination, fit: Fit, estimated: Fit, k: int) -> EffectFound:
    """Describe a term beyond the base model; both fits are of M1 alone."""
    term = fit.terms[k]
    e = x.fitter.series[0]
    number = k - len(x.base.terms)
    estimates = _widen_estimates(x, estimated, k, estimate_term(estimated, k, e))
    others = x.fitter.refine(x.fitter.fit(x.best.terms[:k] + x.best.terms[k + 1 :]))
    without = others.objective + sum(x.best.penalties) - x.best.penalties[k]
    blocks = [float(g) for g in x.cross_validation[number]]
    evidence: dict[str, Any] = {
        "score_gain": float(without - x.best.score),
        "penalty": x.best.penalties[k],
        "absolute_test": jsonable(x.adequacy),
        "cross_validation": blocks,
        "inflation_for_correlated_noise": e.correlation,
    }
    if x.surrogates:
        test = x.surrogates[number]
        evidence["false_alarm_probability"] = test.p
        evidence["surrogates"] = {
            "count": len(test.surrogates),
            "gain": float(test.gain),
            "gains_of_surrogates": [float(g) for g in np.sort(test.surrogates)],
        }
    statement = term.kind.sentence(estimates)
    # the epochs with more than a quarter of the effect's largest movement
    other = x.fitter.fit(fit.terms[:k] + fit.terms[k + 1 :], only=[0])
    size = np.sqrt(np.maximum(e.squares(fit.parameters(0) - other.parameters(0)), 0.0))
    large = np.flatnonzero(size > 0.25 * size.max())
    part = compare_shift_and_tilt(x.fitter, x.best.fit, k)
    if part is not None:
        evidence["shift_and_tilt"], clause = part
        statement += clause
    alternatives = _list_alternatives(x, term, first=number == 0)
    if alternatives:
        names = ", ".join(a["effect"] for a in alternatives)
        statement += f". Alternatives not excluded: {names}"
    lags = _find_lagging_thermometer(x, fit, k)
    if x.late and term.effect not in x.late.names:
        lags = x.late.describe(x.best.names[len(x.base.terms) :])
    if lags is not None:
        alternatives.append(lags)
        statement += f". Or {lags['statement']}"
    if len(x.adequacy) < 2:
        evidence["note"] = "one series only: the constants were not verified on another"
    return EffectFound(
        term.effect,
        statement,
        {
            "parameters": [
                f"object {p[-1]}" if p in FIELD_SCALES else p for p in term.parameters
            ],
            "epochs": [int(e.numbers[large[0]]), int(e.numbers[large[-1]])],
            "image_region": None,
        },
        estimates, evidence, alternatives, term,
    )  # fmt: skip


def _find_lagging_thermometer(x: Examination, fit: Fit, k: int) -> dict[str, Any] | None:
    """Return a lag of the thermometer as an alternative to a gradient or a negative delay, or None.

    A short lag of the thermometer looks like a camera that is ahead of it by a pure delay: the fit
    alone decides, as between two drives.
    """
    term = fit.terms[k]
    if float(dict(term.nonlinear).get(term.kind.delay, 0.0)) < 0.0:
        rate = next(n for n in catalogue.names() if catalogue.get(n).follows_rate)
        fit = x.fitter.refine(x.fitter.fit([Term(rate) if t is term else t for t in fit.terms]))
        if fit.chi2 > x.best.fit.chi2 + criteria.DRIVES_BAND:
            return None
    return lagging_thermometer(fit, k)


def _widen_estimates(
    x: Examination, fit: Fit, k: int, estimates: dict[str, dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Widen the standard deviations to those with one more coefficient in the term.

    That a drift of a lens's A2 is too small to show does not make A1 as certain as if A2 were
    constant.
    """
    term, own = fit.terms[k], set(fit.terms[k].parameters)
    richer = [p for p in term.kind.parameter_sets if len(p) == len(own) + 1 and own < set(p)]
    if not richer:
        return estimates
    terms = (*fit.terms[:k], replace(term, parameters=richer[0]), *fit.terms[k + 1 :])
    other = estimate_term(estimate_first(x, terms)[1], k, x.fitter.series[0])
    return {
        name: {**e, "sd": max(e["sd"], other[name]["sd"])} if e["sd"] is not None else e
        for name, e in estimates.items()
    }


def _list_alternatives(x: Examination, term: Term, first: bool) -> list[dict[str, Any]]:
    """List the solutions with another effect in place of this one that the data cannot exclude.

    first: whether this is the first effect, which also lists solutions that replace none.
    """
    out = []
    for rival in x.rivals:
        mine, theirs = list(x.best.names), list(rival.names)
        replaced = [n for n in mine if n not in theirs]
        instead = [n for n in theirs if n not in mine]
        if not instead or (term.effect not in replaced and not (first and not replaced)):
            continue
        out.append(
            {
                "effect": "+".join(instead),
                "score_difference": float(rival.score - x.best.score),
                "values": {
                    k: v for t in rival.terms if t.effect in instead for k, v in t.nonlinear
                },
                "experiment": term.kind.experiment_against(catalogue.get(instead[0])),
            }
        )
    return out


def _conclude_unexplained(
    x: Examination,
    base: Fit,
    stages: list[Stage],
    known: int,
    progress: Callable[[str], None] | None,
) -> Discovery:
    """Describe what the catalogue does not explain, by a formula if the data allow one.

    Otherwise it is described and bridged by a smooth term, without a name.
    """
    alone = examine(x.fitter, base, 0)
    described = describe_unnamed(x, alone)
    nearest = {s.names[-1]: s for s in reversed(x.ranking)}  # the best of each name
    resembling: list[dict[str, Any]] = [
        {
            "effect": s.names[-1],
            "resembles": True,
            "score_difference": float(s.score - x.best.score),
            "misfit_px_left": None,
        }
        for s in sorted(nearest.values(), key=by_score)[:4]
    ]
    fits = base, base
    proposal = None if x.late else propose(x, described.where["parameters"], progress)
    if proposal is not None:
        best, fitter = proposal.best, proposal.best.fitter
        x = replace(x, base=proposal.base, best=best, adequacy=examine_all(fitter, best.fit))
        fits = fit_first(fitter, x.base.terms), fit_first(fitter, best.terms)
        added = (stages[-1].added, "unnamed")
        stages[-1:] = [measure_stage(x, a, f, known) for a, f in zip(added, fits, strict=True)]
        entry = describe_proposal(described, proposal, x, estimate_first(x, best.terms)[1])
    else:
        before = measure_stage(x, "unnamed", base, known)
        gaps = (measure_gap(x, base, 0, known, alone), *before.gaps[1:])
        stages.append(replace(before, gaps=gaps))
        evidence = {
            **described.evidence,
            "proposal": None,
            "absolute_test_of_best_combination": {
                "effects": list(x.best.names),
                "sigmas": [float(a.significance) for a in x.adequacy],
                "misfit_px": [float(a.misfit_px) for a in x.adequacy],
            },
            "image_space": [e.effect for e in list_image_effects(x)],
        }
        if alone.adequate:
            del evidence["bridge"]
        late = [x.late.describe(())] if x.late else []
        if late:
            statement = f"{described.statement}. Or {late[0]['statement']}"
        else:
            statement = say_contradiction(x) or (
                f"{described.statement}; {NO_PROPOSAL[len(x.fitter.series) > 1]}"
            )
        entry = replace(described, statement=statement, evidence=evidence, alternatives=late)
    entry = replace(entry, alternatives=[*entry.alternatives, *resembling])
    return Discovery("unexplained", (entry,), tuple(stages), x, *fits)


def build_model(discovery: Discovery, old: ThermalModel | None = None) -> ThermalModel:
    """Build the thermal model with the effects found, as `fit` does, from M1 alone.

    What an effect has separately in each series (a time, a phase) is that of M1. The effects that
    the model had already stay in it.
    """
    x = discovery.examination
    own = [t for t in discovery.final_fit.terms if t not in x.knocks]
    # an effect before the knocks, which may have its name
    terms = tuple(t for t in (*own, *x.knocks) if t.values(0) is not None)
    known = discovery.estimated if terms == discovery.final_fit.terms else None
    fitter, fit = known or estimate_first(x, terms)
    listed = [m for e in discovery.effects if e.term is None for m in effects_of(e)]
    found = {t.effect for t in own} | {m.name for m in listed}
    listed += [m for m in (old.effects if old else ()) if m.name not in found]
    moved = [
        Moved(
            float(m.values["time"]),
            np.array([m.values[k] for k in kind.linear]),
            np.diag([m.sds.get(k, 0.0) ** 2 for k in kind.linear]),
        )
        for m in listed
        if (kind := catalogue.get(m.name)).seen_in == "targets"
    ]
    for t in own:
        linear = [p for p in t.kind.linear if t.kind.column(p) in t.parameters]
        start = dict.fromkeys((*t.kind.fresh, *linear), 0.0)
        listed.append(ModelEffect(t.effect, {**start, **(t.values(0) or {})}))
    model = build_camera(
        fitter, fit, x.unblocked[:1], listed, x.noise_growth, moved, x.distortion_sigmas
    ).model
    names = model.covariance_names
    stated = {  # some are wider than the fit's, as those of `_widen_estimates`
        f"{m.name}.{k}": sd
        for e in discovery.effects
        for m in effects_of(e)
        for k, sd in m.sds.items()
    }
    wider = np.array([max(1.0, stated.get(n, 0.0) / (model.sd(n) or np.inf)) for n in names])
    model = with_covariance(
        model,
        names,
        np.array([model.value(n) for n in names]),
        model.covariance_of(names) * np.outer(wider, wider),
    )
    document = discovery.as_dict()
    evidence: dict[str, Any] = {"verdict": discovery.verdict, "gap": document["gap"]}
    for entry in document["effects"]:
        kept = ("statement", "evidence", "alternatives")
        evidence[entry["effect"]] = {key: entry[key] for key in kept}
        if "bridge" in entry["evidence"]:
            evidence["unnamed"]["note"] = "bridged by a smooth term for M1 only; not transferable"
    return replace(
        model,
        evidence={**model.evidence, **evidence},
        name=old.name if old else model.name,
        version=old.version + 1 if old else 1,
    )
