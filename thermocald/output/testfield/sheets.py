"""A printed test field: targets on sheets, sheets in space, boards of others, and their files.

A sheet is a square grid of coded targets with a plain circle in the middle of each mesh; markers of
OpenCV's dictionaries may replace some of the coded targets. Sheet coordinates are mm from the lower
left corner of the trimmed sheet, x right, y up, as a viewer sees it.

Three sheets form a corner: the floor (XY, seen from +Z), the left wall (XZ, seen from +Y) and the
right wall (YZ, seen from +X); left and right as seen when looking into the corner with Z up.
Trimmed edges meet at the axes; the floor is cut to a square if it would extend beyond the walls.

The field of another program's board (ChArUco, chessboard, Kalibr's AprilGrid) is that of
`targets.boards`, which `testfield import` writes too; the drawing follows OpenCV and Kalibr.
"""

from __future__ import annotations

import importlib
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import count, product
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from thermocald.errors import UsageError
from thermocald.figures import drawing_style
from thermocald.files import new_file
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.targets import ring_code
from thermocald.photogrammetry.targets.boards import Board as Board  # noqa: TC001  # for commands
from thermocald.photogrammetry.targets.markers import dictionary, marker_cells, marker_size
from thermocald.store.recording.testfield_file import testfield_csv

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path
    from types import ModuleType

    from numpy.typing import NDArray

    from thermocald.arrays import Array

    Marker: TypeAlias = tuple[str, tuple[float, float], float, NDArray[np.bool_]]
    """Name, centre and side mm, and cells (n, n): True where black, the first row on top."""

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
"""Side of a marker in radii of a disc; its surround then still fits into the pitch."""
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
    def scale_bar(self) -> dict[str, Any] | None:
        """The two coded circles to measure between, the ends of the lowest row, and their distance.

        sheet: its title; a, b: their names; nominal: the distance, mm.
        """
        circles = np.flatnonzero(self.field.circles).tolist()
        coded = [i for i in circles if self.field.codes[i]] or circles
        if len(coded) < 2:
            return None
        x, y, _ = self.field.points.T
        upwards = sorted(coded, key=lambda i: (y[i], x[i]))
        lowest = [i for i in upwards if y[i] == y[upwards[0]]]
        ends = [upwards[0], lowest[-1] if len(lowest) > 1 else upwards[-1]]
        length = float(np.linalg.norm(np.subtract(*self.field.points[ends])))
        a, b = (self.field.names[row] for row in ends)
        return {"sheet": self.title, "a": a, "b": b, "nominal": length}


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
                if design.light:  # with its white surround, which would reach the plain circles
                    h /= 1 + 2 / marker_size(code.partition(":")[0])
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
            f"leave room for {counts[0]} × {counts[1]} targets; use "
            f"{'smaller discs' if design.pitch is None else 'a smaller pitch'} or larger paper"
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
            + ("a smaller --first-code, " if design.first_code else "")
            + "larger discs, smaller paper, or markers in between"
        )


def _marker_codes(design: Design) -> Iterator[str]:
    name = design.dictionary
    if name is not None:
        available = len(dictionary(name).bytesList)
        yield from (f"{name}:{i}" for i in range(available))
        raise UsageError(f"the field needs more than the {available} markers of {name}")


def field_of(sheets: Sequence[Sheet]) -> TestField:
    """Return the sheets' nominal test field with the standard deviations of an unsurveyed print."""
    points, sigmas = [], []
    mount = _SIGMA_MOUNT if len(sheets) > 1 else 0.0
    # of floor, left and right wall: the origin, mm, and the directions of x and y in space (2, 3)
    placements = (
        (np.zeros(3), np.eye(3)[:2]),
        (np.array([sheets[0].size[0], 0.0, 0.0]), np.array([[-1.0, 0, 0], [0, 0, 1.0]])),
        (np.zeros(3), np.eye(3)[1:]),
    )
    for sheet, (origin, axes) in zip(sheets, placements, strict=False):
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


def markers_of(field: TestField, border: int = 1) -> Iterator[Marker]:
    """Yield the markers of a flat field; border: width of the black border in cells."""
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


_APRIL_BORDER = 2
_MARKER_SHARE = 0.75  # side of a ChArUco marker over its square's, if no size is given
_QUIET = 0.5  # white margin of a board over a square's side


def filled(board: Board, page: tuple[float, float]) -> Board:
    """Return a board with the largest sizes that fit on a page (mm) in place of zeros."""
    side = board.marker if board.has_tags else board.square
    if side == 0:
        unit = _extent(replace(board, square=1.0, marker=1.0))
        side = min(room / one for room, one in zip(_room(page), unit, strict=True))
        side = float(np.floor(side) if side >= 5 else np.floor(10 * side) / 10)
        if side <= 0:
            raise UsageError(f"{board.name} does not fit on {page[0]:g} × {page[1]:g} mm")
    if board.has_tags:
        return replace(board, marker=side)
    return replace(board, square=side, marker=board.marker or round(_MARKER_SHARE * side, 1))


def _extent(board: Board) -> tuple[float, float]:
    """Return the width and height of a board with its white margin, mm."""
    (width, height), side = board.black, board.lattice[3]
    quiet = 2 * (side if board.has_tags else _QUIET * side)
    return width + quiet, height + quiet


def _room(page: tuple[float, float]) -> tuple[float, float]:
    """Return the room on a page (mm) beside the strips with the rulers."""
    return page[0] - 2 * TRIM - STRIP, page[1] - 2 * TRIM - STRIP


ONE_PLANE = (
    "one flat sheet calibrates a camera from photographs in several poses (thermocald calibrate), "
    "but not a fixed camera: for a series print the corner, or mount two or three sheets at an "
    "angle and survey them"
)


