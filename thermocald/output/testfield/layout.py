"""The layout of a printed test field: targets on sheets, and sheets in space.

A sheet is a square grid of coded targets with a plain circle in the middle of each mesh; markers of
OpenCV's dictionaries may replace some of the coded targets. Sheet coordinates are mm from the lower
left corner of the trimmed sheet, x right, y up, as a viewer sees it.

Three sheets form a corner: the floor (XY, seen from +Z), the left wall (XZ, seen from +Y) and the
right wall (YZ, seen from +X); left and right as seen when looking into the corner with Z up.
Trimmed edges meet at the axes; the floor is cut to a square if it would extend beyond the walls.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count, product
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import UsageError
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.markers import (
    dictionary,
    marker_cells,
    marker_dictionaries,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array

PAPERS = {
    "A0": (841.0, 1189.0),
    "A1": (594.0, 841.0),
    "A2": (420.0, 594.0),
    "A3": (297.0, 420.0),
    "A4": (210.0, 297.0),
}
TRIM = 8.0
"""Width of the margin outside the crop marks, mm; most printers leave 5 mm of it white."""
STRIP = 14.0
"""Width of the strips at the left and lower edge that hold the rulers and the legend, mm."""
_PITCH = 8.5
"""Grid pitch in radii of a disc: leaves room for the rings' white surround and a plain circle."""
_MAX_SIDE = 5000.0
_MARKER_EVERY = 5
"""One in this many places of the grid holds a marker."""
_CORNERS = ((-1, 1), (1, 1), (1, -1), (-1, -1))
"""Corners of a marker in OpenCV's order, as signs right and up of its centre."""
_MARKER_SIDE = 6.0
"""Side of a marker in radii of a disc; its white surround then still fits into the pitch."""
# Standard deviations of a print before its survey, mm: the printer's irregularity, its scale error
# (per mm from the sheet's centre), paper that is not flat, sheets that are mounted by hand.
_SIGMA_PRINT, _SIGMA_SCALE, _SIGMA_FLAT, _SIGMA_MOUNT = 0.1, 0.003, 1.0, 3.0


_TITLES = ("1 floor (XY)", "2 left wall (XZ)", "3 right wall (YZ)")
_EDGES = ({"left": "A", "lower": "B"}, {"lower": "B", "right": "C"}, {"lower": "A", "left": "C"})


@dataclass(frozen=True, slots=True)
class Design:
    """The options of a print.

    page: width, height mm; diameter: of the discs, mm; bits: of the ring codes, 12 or 14, 0 for no
    codes, None for the fewest that suffice; plain: whether there are plain circles in between;
    dictionary: of markers at every fifth place; light: white targets on black; sheets: 1, or the 3
    of a corner; first_code: codes to skip; pitch: of the grid, mm, None for the smallest.
    """

    page: tuple[float, float]
    diameter: float
    bits: int | None = None
    plain: bool = True
    dictionary: str | None = None
    light: bool = False
    sheets: int = 1
    first_code: int = 0
    pitch: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """One sheet: title, design, trimmed size (width, height) mm, and targets: x, y mm, z = 0."""

    title: str
    design: Design
    size: tuple[float, float]
    field: TestField

    @property
    def edges(self) -> dict[str, str]:
        """The letters of the edges that meet another sheet, by side: left, right, lower."""
        return _EDGES[_TITLES.index(self.title)] if self.title in _TITLES else {}

    @property
    def scale_bar(self) -> tuple[int, int] | None:
        """The rows of the two coded circles to measure between, the ends of the lowest row."""
        circles = np.flatnonzero(self.field.circles).tolist()
        coded = [i for i in circles if self.field.codes[i]] or circles
        if len(coded) < 2:
            return None
        x, y, _ = self.field.points.T
        upwards = sorted(coded, key=lambda i: (y[i], x[i]))
        lowest = [i for i in upwards if y[i] == y[upwards[0]]]
        return (upwards[0], lowest[-1]) if len(lowest) > 1 else (upwards[0], upwards[-1])


