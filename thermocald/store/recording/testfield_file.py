"""`testfield.csv` (CONVENTIONS §3): read, check and write it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import TestFieldError
from thermocald.files import write_text
from thermocald.photogrammetry.field.testfield import KINDS, TestField
from thermocald.result import csv_text
from thermocald.store.recording.table import Table

if TYPE_CHECKING:
    from pathlib import Path

    from thermocald.result import Columns


_MOST_TARGETS = 4000
_LARGEST_MM = 1e9  # a thousand kilometres
_SIGMAS_MM = (1e-9, 1e4)
_NUMBERS = ("X", "Y", "Z", "diameter", "sX", "sY", "sZ")
_REQUIRED = ("target", *_NUMBERS)

# Too small for a camera to be calibrated with; a field given in metres is (a room: 6 "mm").
_SMALLEST_FIELD_MM = 25.0
# A lens cannot focus so close that a field of a few principal distances fills the image.
_SMALLEST_FIELD_IN_PRINCIPAL_DISTANCES = 5.0


def read_testfield(path: Path) -> TestField:
    """Read `testfield.csv`.

    Raises TestFieldError, naming file, line and column, if a column is missing, a number is
    invalid, a target is duplicated or the coordinates look like metres.
    """
    field = _read(Table(path, _REQUIRED, TestFieldError))
    require_millimetres(field, str(path))
    return field


def parse_testfield(text: str, path: Path) -> TestField:
    """Return the test field in the text of a `testfield.csv` that was accepted before.

    It may be empty, as for a camera that is acquired but not calibrated. path: for the messages.
    Raises the errors of `read_testfield`, except for metres.
    """
    return _read(Table(path, _REQUIRED, TestFieldError, text), may_be_empty=True)


def _read(table: Table, *, may_be_empty: bool = False) -> TestField:
    given = [name for name in ("kind", "code") if name in table.columns]
    found = table.read(
        (), [n for n in _NUMBERS if n != "diameter"], ["diameter"], ["target", *given]
    )
    names = [text.strip() for text in found.get("target", ())]
    first: dict[str, int] = {}
    for row, name in enumerate(names):
        if not name:
            table.fail(row, "target", "is empty; every target needs a name")
        if not " ".join(name.splitlines()).isprintable():
            table.fail(row, "target", f"{name[:40]!r} must be printable")
        if first.setdefault(name, row) != row:
            table.fail(row, "target", f"target {name!r} is duplicated")
    columns = {name: found.get(name, np.empty(0)) for name in _NUMBERS}
    for column, numbers in columns.items():
        table.check(column, abs(numbers) > _LARGEST_MM, f"must be within {_LARGEST_MM:g} mm")
        if column == "diameter":
            table.check(column, numbers <= 0, "a diameter must be above 0 mm, or left empty")
        if column.startswith("s"):
            table.check(column, numbers < 0, "a standard deviation must not be negative")
            odd = (numbers > 0) & ((numbers < _SIGMAS_MM[0]) | (numbers > _SIGMAS_MM[1]))
            limits = f"{_SIGMAS_MM[0]:g} and {_SIGMAS_MM[1]:g} mm"
            table.check(column, odd, f"must be between {limits}; 0 holds the coordinate fixed")
    empty = ("",) * len(names)
    kinds = [text.strip() or KINDS[0] for text in found.get("kind", empty)]
    for row, kind in enumerate(kinds):
        if kind not in KINDS:
            table.fail(row, "kind", f"{kind!r} is unknown; it is one of {', '.join(KINDS)}")
    if len(names) > _MOST_TARGETS:
        raise TestFieldError(
            f"{table.path}: holds more than {_MOST_TARGETS} targets; leave out those that no "
            "camera sees"
        )
    if not names and not may_be_empty:
        raise TestFieldError(f"{table.path}: holds no targets")
    return TestField.build(
        names,
        np.array([columns["X"], columns["Y"], columns["Z"]]).T,
        np.array([columns["sX"], columns["sY"], columns["sZ"]]).T,
        columns["diameter"].tolist(),
        kinds,
        [code.strip() for code in found.get("code", empty)],
    )


def require_millimetres(
    field: TestField, where: str, principal_distance: float | None = None
) -> None:
    """Raise TestFieldError if a field is so small that its coordinates must be in metres.

    principal_distance: the camera's, mm; None if unknown.
    """
    if len(field) < 2:
        return
    extent = float(np.linalg.norm(np.ptp(field.points, axis=0)))
    smallest = _SMALLEST_FIELD_MM
    if principal_distance is not None:
        smallest = max(smallest, _SMALLEST_FIELD_IN_PRINCIPAL_DISTANCES * principal_distance)
    if extent < smallest:
        raise TestFieldError(
            f"{where}: the test field is {extent:.4g} mm across, less than the {smallest:.4g} mm "
            "that a camera can see sharply: coordinates in metres? Write X, Y, Z, diameter, "
            "sX, sY, sZ in mm (metres times 1000)"
        )


def testfield_csv(field: TestField) -> str:
    """Return a test field as the text of `testfield.csv`, with all digits of its numbers."""
    numbers = (*field.points.T, np.array(field.diameters, dtype=float), *field.sigmas.T)
    columns: Columns = {"target": field.names, **dict(zip(_NUMBERS, numbers, strict=True))}
    if any(field.codes) or any(kind != KINDS[0] for kind in field.kinds):
        columns["kind"] = field.kinds
    if any(field.codes):
        columns["code"] = field.codes
    return "".join(csv_text([columns]))


def write_testfield(path: Path, field: TestField) -> None:
    """Write `testfield.csv`; an existing file is replaced as a whole or not at all."""
    write_text(path, testfield_csv(field))
