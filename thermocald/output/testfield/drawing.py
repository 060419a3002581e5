"""Draw a test field's sheets in mm, as PDF and SVG of vectors only; needs matplotlib.

One list of paths serves both formats; circles are Bézier curves of eight segments, exact to
4·10⁻⁶ of their radius. The sheet's lower left trimmed corner is the origin, x right, y up.

The last page of a corner's PDF is its plan: where each sheet goes, how to fix it, and the tolerance
of its angles. It shows the corner as seen when looking into it.
"""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Polygon, Wedge
from matplotlib.path import Path as Curve
from matplotlib.transforms import Affine2D

from thermocald.output.testfield.sheets import STRIP, TRIM, Sheet, markers_of
from thermocald.photogrammetry.targets import outline, ring_code

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.output.testfield.sheets import Marker
    from thermocald.photogrammetry.targets.boards import Board


_MM_PER_INCH = 25.4
_POINTS_PER_MM = 72 / _MM_PER_INCH
_RULER = 100.0
_LEGEND_HEIGHT, _LINE_WIDTH = 2.1, 0.1
GREY = "0.62"
"""The colour of text for people: too light to be mistaken for a target."""


class Pen:
    """A figure of one page, with drawing in mm from the lower left trimmed corner."""

    def __init__(self, page: tuple[float, float], light: bool) -> None:
        self.figure = Figure(figsize=(page[0] / _MM_PER_INCH, page[1] / _MM_PER_INCH))
        self.transform = (
            Affine2D().translate(TRIM, TRIM).scale(1 / _MM_PER_INCH) + self.figure.dpi_scale_trans
        )
        self.colour = "white" if light else "black"

    def fill(self, path: Any, colour: str) -> None:
        self.figure.add_artist(
            PathPatch(path, facecolor=colour, edgecolor="none", transform=self.transform)
        )

    def line(self, points: Sequence[tuple[float, float]], colour: str) -> None:
        self.figure.add_artist(
            PathPatch(
                Curve(np.asarray(points)), fill=False, edgecolor=colour,
                linewidth=_LINE_WIDTH * _POINTS_PER_MM, transform=self.transform, capstyle="butt",
            )
        )  # fmt: skip

    def text(self, x: float, y: float, words: str, height: float, **style: Any) -> None:
        style = {"color": self.colour, "ha": "left", "va": "baseline", **style}
        self.figure.text(
            x, y, words, transform=self.transform, fontsize=height * _POINTS_PER_MM, **style
        )


def rectangle(x: float, y: float, width: float, height: float) -> Any:
    """Return a rectangle from its lower left corner and its sides, mm."""
    x1, y1 = x + width, y + height
    return Curve([(x, y), (x1, y), (x1, y1), (x, y1), (x, y)], closed=True)


def square(x: float, y: float, side: float) -> Any:
    """Return a square from its centre and side, mm."""
    return rectangle(x - side / 2, y - side / 2, side, side)


def draw_marker(
    pen: Pen, centre: tuple[float, float], side: float, cells: NDArray[np.bool_]
) -> None:
    """Draw a marker with its border, mm; cells (n, n): True where black, the first row on top.

    The white cells are drawn on the black square, each run of a row in one piece. A run extends
    slightly into a white row below it, so that no renderer leaves a dark seam.
    """
    pen.fill(square(*centre, side), "black")
    white = ~cells
    n = len(white)
    cell = side / n
    left, top = centre[0] - side / 2, centre[1] + side / 2
    for j, row in enumerate(white):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        for a, b in edges.reshape(-1, 2).tolist():
            seam = 0.02 * cell if j + 1 < n and white[j + 1, a:b].all() else 0.0
            low = top - (j + 1) * cell - seam
            pen.fill(rectangle(left + a * cell, low, (b - a) * cell, cell + seam), "white")


def draw_margins(pen: Pen, size: tuple[float, float]) -> None:
    """Draw the crop marks outside the four corners, and a ruler in each direction, because printers
    scale the two differently.
    """
    w, h = size
    for x, sx in ((0.0, -1.0), (w, 1.0)):
        for y, sy in ((0.0, -1.0), (h, 1.0)):
            pen.line([(x + sx * 1, y), (x + sx * (TRIM - 1.5), y)], "black")
            pen.line([(x, y + sy * 1), (x, y + sy * (TRIM - 1.5))], "black")
    for along, length in enumerate(size):
        total = min(_RULER, 10 * int((length - STRIP - 10) / 10))

        def at(s: float, t: float, along: int = along) -> tuple[float, float]:
            return (STRIP + s, t) if along == 0 else (t, STRIP + s)

        pen.line([at(0, 4), at(total, 4)], pen.colour)
        for mm in range(int(total) + 1):
            tick = 3.0 if mm % 10 == 0 else 2.0 if mm % 5 == 0 else 1.2
            pen.line([at(mm, 4), at(mm, 4 + tick)], pen.colour)
        words = f"0 to {total:g} mm: measure it; if not {total:g}.0 mm, the printer has scaled it"
        x, y = at(0, 1.2)
        if along == 0:
            pen.text(x, y, words, 1.9)
        else:
            pen.text(y=y, x=x + 1.9, words=words, height=1.9, rotation=90, ha="right", va="bottom")


