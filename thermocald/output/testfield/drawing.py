"""The drawing of a test field's sheets, in mm: PDF and SVG, all of it vectors.

One list of paths serves both formats; circles are Bézier curves of eight segments, exact to
4·10⁻⁶ of their radius.
"""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import DriverMissing
from thermocald.files import cannot_write
from thermocald.output.testfield.layout import STRIP
from thermocald.output.testfield.pen import GREY, Pen, crop_marks, draw_marker, rulers, square
from thermocald.output.testfield.plan import draw_plan
from thermocald.photogrammetry.targets import outline, ring_code
from thermocald.photogrammetry.targets.markers import marker_cells

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.output.testfield.layout import Marker, Sheet, Target

_TARGET_NAME = 0.7
"""Height of a target's name in radii of its disc."""


def draw(sheet: Sheet) -> Any:
    """The sheet as a matplotlib Figure of the page's size."""
    from matplotlib.path import Path as Curve

    pen = Pen(sheet.design.page, sheet.design.light)
    if sheet.design.light:
        pen.fill(Curve.unit_rectangle().transformed(pen.stretch(*sheet.size)), "black")
    r = sheet.design.diameter / 2
    for target in sheet.targets:
        pen.fill(_circle(target.x, target.y, r), pen.colour)
        for begin, end in _arcs(target):
            pen.fill(_ring_segment(target, r, begin, end), pen.colour)
        below = (outline.RING_OUTER if target.code else 1.0) * r
        _label(pen, target.x, target.y - below, target.name, r)
    for marker in sheet.markers:
        if sheet.design.light:  # a marker is black on white, whatever the circles are
            surround = marker.side * (1 + 2 / len(_marker_bits(marker)))
            pen.fill(square(marker.x, marker.y, surround), "white")
        draw_marker(pen, (marker.x, marker.y), marker.side, _marker_bits(marker))
        _label(pen, marker.x, marker.y - marker.side / 2, marker.name, r)
    crop_marks(pen, sheet.size)
    rulers(pen, sheet.size)
    _legend(pen, sheet)
    _edge_letters(pen, sheet)
    return pen.figure


def _edge_letters(pen: Pen, sheet: Sheet) -> None:
    """At each edge that meets another sheet's the letter that both have."""
    (w, h), size = sheet.size, 3.0
    places = {
        "left": (1.5, 0.75 * h),
        "right": (w - 1.5 - size, 0.75 * h),
        "lower": (0.75 * w, 1.5),
    }
    for side, letter in sheet.edges.items():
        pen.text(*places[side], letter, size, color=GREY)


def _label(pen: Pen, x: float, below: float, name: str, r: float) -> None:
    """A target's name, grey and small enough never to look like a target."""
    height = min(_TARGET_NAME * r, 3.0)
    pen.text(x, below - 0.35 * r - height, name, height, ha="center", color=GREY)


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
    outer, inner = unit * outline.RING_OUTER * r, unit[::-1] * outline.RING_INNER * r
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


def _marker_bits(marker: Marker) -> NDArray[np.bool_]:
    name, number = marker.code.split(":")[:2]
    return marker_cells(name, int(number))


def _legend(pen: Pen, sheet: Sheet) -> None:
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
            pen.line([(a.x, y), (b.x, y)], GREY, 0.1)
    pen.text(STRIP, STRIP - 4.6, words, 2.1)


def pages_of(sheets: Sequence[Sheet]) -> list[Any]:
    """The sheets as Figures; those of a corner with the plan to put it up as the last one."""
    require_matplotlib()
    pages = [draw(sheet) for sheet in sheets]
    return [*pages, draw_plan(sheets)] if len(sheets) == 3 else pages


def write_pdf(pages: Sequence[Any], path: Path) -> None:
    """Figures as the pages of one PDF."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_pdf import PdfPages

    about = {"Title": "thermocald test field", "Creator": "thermocald", "CreationDate": None}
    try:
        with rc_context({"pdf.fonttype": 42}), PdfPages(path, metadata=about) as document:
            for page in pages:
                document.savefig(page)
    except OSError as cause:
        raise cannot_write(path, cause) from cause


def write_svg(page: Any, path: Path) -> None:
    """One Figure as SVG."""
    from matplotlib import rc_context

    about = {"Title": "thermocald test field", "Creator": "thermocald", "Date": None}
    try:
        with rc_context({"svg.hashsalt": "thermocald"}):
            page.savefig(path, format="svg", metadata=about)
    except OSError as cause:
        raise cannot_write(path, cause) from cause


def require_matplotlib() -> None:
    """DriverMissing, with what mends it, where there is no matplotlib."""
    if importlib.util.find_spec("matplotlib") is None:
        raise DriverMissing(
            "drawing a test field needs matplotlib: pip install 'thermocald[report]'"
        )
