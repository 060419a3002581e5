"""The drawing of a test field's sheets, in mm: PDF and SVG, all of it vectors.

One list of paths serves both formats; circles are Bézier curves of eight segments, exact to
4·10⁻⁶ of their radius.
"""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.atomic_file import cannot_write
from thermocald.errors import DriverMissing
from thermocald.output.testfield.layout import STRIP, TRIM
from thermocald.output.testfield.plan import draw_plan
from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.dictionary import marker_cells

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.output.testfield.layout import Marker, Sheet, Target

__all__ = ["draw", "write_pdf", "write_svg"]

_MM_PER_INCH = 25.4
_POINTS_PER_MM = 72 / _MM_PER_INCH
_RULER = 100.0
_GREY = "0.62"
_TARGET_NAME = 0.7
"""Height of a target's name in radii of its disc."""


class _Pen:
    """A figure of one page that is drawn on in mm from the lower left trimmed corner."""

    def __init__(self, page: tuple[float, float], light: bool) -> None:
        from matplotlib.figure import Figure
        from matplotlib.transforms import Affine2D

        self.figure = Figure(figsize=(page[0] / _MM_PER_INCH, page[1] / _MM_PER_INCH))
        self.transform = (
            Affine2D().translate(TRIM, TRIM).scale(1 / _MM_PER_INCH) + self.figure.dpi_scale_trans
        )
        self.colour = "white" if light else "black"

    @staticmethod
    def stretch(width: float, height: float) -> Any:
        from matplotlib.transforms import Affine2D

        return Affine2D().scale(width, height)

    def fill(self, path: Any, colour: str) -> None:
        from matplotlib.patches import PathPatch

        self.figure.add_artist(
            PathPatch(path, facecolor=colour, edgecolor="none", transform=self.transform)
        )

    def line(self, points: Sequence[tuple[float, float]], colour: str, width: float = 0.15) -> None:
        from matplotlib.patches import PathPatch
        from matplotlib.path import Path as Curve

        self.figure.add_artist(
            PathPatch(
                Curve(np.asarray(points)), fill=False, edgecolor=colour,
                linewidth=width * _POINTS_PER_MM, transform=self.transform, capstyle="butt",
            )
        )  # fmt: skip

    def text(self, x: float, y: float, words: str, height: float, **style: Any) -> None:
        style = {"color": self.colour, "ha": "left", "va": "baseline", **style}
        self.figure.text(
            x, y, words, transform=self.transform, fontsize=height * _POINTS_PER_MM, **style
        )


def draw(sheet: Sheet) -> Any:
    """The sheet as a matplotlib Figure of the page's size."""
    from matplotlib.path import Path as Curve

    pen = _Pen(sheet.design.page, sheet.design.light)
    if sheet.design.light:
        pen.fill(Curve.unit_rectangle().transformed(pen.stretch(*sheet.size)), "black")
    r = sheet.design.diameter / 2
    for target in sheet.targets:
        pen.fill(_circle(target.x, target.y, r), pen.colour)
        for begin, end in _arcs(target):
            pen.fill(_ring_segment(target, r, begin, end), pen.colour)
        below = (ring_code.RING_OUTER if target.code else 1.0) * r
        _label(pen, target.x, target.y - below, target.name, r)
    for marker in sheet.markers:
        if sheet.design.light:  # a marker is black on white, whatever the circles are
            surround = marker.side * (1 + 2 / len(_marker_bits(marker.code)))
            pen.fill(_square(marker.x, marker.y, surround), "white")
        pen.fill(_square(marker.x, marker.y, marker.side), "black")
        for path in _white_cells(marker):
            pen.fill(path, "white")
        _label(pen, marker.x, marker.y - marker.side / 2, marker.name, r)
    _crop_marks(pen, sheet)
    _rulers(pen, sheet)
    _legend(pen, sheet)
    _edge_letters(pen, sheet)
    return pen.figure


def _edge_letters(pen: _Pen, sheet: Sheet) -> None:
    """At each edge that meets another sheet's the letter that both have."""
    (w, h), size = sheet.size, 3.0
    places = {
        "left": (1.5, 0.75 * h),
        "right": (w - 1.5 - size, 0.75 * h),
        "lower": (0.75 * w, 1.5),
    }
    for side, letter in sheet.edges.items():
        pen.text(*places[side], letter, size, color=_GREY)


def _label(pen: _Pen, x: float, below: float, name: str, r: float) -> None:
    """A target's name, grey and small enough never to look like a target."""
    height = min(_TARGET_NAME * r, 3.0)
    pen.text(x, below - 0.35 * r - height, name, height, ha="center", color=_GREY)


def _circle(x: float, y: float, r: float) -> Any:
    from matplotlib.path import Path as Curve

    return Curve.circle((x, y), r)


def _arcs(target: Target) -> tuple[tuple[float, float], ...]:
    return ring_code.segments(*ring_code.parse(target.code)) if target.code else ()


def _ring_segment(target: Target, r: float, begin: float, end: float) -> Any:
    """An arc of the ring; codes run clockwise as seen, the sheet's y is up: angles are negated."""
    from matplotlib.path import Path as Curve

    arc = Curve.arc(-360 * end, -360 * begin, n=max(2, int(np.ceil(16 * (end - begin)))))
    unit = np.asarray(arc.vertices, dtype=float)
    outer, inner = unit * ring_code.RING_OUTER * r, unit[::-1] * ring_code.RING_INNER * r
    codes = np.concatenate(
        [
            np.asarray(arc.codes),
            [Curve.LINETO],
            np.full(len(inner) - 1, Curve.CURVE4),
            [Curve.CLOSEPOLY],
        ]
    )
    vertices = np.concatenate([outer, inner, outer[:1]]) + np.array([target.x, target.y])
    return Curve(vertices, codes)


