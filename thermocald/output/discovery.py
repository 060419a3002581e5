"""The report of a discovery: what was found, the plot that proves it, and why the others lost."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery.gap import Gap, image_chi2
from thermocald.discovery.result import Discovery, field_lines, mount_lines
from thermocald.discovery.search import MOUNT, Solution
from thermocald.discovery.unnamed import resolve
from thermocald.figures import (
    BAND,
    GREY,
    PALE,
    PALETTE,
    Arrows,
    draw_arrows,
    drawing_style,
    label_axes,
    legend_above,
    new_drawing,
    tick_text,
)
from thermocald.numbers import parameter_label, plain, shortened, with_sd
from thermocald.report import (
    Answer,
    Chapter,
    Drawing,
    Section,
    Table,
    day,
    of_drawing,
    render_report,
)
from thermocald.store.recording.sense import doubt_lines

if TYPE_CHECKING:
    from datetime import datetime

    from thermocald.arrays import Array
    from thermocald.discovery.entries import EffectFound
    from thermocald.discovery.validation import SurrogateTest
    from thermocald.thermal.hypothesis import Fit
    from thermocald.thermal.series import ReducedSeries

_BASE, _FOUND = PALETTE[1], PALETTE[0]
_AT_NOISE = 1.1  # times the noise: what an effect leaves counts as noise


def report_html(discovery: Discovery, title: str, made: datetime | None = None) -> str:
    """Return the whole page; made: the time that it bears, by default now."""
    chapter = Chapter(
        f"Discovery: {title}",
        _answer(discovery),
        tuple(_sections(discovery)),
        tuple(_origin(discovery)),
        tuple(
            f"{line[0].upper()}{line[1:].strip()}."
            for line in (
                *doubt_lines(discovery.doubts),
                *mount_lines(discovery.examination),
                *field_lines(discovery.examination),
            )
        ),
    )
    return render_report(chapter.title, [chapter], made=made)


def _answer(d: Discovery) -> Answer:
    before, after = d.stages[0], d.stages[-1]
    temperatures = _temperatures(d)
    closing = sorted(d.effects, key=lambda e: e.gap_after.rms_px - e.gap_before.rms_px)
    if closing:
        sentence = f"{_sentence(closing[0].statement)}."
    else:
        sentence = (
            f"The model reproduces the recording within its noise of {_noise_px(d, 0):.3f} px"
            f"{temperatures}: nothing is missing that this recording could show."
        )
    more = []
    if d.effects:
        gaps = zip(_names(d), (before.fit, *before.others), (after.fit, *after.others), strict=True)
        said = [f"{a.rms_px:.3f} to {b.rms_px:.3f} px RMS on {name}" for name, a, b in gaps]
        more += [f"Also found: {e.statement.rstrip('.')}." for e in closing[1:]]
        it = "it" if len(closing) == 1 else "all of it"
        more.append(
            f"With {it} the gap between model and measurement goes from {' and from '.join(said)}"
            f"{temperatures}; the noise of an image coordinate is {_noise_px(d, 0):.3f} px."
        )
    if d.verdict == "unexplained":
        more.append("No effect of the catalogue explains it.")
    return Answer(sentence, _trajectory(d), tuple(more), _next_steps(d), _not_covered(d))


def _sentence(statement: str) -> str:
    return (statement[:1].upper() + statement[1:]).rstrip(".")


def _temperatures(d: Discovery) -> str:
    e = d.examination.fitter.series[0]
    T = e.averaged(e.history.temperature())
    return f" between {np.nanmin(T):.0f} and {np.nanmax(T):.0f} °C"


def _next_steps(d: Discovery) -> tuple[str, ...]:
    steps = [
        f"To tell {e.effect} from {a['effect']}: {a['experiment']}."
        for e in d.effects
        for a in e.alternatives
        if not a.get("resembles") and a.get("experiment")
    ]
    if d.stages[0].verify is None:
        steps.append("Record a second series (M2) and give it with --verify: that is the proof.")
    if d.verdict == "effects_found":
        steps.append("Write the model with --model-out and correct measurements with it.")
    if d.verdict == "adequate":
        steps.append("See with `thermocald discover --plan` which effects this set-up would show.")
    if d.verdict == "unexplained":
        steps.append("Record what may be the cause (light, current, a second temperature) too.")
    return tuple(steps)


def _not_covered(d: Discovery) -> tuple[str, ...]:
    said = [f"Temperatures other than{_temperatures(d)}, and faster changes than were measured."]
    if d.stages[0].verify is None:
        said.append("Whether the constants hold on another day: no M2 was given.")
    said.append("Effects that move the image by less than its noise; they would go unseen.")
    return tuple(said)


def _names(d: Discovery) -> list[str]:
    """M1, M2, … with the recordings' names."""
    return [
        f"M{k}" if (e.source.series or f"M{k}") == f"M{k}" else f"M{k} ({e.source.series})"
        for k, e in enumerate(d.examination.fitter.series, start=1)
    ]


