"""The plan of a corner: which sheet goes where, how to fix it, what error of its angles is allowed.

The last page of a corner's PDF. The drawing is the corner as somebody sees it who looks into it.
"""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array
    from thermocald.output.testfield.layout import Sheet

ALLOWED_ANGLE_DEG = 0.4
"""A wall that is off by this angle moves its far edge by the 3 mm that testfield.csv allows for."""

_TEXT = f"""
Print all pages at "actual size" on matt paper of at least 160 g/m². Measure both rulers of each
sheet; if they are not 100.0 mm the printer scaled, and the survey will find it.

Cut along the crop marks. Sheet 1 may be smaller than its paper.

Glue each sheet without bubbles to a board that stays flat: aluminium composite, MDF from 8 mm, or
glass. Spray glue is best.

Put the boards up so that edges with the same letter meet: A with A, B with B, C with C. Sheet 1
lies, sheet 2 stands on the left, sheet 3 on the right. Gaps of a few mm do no harm.

Fix every edge with two brackets screwed to both boards, and the whole to something heavy. From the
survey on nothing may move by more than 0.02 mm: do not lift it or lean on it.

Angles: if you survey the corner (you should) they may be off by 5°, since the survey measures them.
If you use testfield.csv as it is, by {ALLOWED_ANGLE_DEG:g}° at most, which is 3 mm at the far edge
of a sheet; c, x0 and y0 are then good to some tens of pixels only.

Matt surroundings and even light: no lamp, window or reflection in the picture.

testfield.csv, written with these pages, belongs to this corner. Next: thermocald testfield survey
photos/ --field testfield.csv --scale …
"""
STEPS = tuple(" ".join(step.split()) for step in _TEXT.strip().split("\n\n"))


def draw_plan(sheets: Sequence[Sheet]) -> Any:
    """The plan as a matplotlib Figure of the sheets' page size."""
    from matplotlib.figure import Figure

    width, height = sheets[0].design.page
    figure = Figure(figsize=(width / 25.4, height / 25.4))
    portrait = height > width
    size = min(width, height) / 297 * 13  # points
    figure.text(0.08, 0.95, "How to put up this corner", fontsize=1.6 * size, va="top")
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
    from matplotlib.patches import Polygon

    axes = figure.add_axes(box)
    axes.set_aspect("equal")
    axes.axis("off")
    floor, left, right = (sheet.size for sheet in sheets)
    x, y, z = np.eye(3)
    outlines = {
        "1": np.array([0 * x, floor[0] * x, floor[0] * x + floor[1] * y, floor[1] * y]),
        "2": np.array([0 * x, left[0] * x, left[0] * x + left[1] * z, left[1] * z]),
        "3": np.array([0 * x, right[0] * y, right[0] * y + right[1] * z, right[1] * z]),
    }
    for (name, outline), grey in zip(outlines.items(), ("0.88", "0.95", "0.92"), strict=True):
        axes.add_patch(Polygon(_seen(outline), facecolor=grey, edgecolor="black", linewidth=1.2))
        middle = _seen(outline).mean(axis=0)
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
    """Places in the drawing (n, 2) of points (n, 3): seen from (1, 1, 0.8), Z up, X to the left."""
    towards = np.array([1.0, 1.0, 0.8])
    towards /= np.linalg.norm(towards)
    right = np.cross([0.0, 0.0, 1.0], towards)
    right /= np.linalg.norm(right)
    placed: Array = points @ np.stack([right, np.cross(towards, right)], axis=1)
    return placed
