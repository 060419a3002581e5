"""The report of a discovery: the effects found, the evidence, and why others were rejected."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery.gap import image_chi2
from thermocald.discovery.result import Discovery, field_lines, mount_lines, say_adequate
from thermocald.discovery.search import MOUNT, Solution
from thermocald.discovery.unnamed import describe_misfit
from thermocald.figures import (
    BAND,
    GREY,
    PALE,
    PALETTE,
    Arrows,
    Curve,
    Figure,
    Panel,
    image_panel,
    label_axes,
    legend_above,
    new_drawing,
)
from thermocald.numbers import enumerated, parameter_label, percent, plain, shortened, with_sd
from thermocald.photogrammetry.linalg import best_level
from thermocald.physics import catalogue
from thermocald.report import Answer, Chapter, Section, Table, as_sentence, day
from thermocald.store.recording.sense import doubt_lines

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.arrays import Array
    from thermocald.discovery.entries import EffectFound
    from thermocald.discovery.gap import Stage
    from thermocald.discovery.validation import SurrogateTest
    from thermocald.thermal.hypothesis import Fit
    from thermocald.thermal.series import ReducedSeries

_BASE, _FOUND = PALETTE[1], PALETTE[0]
_AT_NOISE = 1.1  # times the noise: a misfit up to this counts as noise
_ADVICE = {
    "effects_found": "Correct measurements with the model, which --model-out writes.",
    "adequate": "See which effects this set-up would reveal: thermocald discover --plan.",
    "unexplained": "Also record possible causes (light, current, a second temperature).",
}


def report_html(discovery: Discovery, title: str) -> str:
    """Return the report as HTML text."""
    sources = [e.source for e in discovery.examination.fitter.series]
    return Chapter(
        f"Discovery: {title}",
        _answer(discovery),
        tuple(_sections(discovery)),
        tuple(
            f"{one.camera}, {one.sensor}; {name} measured {day(float(one.frame_times[0]))}, "
            f"{int(one.per_row.sum())} epochs."
            for name, one in zip(_names(discovery), sources, strict=True)
        ),
        tuple(
            as_sentence(line)
            for line in (
                *doubt_lines(discovery.doubts),
                *mount_lines(discovery.examination),
                *field_lines(discovery.examination),
            )
        ),
    ).page()


def _answer(d: Discovery) -> Answer:
    before, after = d.stages[0], d.stages[-1]
    first = d.examination.fitter.series[0]
    T, noise = first.averaged(first.history.temperature()), first.sigma_px
    temperatures = f" between {np.nanmin(T):.0f} and {np.nanmax(T):.0f} °C"
    by_gap = sorted(d.effects_with_gaps(), key=lambda e: e[2].rms_px - e[1].rms_px)
    if closing := [e for e, _, _ in by_gap]:
        sentence = as_sentence(_statement(closing[0]))
    elif mount_lines(d.examination):
        sentence = as_sentence(say_adequate(d.examination))
    else:
        sentence = (
            f"The model reproduces the recording within its noise of {noise:.3f} px"
            f"{temperatures}: it lacks no effect that this recording could show."
        )
    more = []
    if d.effects:
        gaps = zip(_names(d), before.gaps, after.gaps, strict=True)
        changes = [
            f"{a.rms_px:.3f} to {b.rms_px:.3f} px RMS on {name}"
            for name, a, b in gaps
            if b.rms_px < a.rms_px  # a bridge closes no gap but that of M1, a defocus none
        ]
        more += [f"Also found: {_statement(e)}." for e in closing[1:]]
        it = "it" if len(closing) == 1 else "all of them"
        falls = f"With {it} the gap between model and measurement falls from "
        more.append(f"{falls}{' and from '.join(changes)}{temperatures}; the" if changes else "The")
        more[-1] += f" noise of an image coordinate is {noise:.3f} px."
    steps = [
        f"To distinguish {e.effect} from {a['effect']}: {a['experiment']}."
        for e in d.effects
        for a in e.alternatives
        if not a.get("resembles") and a.get("experiment")
    ]
    uncovered = [
        f"Temperatures other than those{temperatures}, and changes faster than those measured."
    ]
    if before.verify is None:
        steps.append("Record a second series (M2) and give it with --verify, as the proof.")
        uncovered.append("Whether the constants hold on another day: no M2 was given.")
    steps.append(_ADVICE[d.verdict])
    uncovered.append("Effects that move the image by less than its noise: they are not detected.")
    return Answer(sentence, _trajectory(d), tuple(more), tuple(steps), tuple(uncovered))


def _statement(effect: EffectFound) -> str:
    """Return an effect's statement without the full stop; an amplitude a_x0 is written as x₀."""
    text = re.sub(r"\ba_(\w+)", lambda m: parameter_label(m[1]), effect.statement)
    return text.rstrip(".")


