"""`thermocald testfield print`: a folder with the sheets to print and the test field they are."""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from thermocald.atomic_file import cannot_write
from thermocald.errors import UsageError
from thermocald.output.testfield.drawing import write_pdf, write_svg
from thermocald.output.testfield.layout import field_of, lay_out
from thermocald.store.recording.testfield_file import write_testfield

if TYPE_CHECKING:
    from thermocald.output.testfield.layout import Design, Sheet
    from thermocald.photogrammetry.field.testfield import TestField

__all__ = ["Printed", "default_diameter", "print_testfield"]


@dataclass(frozen=True, slots=True)
class Printed:
    """What was written: the files, the sheets, the nominal field."""

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
    if not replace_printed and (folder / "testfield.csv").exists():
        raise UsageError(
            f"{folder}: holds a printed test field already, whose coordinates would be lost: give "
            "another folder with --out, or --force to replace it"
        )
    sheets = lay_out(design)
    field = field_of(sheets)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=".testfield-", dir=folder))
    except OSError as cause:
        raise cannot_write(folder, cause) from cause
    try:
        names = ["testfield.pdf"]
        write_pdf(sheets, work / "testfield.pdf")
        for i, sheet in enumerate(sheets, start=1):
            name = "testfield.svg" if len(sheets) == 1 else f"testfield-{i}.svg"
            write_svg(sheet, work / name)
            names.append(name)
        write_testfield(work / "testfield.csv", field)
        names.append("testfield.csv")
        for name in names:
            os.replace(work / name, folder / name)
    except OSError as cause:
        raise cannot_write(folder, cause) from cause
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return Printed(tuple(folder / name for name in names), sheets, field)