@dataclass(frozen=True, slots=True)
class Printed:
    """A printed test field: the files, sheets (none for a board), nominal field, and board.

    page: width, height mm.
    """

    folder: Path
    files: tuple[Path, ...]
    sheets: tuple[Sheet, ...]
    field: TestField
    page: tuple[float, float]
    board: Board | None = None

    @property
    def is_flat(self) -> bool:
        """Whether the test field is a single sheet."""
        return len(self.sheets) <= 1

    def as_dict(self) -> dict[str, Any]:
        """Return the document that `testfield print` writes with `--json`."""
        document: dict[str, Any] = {
            "format": "thermocald-testfield-print/1",
            "files": [str(path) for path in self.files],
            "sheets": len(self.sheets) or 1,
            "targets": len(self.field),
        }
        if (board := self.board) is not None:
            sizes = {"square": board.square, "marker": board.marker}
            return document | {"board": board.kind, **sizes}
        corners = self.field.kinds.count("marker_corner")
        plain = self.field.codes.count("")
        return document | {
            "diameter": self.sheets[0].design.diameter,
            "coded": len(self.field) - corners - plain,
            "plain": plain,
            "markers": corners // 4,
            "scale_bars": [sheet.scale_bar for sheet in self.sheets if sheet.scale_bar],
        }

    def lines(self) -> list[str]:
        """Return the lines that `testfield print` prints."""
        size = f"{self.page[0]:g} × {self.page[1]:g} mm"
        if self.board is not None:
            board = f"{self.board.name} ({self.board.measures})"
            return [f"{self.folder}: {board} on {size}, {len(self.field)} targets"]
        found = self.as_dict()
        sheets = "1 sheet" if self.is_flat else "3 sheets of a corner (and how to mount it)"
        return [
            (
                f"{self.folder}: {sheets} of {size}, {found['coded']} coded and {found['plain']} "
                f"plain circles of {found['diameter']:g} mm, {found['markers']} markers"
            ),
            *(
                (
                    f"  {bar['sheet']}: measure {bar['a']} to {bar['b']} (nominal "
                    f"{bar['nominal']:.2f} mm) for --scale {bar['a']} {bar['b']} MM"
                )
                for bar in found["scale_bars"]
            ),
        ]


def default_diameter(page: tuple[float, float]) -> float:
    """Return a disc diameter, mm, that puts about a hundred targets on a page of this size (mm)."""
    return max(3.0, round(min(page) / 34))


def print_testfield(design: Design, folder: Path, *, replace_printed: bool = False) -> Printed:
    """Write `testfield.pdf`, one SVG per sheet, and `testfield.csv` into a folder.

    Either all files are written or none. Raises UsageError if the folder holds a `testfield.csv`
    already, because a mounted field would lose its coordinates; `replace_printed` replaces it.
    """
    sheets = lay_out(design)
    field = field_of(sheets)
    drawing = _drawing()
    pages = [drawing.draw(sheet) for sheet in sheets]
    plan = [drawing.draw_plan(sheets)] if len(sheets) == 3 else []
    files = _publish([*pages, *plan], len(sheets), field, folder, replace_printed)
    return Printed(folder, files, sheets, field, design.page)


def print_board(
    board: Board, page: tuple[float, float], folder: Path, *, replace_printed: bool = False
) -> Printed:
    """Write a board's `testfield.pdf`, `testfield.svg` and `testfield.csv`, as `print_testfield`.

    page: width, height mm. Raises UsageError if the board does not fit on it.
    """
    field = board.field()
    (width, height), room = _extent(board), _room(page)
    if width > room[0] + 1e-6 or height > room[1] + 1e-6:
        raise UsageError(
            f"{board.name} ({board.measures}) needs {width:.0f} × {height:.0f} mm with its white "
            f"margin; {page[0]:g} × {page[1]:g} mm paper has room for {room[0]:.0f} × "
            f"{room[1]:.0f}; use smaller squares or larger paper"
        )
    # where the origin is on the page if the board is in its middle
    low = board.lattice[3] if board.has_tags else 0.0
    origin = [STRIP + (r - b) / 2 + low for r, b in zip(room, board.black, strict=True)]
    markers = markers_of(field, _APRIL_BORDER if board.has_tags else 1)
    drawn = _drawing().draw_board(board, page, origin, markers)
    files = _publish([drawn], 1, field, folder, replace_printed)
    return Printed(folder, files, (), field, page, board)


def _drawing() -> ModuleType:
    """Return the drawing module; DriverMissing, with the command to run, without matplotlib."""
    with drawing_style():
        return importlib.import_module("thermocald.output.testfield.drawing")


def _publish(
    pages: Sequence[Any], sheets: int, field: TestField, folder: Path, replace_printed: bool
) -> tuple[Path, ...]:
    """Write all pages to one PDF, the first `sheets` of them as SVG, and the field; return all."""
    if not replace_printed and (folder / "testfield.csv").exists():
        raise UsageError(
            f"{folder}: holds a printed test field already, whose coordinates would be lost; give "
            "another folder with --out, or --force to replace it"
        )
    drawings = (
        ["testfield.svg"] if sheets == 1 else [f"testfield-{i + 1}.svg" for i in range(sheets)]
    )
    names = ["testfield.pdf", *drawings, "testfield.csv"]
    with ExitStack() as opened:
        partial = {name: opened.enter_context(new_file(folder / name)) for name in names}
        _drawing().write(pages, partial["testfield.pdf"], [partial[name] for name in drawings])
        partial["testfield.csv"].write_text(testfield_csv(field), encoding="utf-8")
    return tuple(folder / name for name in names)