def _origin(d: Discovery) -> list[str]:
    lines = []
    for name, e in zip(_names(d), d.examination.fitter.series, strict=True):
        source, sensor = e.source, e.source.sensor
        lines.append(
            f"{source.camera}, {sensor.width} × {sensor.height} px of "
            f"{sensor.pixel_pitch * 1000:g} µm; {name} measured "
            f"{day(float(source.frame_times[0]))}, {int(source.per_row.sum())} epochs."
        )
    return lines


def _sections(d: Discovery) -> list[Section]:
    tested = d.verdict == "effects_found" and bool(d.examination.surrogates)
    return [
        Section("Before and after", figures=(_movement(d), _gaps(d)), tables=(_gap_table(d),)),
        *(_effect(e) for e in d.effects),
        *([_noise_test(d)] if tested else []),
        _candidates(d),
        Section(
            "Where the base model fails, in numbers",
            ("What the base model leaves of M1, against everything that was recorded.",),
            (_misfit_matrix(d),),
            (_misfit_table(d),),
            folded=True,
        ),
    ]


# what was measured, and what the models leave of it


def _without_level(e: ReducedSeries, values: Array) -> Array:
    """Parameters (E, P) less their level in the metric of the image points."""
    right = np.einsum("epq,eq->p", e.N, values)
    return np.asarray(values - np.linalg.lstsq(e.N.sum(axis=0), right, rcond=1e-12)[0])


def _model(fit: Fit, series: int) -> Array:
    C, V, index = fit.designs[series]
    return np.asarray((C * fit.coefficients[index]) @ V.T)


def _noise_px(d: Discovery, series: int) -> float:
    """Standard deviation of an image coordinate, px: what no model can go below."""
    weights = d.examination.fitter.series[series].weights[..., :2]
    return float(1.0 / np.sqrt(np.mean(weights[weights > 0])))


def _trajectory(d: Discovery) -> Drawing:
    """Measured image movement against both models over time and temperature, residuals below."""
    e = d.examination.fitter.series[0]
    base, final = (_model(fit, 0) for fit in (d.base_fit, d.final_fit))
    rests = [_without_level(e, e.values - m) for m in (base, final)]
    found = bool(np.abs(final - base).max() > 0)
    size, U = np.linalg.eigh(e.N.mean(axis=0))
    root = U * np.sqrt(np.maximum(size, 0.0))
    model = _without_level(e, final - base) if found else rests[0]
    _, _, v = np.linalg.svd(model @ root, full_matrices=False)
    # root-mean-square over the image coordinates
    along = root @ v[0] * _noise_px(d, 0) / np.sqrt(max(float(2 * e.n.mean()), 1.0))
    measured = _without_level(e, e.values) @ along
    noise = _noise_px(d, 0) / np.sqrt(max(float(2 * e.n.mean()), 1.0))
    minutes, T = e.times / 60.0, e.averaged(e.history.temperature())
    name = " + ".join(effect.effect for effect in d.effects) if found else ""
    with drawing_style():
        drawing = new_drawing(9.0, 4.6)
        axes = drawing.subplots(
            2, 2, sharex="col", sharey="row", gridspec_kw={"height_ratios": (2, 1)}
        )
        for column, x in enumerate((minutes, T)):
            top, below = axes[:, column]
            top.plot(x, measured, ".", color=PALE, ms=4, label="measured")
            top.plot(x, measured - rests[0] @ along, "--", color=_BASE, lw=1.2, label="base model")
            below.plot(x, rests[0] @ along, ".", color=_BASE, ms=2.5)
            if found:
                shown = measured - rests[1] @ along
                label = f"with {name}" if len(d.effects) == 1 else "with all effects"
                top.plot(x, shown, "-", color=_FOUND, lw=1.2, label=label)
                below.plot(x, rests[1] @ along, ".", color=_FOUND, ms=2.5)
            below.axhspan(-BAND * noise, BAND * noise, color=GREY, alpha=0.25, lw=0)
            below.axhline(0.0, color=GREY, lw=0.6)
        label_axes(axes[0, 0], y="image movement in px")
        label_axes(axes[1, 0], "time in min", "left over in px")
        label_axes(axes[1, 1], "temperature in °C")
        legend_above(axes[0, 0])
    text = (
        "Movement of the image in the pattern in which "
        + (f"{name} shows" if found else "the model leaves most")
        + ", root-mean-square over the targets of M1: measured, and as the models have it. Below: "
        "what each leaves; grey: 95 % of the noise of an epoch."
    )
    return of_drawing(drawing, "trajectory", "Measured and modelled", text)


