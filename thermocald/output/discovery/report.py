"""The report of a discovery: one HTML file that needs nothing else."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from html import escape
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from thermocald import __version__
from thermocald.discovery.verdict.misfit import resolve
from thermocald.output.discovery import figures
from thermocald.output.figures.numbers import with_sd

if TYPE_CHECKING:
    from thermocald.discovery.verdict.found import EffectFound
    from thermocald.discovery.verdict.gap import Gap
    from thermocald.discovery.verdict.result import Discovery

__all__ = ["report_html"]

_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;color:#1c2b36;background:#fff;max-width:62rem;
margin:2rem auto;padding:0 1rem}
h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2.2rem;border-bottom:1px solid #cfd8de}
.sentence{font-size:1.25rem;border-left:4px solid #c4542b;padding:.4rem 1rem;background:#faf5f2}
table{border-collapse:collapse;font-size:.9rem;margin:.6rem 0}
td,th{padding:.25rem .7rem;text-align:left;border-bottom:1px solid #e3e8ec}
td.n{text-align:right;font-variant-numeric:tabular-nums}
.figure{overflow-x:auto}.figure svg{display:block;width:100%;min-width:36rem;height:auto}
.note,.made{color:#5b6b76;font-size:.9rem}.made{margin:.2rem 0}
nav{border:1px solid #cfd8de;border-radius:4px;padding:.4rem 1rem;margin:1rem 0;font-size:.9rem}
nav ol{margin:.3rem 0;padding-left:1.4rem}a{color:#0b63a5}
"""
_SECTIONS = (
    "The signature",
    "Where simulation and measurement disagree",
    "All candidates, alone",
)
_VERDICTS = {
    "adequate": "The model reproduces the recording within its noise: nothing is missing that "
    "this recording could show.",
    "effects_found": "The base model does not reproduce the recording; "
    "with what was found it does.",
    "unexplained": "The base model does not reproduce the recording, "
    "and no effect of the catalogue explains why.",
}


def report_html(discovery: Discovery, title: str, made: datetime | None = None) -> str:
    """The whole page; made: the time that it bears, by default now."""
    parts = [
        (
            "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
            "<meta name='viewport' content='width=device-width,initial-scale=1'>"
            f"<title>Discovery: {escape(title)}</title><style>{_STYLE}</style></head><body>"
        ),
        f"<h1>Discovery: {escape(title)}</h1>",
    ]
    parts += [f"<p class='made'>{escape(line)}</p>" for line in _origin(discovery, made)]
    parts += [f"<p class='sentence'>{escape(e.statement)}</p>" for e in discovery.effects]
    parts.append(f"<p>{escape(_VERDICTS[discovery.verdict])}</p>")
    tested = discovery.verdict == "effects_found" and bool(discovery.examination.surrogates)
    names = ["The gap", *(e.effect for e in discovery.effects),
             *(["Could noise do this?"] if tested else []), *_SECTIONS]  # fmt: skip
    parts.append(
        "<nav aria-label='Contents'><b>Contents</b><ol>"
        + "".join(f"<li><a href='#s{i}'>{escape(name)}</a></li>" for i, name in enumerate(names))
        + "</ol></nav>"
    )
    heads = iter([f"<h2 id='s{i}'>{escape(name)}</h2>" for i, name in enumerate(names)])
    parts.append(next(heads) + _gaps(discovery) + _drawn(figures.staircase(discovery)))
    parts += [next(heads) + _effect(e) for e in discovery.effects]
    if tested:
        parts.append(
            next(heads)
            + _drawn(figures.surrogates(discovery))
            + "<p class='note'>The recording's own noise, moved in time against the temperatures "
            "and searched in the same way. A name needs a gain that no surrogate reaches.</p>"
        )
    parts.append(next(heads) + _drawn(figures.signature(discovery)))
    parts.append(
        next(heads)
        + _drawn(figures.misfit_map(discovery))
        + "<p class='note'>Colour: what the model leaves of each target over the series. "
        "Arrows: its strongest pattern. M1.</p>"
        + _where(discovery)
        + _drawn(figures.misfit_matrix(discovery))
    )
    parts.append(
        next(heads)
        + _drawn(figures.ranking(discovery))
        + "<p class='note'>Improvement of −2 log L less the penalty for what was searched. "
        "Candidates that promise nothing are not drawn.</p>"
    )
    parts.append("</body></html>")
    return "".join(parts)


def _drawn(svg: str) -> str:
    """A figure; a narrow page scrolls it, so that its text can be read."""
    return f"<div class='figure'>{svg}</div>"


