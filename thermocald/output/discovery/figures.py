"""The figures of a discovery as SVG text: misfit map, signature, ranking, staircase."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.discovery.search.candidates import MOUNT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from thermocald.arrays import Array
    from thermocald.discovery.verdict.result import Discovery
    from thermocald.reduction.hypothesis import Fit

__all__ = ["misfit_map", "misfit_matrix", "ranking", "signature", "staircase", "surrogates"]

_INK, _ACCENT, _PALE = "#1f3a4d", "#c4542b", "#9fb4c1"


def _figure(width: float, height: float, columns: int = 1) -> tuple[Figure, Any]:
    from matplotlib.figure import Figure as MatplotlibFigure

    figure = MatplotlibFigure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(1, columns, squeeze=False)[0]
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(colors=_INK, labelsize=8)
    return figure, axes


def _svg(figure: Figure) -> str:
    from matplotlib import rc_context

    buffer = io.StringIO()
    with rc_context({"svg.hashsalt": "thermocald", "svg.fonttype": "path"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def _rest(discovery: Discovery, fit: Fit, series: int) -> Array:
    """What a fit leaves of the epochs' parameters (E, P), px-scaled, level taken out."""
    e = discovery.examination.fitter.series[series]
    C, V, index = fit.designs[series]
    r = e.values - (C * fit.coefficients[index]) @ V.T
    level = np.linalg.lstsq(e.N.sum(axis=0), np.einsum("epq,eq->p", e.N, r), rcond=1e-12)[0]
    return np.asarray(r - level)


def misfit_map(discovery: Discovery) -> str:
    """Per target, the RMS misfit over the series and its strongest trajectory, before and after."""
    e = discovery.examination.fitter.series[0]
    seen = e.weights[..., 0].any(axis=0)
    places = e.at.predicted[seen]
    figure, axes = _figure(9.0, 3.9, 2)
    top = 0.0
    drawn = []
    for fit in (discovery.base_fit, discovery.final_fit):
        r = _rest(discovery, fit, 0)
        N = e.N.mean(axis=0)
        size, U = np.linalg.eigh(N)
        w = (r @ U) * np.sqrt(np.maximum(size, 0.0))
        _, s, v = np.linalg.svd(w, full_matrices=False)
        keep = size > 1e-6 * size.max()
        pattern = U[:, keep] @ (v[0][keep] / np.sqrt(size[keep])) * s[0] / np.sqrt(len(r))
        arrows = np.einsum("tij,j->ti", e.columns[seen], pattern)
        misfit = np.sqrt(np.mean(np.einsum("tij,ej->eti", e.columns[seen], r) ** 2, axis=(0, 2)))
        drawn.append((misfit, arrows))
        top = max(top, float(misfit.max()))
    length = max(float(np.linalg.norm(drawn[0][1], axis=1).max()), 1e-9)
    for axis, (misfit, arrows), title in zip(axes, drawn, ("before", "after"), strict=True):
        points = axis.scatter(*places.T, c=misfit, cmap="viridis", vmin=0, vmax=top, s=18)
        scale = length / (0.08 * e.source.sensor.width)
        axis.quiver(
            *places.T, *arrows.T, angles="xy", scale_units="xy", scale=scale, color=_ACCENT,
            width=0.003,
        )  # fmt: skip
        axis.set_xlim(0, e.source.sensor.width)
        axis.set_ylim(e.source.sensor.height, 0)
        axis.set_aspect("equal")
        axis.set_title(
            f"{title}: {float(np.sqrt(np.mean(misfit**2))):.3f} px RMS", color=_INK, fontsize=10
        )
        axis.set_xlabel("x / px", fontsize=8)
    axes[0].set_ylabel("y / px", fontsize=8)
    bar = figure.colorbar(points, ax=axes, shrink=0.85)
    bar.set_label("misfit of a target / px RMS", fontsize=8)
    return _svg(figure)


def signature(discovery: Discovery) -> str:
    """What is measured of the effect beyond the base model, and the effect's own trajectory."""
    e = discovery.examination.fitter.series[0]
    before = _rest(discovery, discovery.base_fit, 0)
    after = _rest(discovery, discovery.final_fit, 0)
    model = before - after
    N = e.N.mean(axis=0)
    if float(np.abs(model).max()) <= 0:
        model = before
    size, U = np.linalg.eigh(N)
    root = U * np.sqrt(np.maximum(size, 0.0))
    _, _, v = np.linalg.svd(model @ root, full_matrices=False)
    coordinates = max(float(2 * e.n.mean()), 1.0)
    weights = e.weights[..., 0]
    sigma = float(1.0 / np.sqrt(np.mean(weights[weights > 0])))
    unit = sigma / np.sqrt(coordinates)
    measured = before @ root @ v[0] * unit
    own = (before - after) @ root @ v[0] * unit
    figure, axes = _figure(9.0, 3.4, 2)
    minutes = e.times / 60.0
    T = e.averaged(e.history.temperature())
    named = discovery.verdict == "effects_found" or any(f.term for f in discovery.effects)
    for axis, x, label in ((axes[0], minutes, "time / min"), (axes[1], T, "T / °C")):
        axis.plot(x, measured, ".", color=_PALE, ms=3, label="measured minus base model")
        if named:
            axis.plot(x, own, "-", color=_ACCENT, lw=1.3, label="what was found")
        axis.set_xlabel(label, fontsize=8)
    axes[0].set_ylabel("movement of the image / px RMS", fontsize=8)
    twin = axes[0].twinx()
    twin.plot(minutes, T, color=_INK, lw=0.7, ls=":", label="T")
    twin.set_ylabel("T / °C", fontsize=8)
    twin.tick_params(labelsize=8)
    _legend_above(axes[1])
    return _svg(figure)