def _movement(d: Discovery) -> Drawing:
    """What each model leaves of the targets' movement, as vectors of one scale."""
    e = d.examination.fitter.series[0]
    seen = e.weights[..., 0].any(axis=0)
    places = e.at.predicted[seen]
    N = e.N.mean(axis=0)
    size, U = np.linalg.eigh(N)
    keep = size > 1e-6 * size.max()
    drawn = []
    fits = (d.base_fit,) if d.final_fit is d.base_fit else (d.base_fit, d.final_fit)
    for fit in fits:
        r = _without_level(e, e.values - _model(fit, 0))
        _, s, v = np.linalg.svd((r @ U) * np.sqrt(np.maximum(size, 0.0)), full_matrices=False)
        pattern = U[:, keep] @ (v[0][keep] / np.sqrt(size[keep])) * s[0] / np.sqrt(len(r))
        misfit = np.sqrt(np.mean(np.einsum("tij,ej->eti", e.columns[seen], r) ** 2))
        drawn.append((float(misfit), np.einsum("tij,j->ti", e.columns[seen], pattern)))
    # what is less than the noise shall not look large
    longest = max(float(np.linalg.norm(drawn[0][1], axis=1).max()), _noise_px(d, 0))
    frame = (e.source.sensor.width, e.source.sensor.height)
    with drawing_style():
        drawing = new_drawing(9.0, 3.8)
        axes = drawing.subplots(1, 2, sharey=True)
        for axis in axes[len(drawn) :]:
            axis.set_axis_off()
        for axis, (misfit, vectors), title, colour in zip(
            axes, drawn, ("Before", "After"), (_BASE, _FOUND), strict=False
        ):
            axis.plot(*places.T, ".", color=GREY, ms=2)
            draw_arrows(axis, Arrows(places, vectors, frame, colour, longest))
            axis.set_title(f"{title}: {misfit:.3f} px RMS", loc="left")
            label_axes(axis, "x in px")
        label_axes(axes[0], y="y in px, down")
    return of_drawing(
        drawing, "movement", "Image movement that the model leaves",
        "Each target of M1 with the strongest pattern of what is measured less what the model "
        + ("says, before and after what was found; both drawn to the same scale."
           if len(drawn) > 1
           else "says; nothing was found that another recording would show too."),
    )  # fmt: skip


def _gaps(d: Discovery) -> Drawing:
    """The gap of every stage on every recording as bars against the noise."""
    labels = ["base model", *(f"+ {stage.added}" for stage in d.stages[1:])]
    names = _names(d)
    with drawing_style():
        drawing = new_drawing(9.0, 0.9 + 0.32 * len(labels) * len(names))
        axis = drawing.subplots()
        ticks, place = [], 0.0
        top = max(gap.rms_px for stage in d.stages for gap in (stage.fit, *stage.others))
        for k, name in enumerate(names):
            noise = _noise_px(d, k)
            first = place
            for stage, label in zip(d.stages, labels, strict=True):
                gap = (stage.fit, *stage.others)[k]
                axis.barh(place, gap.rms_px, 0.7, color=_BASE if not stage.added else _FOUND)
                axis.annotate(f"{gap.rms_px:.3f}", (gap.rms_px, place), (4, 0), fontsize=8,
                              textcoords="offset points", va="center")  # fmt: skip
                ticks.append((place, f"{name}, {label}"))
                place -= 1.0
            axis.plot([noise, noise], [first + 0.5, place + 0.5], "--", color=GREY, lw=1.2,
                      label="" if k else "noise")  # fmt: skip
            place -= 0.4
        axis.set_yticks([at for at, _ in ticks], [shortened(label, 40) for _, label in ticks])
        axis.set_xlim(0.0, 1.12 * top)
        axis.grid(visible=False, axis="y")
        label_axes(axis, "gap between model and measurement in px RMS")
        legend_above(axis)
    return of_drawing(
        drawing, "gaps", "The gap",
        "Image points measured less simulated, with and without what was found, against the noise "
        "of an image coordinate (dashed). The constants are those of M1 throughout.",
    )  # fmt: skip