def _names(d: Discovery) -> list[str]:
    """Return M1, M2, … with the series' names, or the recordings' where these would mislead."""
    sources = [e.source for e in d.examination.fitter.series]
    roles, own = [f"M{k + 1}" for k in range(len(sources))], [s.series for s in sources]
    if any(name in roles and roles.index(name) != k for k, name in enumerate(own)):
        own = [Path(s.name).name for s in sources]
    named = zip(roles, own, strict=True)
    return [role if name in ("", role) else f"{role} ({name})" for role, name in named]


def _sections(d: Discovery) -> list[Section]:
    tested = d.verdict == "effects_found" and bool(d.examination.surrogates)
    left = "Before and after" if d.effects else "Misfit of the model"
    return [
        Section(left, figures=(_movement(d), gap_figure(d)), tables=(_gap_table(d),)),
        *(_effect(e) for e in d.effects),
        *([_noise_test(d)] if tested else []),
        _candidates(d),
        Section("Misfit of the base model, in numbers", tables=(_misfit_table(d),), folded=True),
    ]


# measured and modelled movement


def _without_level(e: ReducedSeries, values: Array) -> Array:
    """Subtract from parameters (E, P) their mean, weighted as the image points determine them."""
    return values - best_level(e.N, np.einsum("epq,eq->ep", e.N, values))


def _of_readings(d: Discovery) -> Array:
    """Return what the noise of the readings does to the parameters (P,): one sd of it."""
    e = d.examination.fitter.series[0]
    T = e.averaged(e.history.temperature())
    T = np.nan_to_num(T - np.nanmean(T))
    rates = T @ d.base_fit.parameters(0) / max(float(T @ T), 1e-12)
    return np.asarray(rates * e.thermometers[e.history.reference].noise)


def _root(e: ReducedSeries) -> Array:
    """Return R (P, P) with R Rᵀ the mean normal matrix: |p R| is the movement of parameters p."""
    size, U = np.linalg.eigh(e.N.mean(axis=0))
    return np.asarray(U * np.sqrt(np.maximum(size, 0.0)))


def _trajectory(d: Discovery) -> Figure:
    """Draw measured and modelled image movement over time and temperature, residuals below."""
    e = d.examination.fitter.series[0]
    base, final = (fit.parameters(0) for fit in (d.base_fit, d.final_fit))
    rests = [_without_level(e, e.values - m) for m in (base, final)]
    # a defocus and displaced targets move no parameter
    still = {n for n in catalogue.names() if catalogue.get(n).seen_in != "trajectory"}
    moving = [effect.effect for effect in d.effects if effect.effect not in still]
    found = bool(moving) and bool(np.abs(final - base).max() > 0)
    root = _root(e)
    model = _without_level(e, final - base) if found else rests[0]
    _, _, v = np.linalg.svd(model @ root, full_matrices=False)
    # root-mean-square over the image coordinates
    noise = e.sigma_px / np.sqrt(max(float(2 * e.n.mean()), 1.0))
    along = root @ v[0] * noise
    measured, (before, after) = _without_level(e, e.values) @ along, (r @ along for r in rests)
    sd = float(np.hypot(noise, _of_readings(d) @ along))
    label = f"with {moving[0]}" if len(d.effects) == 1 and found else "with all effects"
    above, below = [], []
    for x, of in (
        (e.times / 60.0, "time in min"),
        (e.averaged(e.history.temperature()), "temperature in °C"),
    ):
        curves = [
            Curve("measured", x, measured, "points", PALE),
            Curve("base model", x, measured - before, "line", _BASE, dashed=True),
        ]
        ends, band = np.array([np.nanmin(x), np.nanmax(x)]), np.full(2, BAND * sd)
        left = [
            Curve("", ends, np.zeros(2), "line", GREY, band),
            Curve("", x, before, "points", _BASE),
        ]
        if found:
            curves.append(Curve(label, x, measured - after, "line", _FOUND))
            left.append(Curve("", x, after, "points", _FOUND))
        above.append(Panel("Movement", of, "image movement in px", tuple(curves)))
        below.append(Panel("Residual", of, "residual in px", tuple(left)))
    return Figure(
        "trajectory",
        "Measured and modelled",
        "Movement of the image in the pattern of "
        + (" + ".join(moving) if found else "the largest misfit")
        + ", root mean square over the targets of M1, as measured and as modelled. Below: the "
        "residuals of each model; grey: 95 % of the noise of an epoch and of the readings.",
        (*above, *below),
        columns=2,
    )


