"""Boards of other programs, drawn: ChArUco, chessboard, Kalibr's AprilGrid.

The field is that of `targets.boards`, the same that `testfield import` writes for a board that was
bought; the drawing follows OpenCV's and Kalibr's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import UsageError
from thermocald.output.testfield.drawing import Pen, crop_marks, draw_marker, rectangle, rulers
from thermocald.output.testfield.layout import STRIP, TRIM
from thermocald.photogrammetry.targets import boards
from thermocald.photogrammetry.targets.markers import marker_cells

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from thermocald.photogrammetry.field.testfield import TestField

KINDS = ("charuco", "chessboard", "aprilgrid")
_APRIL_DICTIONARY = "DICT_APRILTAG_36h11"
_APRIL_BORDER = 2
_MARKER_SHARE = 0.75  # of a ChArUco square, where no size is given
_QUIET = 0.5  # of a square, white about the board
_LEGEND_HEIGHT = 2.1


@dataclass(frozen=True, slots=True)
class Board:
    """A board of columns × rows: squares of a ChArUco board, inner corners of a chessboard, tags.

    square mm: side of a square (not of an AprilGrid); marker mm: side of a marker or tag with its
    black border; spacing: between tags, over their side; dictionary: OpenCV's name, of a ChArUco
    board; legacy: ChArUco as OpenCV drew it before 4.6.
    """

    kind: str
    columns: int
    rows: int
    square: float = 0.0
    marker: float = 0.0
    spacing: float = 0.3
    dictionary: str = "DICT_5X5_1000"
    legacy: bool = False

    def field(self, sigma: float | None = None) -> TestField:
        """The test field, origin at the board's lower left; sigma: mm, None for a print."""
        if self.kind == "charuco":
            return boards.charuco(
                self.columns, self.rows, self.square, self.marker, self.dictionary,
                legacy=self.legacy, sigma=sigma,
            )  # fmt: skip
        if self.kind == "chessboard":
            return boards.chessboard(self.columns, self.rows, self.square, sigma=sigma)
        return boards.aprilgrid(self.columns, self.rows, self.marker, self.spacing, sigma=sigma)

    @property
    def name(self) -> str:
        """What it is, in words."""
        size = f"{self.columns} × {self.rows}"
        if self.kind == "charuco":
            return f"a ChArUco board of {size} squares"
        if self.kind == "chessboard":
            return f"a chessboard of {size} inner corners"
        return f"an AprilGrid of {size} tags"

    @property
    def measures(self) -> str:
        """Its sizes, in words."""
        if self.kind == "charuco":
            return (
                f"squares {self.square:g} mm, markers {self.marker:g} mm of {self.dictionary}"
                + (", as OpenCV drew it before 4.6" if self.legacy else "")
            )
        if self.kind == "chessboard":
            return f"squares {self.square:g} mm"
        return f"tags {self.marker:g} mm, {self.spacing * self.marker:g} mm apart"

    def filled(self, page: tuple[float, float]) -> Board:
        """With the largest sizes that fit on a page (mm) in place of those that are 0."""
        side = self.marker if self.kind == "aprilgrid" else self.square
        if side == 0:
            unit = replace(self, square=1.0, marker=1.0)._extent()
            room = _room(page)
            side = min(room[0] / unit[0], room[1] / unit[1])
            side = np.floor(side) if side >= 5 else np.floor(10 * side) / 10
            if side <= 0:
                raise UsageError(f"{self.name} has no place on {page[0]:g} × {page[1]:g} mm")
        if self.kind == "aprilgrid":
            return replace(self, marker=float(side))
        marker = self.marker or round(_MARKER_SHARE * side, 1)
        return replace(self, square=float(side), marker=marker)

    def check_fits(self, page: tuple[float, float]) -> None:
        """UsageError, with what would fit, where the board is larger than the page (mm)."""
        (w, h), room = self._extent(), _room(page)
        if w > room[0] + 1e-6 or h > room[1] + 1e-6:
            raise UsageError(
                f"{self.name} ({self.measures}) needs {w:.0f} × {h:.0f} mm with its white margin; "
                f"{page[0]:g} × {page[1]:g} mm paper has room for {room[0]:.0f} × {room[1]:.0f}: "
                "take smaller squares, or larger paper"
            )

    def corners(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Lower left and upper right corner of what is black, mm."""
        if self.kind == "aprilgrid":
            gap = self.spacing * self.marker
            step = self.marker + gap
            return (-gap, -gap), (self.columns * step, self.rows * step)
        more = 1 if self.kind == "chessboard" else 0
        return (0.0, 0.0), ((self.columns + more) * self.square, (self.rows + more) * self.square)

    def _extent(self) -> tuple[float, float]:
        """Width and height with the white margin, mm."""
        (x0, y0), (x1, y1) = self.corners()
        quiet = 2 * self._quiet()
        return x1 - x0 + quiet, y1 - y0 + quiet

    def _quiet(self) -> float:
        return _QUIET * self.square if self.kind != "aprilgrid" else self.spacing * self.marker

    def squares(self) -> Iterator[tuple[float, float, float]]:
        """The black squares that are no markers: lower left x, y and side, mm."""
        if self.kind == "aprilgrid":
            gap = self.spacing * self.marker
            for j in range(self.rows + 1):
                for i in range(self.columns + 1):
                    yield i * (self.marker + gap) - gap, j * (self.marker + gap) - gap, gap
            return
        s = self.square
        if self.kind == "chessboard":
            for j in range(self.rows + 1):
                for i in range(self.columns + 1):
                    if (i + self.rows - j) % 2 == 0:  # the upper left one is black
                        yield i * s, j * s, s
            return
        white = {(int(x // s), int(y // s)) for (x, y), _ in self.markers()}
        for j in range(self.rows):
            for i in range(self.columns):
                if (i, j) not in white:
                    yield i * s, j * s, s

    def markers(self) -> list[tuple[tuple[float, float], NDArray[np.bool_]]]:
        """The markers: centre mm, and cells (n, n), True where black, the first row on top."""
        if self.kind == "chessboard":
            return []
        field = self.field()
        found = []
        rows = [r for r, kind in enumerate(field.kinds) if kind == "marker_corner"]
        for first in range(0, len(rows), 4):
            quad = field.points[rows[first : first + 4], :2]
            name, number = field.codes[rows[first]].split(":")[:2]
            cells = marker_cells(name, int(number), _APRIL_BORDER if self._april else 1)
            # corner 0 is where the cells' first one is; turns of 90° bring it there
            offset = quad[0] - quad.mean(axis=0)
            turns = {(-1, 1): 0, (-1, -1): 1, (1, -1): 2, (1, 1): 3}[
                (int(np.sign(offset[0])), int(np.sign(offset[1])))
            ]
            x, y = quad.mean(axis=0).tolist()
            found.append(((x, y), np.rot90(cells, turns)))
        return found

    @property
    def _april(self) -> bool:
        return self.kind == "aprilgrid"


def counts_of(option: str, text: str) -> tuple[int, int]:
    """Return columns and rows of 9x6; UsageError that names the option."""
    columns, _, rows = text.lower().replace("×", "x").partition("x")
    if not (columns.isascii() and columns.isdigit() and rows.isascii() and rows.isdigit()):
        raise UsageError(f"{option} {text}: write COLUMNSxROWS, such as 9x6")
    if not 0 < int(columns[:6]) <= 1000 or not 0 < int(rows[:6]) <= 1000:
        raise UsageError(f"{option} {text}: counts up to 1000 are possible")
    return int(columns), int(rows)


def _room(page: tuple[float, float]) -> tuple[float, float]:
    """What a page (mm) leaves beside the rulers' strips."""
    return page[0] - 2 * TRIM - STRIP, page[1] - 2 * TRIM - STRIP


def draw_board(board: Board, page: tuple[float, float]) -> Any:
    """A board in the middle of a page (mm), with rulers and its name, as a matplotlib Figure."""
    pen = Pen(page, light=False)
    size = (page[0] - 2 * TRIM, page[1] - 2 * TRIM)
    crop_marks(pen, size)
    rulers(pen, size)
    pen.text(STRIP, STRIP - 4.6, f"{board.name[2:].lstrip()}, {board.measures}", _LEGEND_HEIGHT)
    room = _room(page)
    (x0, y0), (x1, y1) = board.corners()
    dx = STRIP + (room[0] - (x1 - x0)) / 2 - x0
    dy = STRIP + (room[1] - (y1 - y0)) / 2 - y0
    for x, y, side in board.squares():
        pen.fill(rectangle(x + dx, y + dy, side, side), "black")
    for (x, y), cells in board.markers():
        draw_marker(pen, (x + dx, y + dy), board.marker, cells)
    return pen.figure
