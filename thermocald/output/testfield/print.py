"""`thermocald testfield print`: a folder with the sheets to print and the test field they are."""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.errors import UsageError
from thermocald.files import cannot_write, new_file
from thermocald.output.testfield.board import Board, draw_board
from thermocald.output.testfield.drawing import (
    pages_of,
    require_matplotlib,
    write_pdf,
    write_svg,
)
from thermocald.output.testfield.layout import Design, Sheet, field_of, lay_out
from thermocald.store.recording.testfield_file import write_testfield

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.photogrammetry.field.testfield import TestField

ONE_PLANE = (
    "one flat sheet calibrates a camera from photographs in several poses (thermocald calibrate); "
    "a camera that stands still before it gets no result: for series print the corner, or put up "
    "two or three sheets at an angle and survey them"
)


@dataclass(frozen=True, slots=True)
class Printed:
    """What was written: the files, the sheets (none of a board), the nominal field, the board.

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
        """Whether it is one sheet."""
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
        circles = [t for sheet in self.sheets for t in sheet.targets]
        bars = []
        for sheet in self.sheets:
            if sheet.scale_bar is not None:
                a, b = sheet.scale_bar
                length = ((b.x - a.x) ** 2 + (b.y - a.y) ** 2) ** 0.5
                bars.append({"sheet": sheet.title, "a": a.name, "b": b.name, "nominal": length})
        return document | {
            "diameter": self.sheets[0].design.diameter,
            "coded": sum(bool(t.code) for t in circles),
            "plain": sum(not t.code for t in circles),
            "markers": sum(len(sheet.markers) for sheet in self.sheets),
            "scale_bars": bars,
        }

    def lines(self) -> list[str]:
        """Return the lines that `testfield print` prints."""
        size = f"{self.page[0]:g} × {self.page[1]:g} mm"
        if self.board is not None:
            return [
                (
                    f"{self.folder}: {self.board.name} ({self.board.measures}) on {size}, "
                    f"{len(self.field)} targets"
                )
            ]
        found = self.as_dict()
        sheets = "1 sheet" if self.is_flat else "3 sheets of a corner (and how to put it up)"
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
    """A disc diameter for a page size (mm): about a hundred targets on a sheet, mm."""
    return max(3.0, round(min(page) / 34))


def print_testfield(design: Design, folder: Path, *, replace_printed: bool = False) -> Printed:
    """Write `testfield.pdf`, one SVG per sheet, and `testfield.csv` into a folder.

    All files appear, or none. UsageError where the folder holds a `testfield.csv` already: what
    hangs on a wall would no longer have its coordinates; `replace_printed` replaces it.
    """
    sheets = lay_out(design)
    field = field_of(sheets)
    require_matplotlib()
    files = _publish(pages_of(sheets), len(sheets), field, folder, replace_printed)
    return Printed(folder, files, sheets, field, design.page)


def print_board(
    board: Board, page: tuple[float, float], folder: Path, *, replace_printed: bool = False
) -> Printed:
    """Write a board's `testfield.pdf`, `testfield.svg` and `testfield.csv`, as `print_testfield`.

    page: width, height mm. UsageError where the board does not fit on it.
    """
    board.check_fits(page)
    require_matplotlib()
    field = board.field()
    files = _publish([draw_board(board, page)], 1, field, folder, replace_printed)
    return Printed(folder, files, (), field, page, board)


def _publish(
    pages: Sequence[Any], sheets: int, field: TestField, folder: Path, replace_printed: bool
) -> tuple[Path, ...]:
    """All pages as one PDF, the first `sheets` of them as SVG, and the field."""
    if not replace_printed and (folder / "testfield.csv").exists():
        raise UsageError(
            f"{folder}: holds a printed test field already, whose coordinates would be lost: give "
            "another folder with --out, or --force to replace it"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=".testfield-", dir=folder))
    except OSError as cause:
        raise cannot_write(folder, cause) from cause
    try:
        names = ["testfield.pdf"]
        write_pdf(pages, work / "testfield.pdf")
        for i in range(sheets):
            name = "testfield.svg" if sheets == 1 else f"testfield-{i + 1}.svg"
            write_svg(pages[i], work / name)
            names.append(name)
        write_testfield(work / "testfield.csv", field)
        names.append("testfield.csv")
        for name in names:
            if not os.path.lexists(folder / name):
                os.replace(work / name, folder / name)
                continue
            with new_file(folder / name) as file:
                shutil.copyfile(work / name, file)
    except OSError as cause:
        raise cannot_write(folder, cause) from cause
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return tuple(folder / name for name in names)