def _gap_table(d: Discovery) -> Table:
    rows = []
    for stage in d.stages:
        label = f"with {stage.added}" if stage.added else "base model"
        gaps = (stage.fit, *stage.others)
        rows += [_gap_row(f"{n}, {label}", gap) for n, gap in zip(_names(d), gaps, strict=True)]
    outside, inside = d.cross_validation
    note = "1 is the floor of reduced χ²."
    if math.isfinite(outside):
        note += (
            " On blocks of M1 left out of the fit, χ² of the parameters per degree of freedom is "
            f"{outside:.3f}; fitted with them {inside:.3f}."
        )
    if d.stages[0].verify is None:
        note += " No M2 was given: the constants are not verified."
    return Table(
        "The gap in numbers", ("", "px RMS", "reduced χ²", "mm at 10 m"), tuple(rows), note
    )


def _gap_row(name: str, gap: Gap) -> tuple[str, ...]:
    return (name, f"{gap.rms_px:.4f}", f"{gap.chi2_reduced:.3f}", f"{gap.object_mm_at_10m:.2f}")


# what was found


def _effect(effect: EffectFound) -> Section:
    rows = [(_parameter(name), _value(e)) for name, e in effect.estimates.items()]
    text = []
    if proposal := effect.evidence.get("proposal"):
        test = proposal["surrogates"]
        text.append(
            f"Formula {proposal['formula']}: constants of M1 alone explain "
            f"{proposal['closed_on_verify_by_fit']:.0%} of the misfit of M2. Formulas on a grid of "
            f"constants explain {test['explained']:.0%} of the misfit, of {test['count']} "
            "surrogates whose cause was not recorded at most "
            f"{test['largest_of_surrogates']:.0%}: probability of a false formula "
            f"{_p(proposal['false_alarm_probability'], test['count'])}."
        )
    excluded = [a for a in effect.alternatives if not a.get("resembles")]
    if excluded:
        text.append("These data cannot exclude the following instead.")
    items = [
        (a["effect"], (f"scores {a['score_difference']:.1f} worse. To separate them: "
         f"{a['experiment']}."))
        for a in excluded
    ]  # fmt: skip
    if alike := [a["effect"] for a in effect.alternatives if a.get("resembles")]:
        text.append(
            f"Effects that merely resemble it: {', '.join(alike)}. Not one passes the absolute "
            "test."
            + ("" if effect.term else " The smooth bridge in M1 does not transfer to another "
               "series.")
        )  # fmt: skip
    table = Table("What was estimated", ("parameter", "value ± sd"), tuple(rows))
    return Section(f"What was found: {effect.effect}", tuple(text), (), (table,), tuple(items))


def _parameter(name: str) -> str:
    """How a parameter of an effect is called: a_c is the amplitude of c."""
    return f"amplitude of {parameter_label(name[2:])}" if name.startswith("a_") else (
        name.replace("_", " ")
    )  # fmt: skip


def _value(estimate: dict[str, Any]) -> str:
    value, sd = estimate["value"], estimate["sd"]
    unit = "" if estimate["unit"] == "1" else estimate["unit"]
    if isinstance(value, float):
        return with_sd(value, sd if isinstance(sd, float) else math.nan, unit)
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _p(p: float, count: int) -> str:
    """A probability out of so many surrogates: none can show less than one in count + 1."""
    return f"≤ 1/{count + 1}" if p <= 1.000001 / (count + 1) else f"{p:.2g}"