def paper_size(
    text: str, landscape: bool | None = None, *, usual: bool = False
) -> tuple[float, float]:
    """Return the size in mm of `A3` or `300x400` (width × height, mm); UsageError for others.

    landscape: None for the usual orientation of a named paper, and for that of a size in mm.
    """
    name = text.strip().upper()
    if name in PAPERS:
        w, h = PAPERS[name]
        return (h, w) if (usual if landscape is None else landscape) else (w, h)
    parts = name.replace("×", "X").split("X")
    try:
        w, h = (float(part) for part in parts)
    except ValueError:
        raise UsageError(
            f"paper {text!r}: give one of {', '.join(sorted(PAPERS))}, or WIDTHxHEIGHT in mm"
        ) from None
    if not (60 <= w <= _MAX_SIDE and 60 <= h <= _MAX_SIDE):
        raise UsageError(f"paper {text!r}: both sides must be between 60 and {_MAX_SIDE:.0f} mm")
    return (max(w, h), min(w, h)) if landscape else (w, h)


def lay_out(design: Design) -> tuple[Sheet, ...]:
    """Return the sheets of a design; UsageError if it does not fit, or codes are too few."""
    if design.bits is None:
        try:
            return lay_out(replace(design, bits=12))
        except UsageError:  # if the reason is not the number of codes, this fails too
            return lay_out(replace(design, bits=14))
    _check(design)
    width, height = (side - 2 * TRIM for side in design.page)
    sizes = [(width, height)]
    titles: tuple[str, ...] = ("sheet",)
    if design.sheets == 3:
        titles = _TITLES
        sizes = [(width, min(width, height)), (width, height), (width, height)]
    codes, markers, plain = _codes(design), _marker_codes(design), count(1)
    sheets = []
    for title, size in zip(titles, sizes, strict=True):
        circles: list[tuple[str, float, float, str]] = []
        corners: list[tuple[str, float, float, str]] = []
        x, y = (axis.tolist() for axis in _grid(design, size))
        for (j, v), (i, u) in product(enumerate(y), enumerate(x)):
            if design.dictionary and (i + 2 * j) % _MARKER_EVERY == _MARKER_EVERY // 2:
                code = next(markers)
                name, h = f"M{code.rpartition(':')[2]}", _MARKER_SIDE * design.diameter / 4
                corners += [
                    (f"{name}.{i}", u + h * right, v + h * up, f"{code}:{i}")
                    for i, (right, up) in enumerate(_CORNERS)
                ]
            elif design.bits:
                code = next(codes)
                circles.append((f"R{code.rpartition(':')[2]}", u, v, code))
            else:
                circles.append((f"P{next(plain)}", u, v, ""))
        if design.plain and design.bits:
            half = (x[1] - x[0]) / 2
            for v, u in product(y[:-1], x[:-1]):
                circles.append((f"P{next(plain)}", u + half, v + half, ""))
        names, right, up, written = zip(*circles, *corners, strict=True)
        n, m = len(circles), len(corners)
        field = TestField.build(
            names, np.column_stack([right, up, np.zeros(n + m)]), 0.0,
            [design.diameter] * n + [np.nan] * m, ["circle"] * n + ["marker_corner"] * m, written,
        )  # fmt: skip
        sheets.append(Sheet(title, design, size, field))
    return tuple(sheets)


def _grid(design: Design, size: tuple[float, float]) -> tuple[Array, Array]:
    """Return the coordinates of the columns and rows on a sheet, mm."""
    r = design.diameter / 2
    pitch = design.pitch if design.pitch is not None else _PITCH * r
    reach = 4 * r if design.bits or design.dictionary else 2 * r
    low = STRIP + reach
    counts = [int((side - low - reach) / pitch) + 1 if side > low + reach else 0 for side in size]
    if min(counts) < 2:
        raise UsageError(
            f"discs of {design.diameter:g} mm on {design.page[0]:g} × {design.page[1]:g} mm paper "
            f"leave room for {counts[0]} × {counts[1]} targets; use smaller discs or larger paper"
        )
    x, y = (
        np.asarray(low + (side - low - reach - (n - 1) * pitch) / 2 + pitch * np.arange(n), float)
        for side, n in zip(size, counts, strict=True)
    )
    return x, y