def _movement(d: Discovery) -> Figure:
    """Draw the targets' movement that each model does not explain, as vectors of one scale."""
    e = d.examination.fitter.series[0]
    seen = e.weights[..., 0].any(axis=0)
    places = e.at.predicted[seen]
    root = _root(e)
    drawn = []
    for fit in dict.fromkeys((d.base_fit, d.final_fit)):
        r = _without_level(e, e.values - fit.parameters(0))
        _, s, v = np.linalg.svd(r @ root, full_matrices=False)
        pattern = np.linalg.pinv(root, rcond=1e-3).T @ v[0] * s[0] / np.sqrt(len(r))
        misfit = np.sqrt(np.mean(np.einsum("tij,ej->eti", e.columns[seen], r) ** 2))
        drawn.append((float(misfit), np.einsum("tij,j->ti", e.columns[seen], pattern)))
    reading_sd = e.thermometers[e.history.reference].noise
    of_readings = float(np.sqrt(np.mean((e.columns[seen] @ _of_readings(d)) ** 2)))
    # a movement below the noise must not look large
    longest = max(float(np.linalg.norm(drawn[0][1], axis=1).max()), e.sigma_px)
    frame = (e.source.sensor.width, e.source.sensor.height)
    targets = Curve("", places[:, 0], places[:, 1], "points", PALE)
    titles = ("Before", "After") if len(drawn) > 1 else ("Misfit",)
    panels = tuple(
        image_panel(
            f"{title}: {misfit:.3f} px", targets,
            arrows=Arrows(places, vectors, frame, colour, longest),
        )
        for title, (misfit, vectors), colour in zip(titles, drawn, (_BASE, _FOUND), strict=False)
    )  # fmt: skip
    return Figure(
        "movement",
        "Image movement that the model does not explain",
        "The strongest pattern of measured minus modelled movement, at each target of M1"
        + (
            ", before and after the effects found, with the root mean square; one scale for both."
            if len(drawn) > 1
            else "; no effect was found that another recording would show."
        )
        + f" Up to {of_readings:.3f} px of it is the noise of the readings, {reading_sd:.3f} K.",
        panels,
        columns=2,
    )


def _bars(groups: list[tuple[float, list[tuple[str, float, str]]]], label: str) -> Any:
    """Draw bars (name, px, colour) in groups, each group with its noise, px."""
    bars = [bar for _, group in groups for bar in group]
    with new_drawing(4.0, 0.9 + 0.4 * len(bars) + 0.1 * len(groups)) as drawing:
        axis = drawing.subplots()
        place = 0.0
        for k, (noise, group) in enumerate(groups):
            for j, (name, length, colour) in enumerate(group):
                axis.annotate(shortened(name, 60), (0.0, place), (2, 3), fontsize=8,
                              textcoords="offset points")  # fmt: skip
                axis.barh(place - 0.2, length, 0.4, color=colour)
                axis.annotate(f"{length:.3f}", (length, place - 0.2), (4, 0), fontsize=8,
                              textcoords="offset points", va="center")  # fmt: skip
                axis.plot([noise, noise], [place - 0.45, place + 0.05], ":", color="black", lw=1.5,
                          label="" if j or k else "noise")  # fmt: skip
                place -= 1.0
            place -= 0.2
        axis.set_ylim(place + 0.5, 0.6)
        axis.set_yticks([])
        axis.set_xlim(0.0, 1.12 * max(length for _, length, _ in bars))
        axis.grid(visible=False, axis="y")
        label_axes(axis, label)
        legend_above(axis)
    return drawing


def gap_figure(d: Discovery) -> Figure:
    """Draw the gap of every stage on every recording as bars, with the noise."""
    groups = [
        (
            d.examination.fitter.series[k].sigma_px,
            [
                (_gap_name(name, s), s.gaps[k].rms_px, _FOUND if s.added else _BASE)
                for s in d.stages
            ],
        )
        for k, name in enumerate(_names(d))
    ]
    return Figure(
        "gaps",
        "The gap",
        "Measured minus simulated image points, without and with the effects found, and the noise "
        "of an image coordinate (dotted). All constants are those of M1.",
        drawing=_bars(groups, "gap between model and measurement in px RMS"),
    )