def _noise_test(d: Discovery) -> Section:
    x = d.examination
    names = x.best.names[len(x.base.terms) :]
    tests = list(zip(names, x.surrogates, strict=False))
    with drawing_style():
        drawing = new_drawing(9.0, 0.4 + 1.7 * len(tests))
        axes = np.atleast_1d(drawing.subplots(len(tests), 1))
        for axis, (name, test) in zip(axes, tests, strict=True):
            _draw_surrogates(axis, name, test)
    text = "; ".join(f"{name}: p {_p(t.p, len(t.surrogates))}" for name, t in tests)
    figure = of_drawing(
        drawing, "surrogates", "Surrogates",
        f"{text}. Grey: what the same search gains on surrogates, which are the recording's own "
        "noise moved in time against the temperatures. A name needs a gain that none of them "
        "reaches.",
    )  # fmt: skip
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
    """What every candidate leaves when it is alone, and why it is not the one."""
    x = d.examination
    singles: dict[str, Solution] = {}
    for s in sorted(x.ranking, key=lambda s: s.score):
        singles.setdefault(_candidate_name(s), s)
    noise = _noise_px(d, 0)
    rows = [(name, s, _left_px(d, s.fit)) for name, s in singles.items()]
    best = x.best.names[len(x.base.terms) :]
    combined = len(best) > 1 and x.adequate
    named = x.adequate and bool(best)
    bars = [(name, left, named and name.split(" ")[0] in best) for name, _, left in rows]
    if combined:
        bars.insert(0, (" + ".join(best), _left_px(d, x.best.fit), True))
    if not bars:
        return Section("The candidates", ("No effect of the catalogue promised anything.",))
    with drawing_style():
        drawing = new_drawing(9.0, 0.8 + 0.3 * len(bars))
        axis = drawing.subplots()
        for place, (_, left, found) in enumerate(bars):
            axis.barh(-place, left, 0.7, color=_FOUND if found else PALE)
            axis.annotate(f"{left:.3f}", (left, -place), (4, 0), fontsize=8, va="center",
                          textcoords="offset points")  # fmt: skip
        axis.axvline(noise, ls="--", color=GREY, lw=1.2, label="noise")
        axis.set_yticks([-k for k in range(len(bars))], [shortened(b[0], 40) for b in bars])
        axis.set_xlim(0.0, 1.12 * max(left for _, left, _ in bars))
        axis.grid(visible=False, axis="y")
        label_axes(axis, "left on M1 in px RMS")
        legend_above(axis)
    figure = of_drawing(
        drawing, "candidates", "The candidates, each alone",
        f"What the base model with one effect more leaves of M1. {'Blue: named. ' if named else ''}"
        "The dashed line is the noise, below which nothing can be explained.",
    )  # fmt: skip
    items = tuple((name, _why(d, name, s, left, noise)) for name, s, left in rows)
    return Section("The candidates, and why each lost", (), (figure,), (), items)


def _candidate_name(s: Solution) -> str:
    term = s.terms[-1]
    return f"{term.effect} (mount)" if term.parameters == MOUNT != term.kind.usual else term.effect


def _left_px(d: Discovery, fit: Fit) -> float:
    """RMS of what a fit leaves of M1's image points, px, as the gap counts it."""
    e = d.examination.fitter.series[0]
    within = float(np.sum(e.weights[..., :2] * np.nan_to_num(e.residuals) ** 2))
    chi2 = within + e.correlation * image_chi2(e, fit, 0)
    return _noise_px(d, 0) * math.sqrt(chi2 / max(2.0 * float(e.n.sum()), 1.0))


def _why(d: Discovery, name: str, s: Solution, left: float, noise: float) -> str:
    x = d.examination
    best = x.best.names[len(x.base.terms) :]
    worse = s.score - x.best.score
    score = f"−2 log L and penalty together are {worse:,.0f} worse"
    if x.adequate and name.split(" ")[0] in best:
        if len(best) > 1:
            return f"named, together with {' and '.join(n for n in best if n != name)}."
        return f"named: it leaves {left:.3f} px, which is the noise."
    if any(name.split(" ")[0] in r.names for r in x.rivals):
        return f"cannot be excluded: {score} only."
    if left > _AT_NOISE * noise:
        text = f"leaves {left:.3f} px, {left / noise:.1f} times the noise"
        if "omega" in s.terms[-1].parameters:
            text += "; a mount that moves shifts near targets more than far ones, as these do not"
        return f"{text}."
    return f"leaves no more than noise on M1, but over all recordings {score}: excluded."


# where the base model fails


def _misfit_table(d: Discovery) -> Table:
    rows = tuple(
        (parameter_label(name), _number(value, 4), _number(sigmas, 1))
        for name, value, sigmas in resolve(d.examination).rows
    )
    return Table(
        "Misfit of the base model", ("against", "size in px RMS", "significance in σ"), rows
    )


def _number(value: Any, decimals: int) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"{value:.{decimals}f}".replace("-", "−") if math.isfinite(value) else "–"


def _misfit_matrix(d: Discovery) -> Drawing:
    """Where the base model fails: slow trajectories by parameter combination, in sigma."""
    a = d.examination.base_adequacy[0]
    scores = np.maximum(np.abs(a.scores[:, ::-1]), 1e-3)
    with drawing_style():
        drawing = new_drawing(9.0, 3.0)
        axis = drawing.subplots()
        image = axis.pcolormesh(scores, cmap="magma_r", norm="log")
        axis.grid(visible=False)
        label_axes(axis, "parameter combination, best first (number)",
                   "half-waves over M1 (number)")  # fmt: skip
        bar = drawing.colorbar(image, ax=axis)
        bar.set_label("|misfit| in σ")
        bar.ax.yaxis.set_major_formatter(lambda value, _: tick_text(value))
    text = (
        f"Slow trajectories that the base model leaves: {plain(float(scores.max()), digits=3)} σ "
        "at most."
    )
    return of_drawing(drawing, "misfit-matrix", "Misfit of the base model", text)
