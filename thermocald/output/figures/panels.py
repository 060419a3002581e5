"""Panels: small diagrams described once, drawn for print and for looking closer.

A figure is a list of panels. `draw` draws them with matplotlib (SVG, PNG); `document` hands them to
the script in the report. Long curves are thinned to the minimum and maximum of each stretch, so
that no outlier disappears and no file grows with the length of a series.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array

__all__ = ["PALETTE", "Curve", "Figure", "Panel", "document", "thin"]

# Colour-blind safe (Okabe & Ito 2008), dark enough for thin lines on white paper.
PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
_MOST_POINTS = 800
_DIGITS = 5


@dataclass(frozen=True, eq=False)
class Curve:
    """x, y (n,); kind: line, points, or band between `lower` and `upper` (n,) about a line."""

    name: str
    x: Array
    y: Array
    kind: Literal["line", "points", "band"] = "line"
    colour: str = PALETTE[0]
    lower: Array | None = None
    upper: Array | None = None
    dashed: bool = False


@dataclass(frozen=True, eq=False)
class Panel:
    """One diagram; horizontal: (y, label) of dashed lines; equal: same scale on both axes."""

    title: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]
    log_y: bool = False
    equal: bool = False
    horizontal: tuple[tuple[float, str], ...] = ()


@dataclass(frozen=True, eq=False)
class Figure:
    """Panels under one name, which is a file name too; columns: in a drawing for a paper."""

    name: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    columns: int = 3


def thin(x: Array, *ys: Array, most: int = _MOST_POINTS) -> tuple[Array, ...]:
    """Columns (n,) at about `most` rows or fewer, which hold the extremes of the first of `ys`."""
    n = len(x)
    if n <= most:
        return (x, *ys)
    edges = np.linspace(0, n, most // 2 + 1).astype(int)[:-1]
    y = ys[0]
    filled_low = np.where(np.isfinite(y), y, np.inf)
    filled_high = np.where(np.isfinite(y), y, -np.inf)
    rows = np.unique(
        np.concatenate(
            [
                _position(filled_low, np.minimum.reduceat(filled_low, edges), edges),
                _position(filled_high, np.maximum.reduceat(filled_high, edges), edges),
            ]
        )
    )
    return tuple(column[rows] for column in (x, *ys))


def _position(values: Array, extremes: Array, edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """The first row of each stretch that holds its extreme."""
    lengths = np.diff(np.append(edges, len(values)))
    hit = np.flatnonzero(values == np.repeat(extremes, lengths))
    stretch = np.searchsorted(edges, hit, side="right") - 1
    _, first = np.unique(stretch, return_index=True)
    return np.asarray(hit[first])


def document(figure: Figure) -> list[dict[str, Any]]:
    """The panels of a figure as JSON-able data for the report's script."""
    return [
        {
            "title": p.title,
            "x": p.x_label,
            "y": p.y_label,
            "log": p.log_y,
            "equal": p.equal,
            "horizontal": [[_number(y), label] for y, label in p.horizontal],
            "curves": [_curve(c) for c in p.curves],
        }
        for p in figure.panels
    ]


def _curve(curve: Curve) -> dict[str, Any]:
    columns = [curve.x, curve.y]
    if curve.lower is not None and curve.upper is not None:
        columns += [curve.lower, curve.upper]
    names = ("x", "y", "lower", "upper")
    return {
        "name": curve.name,
        "kind": curve.kind,
        "colour": curve.colour,
        "dashed": curve.dashed,
        **{n: [_number(v) for v in c] for n, c in zip(names, columns, strict=False)},
    }


def _number(value: float) -> float | None:
    """Short, and null where JSON has no number."""
    return float(f"{value:.{_DIGITS}g}") if np.isfinite(value) else None
