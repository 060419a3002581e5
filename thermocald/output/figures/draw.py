"""Drawing with matplotlib: panels and matrices, as SVG for the report, SVG and PNG for papers."""

from __future__ import annotations

import io
import re
from contextlib import contextmanager
from html import escape
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from thermocald.atomic_file import new_file
from thermocald.output.figures.numbers import coefficient

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from thermocald.arrays import Array
    from thermocald.output.figures.panels import Curve, Figure, Panel

__all__ = ["draw_figure", "draw_matrix", "draw_panel", "inline_svg", "save"]

_STYLE: dict[str, Any] = {
    "svg.fonttype": "none",  # text stays text: it can be searched, copied, and edited
    "svg.hashsalt": "thermocald",  # the same study gives the same file
    "font.family": "sans-serif",
    "font.size": 9,
    "path.simplify": False,  # curves are thinned already; it would drop zero-length strokes
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-3, 4),
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "figure.max_open_warning": 0,
}
_PANEL_INCHES = (3.4, 2.5)
_LEGEND_LETTERS = 52  # in a line above a panel


def _figure(width: float, height: float, layout: Literal["constrained"] | None) -> Any:
    # Without pyplot: no global state, no window, nothing to close.
    from matplotlib.figure import Figure as Canvas

    return Canvas(figsize=(width, height), layout=layout)


@contextmanager
def _style() -> Iterator[None]:
    import matplotlib as mpl

    settings: Any = _STYLE
    with mpl.rc_context(settings):
        yield


def inline_svg(drawing: Any, prefix: str, label: str) -> str:
    """A drawing as an <svg> element; `prefix` keeps its ids apart from those of others."""
    buffer = io.StringIO()
    with _style():
        drawing.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'font-family: [^;"]*', "font-family: sans-serif", text)
    text = re.sub(r">\s+<", "><", text)
    text = re.sub(r'\bid="', f'id="{prefix}-', text)
    text = re.sub(r"url\(#", f"url(#{prefix}-", text)
    text = re.sub(r'href="#', f'href="#{prefix}-', text)
    text = re.sub(r"<[^>]*>", lambda tag: _shorter(tag[0]), text)
    # The page decides the width; the height follows from the viewBox.
    head, rest = text.split(">", 1)
    head = re.sub(r'\s(width|height)="[^"]*"', "", head)
    return f'{head} role="img" aria-label="{escape(label)}">{rest}'


def _shorter(tag: str) -> str:
    """A tag with its numbers to 0.01 pt, on one line."""
    return re.sub(r"(\.\d\d)\d+", r"\1", re.sub(r"\s+", " ", tag))


def save(drawing: Any, folder: Path, name: str) -> list[Path]:
    """A drawing as <name>.svg and <name>.png (200 dpi)."""
    paths = [folder / f"{name}.svg", folder / f"{name}.png"]
    with _style():
        with new_file(paths[0]) as partial:
            about = {"Date": None, "Creator": "thermocald"}
            drawing.savefig(partial, format="svg", metadata=about)
        with new_file(paths[1]) as partial:
            drawing.savefig(partial, format="png", dpi=200)
    return paths


def draw_panel(panel: Panel, *, legend: bool = True) -> Any:
    """One panel as a drawing of its own."""
    with _style():
        # Fixed margins fit the short labels; fitting them exactly triples the time of a report.
        drawing = _figure(*_PANEL_INCHES, None)
        axis = drawing.subplots()
        rows = _fill(axis, panel, legend=legend)
        drawing.subplots_adjust(right=0.95, bottom=0.19, top=0.89 - 0.055 * rows)
        # how many ticks there are, and with how many digits, depends on the height
        longest = max((len(text) for text in _tick_labels(axis)), default=0)
        drawing.subplots_adjust(left=min(0.36, 0.155 + 0.0185 * longest))
        return drawing


