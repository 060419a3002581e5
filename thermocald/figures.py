"""The figures of all reports, drawn with matplotlib as SVG, for papers also as PNG.

A figure is either a list of panels, which a page shows one by one and a paper in one drawing, or a
drawing made elsewhere. Long curves are thinned to the minimum and maximum of each stretch, so that
no outlier disappears and no file grows with the length of a series. Text stays text: it can be
searched, copied and edited.
"""

from __future__ import annotations

import io
import re
import warnings
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from thermocald.errors import DriverMissing
from thermocald.files import new_file
from thermocald.numbers import coefficient, distinct_names, shortened, superscript

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure as Drawing

    from thermocald.arrays import Array

# safe for the colour-blind (Okabe & Ito 2008; the last three Tol 2021), dark enough for thin lines
PALETTE = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000", "#332288",
    "#882255", "#999933",
)  # fmt: skip
PALE, GREY = "#9fb4c1", "#555555"
BAND = 1.96  # standard deviations: 95 % on every page
_MOST_POINTS = 800
_PANEL_INCHES = (3.4, 2.5)
_LEGEND_LETTERS = 46  # per line above a panel
_KEY_LETTERS = 5.4  # width of a legend's line and spaces
_MATRIX_LETTERS = 13  # per name of a row
_TITLE_LETTERS = 11  # per inch
_FEW_ARROWS = 25
_DECADES = 3.0  # spanned by an axis that is logarithmic
_STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "thermocald",  # the same study gives the same file
    "font.family": "sans-serif",
    "font.size": 9,
    "path.simplify": False,  # curves are thinned already, and it drops zero-length strokes
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.formatter.useoffset": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 7,
    "figure.max_open_warning": 0,
}


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve or points x, y (n,); half: half the width (n,) of a band about the line."""

    name: str
    x: Array
    y: Array
    kind: Literal["line", "points"] = "line"
    colour: str = PALETTE[0]
    half: Array | None = None
    dashed: bool = False


@dataclass(frozen=True, eq=False)
class Arrows:
    """Vectors (n, 2) at image points (n, 2), px, y down, in a frame of (width, height), px.

    longest: the length, px, that is drawn as a tenth of the frame's width (a fifth for few arrows),
    by default that of the longest vector.
    """

    points: Array
    vectors: Array
    frame: tuple[int, int]
    colour: str = PALETTE[1]
    longest: float | None = None


@dataclass(frozen=True, eq=False)
class Panel:
    """A diagram; horizontal: (y, label) of dashed lines; equal: same scale on both axes.

    y_down: y increases downwards, as in the image.
    """

    title: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]
    log_y: bool = False
    equal: bool = False
    y_down: bool = False
    horizontal: tuple[tuple[float, str], ...] = ()
    arrows: Arrows | None = None


def image_panel(title: str, *curves: Curve, arrows: Arrows | None = None) -> Panel:
    """Return a panel of the image, px, y down; `draw_arrows` sets an arrow panel's axes itself."""
    down = arrows is None
    return Panel(
        title, "x in px", "y in px, down", curves, equal=down, y_down=down, arrows=arrows
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Figure:
    """Panels or one matplotlib drawing, with a name that is also its file's.

    columns: greatest number of panels in a row.
    """

    name: str
    title: str
    caption: str
    panels: tuple[Panel, ...] = ()
    columns: int = 3
    drawing: Any = None

    @property
    def in_a_row(self) -> int:
        """The number of panels side by side."""
        return max(1, min(self.columns, len(self.panels)))

    @property
    def width_rem(self) -> float:
        """The width of a column, rem, on a page that is wide enough."""
        return 27.0 if self.drawing is None else 7.4 * float(self.drawing.get_size_inches()[0])

    def svgs(self, prefix: str = "") -> list[str]:
        """Return the drawings for a page as <svg> elements; prefix: of their ids."""
        name = prefix + self.name
        if self.drawing is not None:
            return [inline_svg(self.drawing, name, self.title)]
        return [
            inline_svg(draw_panel(panel, legend=i == 0), f"{name}-{i}", panel.title)
            for i, panel in enumerate(self.panels)
        ]


def thin(x: Array, *ys: Array) -> tuple[Array, ...]:
    """Thin columns (n,) to at most 800 rows, which include the extremes of the first of `ys`."""
    if len(x) <= _MOST_POINTS:
        return (x, *ys)
    low, high = (np.where(np.isfinite(ys[0]), ys[0], other) for other in (np.inf, -np.inf))
    stretches = np.array_split(np.arange(len(x)), _MOST_POINTS // 2)
    rows = np.unique([(r[np.argmin(low[r])], r[np.argmax(high[r])]) for r in stretches])
    return tuple(column[rows] for column in (x, *ys))


@contextmanager
def drawing_style() -> Iterator[None]:
    """Set the common style of all drawings while one is made.

    Raises DriverMissing if matplotlib is not installed.
    """
    try:
        import matplotlib as mpl
    except ImportError:
        raise DriverMissing(
            "a drawing needs matplotlib: pip install 'thermocald[report]'"
        ) from None
    settings: Any = _STYLE
    with mpl.rc_context(settings), warnings.catch_warnings():
        # the browser has the glyphs that this font lacks
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        warnings.filterwarnings("ignore", message="Matplotlib currently does not support")
        yield


@contextmanager
def new_drawing(
    width: float, height: float, layout: Literal["constrained"] | None = "constrained"
) -> Iterator[Any]:
    """Yield an empty drawing, width × height inches, and set its style while it is made."""
    with drawing_style():
        # not with pyplot: no global state, no window, nothing to close
        from matplotlib.figure import Figure as Canvas

        class Shown(Canvas):
            """A drawing that a notebook shows without `%matplotlib`."""

            def _repr_svg_(self) -> str:
                return inline_svg(self, "drawing", "drawing")

        yield Shown(figsize=(width, height), layout=layout)


def inline_svg(drawing: Any, prefix: str, label: str) -> str:
    """Return a drawing as an <svg> element; prefix: makes its ids unique on a page."""
    buffer = io.StringIO()
    with drawing_style():
        drawing.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'font-family: [^;"]*', "font-family: sans-serif", text)
    text = re.sub(r">\s+<", "><", text)
    text = re.sub(r'\b(id="|url\(#|href="#)', rf"\g<1>{prefix}-", text)
    # numbers to 0.01 pt, a tag on one line
    text = re.sub(
        r"<[^>]*>", lambda tag: re.sub(r"(\.\d\d)\d+", r"\1", re.sub(r"\s+", " ", tag[0])), text
    )
    # the page sets the width, and the height follows from the viewBox
    head, rest = text.split(">", 1)
    head = re.sub(r'\s(width|height)="[^"]*"', "", head)
    return f'{head} role="img" aria-label="{escape(label)}"{_scales(drawing)}>{rest}'


def _scales(drawing: Any) -> str:
    """Return what the page's script needs to read values off: an axis's corners in pt and data."""
    if len(drawing.axes) != 1 or drawing.axes[0].get_yscale() != "linear":
        return ""
    axis = drawing.axes[0]
    if not (axis.xaxis.label.get_text() and axis.yaxis.label.get_text()):
        return ""
    width, height = 72 * drawing.get_size_inches()
    box = axis.get_position()
    corners = (box.x0 * width, box.x1 * width, (1 - box.y0) * height, (1 - box.y1) * height)
    numbers = [f"{v:.6g}" for v in (*corners, *axis.get_xlim(), *axis.get_ylim())]
    return f' data-scales="{" ".join(numbers)}"'


def save(drawing: Any, folder: Path, name: str) -> list[Path]:
    """Write a drawing as <name>.svg and <name>.png (200 dpi); return the files."""
    paths = [folder / f"{name}.svg", folder / f"{name}.png"]
    svg: dict[str, Any] = {"metadata": {"Date": None, "Creator": "thermocald"}}
    for path, settings in zip(paths, (svg, {"dpi": 200}), strict=True):
        with drawing_style(), new_file(path) as partial:
            drawing.savefig(partial, format=path.suffix[1:], **settings)
    return paths


def draw_panel(panel: Panel, *, legend: bool = True) -> Any:
    """Draw a panel alone."""
    # fixed margins fit the short labels; fitting them exactly triples the time of a report
    with new_drawing(*_PANEL_INCHES, None) as drawing:
        axis = drawing.subplots()
        rows = _fill(axis, panel, legend=legend)
        drawing.subplots_adjust(right=0.95, bottom=0.19, top=0.89 - 0.055 * rows)
        # after the height is set, as the number of ticks and of their digits depends on it
        low, high = sorted(axis.get_ylim())
        ticks = [tick for tick in axis.get_yticks() if low <= tick <= high]
        labels = axis.yaxis.get_major_formatter().format_ticks(ticks)
        longest = max(map(len, labels), default=0)
        drawing.subplots_adjust(left=min(0.36, 0.155 + 0.0185 * longest))
        return drawing


def draw_figure(figure: Figure) -> Drawing:
    """Draw all panels of a figure in one drawing, for a paper."""
    if figure.drawing is not None:
        return cast("Drawing", figure.drawing)
    columns = figure.in_a_row
    rows = -(-len(figure.panels) // columns)
    with new_drawing(_PANEL_INCHES[0] * columns, _PANEL_INCHES[1] * rows) as drawing:
        axes = np.atleast_1d(drawing.subplots(rows, columns)).ravel()
        for i, axis in enumerate(axes):
            if i < len(figure.panels):
                _fill(axis, figure.panels[i], legend=i == 0)
            else:
                axis.set_axis_off()
        return cast("Drawing", drawing)


def _fill(axis: Any, panel: Panel, *, legend: bool) -> int:
    """Draw a panel; return the number of rows of its legend, which is above the panel."""
    for curve in panel.curves:
        _draw_curve(axis, curve)
    if panel.arrows is not None:
        draw_arrows(axis, panel.arrows)
    for y, label in panel.horizontal:
        axis.axhline(y, color=GREY, linestyle="--", linewidth=0.9)
        if label:
            axis.annotate(
                label, (0.99, y), xycoords=("axes fraction", "data"), ha="right", va="bottom",
                fontsize=7, color=GREY,
            )  # fmt: skip
    if panel.log_y:
        use_logarithm(axis)
    if panel.equal:
        axis.set_aspect("equal", adjustable="datalim")
        axis.locator_params(nbins=5)  # the axis is narrow: more labels would touch
    if panel.y_down:
        axis.invert_yaxis()
    label_axes(axis, panel.x_label, panel.y_label)
    names = {c.name for c in panel.curves if c.name}
    rows = legend_above(axis) if legend and len(names) > 1 else 0
    most = 28 if panel.arrows is None else 18  # letters, beside the scale arrow
    axis.set_title(shortened(panel.title, most), loc="left", pad=6 + 10 * rows)
    return rows


def label_axes(axis: Any, x: str = "", y: str = "") -> None:
    """Label both axes and write their ticks without a common offset or power of ten."""
    if x:
        axis.set_xlabel(shortened(x, 48))
    if y:
        axis.set_ylabel(shortened(y, 36))
    for one, limits in ((axis.xaxis, axis.get_xlim()), (axis.yaxis, axis.get_ylim())):
        if one.get_scale() == "linear" and not 1e-3 <= max(map(abs, limits)) < 1e5:
            one.set_major_formatter(lambda value, _: tick_text(value))


def tick_text(value: float) -> str:
    """Write a tick's value: `20`, `0.001`, `2·10⁵`, with a power of ten only if it needs one."""
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        return f"{value:.7g}".replace("-", "−")
    mantissa, _, exponent = f"{value:.4e}".partition("e")
    shown = f"{float(mantissa):g}"
    power = f"10{superscript(int(exponent))}"
    return (power if shown == "1" else f"{shown}·{power}").replace("-", "−")


def use_logarithm(axis: Any) -> None:
    """Make the y axis logarithmic with full tick labels, unless the data span few decades."""
    from matplotlib.ticker import LogLocator, NullFormatter

    low, high = axis.get_ylim()
    drawn = [np.asarray(line.get_ydata(), dtype=float) for line in axis.get_lines()]
    low = min((float(y[np.isfinite(y)].min()) for y in drawn if np.isfinite(y).any()), default=low)
    if low <= 0 or np.log10(high / low) < _DECADES:
        return
    axis.set_yscale("log")
    axis.yaxis.set_major_locator(LogLocator(numticks=6))
    axis.yaxis.set_major_formatter(lambda value, _: tick_text(value))
    axis.yaxis.set_minor_formatter(NullFormatter())


def legend_above(axis: Any) -> int:
    """Put the legend above the axes, clear of the data; return its number of rows."""
    handles, names = axis.get_legend_handles_labels()
    handle_of = dict(zip(names, handles, strict=True))
    short = distinct_names(list(handle_of), 18)
    columns = max(1, int(_LEGEND_LETTERS / (max(map(len, short)) + _KEY_LETTERS)))
    rows = -(-len(short) // columns)
    axis.legend(
        list(handle_of.values()), short, loc="lower left", bbox_to_anchor=(0.0, 1.0),
        ncols=-(-len(short) // rows),
        handlelength=1.2, columnspacing=1.0, labelspacing=0.2, borderaxespad=0.1, borderpad=0.2,
    )  # fmt: skip
    return rows


def _draw_curve(axis: Any, curve: Curve) -> None:
    label = curve.name or None
    if curve.kind == "points" or len(curve.x) == 1:
        # very short strokes with round caps take a tenth of the bytes of markers; in a PNG those
        # that are, or snap to, length zero are dropped
        known = curve.x[np.isfinite(curve.x)]
        short = 1e-7 * float(np.ptp(known)) if len(known) > 1 else 0.0
        ends = curve.x + (short or 1e-9)
        x = np.column_stack([curve.x, ends, np.full(len(curve.x), np.nan)]).ravel()
        y = np.column_stack([curve.y, curve.y, np.full(len(curve.y), np.nan)]).ravel()
        cap: Any = "projecting" if curve.dashed else "round"
        axis.plot(x, y, color=curve.colour, lw=2.2, solid_capstyle=cap, label=label, snap=False)
        return
    style = "--" if curve.dashed else "-"
    axis.plot(curve.x, curve.y, style, color=curve.colour, linewidth=1.1, label=label)
    if curve.half is not None:
        lower, upper = curve.y - curve.half, curve.y + curve.half
        axis.fill_between(curve.x, lower, upper, color=curve.colour, alpha=0.2, linewidth=0)


def draw_arrows(axis: Any, arrows: Arrows) -> None:
    """Draw vectors in their frame, y down, with a scale arrow above it."""
    width, height = arrows.frame
    lengths = np.linalg.norm(arrows.vectors, axis=1)
    shown = arrows.longest or max(float(np.nanmax(lengths, initial=0.0)), 1e-9)
    share = 0.2 if len(arrows.points) <= _FEW_ARROWS else 0.1
    scale = shown / (share * width)
    axis.plot([0, width, width, 0, 0], [0, 0, height, height, 0], color=PALE, linewidth=0.8)
    quiver = axis.quiver(
        *arrows.points.T, *arrows.vectors.T, angles="xy", scale_units="xy", scale=scale,
        color=arrows.colour, width=0.006, headwidth=4, minlength=0,
    )  # fmt: skip
    # the next lower 1, 2, 5 times a power of ten
    power = 10.0 ** np.floor(np.log10(shown))
    reference = float(max(m for m in (1.0, 2.0, 5.0) if m * power <= shown * 1.0000001) * power)
    axis.quiverkey(
        quiver, 0.9, 1.05, reference, f"{tick_text(reference)} px", labelpos="W",
        coordinates="axes", color="black", fontproperties={"size": 8},
    )  # fmt: skip
    # the limits include the tips, except those of gross errors
    tips = np.nan_to_num(arrows.points + arrows.vectors / scale)
    low = np.clip(tips.min(axis=0, initial=0.0), -0.3 * width, 0.0) - 0.03 * width
    high = np.clip(
        tips.max(axis=0, initial=0.0), (width, height), (1.3 * width, height + 0.3 * width)
    )
    axis.set_xlim(low[0], high[0] + 0.03 * width)
    axis.set_ylim(high[1] + 0.03 * width, low[1])
    axis.set_aspect("equal")
    axis.locator_params(nbins=6)
    axis.grid(visible=False)


def draw_matrix(matrix: Array, names: Sequence[str], title: str) -> Any:
    """Draw correlation coefficients (n, n) as coloured cells with numbers; NaN is grey."""
    n = len(names)
    short = distinct_names(names, _MATRIX_LETTERS)
    size = 1.3 + 0.31 * n
    with new_drawing(size, size + 0.3) as drawing:
        axis = drawing.subplots()
        axis.set_facecolor("#dddddd")
        # not an image, since cells of an SVG stay sharp and can be edited
        axis.pcolormesh(
            np.ma.masked_invalid(matrix), cmap="RdBu_r", vmin=-1, vmax=1, edgecolors="white"
        )
        for (row, column), r in np.ndenumerate(matrix):
            if np.isfinite(r):
                shade = "white" if abs(r) > 0.6 else "black"
                axis.text(
                    column + 0.5, row + 0.5, coefficient(r).replace("0.", "."), ha="center",
                    va="center", fontsize=7, color=shade,
                )  # fmt: skip
        axis.set_xticks(np.arange(n) + 0.5, short, rotation=60, ha="right")
        axis.set_yticks(np.arange(n) + 0.5, short)
        axis.invert_yaxis()
        axis.set_aspect("equal")
        axis.grid(visible=False)
        axis.tick_params(length=0)
        drawing.suptitle(
            shortened(title, int(_TITLE_LETTERS * size)), x=0.01, ha="left", size=10, weight="bold"
        )
        return drawing