def _marker_bits(code: str) -> NDArray[np.bool_]:
    """The cells of a marker, its black border included, True where black; first row on top."""
    name, number = code.split(":")[:2]
    return marker_cells(name, int(number))


def _white_cells(marker: Marker) -> list[Any]:
    """The white cells inside the black square of a marker, each row's runs in one piece.

    Every run reaches a hair into a white row below it, so that no renderer leaves a dark seam.
    """
    from matplotlib.path import Path as Curve

    white = ~_marker_bits(marker.code)
    n = len(white)
    cell = marker.side / n
    left, top = marker.x - marker.side / 2, marker.y + marker.side / 2
    paths = []
    for j, row in enumerate(white):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        for a, b in edges.reshape(-1, 2):
            seam = 0.02 * cell if j + 1 < n and white[j + 1, a:b].all() else 0.0
            low, high = top - (j + 1) * cell - seam, top - j * cell
            x0, x1 = left + a * cell, left + b * cell
            paths.append(
                Curve([(x0, low), (x1, low), (x1, high), (x0, high), (x0, low)], closed=True)
            )
    return paths


def _square(x: float, y: float, side: float) -> Any:
    from matplotlib.path import Path as Curve

    h = side / 2
    corners = np.array([(-h, -h), (h, -h), (h, h), (-h, h), (-h, -h)]) + np.array([x, y])
    return Curve(corners, closed=True)


def _crop_marks(pen: _Pen, sheet: Sheet) -> None:
    w, h = sheet.size
    for x, sx in ((0.0, -1.0), (w, 1.0)):
        for y, sy in ((0.0, -1.0), (h, 1.0)):
            pen.line([(x + sx * 1, y), (x + sx * (TRIM - 1.5), y)], "black", 0.1)
            pen.line([(x, y + sy * 1), (x, y + sy * (TRIM - 1.5))], "black", 0.1)


def _rulers(pen: _Pen, sheet: Sheet) -> None:
    """A ruler per direction: printers scale the two differently."""
    for along, length in enumerate(sheet.size):
        total = min(_RULER, 10 * int((length - STRIP - 10) / 10))

        def at(s: float, t: float, along: int = along) -> tuple[float, float]:
            return (STRIP + s, t) if along == 0 else (t, STRIP + s)

        pen.line([at(0, 4), at(total, 4)], pen.colour, 0.1)
        for mm in range(int(total) + 1):
            tick = 3.0 if mm % 10 == 0 else 2.0 if mm % 5 == 0 else 1.2
            pen.line([at(mm, 4), at(mm, 4 + tick)], pen.colour, 0.1)
        words = f"0 to {total:g} mm: measure it; if it is not {total:g}.0 mm, the printer scaled"
        x, y = at(0, 1.2)
        if along == 0:
            pen.text(x, y, words, 1.9)
        else:
            pen.text(y=y, x=x + 1.9, words=words, height=1.9, rotation=90, ha="right", va="bottom")


def _legend(pen: _Pen, sheet: Sheet) -> None:
    bar = sheet.scale_bar
    words = f"{sheet.title}, discs {sheet.design.diameter:g} mm"
    if bar is not None:
        a, b = bar
        distance = float(np.hypot(b.x - a.x, b.y - a.y))
        words += f"; scale {a.name}–{b.name}: nominal {distance:.2f} mm, measured ________ mm"
        if a.y == b.y:
            y = STRIP - 1.0
            for x in (a.x, b.x):
                pen.line([(x, y - 1.2), (x, y + 1.2)], pen.colour, 0.1)
            pen.line([(a.x, y), (b.x, y)], _GREY, 0.1)
    pen.text(STRIP, STRIP - 4.6, words, 2.1)


def write_pdf(sheets: Sequence[Sheet], path: Path) -> None:
    """All sheets as the pages of one PDF; a corner's have the plan to put it up as the last one."""
    _require_matplotlib()
    from matplotlib import rc_context
    from matplotlib.backends.backend_pdf import PdfPages

    about = {"Title": "thermocald test field", "Creator": "thermocald", "CreationDate": None}
    try:
        with rc_context({"pdf.fonttype": 42}), PdfPages(path, metadata=about) as pages:
            for sheet in sheets:
                pages.savefig(draw(sheet))
            if len(sheets) == 3:
                pages.savefig(draw_plan(sheets))
    except OSError as cause:
        raise cannot_write(path, cause) from cause


def write_svg(sheet: Sheet, path: Path) -> None:
    """One sheet as SVG."""
    _require_matplotlib()
    from matplotlib import rc_context

    about = {"Title": "thermocald test field", "Creator": "thermocald", "Date": None}
    try:
        with rc_context({"svg.hashsalt": "thermocald"}):
            draw(sheet).savefig(path, format="svg", metadata=about)
    except OSError as cause:
        raise cannot_write(path, cause) from cause


def _require_matplotlib() -> None:
    if importlib.util.find_spec("matplotlib") is None:
        raise DriverMissing(
            "drawing a test field needs matplotlib: pip install 'thermocald[report]'"
        )