def draw_figure(figure: Figure) -> Any:
    """All panels of a figure in one drawing, for a paper."""
    with _style():
        columns = min(figure.columns, len(figure.panels))
        rows = -(-len(figure.panels) // columns)
        drawing = _figure(_PANEL_INCHES[0] * columns, _PANEL_INCHES[1] * rows, "constrained")
        axes = np.atleast_1d(drawing.subplots(rows, columns)).ravel()
        for i, axis in enumerate(axes):
            if i < len(figure.panels):
                _fill(axis, figure.panels[i], legend=i == 0)
            else:
                axis.set_axis_off()
        return drawing


def _tick_labels(axis: Any) -> list[str]:
    """The labels of the y axis that will be drawn, without drawing it."""
    low, high = axis.get_ylim()
    ticks = [tick for tick in axis.get_yticks() if low <= tick <= high]
    labels: list[str] = axis.yaxis.get_major_formatter().format_ticks(ticks)
    # A power of ten is typeset: its markup is longer than what is seen.
    return [re.sub(r"\$|\\mathdefault|[{}^]", "", label) for label in labels]


def _fill(axis: Any, panel: Panel, *, legend: bool) -> int:
    """Draw a panel; returns the rows of its legend, which is above it, clear of the data."""
    for curve in panel.curves:
        _draw_curve(axis, curve)
    for y, label in panel.horizontal:
        axis.axhline(y, color="#555555", linestyle="--", linewidth=0.9)
        if label:
            axis.annotate(
                label,
                (0.99, y),
                xycoords=("axes fraction", "data"),
                ha="right",
                va="bottom",
                fontsize=7,
                color="#555555",
            )
    if panel.log_y:
        axis.set_yscale("log")
    if panel.equal:
        axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel(panel.x_label)
    axis.set_ylabel(panel.y_label)
    names = {c.name for c in panel.curves if c.name}
    rows = 0
    if legend and len(names) > 1:
        columns = max(1, min(len(names), _LEGEND_LETTERS // (max(map(len, names)) + 4)))
        rows = -(-len(names) // columns)
        axis.legend(
            fontsize=7,
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=columns,
            handlelength=1.2,
            columnspacing=1.0,
            labelspacing=0.2,
            borderaxespad=0.1,
            borderpad=0.2,
        )
    axis.set_title(panel.title, loc="left", pad=6 + 10 * rows)
    return rows


def _draw_curve(axis: Any, curve: Curve) -> None:
    label = curve.name or None
    if curve.kind == "points":
        # Zero-length strokes with round caps: a tenth of the size of as many markers.
        x = np.column_stack([curve.x, curve.x, np.full(len(curve.x), np.nan)]).ravel()
        y = np.column_stack([curve.y, curve.y, np.full(len(curve.y), np.nan)]).ravel()
        axis.plot(x, y, color=curve.colour, linewidth=2.2, solid_capstyle="round", label=label)
        return
    style = "--" if curve.dashed else "-"
    axis.plot(curve.x, curve.y, style, color=curve.colour, linewidth=1.1, label=label)
    if curve.kind == "band" and curve.lower is not None and curve.upper is not None:
        axis.fill_between(
            curve.x, curve.lower, curve.upper, color=curve.colour, alpha=0.2, linewidth=0
        )


def draw_matrix(matrix: Array, names: Sequence[str], title: str) -> Any:
    """A matrix of correlation coefficients (n, n) in colours with its numbers; NaN stays grey."""
    with _style():
        n = len(names)
        size = 1.4 + 0.42 * n
        drawing = _figure(size, size, "constrained")
        axis = drawing.subplots()
        axis.set_facecolor("#dddddd")
        # Not an image: cells of an SVG stay sharp and can be edited.
        axis.pcolormesh(
            np.ma.masked_invalid(matrix), cmap="RdBu_r", vmin=-1, vmax=1, edgecolors="white"
        )
        for (row, column), r in np.ndenumerate(matrix):
            if np.isfinite(r):
                shade = "white" if abs(r) > 0.6 else "black"
                axis.text(
                    column + 0.5,
                    row + 0.5,
                    coefficient(r),
                    ha="center",
                    va="center",
                    fontsize=7,
                    color=shade,
                )
        axis.set_xticks(np.arange(n) + 0.5, names, rotation=60, ha="right")
        axis.set_yticks(np.arange(n) + 0.5, names)
        axis.invert_yaxis()
        axis.set_aspect("equal")
        axis.grid(visible=False)
        axis.tick_params(length=0)
        axis.set_title(title, loc="left")
        return drawing