def _gap_name(recording: str, stage: Stage) -> str:
    return f"{recording}, {f'+ {stage.added}' if stage.added else 'base model'}"


def _gap_table(d: Discovery) -> Table:
    gaps = [
        (_gap_name(name, stage), gap)
        for stage in d.stages
        for name, gap in zip(_names(d), stage.gaps, strict=True)
    ]
    note = "With noise alone, reduced χ² is 1."
    if d.stages[0].verify is None:
        note += " No M2 was given: the constants are not verified."
    return Table.of(
        "The gap in numbers",
        gaps,
        {
            "": lambda r: r[0],
            "px RMS": lambda r: f"{r[1].rms_px:.4f}",
            "reduced χ²": lambda r: f"{r[1].chi2_reduced:.3f}",
            "mm at 10 m": lambda r: f"{r[1].object_mm_at_10m:.2f}",
        },
        note,
    )


# effects


def _effect(effect: EffectFound) -> Section:
    labels = [
        f"amplitude of {parameter_label(n[2:])}" if n.startswith("a_") else n.replace("_", " ")
        for n in effect.estimates
    ]
    rows = list(zip(labels, map(estimate_text, effect.estimates.values()), strict=True))
    text = []
    if proposal := effect.evidence.get("proposal"):
        test = proposal["surrogates"]
        text.append(
            f"Formula {proposal['formula']}: with constants of M1 alone it explains "
            f"{percent(proposal['closed_on_verify_by_fit'])} of the misfit of M2. Formulas on a "
            f"grid of constants explain {percent(test['explained'])} of the misfit, but of "
            f"{test['count']} surrogates whose cause was not recorded at most "
            f"{percent(test['largest_of_surrogates'])}: probability of a false formula "
            f"{_p(proposal['false_alarm_probability'], test['count'])}."
        )
    excluded = [a for a in effect.alternatives if not a.get("resembles")]
    if excluded:
        text.append("These data cannot exclude the following alternatives.")
    items = [
        (
            a["effect"],
            f"its score is {_differs(a['score_difference'])}. To separate them: {a['experiment']}.",
        )
        for a in excluded
    ]
    if alike := dict.fromkeys(a["effect"] for a in effect.alternatives if a.get("resembles")):
        text.append(
            f"Effects that merely resemble it: {', '.join(alike)}. They do not pass the absolute "
            "test."
            + (" The smooth term fitted to M1 does not apply to another series."
               if "bridge" in effect.evidence else "")
        )  # fmt: skip
    table = Table("Estimates", ("parameter", "value ± sd"), tuple(rows))
    return Section(f"Effect found: {effect.effect}", tuple(text), (), (table,), tuple(items))


def estimate_text(estimate: Mapping[str, Any]) -> str:
    """Write an estimated constant with its standard deviation and unit, or the names that it is."""
    value, sd = estimate["value"], estimate["sd"]
    unit = "" if estimate["unit"] == "1" else estimate["unit"]
    if isinstance(value, float):
        return with_sd(value, sd if isinstance(sd, float) else math.nan, unit)
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _p(p: float, count: int) -> str:
    """Return a probability as text; `count` surrogates cannot resolve less than 1/(count + 1)."""
    return f"≤ 1/{count + 1}" if p <= 1.000001 / (count + 1) else f"{p:.2g}"


def _noise_test(d: Discovery) -> Section:
    x = d.examination
    names = x.best.names[len(x.base.terms) :]
    tests = list(zip(names, x.surrogates, strict=False))
    with new_drawing(4.0, 0.4 + 1.7 * len(tests)) as drawing:
        axes = np.atleast_1d(drawing.subplots(len(tests), 1))
        for axis, (name, test) in zip(axes, tests, strict=True):
            _draw_surrogates(axis, name, test)
    text = "; ".join(f"{name}: p {_p(t.p, len(t.surrogates))}" for name, t in tests)
    figure = Figure(
        "surrogates",
        "Surrogates",
        f"{text}. Grey: the gain of the same search on surrogates, in which the recording's own "
        "noise is shifted in time against the temperatures. An effect is named only if its gain "
        "exceeds that of every surrogate.",
        drawing=drawing,
    )
    return Section("Could noise do this?", (), (figure,))