def _origin(discovery: Discovery, made: datetime | None) -> list[str]:
    """When and with what it was made, of which camera, when it was measured."""
    at = made or datetime.now(tz=UTC)
    versions = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy"))
    lines = [f"Made on {at:%Y-%m-%d at %H:%M} UTC with thermocald {__version__} ({versions})."]
    for evidence in discovery.examination.fitter.series:
        source = evidence.source
        sensor, start = source.sensor, datetime.fromtimestamp(float(source.frame_times[0]), UTC)
        lines.append(
            f"{source.camera}, {sensor.width} × {sensor.height} px of "
            f"{sensor.pixel_pitch * 1000:g} µm; {source.series or source.name} measured "
            f"{start:%Y-%m-%d %H:%M} UTC, {source.epochs} epochs."
        )
    return lines


def _row(name: str, gap: Gap | None) -> str:
    if gap is None:
        return ""
    cells = (f"{gap.rms_px:.4f}", f"{gap.chi2_reduced:.3f}", f"{gap.object_mm_at_10m:.2f}")
    return (
        f"<tr><td>{escape(name)}</td>" + "".join(f"<td class='n'>{c}</td>" for c in cells) + "</tr>"
    )


def _gaps(discovery: Discovery) -> str:
    rows = []
    for stage in discovery.stages:
        label = f"with {stage.added}" if stage.added else "base model"
        rows.append(_row(f"M1, {label}", stage.fit))
        rows += [_row(f"M{k}, {label}", gap) for k, gap in enumerate(stage.others, start=2)]
    text = (
        "<table><tr><th></th><th>px RMS</th><th>reduced χ²</th><th>mm at 10 m</th></tr>"
        + "".join(rows)
        + "</table>"
    )
    outside, inside = discovery.cross_validation
    if outside == outside:  # a number
        text += (
            "<p>On blocks of M1 left out of the fit, χ² of the parameters per degree of freedom "
            f"is {outside:.3f}; fitted with them {inside:.3f}.</p>"
        )
    if discovery.stages[0].verify is None:
        text += "<p class='note'>No M2 was given: the constants are not verified.</p>"
    return text


def _effect(effect: EffectFound) -> str:
    rows = []
    for name, e in effect.estimates.items():
        value, sd = e["value"], e["sd"]
        unit = "" if e["unit"] == "1" else e["unit"]
        shown = str(value)
        if isinstance(value, float):
            shown = with_sd(value, sd if isinstance(sd, float) else math.nan, unit)
        rows.append(f"<tr><td>{escape(name)}</td><td class='n'>{escape(shown)}</td></tr>")
    text = f"<table><tr><th>parameter</th><th>value ± sd</th></tr>{''.join(rows)}</table>"
    if proposal := effect.evidence.get("proposal"):
        largest = proposal["surrogates"]["largest_of_surrogates"]
        text += (
            f"<p>Formula <code>{escape(proposal['formula'])}</code>: constants of M1 alone explain "
            f"{proposal['closed_on_verify_by_fit']:.0%} of the misfit of M2. Formulas on a grid of "
            f"constants explain {proposal['surrogates']['explained']:.0%} of the misfit, of "
            f"{proposal['surrogates']['count']} surrogates whose cause was not recorded at most "
            f"{largest:.0%}: probability of a false formula "
            f"{proposal['false_alarm_probability']:.3f}.</p>"
        )
    excluded = [a for a in effect.alternatives if not a.get("resembles")]
    alike = [a["effect"] for a in effect.alternatives if a.get("resembles")]
    if excluded:
        text += "<p>These data cannot exclude:</p><ul>"
        for a in excluded:
            text += (
                f"<li><b>{escape(a['effect'])}</b>, scoring {a['score_difference']:.1f} worse. "
                f"To separate them: {escape(a['experiment'])}.</li>"
            )
        text += "</ul>"
    if alike:
        text += (
            f"<p>Effects that merely resemble it: {escape(', '.join(alike))}. None passes "
            "the absolute test."
            + (" The smooth bridge in M1 does not transfer to another series."
               if effect.term is None else "")
            + "</p>"
        )  # fmt: skip
    return text


def _where(discovery: Discovery) -> str:
    rows = []
    for name, value, sigmas in resolve(discovery.examination).rows:
        rows.append(
            f"<tr><td>{escape(name)}</td><td class='n'>{_text(value)}</td>"
            f"<td class='n'>{_text(sigmas, 1)}</td></tr>"
        )
    return (
        "<table><tr><th>misfit of the base model against</th><th>size / px RMS</th>"
        f"<th>significance / σ</th></tr>{''.join(rows)}</table>"
    )


def _text(value: Any, decimals: int = 4) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"{value:.{decimals}f}".replace("-", "−")