def ranking(discovery: Discovery) -> str:
    """How much each single effect improves the score of the base model."""
    x = discovery.examination
    rows: dict[str, float] = {}
    for s in x.ranking:
        name = s.names[-1]
        if s.terms[-1].parameters == MOUNT != s.terms[-1].kind.usual:
            name += " (mount)"
        rows[name] = max(rows.get(name, 0.0), x.base.score - s.score)
    figure, axes = _figure(9.0, 0.6 + 0.3 * max(len(rows), 1))
    names = sorted(rows, key=lambda n: rows[n])
    axes[0].barh(names, [max(rows[n], 1.0) for n in names], color=_PALE)
    best = [n for n in names if n.split(" ")[0] in x.best.names]
    for n in best:
        axes[0].barh([n], [max(rows[n], 1.0)], color=_ACCENT)
    if rows:
        axes[0].set_xscale("log")
    axes[0].set_xlabel("improvement of the penalised score, alone", fontsize=8)
    return _svg(figure)


def staircase(discovery: Discovery) -> str:
    """NormalEquations χ² and px RMS after each step, on M1 and on M2, and the floor."""
    stages = discovery.stages
    labels = ["before", *(f"+ {s.added}" for s in stages[1:])]
    figure, axes = _figure(9.0, 3.0, 2)
    for axis, key, title in (
        (axes[0], "chi2_reduced", "reduced χ²"),
        (axes[1], "rms_px", "px RMS"),
    ):
        series = zip(*((s.fit, *s.others) for s in stages), strict=True)
        for number, gaps in enumerate(series):
            colour, name = (_ACCENT if number else _INK), f"M{number + 1}"
            axis.plot(
                range(len(gaps)), [getattr(g, key) for g in gaps], "o-", color=colour,
                drawstyle="steps-post", label=name, ms=4,
            )  # fmt: skip
        if key == "chi2_reduced":
            axis.axhline(1.0, color=_PALE, lw=1, ls="--", label="floor")
        axis.set_yscale("log")
        axis.set_xticks(range(len(labels)), labels, rotation=15, fontsize=8)
        axis.set_ylabel(title, fontsize=8)
        _legend_above(axis)
    return _svg(figure)


def _legend_above(axis: Any) -> None:
    """The legend above the axes, clear of the data."""
    axis.legend(
        fontsize=7, frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3,
        borderaxespad=0.2,
    )  # fmt: skip


def surrogates(discovery: Discovery) -> str:
    """Penalised gain of each effect against those of surrogates of the recording's own noise.

    Empty where no effect was held against surrogates.
    """
    x = discovery.examination
    tests = list(zip(x.best.names[len(x.base.terms) :], x.surrogates, strict=False))
    if not tests:
        return ""
    figure, axes = _figure(9.0, 0.9 + 0.9 * len(tests))
    axis = axes[0]
    rows = range(len(tests), 0, -1)
    for row, (_, test) in zip(rows, tests, strict=True):
        spread = np.linspace(-0.22, 0.22, len(test.surrogates))
        axis.plot(test.surrogates, row + spread, "o", color=_PALE, ms=3, mew=0)
        axis.plot([test.gain], [row], "D", color=_ACCENT, ms=8)
        axis.annotate(
            f"p = {test.p:.3f}", (test.gain, row), (0, 9), textcoords="offset points",
            ha="right", fontsize=8, color=_INK,
        )  # fmt: skip
    axis.set_xscale("symlog", linthresh=50)
    axis.xaxis.set_major_formatter("{x:g}")
    axis.set_yticks(list(rows), [name for name, _ in tests], fontsize=9)
    axis.set_ylim(0.5, len(tests) + 0.6)
    axis.axvline(0.0, color=_PALE, lw=0.8)
    axis.set_xlabel("gain of −2 log L less the penalty; dots: surrogates, diamond: found",
                    fontsize=8)  # fmt: skip
    return _svg(figure)


def misfit_matrix(discovery: Discovery) -> str:
    """Where the base model fails: slow trajectories by parameter combination, in sigma."""
    a = discovery.examination.base_adequacy[0]
    figure, axes = _figure(9.0, 3.0)
    image = axes[0].imshow(
        np.abs(a.scores[:, ::-1]), aspect="auto", cmap="magma_r", norm="log", origin="lower"
    )
    axes[0].set_xlabel("independent combination of parameters, best determined first", fontsize=8)
    axes[0].set_ylabel("half-waves over the series", fontsize=8)
    bar = figure.colorbar(image, ax=axes[0])
    bar.set_label("|misfit| / σ", fontsize=8)
    return _svg(figure)
