"""`thermocald testfield print`: a folder with the sheets to print and the test field they are."""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.atomic_file import cannot_write
from thermocald.errors import UsageError
from thermocald.output.testfield.board import draw_board
from thermocald.output.testfield.drawing import (
    pages_of,
    require_matplotlib,
    write_pdf,
    write_svg,
)
from thermocald.output.testfield.layout import field_of, lay_out
from thermocald.store.recording.testfield_file import write_testfield

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.output.testfield.board import Board
    from thermocald.output.testfield.layout import Design, Sheet
    from thermocald.photogrammetry.field.testfield import TestField

__all__ = ["Printed", "default_diameter", "print_board", "print_testfield"]


@dataclass(frozen=True, slots=True)
class Printed:
    """What was written: the files, the sheets (none of a board), the nominal field."""

    files: tuple[Path, ...]
    sheets: tuple[Sheet, ...]
    field: TestField


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
    return Printed(files, sheets, field)


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
    return Printed(files, (), field)


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
            os.replace(work / name, folder / name)
    except OSError as cause:
        raise cannot_write(folder, cause) from cause
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return tuple(folder / name for name in names)
