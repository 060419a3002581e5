"""The report of a discovery: one HTML file that needs nothing else."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any

from thermocald.discovery.verdict.misfit import resolve
from thermocald.output.discovery import figures

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
td.n{text-align:right;font-variant-numeric:tabular-nums}svg{max-width:100%;height:auto}
.note{color:#5b6b76;font-size:.9rem}
"""
_VERDICTS = {
    "adequate": "The model reproduces the recording within its noise: nothing is missing that "
    "this recording could show.",
    "effects_found": "The base model does not reproduce the recording; "
    "with what was found it does.",
    "unexplained": "The base model does not reproduce the recording, "
    "and no effect of the catalogue explains why.",
}


def report_html(discovery: Discovery, title: str) -> str:
    """The whole page."""
    parts = [
        (
            "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
            "<meta name='viewport' content='width=device-width,initial-scale=1'>"
            f"<title>Discovery: {escape(title)}</title><style>{_STYLE}</style></head><body>"
        ),
        f"<h1>Discovery: {escape(title)}</h1>",
    ]
    parts += [f"<p class='sentence'>{escape(e.statement)}</p>" for e in discovery.effects]
    parts.append(f"<p>{escape(_VERDICTS[discovery.verdict])}</p>")
    parts.append("<h2>The gap</h2>" + _gaps(discovery) + figures.staircase(discovery))
    parts += [_effect(e) for e in discovery.effects]
    parts.append("<h2>The signature</h2>" + figures.signature(discovery))
    parts.append(
        "<h2>Where simulation and measurement disagree</h2>"
        + figures.misfit_map(discovery)
        + "<p class='note'>Colour: what the model leaves of each target over the series. "
        "Arrows: its strongest pattern. M1.</p>"
        + _where(discovery)
        + figures.misfit_matrix(discovery)
    )
    parts.append(
        "<h2>All candidates, alone</h2>"
        + figures.ranking(discovery)
        + "<p class='note'>Improvement of −2 log L less the penalty for what was searched. "
        "Candidates that promise nothing are not drawn.</p>"
    )
    parts.append("</body></html>")
    return "".join(parts)


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
        rows.append(_row(f"M2, {label}", stage.verify))
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
        shown = f"{value:.6g}" if isinstance(value, float) else escape(str(value))
        spread = f"{sd:.2g}" if isinstance(sd, float) else ""
        rows.append(
            f"<tr><td>{escape(name)}</td><td class='n'>{shown}</td><td class='n'>{spread}</td>"
            f"<td>{escape(e['unit'])}</td></tr>"
        )
    text = (
        f"<h2>{escape(effect.effect)}</h2><table><tr><th>parameter</th><th>value</th><th>sd</th>"
        f"<th>unit</th></tr>{''.join(rows)}</table>"
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
            "the absolute test. The smooth bridge in M1 does not transfer to another series.</p>"
        )
    return text


def _where(discovery: Discovery) -> str:
    rows = []
    for name, value, sigmas in resolve(discovery.examination).rows:
        rows.append(
            f"<tr><td>{escape(name)}</td><td class='n'>{_text(value)}</td>"
            f"<td class='n'>{sigmas:.1f}</td></tr>"
        )
    return (
        "<table><tr><th>misfit of the base model against</th><th>size / px RMS</th>"
        f"<th>significance / σ</th></tr>{''.join(rows)}</table>"
    )


def _text(value: Any) -> str:
    return f"{value:.4f}" if isinstance(value, float) else str(value)
