"""The pen that test fields and boards are drawn with, in mm, and the marks every sheet has.

Everything is a vector; the sheet's lower left trimmed corner is the origin, x right, y up.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.output.testfield.layout import STRIP, TRIM

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

_MM_PER_INCH = 25.4
_POINTS_PER_MM = 72 / _MM_PER_INCH
_RULER = 100.0
GREY = "0.62"
"""What is read by people only: light enough never to be mistaken for a target."""


class Pen:
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


def rectangle(x: float, y: float, width: float, height: float) -> Any:
    """A rectangle by its lower left corner and its sides, mm."""
    from matplotlib.path import Path as Curve

    x1, y1 = x + width, y + height
    return Curve([(x, y), (x1, y), (x1, y1), (x, y1), (x, y)], closed=True)


def square(x: float, y: float, side: float) -> Any:
    """A square by its centre and side, mm."""
    return rectangle(x - side / 2, y - side / 2, side, side)


def draw_marker(
    pen: Pen, centre: tuple[float, float], side: float, cells: NDArray[np.bool_]
) -> None:
    """A marker with its border: cells (n, n), True where black, the first row on top; mm.

    The white cells are drawn on the black square, each row's runs in one piece. Every run reaches a
    hair into a white row below it, so that no renderer leaves a dark seam.
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


def crop_marks(pen: Pen, size: tuple[float, float]) -> None:
    """Where to cut: short lines outside of the four corners."""
    w, h = size
    for x, sx in ((0.0, -1.0), (w, 1.0)):
        for y, sy in ((0.0, -1.0), (h, 1.0)):
            pen.line([(x + sx * 1, y), (x + sx * (TRIM - 1.5), y)], "black", 0.1)
            pen.line([(x, y + sy * 1), (x, y + sy * (TRIM - 1.5))], "black", 0.1)


def rulers(pen: Pen, size: tuple[float, float]) -> None:
    """A ruler per direction: printers scale the two differently."""
    for along, length in enumerate(size):
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
