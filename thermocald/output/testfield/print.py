"""`thermocald testfield print`: write the sheets to print and their test field to a folder.

The field of another program's board (ChArUco, chessboard, Kalibr's AprilGrid) is that of
`targets.boards`, which `testfield import` writes too; the drawing follows OpenCV and Kalibr.
"""

from __future__ import annotations

import importlib
import importlib.util
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import DriverMissing, UsageError
from thermocald.files import new_file
from thermocald.output.testfield.layout import (
    STRIP,
    TRIM,
    Design,
    Sheet,
    field_of,
    lay_out,
    markers_of,
)
from thermocald.photogrammetry.targets import boards
from thermocald.store.recording.testfield_file import testfield_csv

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path
    from types import ModuleType

    from numpy.typing import NDArray

    from thermocald.photogrammetry.field.testfield import TestField


KINDS = ("charuco", "chessboard", "aprilgrid")
_APRIL_BORDER = 2
_MARKER_SHARE = 0.75  # side of a ChArUco marker over its square's, if no size is given
_QUIET = 0.5  # white margin of a board over a square's side


@dataclass(frozen=True, slots=True)
class Board:
    """A board of columns × rows: squares of a ChArUco board, inner corners of a chessboard, tags.

    square mm: side of a square (not of an AprilGrid); marker mm: side of a marker or tag with its
    black border; spacing: gap between tags over their side; dictionary: of a ChArUco board, by its
    OpenCV name; legacy: ChArUco as drawn by OpenCV before 4.6.
    """

    kind: str
    columns: int
    rows: int
    square: float = 0.0
    marker: float = 0.0
    spacing: float = 0.3
    dictionary: str = "DICT_5X5_1000"
    legacy: bool = False

    @property
    def _tags(self) -> bool:
        return self.kind == "aprilgrid"

    def field(self, sigma: float | None = None) -> TestField:
        """Return the test field, origin at the board's lower left; sigma: mm, None for a print."""
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
        """The kind and size of the board, in words."""
        kind, unit = {
            "charuco": ("a ChArUco board", "squares"),
            "chessboard": ("a chessboard", "inner corners"),
            "aprilgrid": ("an AprilGrid", "tags"),
        }[self.kind]
        return f"{kind} of {self.columns} × {self.rows} {unit}"

    @property
    def measures(self) -> str:
        """The dimensions of squares, markers or tags, in words."""
        if self.kind == "charuco":
            return (
                f"squares {self.square:g} mm, markers {self.marker:g} mm of {self.dictionary}"
                + (", as OpenCV drew it before 4.6" if self.legacy else "")
            )
        if self.kind == "chessboard":
            return f"squares {self.square:g} mm"
        return f"tags {self.marker:g} mm, {self._gap:g} mm apart"

    def filled(self, page: tuple[float, float]) -> Board:
        """Return the board with the largest sizes that fit on a page (mm) in place of zeros."""
        side = self.marker if self._tags else self.square
        if side == 0:
            unit = replace(self, square=1.0, marker=1.0)._extent()
            room = _room(page)
            side = min(room[0] / unit[0], room[1] / unit[1])
            side = np.floor(side) if side >= 5 else np.floor(10 * side) / 10
            if side <= 0:
                raise UsageError(f"{self.name} does not fit on {page[0]:g} × {page[1]:g} mm")
        if self._tags:
            return replace(self, marker=float(side))
        marker = self.marker or round(_MARKER_SHARE * side, 1)
        return replace(self, square=float(side), marker=marker)

    def check_fits(self, page: tuple[float, float]) -> None:
        """Raise UsageError, with what would fit, if the board is larger than the page (mm)."""
        (w, h), room = self._extent(), _room(page)
        if w > room[0] + 1e-6 or h > room[1] + 1e-6:
            raise UsageError(
                f"{self.name} ({self.measures}) needs {w:.0f} × {h:.0f} mm with its white margin; "
                f"{page[0]:g} × {page[1]:g} mm paper has room for {room[0]:.0f} × {room[1]:.0f}; "
                "use smaller squares or larger paper"
            )

    def place(self, page: tuple[float, float]) -> tuple[float, float]:
        """Return the position of the origin that centres the board on a page (mm)."""
        room, (width, height) = _room(page), self._black()
        low = -self._gap if self._tags else 0.0
        return STRIP + (room[0] - width) / 2 - low, STRIP + (room[1] - height) / 2 - low

    @property
    def _gap(self) -> float:
        return self.spacing * self.marker

    def _black(self) -> tuple[float, float]:
        """Return the width and height of the black area, mm."""
        if self._tags:
            step = self.marker + self._gap
            return self.columns * step + self._gap, self.rows * step + self._gap
        more = 1 if self.kind == "chessboard" else 0
        return (self.columns + more) * self.square, (self.rows + more) * self.square

    def _extent(self) -> tuple[float, float]:
        """Return the width and height with the white margin, mm."""
        quiet = 2 * (self._gap if self._tags else _QUIET * self.square)
        width, height = self._black()
        return width + quiet, height + quiet

    def squares(self) -> Iterator[tuple[float, float, float]]:
        """Yield the black squares that are not markers: lower left x, y and side, mm."""
        if self._tags:
            step = self.marker + self._gap
            for j, i in product(range(self.rows + 1), range(self.columns + 1)):
                yield i * step - self._gap, j * step - self._gap, self._gap
        else:
            s, more = self.square, int(self.kind == "chessboard")
            white = self.legacy and self.rows % 2 == 0  # the upper left one
            for j, i in product(range(self.rows + more), range(self.columns + more)):
                if (i + self.rows + more - 1 - j) % 2 == white:
                    yield i * s, j * s, s

    def markers(self) -> Iterator[tuple[str, tuple[float, float], float, NDArray[np.bool_]]]:
        """Yield the markers, as `markers_of` does."""
        return markers_of(self.field(), _APRIL_BORDER if self._tags else 1)


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
        if self.board is not None:
            board = self.board
            return document | {
                "board": board.kind, "square": board.square, "marker": board.marker
            }  # fmt: skip
        bars = []
        for sheet in self.sheets:
            if sheet.scale_bar is not None:
                a, b = (sheet.field.names[row] for row in sheet.scale_bar)
                dx, dy, _ = np.diff(sheet.field.points[[*sheet.scale_bar]], axis=0)[0]
                length = float(np.hypot(dx, dy))
                bars.append({"sheet": sheet.title, "a": a, "b": b, "nominal": length})
        corners = self.field.kinds.count("marker_corner")
        plain = self.field.codes.count("")
        return document | {
            "diameter": self.sheets[0].design.diameter,
            "coded": len(self.field) - corners - plain,
            "plain": plain,
            "markers": corners // 4,
            "scale_bars": bars,
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
    board.check_fits(page)
    field = board.field()
    files = _publish([_drawing().draw_board(board, page)], 1, field, folder, replace_printed)
    return Printed(folder, files, (), field, page, board)


def _drawing() -> ModuleType:
    """Return the drawing module; DriverMissing, with the command to run, without matplotlib."""
    if importlib.util.find_spec("matplotlib") is None:
        raise DriverMissing(
            "drawing a test field needs matplotlib: pip install 'thermocald[report]'"
        )
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
        _drawing().write_pdf(pages, partial["testfield.pdf"])
        for page, name in zip(pages, drawings, strict=False):  # the plan is only in the PDF
            _drawing().write_svg(page, partial[name])
        partial["testfield.csv"].write_text(testfield_csv(field), encoding="utf-8")
    return tuple(folder / name for name in names)