ALLOWED_ANGLE_DEG = 0.4
"""The error of a wall's angle that moves its far edge by 3 mm, the sd in testfield.csv."""

_TEXT = f"""
Print all pages at "actual size" on matt paper of at least 160 g/m². Measure both rulers of each
sheet; if they are not 100.0 mm, the printer has scaled the sheet, which the survey will show.

Cut along the crop marks. Sheet 1 may be smaller than its paper.

Glue each sheet without bubbles to a board that stays flat: aluminium composite, MDF of at least
8 mm, or glass. Spray glue is best.

Mount the boards so that edges with the same letter meet: A with A, B with B, C with C. Sheet 1
lies flat, sheet 2 stands on the left, sheet 3 on the right. Gaps of a few mm do no harm.

Fix every edge with two brackets screwed to both boards, and the corner to something heavy. After
the survey nothing may move by more than 0.02 mm: do not lift the corner or lean on it.

Angles: if you survey the corner (recommended), they may be off by 5°, since the survey measures
them. If you use testfield.csv as it is, they may be off by {ALLOWED_ANGLE_DEG:g}° at most, which is
3 mm at the far edge of a sheet; c, x0 and y0 are then accurate to some tens of pixels only.

Use matt surroundings and even light: no lamp, window or reflection in the image.

testfield.csv, written with these pages, belongs to this corner. Next: thermocald testfield survey
photos/ --field testfield.csv --scale …
"""
STEPS = tuple(" ".join(step.split()) for step in _TEXT.strip().split("\n\n"))


def draw_plan(sheets: Sequence[Sheet]) -> Any:
    """Draw the plan as a matplotlib Figure of the sheets' page size."""
    width, height = sheets[0].design.page
    figure = Figure(figsize=(width / _MM_PER_INCH, height / _MM_PER_INCH))
    portrait = height > width
    size = min(width, height) / 297 * 13  # points
    figure.text(0.08, 0.95, "How to mount this corner", fontsize=1.6 * size, va="top")
    box = (0.08, 0.52, 0.84, 0.38) if portrait else (0.03, 0.1, 0.45, 0.75)
    _draw_corner(figure, box, sheets, size)
    x, y = (0.08, 0.49) if portrait else (0.5, 0.86)
    for number, step in enumerate(STEPS, 1):
        lines = textwrap.wrap(step, 84 if portrait else 62)
        figure.text(x, y, f"{number}", fontsize=size, va="top", weight="bold")
        figure.text(x + 0.03, y, "\n".join(lines), fontsize=size, va="top", linespacing=1.3)
        y -= (1.3 * len(lines) + 0.6) * size / 72 * 25.4 / height
    return figure


def _draw_corner(
    figure: Any, box: tuple[float, float, float, float], sheets: Sequence[Sheet], size: float
) -> None:
    axes = figure.add_axes(box)
    axes.set_aspect("equal")
    axes.axis("off")
    floor, left, right = (sheet.size for sheet in sheets)
    x, y, z = np.eye(3)
    for name, (width, height), u, v, grey in (
        ("1", floor, x, y, "0.88"), ("2", left, x, z, "0.95"), ("3", right, y, z, "0.92"),
    ):  # fmt: skip
        corners = np.array([0 * u, width * u, width * u + height * v, height * v])
        axes.add_patch(Polygon(_seen(corners), facecolor=grey, edgecolor="black", linewidth=1.2))
        middle = _seen(corners).mean(axis=0)
        axes.text(*middle, name, fontsize=3 * size, ha="center", va="center")
    for letter, middle in (
        ("A", 0.5 * floor[1] * y), ("B", 0.5 * floor[0] * x), ("C", 0.5 * left[1] * z),
    ):  # fmt: skip
        axes.text(
            *_seen(middle[None])[0], letter, fontsize=1.5 * size, ha="center", va="center",
            bbox={"facecolor": "white", "edgecolor": "black", "boxstyle": "circle"},
        )  # fmt: skip
    for name, end in (("X", 1.12 * floor[0] * x), ("Y", 1.12 * floor[1] * y),
                      ("Z", 1.06 * left[1] * z)):  # fmt: skip
        axes.annotate(
            name, _seen(end[None])[0], ha="center", va="center", fontsize=size, color="0.35"
        )
    axes.autoscale_view()