def _check(design: Design) -> None:
    if not 2 <= design.diameter <= 200:
        raise UsageError(f"disc diameter {design.diameter:g} mm: must be between 2 and 200 mm")
    if design.bits not in (0, *ring_code.BITS):
        raise UsageError(f"ring codes of {design.bits} bits: must be 12 or 14, or 0 for no codes")
    if not design.bits and design.dictionary is None:
        raise UsageError(
            "plain circles alone cannot be identified; add ring codes (--bits 12) or markers "
            "(--markers DICT_APRILTAG_36h11)"
        )
    if design.sheets not in (1, 3):
        raise UsageError(f"{design.sheets} sheets: must be one, or the three of a corner")
    least = _PITCH * design.diameter / 2
    if design.pitch is not None and design.pitch < least - 1e-9:
        raise UsageError(
            f"pitch {design.pitch:g} mm: discs of {design.diameter:g} mm need at least {least:g} mm"
        )


def _codes(design: Design) -> Iterator[str]:
    if design.bits:
        available = ring_code.codes(design.bits)
        for number in available[design.first_code :]:
            yield ring_code.write(design.bits, number)
        raise UsageError(
            f"the field needs more than the {len(available[design.first_code :])} ring codes of "
            f"{design.bits} bits that are left; "
            + ("use --bits 14, or " if design.bits == 12 else "use ")
            + "larger discs, smaller paper, or markers in between"
        )


def _marker_codes(design: Design) -> Iterator[str]:
    name = design.dictionary
    if name is not None:
        known = marker_dictionaries()
        if name not in known:
            raise UsageError(f"no marker dictionary {name!r}; there are {', '.join(known)}")
        available = len(dictionary(name).bytesList)
        yield from (f"{name}:{i}" for i in range(available))
        raise UsageError(f"the field needs more than the {available} markers of {name}")


def _placement(sheets: Sequence[Sheet], k: int) -> tuple[Array, Array]:
    """Return a sheet's origin (3,) mm, and the directions of its x and y axes in space (2, 3)."""
    if len(sheets) == 1 or k == 0:
        return np.zeros(3), np.eye(3)[:2]
    if k == 1:
        return np.array([sheets[k].size[0], 0.0, 0.0]), np.array([[-1.0, 0, 0], [0, 0, 1.0]])
    return np.zeros(3), np.eye(3)[1:]


def field_of(sheets: Sequence[Sheet]) -> TestField:
    """Return the sheets' nominal test field with the standard deviations of an unsurveyed print."""
    points, sigmas = [], []
    mount = _SIGMA_MOUNT if len(sheets) > 1 else 0.0
    for k, sheet in enumerate(sheets):
        origin, axes = _placement(sheets, k)
        xy = sheet.field.points[:, :2]
        local = xy - np.asarray(sheet.size) / 2
        in_plane = np.hypot(_SIGMA_PRINT, _SIGMA_SCALE * local) @ np.abs(axes)
        normal = _SIGMA_FLAT * np.abs(np.cross(axes[0], axes[1]))
        points.append(origin + xy @ axes)
        sigmas.append(np.sqrt(in_plane**2 + normal**2 + mount**2))
    flat = [sheet.field for sheet in sheets]
    return TestField.build(
        [name for field in flat for name in field.names], np.concatenate(points),
        np.concatenate(sigmas), np.concatenate([field.diameters for field in flat]),
        [kind for field in flat for kind in field.kinds],
        [code for field in flat for code in field.codes],
    )  # fmt: skip


def markers_of(
    field: TestField, border: int = 1
) -> Iterator[tuple[str, tuple[float, float], float, NDArray[np.bool_]]]:
    """Yield the markers of a flat field: name, centre and side mm, cells (n, n).

    border: width of the black border in cells; a cell is True where black, the first row on top.
    """
    rows = [r for r, kind in enumerate(field.kinds) if kind == "marker_corner"]
    for first in range(0, len(rows), 4):
        quad = field.points[rows[first : first + 4], :2]
        name, number, _ = field.codes[rows[first]].split(":")
        cells = marker_cells(name, int(number), border)
        # corner 0 is at the first cell: turn the cells by multiples of 90° until it is
        x, y = quad.mean(axis=0).tolist()
        turns = {(False, True): 0, (False, False): 1, (True, False): 2, (True, True): 3}
        turned = np.rot90(cells, turns[bool(quad[0, 0] > x), bool(quad[0, 1] > y)])
        yield field.names[rows[first]].rpartition(".")[0], (x, y), float(np.ptp(quad[:, 0])), turned
