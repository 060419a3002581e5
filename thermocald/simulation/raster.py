"""Exact area coverage: which share of each pixel lies inside polygons.

Every edge is cut at the pixels' borders; a piece inside one pixel adds the area to its right to
the pixel, and its height to all pixels to the right of it, which one running sum along the rows
turns into coverage. Nothing is sampled. Many polygons are done at once, in windows of their own.

Source: the signed-area accumulation of scan converters, e.g. FreeType's smooth rasteriser.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array

    Integers = NDArray[np.int64]

__all__ = ["Windows", "blur", "coverage", "windows_around"]

_WIDTH_STEP = 16


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Windows of one width, stacked below each other.

    members (k,): which shapes; left, top, height (k,) px: where they lie in the image;
    row (k,): the first row of each in the stack; width px; rows: height of the stack.
    """

    members: Integers
    left: Integers
    top: Integers
    height: Integers
    row: Integers
    width: int
    rows: int


def windows_around(low: Array, high: Array, margin: int) -> list[Windows]:
    """Windows around shapes with bounds low, high (n, 2) px, with a margin in px; by width."""
    first = np.floor(low + 0.5).astype(np.int64) - margin
    last = np.floor(high + 0.5).astype(np.int64) + margin + 1
    width = -(-(last[:, 0] - first[:, 0] + 1) // _WIDTH_STEP) * _WIDTH_STEP
    result = []
    for w in np.unique(width):
        members = np.flatnonzero(width == w)
        height = last[members, 1] - first[members, 1] + 1
        row = np.cumsum(height) - height
        result.append(
            Windows(
                members,
                first[members, 0],
                first[members, 1],
                height,
                row,
                int(w),
                int(height.sum()),
            )
        )
    return result


def _cut(a: Array, b: Array, axis: int) -> tuple[Array, Array, Integers, Integers]:
    """Cut edges a → b (n, 2) at whole numbers of one axis: pieces a, b, cell, edge of each."""
    fa = np.floor(a[:, axis]).astype(np.int64)
    fb = np.floor(b[:, axis]).astype(np.int64)
    pieces = np.abs(fb - fa) + 1
    edge = np.repeat(np.arange(len(a)), pieces)
    j = np.arange(len(edge)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    rising = (fb >= fa)[edge]
    cell = np.where(rising, fa[edge] + j, fa[edge] - j)
    begin, end = a[edge], b[edge]
    other = 1 - axis
    delta = end[:, axis] - begin[:, axis]
    slope = (end[:, other] - begin[:, other]) / np.where(delta != 0.0, delta, 1.0)
    inner_begin, inner_end = j > 0, j < pieces[edge] - 1
    line_begin = np.where(rising, cell, cell + 1)
    line_end = np.where(rising, cell + 1, cell)
    start = begin[:, other] + (line_begin - begin[:, axis]) * slope
    stop = begin[:, other] + (line_end - begin[:, axis]) * slope
    new_a, new_b = np.empty_like(begin), np.empty_like(begin)
    new_a[:, axis] = np.where(inner_begin, line_begin, begin[:, axis])
    new_a[:, other] = np.where(inner_begin, start, begin[:, other])
    new_b[:, axis] = np.where(inner_end, line_end, end[:, axis])
    new_b[:, other] = np.where(inner_end, stop, end[:, other])
    return new_a, new_b, cell, edge


def coverage(
    a: Array, b: Array, sign: Array, shape: Integers, windows: Windows
) -> NDArray[np.float32]:
    """Signed coverage (rows, width) of the windows.

    a, b (e, 2) px: the polygons' edges; sign (e,): +1 for polygons that run clockwise in the image
    (y down) and are to be added; shape (e,): the member (place in `windows`) each belongs to.
    """
    # a pixel's cell is [i, i+1) after the shift by half a pixel
    origin = np.stack([windows.left, windows.top - windows.row], axis=1)[shape] - 0.5
    a1, b1, cy, edge1 = _cut(a - origin, b - origin, 1)
    a2, b2, cx, edge2 = _cut(a1, b1, 0)
    dy = (b2[:, 1] - a2[:, 1]) * sign[edge1[edge2]]
    right = 0.5 * (a2[:, 0] + b2[:, 0]) - cx
    # the row is the first cut's: the second one's rounding cannot move it
    cell = cy[edge2] * windows.width + cx
    size = windows.rows * windows.width
    area = (
        np.bincount(cell, dy * (1.0 - right), size)
        + np.bincount(cell + 1, dy * right, size + 1)[:size]
    )
    # each row sums to 0: a running sum over all rows is a running sum over each
    return -np.cumsum(area).reshape(windows.rows, windows.width).astype(np.float32)


def blur(stack: NDArray[np.float32], kernel: Array) -> NDArray[np.float32]:
    """Convolve along both axes with a symmetric kernel (2n+1,); the margins must hold zeros."""
    n = len(kernel) // 2
    for axis in (0, 1):
        k = kernel.astype(np.float32)
        moved = np.moveaxis(stack, axis, 0)
        out = np.multiply(moved, k[n])
        part = np.empty_like(moved)
        for d in range(1, n + 1):
            inner = part[d:-d]
            np.add(moved[2 * d :], moved[: -2 * d], out=inner)
            np.multiply(inner, k[n + d], out=inner)
            np.add(out[d:-d], inner, out=out[d:-d])
        stack = np.moveaxis(out, 0, axis)
    return stack