def _seen(points: Array) -> Array:
    """Project points (n, 3) into the drawing (n, 2), seen from (1, 1, 0.8), Z up, X to the left."""
    towards = np.array([1.0, 1.0, 0.8])
    towards /= np.linalg.norm(towards)
    right = np.cross([0.0, 0.0, 1.0], towards)
    right /= np.linalg.norm(right)
    return np.asarray(points @ np.stack([right, np.cross(towards, right)], axis=1))


_TARGET_NAME = 0.7
"""Height of a target's name in radii of its disc."""
_EDGE_LETTER = 3.0
"""Height of the letter at an edge, mm."""


def draw(sheet: Sheet) -> Any:
    """Draw a sheet as a matplotlib Figure of the page's size."""
    pen = Pen(sheet.design.page, sheet.design.light)
    if sheet.design.light:
        pen.fill(rectangle(0.0, 0.0, *sheet.size), "black")
    r, field = sheet.design.diameter / 2, sheet.field
    for row in np.flatnonzero(field.circles):
        (x, y, _), code = field.points[row].tolist(), field.codes[row]
        pen.fill(Curve.circle((x, y), r), pen.colour)
        for begin, end in ring_code.segments(*ring_code.parse(code)) if code else ():
            # codes run clockwise but y is up: angles are negated
            angles, width = (-360 * end, -360 * begin), outline.RING_OUTER - outline.RING_INNER
            arc = Wedge((x, y), outline.RING_OUTER * r, *angles, width=width * r)
            pen.fill(arc.get_path(), pen.colour)
        _label(pen, x, y - (outline.RING_OUTER if code else 1.0) * r, field.names[row], r)
    for name, (x, y), side, cells in markers_of(field):
        if sheet.design.light:  # a marker is always black on white
            pen.fill(square(x, y, side * (1 + 2 / len(cells))), "white")
        draw_marker(pen, (x, y), side, cells)
        _label(pen, x, y - side / 2, name, r)
    draw_margins(pen, sheet.size)
    _legend(pen, sheet)
    w, h = sheet.size
    places = {
        "left": (1.5, 0.75 * h),
        "right": (w - 1.5 - _EDGE_LETTER, 0.75 * h),
        "lower": (0.75 * w, 1.5),
    }
    for edge, letter in sheet.edges.items():  # the common letter of two edges that meet
        pen.text(*places[edge], letter, _EDGE_LETTER, color=GREY)
    return pen.figure


def _label(pen: Pen, x: float, below: float, name: str, r: float) -> None:
    """Write a target's name, grey and too small to be mistaken for a target."""
    height = min(_TARGET_NAME * r, 3.0)
    pen.text(x, below - 0.35 * r - height, name, height, ha="center", color=GREY)


def _legend(pen: Pen, sheet: Sheet) -> None:
    bar = sheet.scale_bar
    words = f"{sheet.title}, discs {sheet.design.diameter:g} mm"
    if bar is not None:
        words += "; scale {a}–{b}: nominal {nominal:.2f} mm, measured ________ mm".format(**bar)
        rows = [sheet.field.index[bar[end]] for end in "ab"]
        ends, levels = sheet.field.points[rows, :2].T.tolist()
        if levels[0] == levels[1]:
            y = STRIP - 1.0
            for x in ends:
                pen.line([(x, y - 1.2), (x, y + 1.2)], pen.colour)
            pen.line([(x, y) for x in ends], GREY)
    pen.text(STRIP, STRIP - 4.6, words, _LEGEND_HEIGHT)


def draw_board(
    board: Board, page: tuple[float, float], origin: Sequence[float], markers: Iterable[Marker]
) -> Any:
    """Draw a board with its origin at a place on a page (mm), with rulers and its name."""
    pen = Pen(page, light=False)
    size = (page[0] - 2 * TRIM, page[1] - 2 * TRIM)
    draw_margins(pen, size)
    name = board.name.partition(" ")[2]
    pen.text(STRIP, STRIP - 4.6, f"{name}, {board.measures}", _LEGEND_HEIGHT)
    dx, dy = origin
    for x, y, side in board.squares():
        pen.fill(rectangle(x + dx, y + dy, side, side), "black")
    for _, (x, y), side, cells in markers:
        draw_marker(pen, (x + dx, y + dy), side, cells)
    return pen.figure


def write(pages: Sequence[Any], pdf: Path, svgs: Sequence[Path]) -> None:
    """Write Figures as the pages of one PDF, and the first of them as SVG files."""
    about = {"Title": "thermocald test field", "Creator": "thermocald"}
    with rc_context({"pdf.fonttype": 42, "svg.hashsalt": "thermocald"}):
        with PdfPages(pdf, metadata={**about, "CreationDate": None}) as document:
            for page in pages:
                document.savefig(page)
        for page, path in zip(pages, svgs, strict=False):  # the plan is only in the PDF
            page.savefig(path, format="svg", metadata={**about, "Date": None})