def _draw_surrogates(axis: Any, name: str, test: SurrogateTest) -> None:
    gains = np.sort(test.surrogates)
    span = max(float(np.ptp(gains)), 1.0)
    beyond = test.gain > gains[-1] + 5 * span
    end = gains[-1] + 1.5 * span if beyond else max(float(test.gain), gains[-1]) + 0.3 * span
    axis.hist(gains, bins=24, color=PALE)
    axis.set_xlim(gains[0] - 0.1 * span, end)
    text = f"found: {test.gain:,.0f}" + (" →" if beyond else "")
    place = (end, 0.5) if beyond else (float(test.gain), 0.5)
    axis.annotate(
        text, place, (-4, 0), xycoords=("data", "axes fraction"), textcoords="offset points",
        ha="right", color=_FOUND, weight="bold",
    )  # fmt: skip
    if not beyond:
        axis.axvline(test.gain, color=_FOUND, lw=2)
    axis.set_title(name, loc="left")
    label_axes(axis, "gain in −2 log L, less the penalty (no unit)", "surrogates (count)")


def _candidates(d: Discovery) -> Section:
    """Compare the misfit of every candidate alone, and state why it was named or rejected."""
    x = d.examination
    singles: dict[str, Solution] = {}
    for s in sorted(x.ranking, key=lambda s: s.score):
        term = s.terms[-1]
        at_mount = term.parameters == MOUNT != term.kind.usual
        singles.setdefault(f"{term.effect} (mount)" if at_mount else term.effect, s)
    noise = x.fitter.series[0].sigma_px
    best = x.best.names[len(x.base.terms) :] if x.adequate else ()
    rows = [(name, s, _left_px(d, s.fit)) for name, s in singles.items()]
    rows.sort(key=lambda row: (row[0].split(" ")[0] not in best, row[2]))
    bars = [(name, left, _FOUND if name.split(" ")[0] in best else PALE) for name, _, left in rows]
    if len(best) > 1:
        bars.insert(0, (" + ".join(best), _left_px(d, x.best.fit), _FOUND))
    if not bars:
        return Section(
            "Candidates", ("No effect of the catalogue explains more than noise would.",)
        )
    figure = Figure(
        "candidates",
        "Candidates, each alone",
        f"Misfit on M1 of the base model with one more effect. {'Blue: named. ' if best else ''}"
        "Dotted: the noise, the least misfit of any model.",
        drawing=_bars([(noise, bars)], "misfit on M1 in px RMS"),
    )
    items = tuple((name, _why(d, name, s, left, noise)) for name, s, left in rows)
    return Section("Candidates, and why they were named or rejected", (), (figure,), (), items)


def _left_px(d: Discovery, fit: Fit) -> float:
    """Return the RMS misfit of a fit to M1's image points, px, computed as the gap is."""
    e = d.examination.fitter.series[0]
    within = float(np.sum(e.weights[..., :2] * np.nan_to_num(e.residuals) ** 2))
    chi2 = within + e.correlation * image_chi2(e, fit, 0)
    return e.sigma_px * math.sqrt(chi2 / max(2.0 * float(e.n.sum()), 1.0))


def _differs(score_difference: float) -> str:
    """Say by how much a score is worse or better."""
    return f"{abs(score_difference):,.1f} {'worse' if score_difference >= 0 else 'better'}"


def _why(d: Discovery, name: str, s: Solution, left: float, noise: float) -> str:
    x = d.examination
    best = x.best.names[len(x.base.terms) :]
    if x.adequate and name.split(" ")[0] in best:
        if len(best) > 1:
            return f"named, together with {enumerated([n for n in best if n != name])}."
        return f"named: its misfit of {left:.3f} px is the noise."
    if rivals := [r.score for r in x.rivals if name.split(" ")[0] in r.names]:
        by = _differs(min(rivals) - x.best.score)
        return f"cannot be excluded: the best solution with it scores {by}."
    if left > _AT_NOISE * noise:
        text = f"misfit {left:.3f} px, {left / noise:.1f} times the noise"
        if "omega" in s.terms[-1].parameters:
            text += "; a moving mount shifts near targets more than far ones, which is not observed"
        return f"{text}."
    score = f"(−2 log L plus penalty) is {s.score - x.best.score:,.0f} worse"
    return f"misfit at the noise on M1, but over all recordings its score {score}: excluded."


# misfit of the base model


def _misfit_table(d: Discovery) -> Table:
    return Table.of(
        "The misfit on M1, against everything that was recorded",
        describe_misfit(d.examination)["against"],
        {
            "against": lambda r: ", ".join(map(parameter_label, r["what"].split(", "))),
            "size in px RMS": lambda r: f"{r['rms_px']:z.4f}",
            "significance in σ": lambda r: plain(r["significance_sigmas"], digits=3),
        },
    )
