"""`testfield.csv` (CONVENTIONS §3), and the boards of other programs.

These are Kalibr, OpenCV, calib.io, and lists of ring-coded targets.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import TestFieldError, UsageError
from thermocald.files import QuantityReader, read_yaml, write_text
from thermocald.photogrammetry.field.testfield import KINDS, Distance, TestField
from thermocald.result import csv_text
from thermocald.store.recording.table import Table

if TYPE_CHECKING:
    from pathlib import Path

    from thermocald.photogrammetry.targets.boards import Board
    from thermocald.result import Columns


_MOST_TARGETS = 4000
_LARGEST_MM = 1e9  # a thousand kilometres
_SIGMAS_MM = (1e-9, 1e4)
_NUMBERS = ("X", "Y", "Z", "diameter", "sX", "sY", "sZ")
_REQUIRED = ("target", *_NUMBERS)
_SCALE = ("scaleX", "scaleY", "scaleZ")
"""Shares in sX, sY, sZ of the scale that all targets have in common, with their signs."""

# Too small for a camera to be calibrated with; a field given in metres is (a room: 6 "mm").
_SMALLEST_FIELD_MM = 25.0
# A lens cannot focus so close that a field of a few principal distances fills the image.
_SMALLEST_FIELD_IN_PRINCIPAL_DISTANCES = 5.0

_MOST_LINES = 20_000
_MOST_ROWS = 1000
_LARGEST_BYTES = 5_000_000
_KINDS = ("aprilgrid", "april_grid", "checkerboard", "chessboard", "checker", "charuco",
          "charucoboard")  # fmt: skip
_SYNONYMS = {
    "columns": ("squaresx", "numsquaresx", "cols", "columns", "boardcols", "numcols", "ncols",
                "width", "boardwidth", "targetcols", "tagcols"),
    "rows": ("squaresy", "numsquaresy", "rows", "boardrows", "numrows", "nrows", "height",
             "boardheight", "targetrows", "tagrows"),
    "square": ("squarelength", "squaresize", "squareside", "square", "checkersize", "checkerwidth",
               "cellsize"),
    "marker": ("markerlength", "markersize", "markerside", "marker"),
    "dictionary": ("dictionary", "dict", "arucodict", "arucodictionary", "dictname",
                   "dictionaryname"),
}  # fmt: skip
"""Keys for each quantity, in lower case, without underscores and unit."""
_CALIB_IO = re.compile(
    r"calib\.io_(checker|charuco)_[^_]+_(\d{1,3})x(\d{1,3})_(\d*\.?\d+)"
    r"(?:_(\d*\.?\d+))?(?:_(DICT_\w+?))?(?:\.\w+)?",
    re.IGNORECASE,
)
"""Names of calib.io's files: kind, page, rows x columns of squares, square, marker mm."""


def read_testfield(path: Path) -> TestField:
    """Read `testfield.csv`.

    Raises TestFieldError, naming file, line and column, if a column is missing, a number is
    invalid, a target is duplicated or the coordinates look like metres.
    """
    field = _read(Table(path, _REQUIRED, TestFieldError))
    require_millimetres(field, str(path))
    return field


def parse_testfield(text: str, path: Path | str) -> TestField:
    """Return the test field in the text of a `testfield.csv` that was accepted before.

    It may be empty, as for a camera that is acquired but not calibrated. path: for the messages.
    Raises the errors of `read_testfield`, except for metres.
    """
    return _read(Table(path, _REQUIRED, TestFieldError, text), may_be_empty=True)


def _read(table: Table, *, may_be_empty: bool = False) -> TestField:
    given = [name for name in ("kind", "code") if name in table.columns]
    shares = _SCALE if set(_SCALE) <= set(table.columns) else ()
    found = table.read(
        (), [*(n for n in _NUMBERS if n != "diameter"), *shares], ["diameter"], ["target", *given]
    )
    names = [text.strip() for text in found["target"]]
    first: dict[str, int] = {}
    for row, name in enumerate(names):
        if not name:
            table.fail(row, "target", "is empty; every target needs a name")
        if not " ".join(name.splitlines()).isprintable():
            table.fail(row, "target", f"{name[:40]!r} must be printable")
        if first.setdefault(name, row) != row:
            table.fail(row, "target", f"target {name!r} is duplicated")
    codes = [code.strip() for code in found.get("code", ("",) * len(names))]
    known: dict[str, str] = {}
    for row, code in enumerate(codes):
        if code and (other := known.setdefault(code, names[row])) != names[row]:
            table.fail(row, "code", f"code {code!r} is duplicated: target {other!r} has it")
    for column in _NUMBERS:
        numbers = found[column]
        table.check(column, abs(numbers) > _LARGEST_MM, f"must be within {_LARGEST_MM:g} mm")
        if column == "diameter":
            table.check(column, numbers <= 0, "a diameter must be above 0 mm, or left empty")
        if column.startswith("s"):
            table.check(column, numbers < 0, "a standard deviation must not be negative")
            odd = (numbers > 0) & ((numbers < _SIGMAS_MM[0]) | (numbers > _SIGMAS_MM[1]))
            limits = f"{_SIGMAS_MM[0]:g} and {_SIGMAS_MM[1]:g} mm"
            table.check(column, odd, f"must be between {limits}; 0 holds the coordinate fixed")
    kinds = [text.strip() or KINDS[0] for text in found.get("kind", ("",) * len(names))]
    for row, kind in enumerate(kinds):
        if kind not in KINDS:
            table.fail(row, "kind", f"{kind!r} is unknown; it is one of {', '.join(KINDS)}")
    if len(names) > _MOST_TARGETS:
        raise TestFieldError(
            f"{table.title}: holds more than {_MOST_TARGETS} targets; leave out those that no "
            "camera sees"
        )
    if not names and not may_be_empty:
        raise TestFieldError(f"{table.title}: holds no targets")
    for share in shares:
        larger = abs(found[share]) > found[share.replace("scale", "s")]
        table.check(share, larger, "must not exceed the standard deviation of which it is a share")
    points, sigmas = (np.array([found[s + axis] for axis in "XYZ"]).T for s in ("", "s"))
    field = TestField.build(names, points, sigmas, found["diameter"].tolist(), kinds, codes)
    return replace(field, scale=np.array([found[s] for s in shares]).T) if shares else field


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
    if field.scale is not None:
        columns |= dict(zip(_SCALE, field.scale.T, strict=True))
    return "".join(csv_text([columns]))


def write_testfield(path: Path, field: TestField) -> None:
    """Write `testfield.csv`; an existing file is replaced as a whole or not at all."""
    write_text(path, testfield_csv(field))


def read_board(path: Path) -> Board:
    """Read the board in a YAML or JSON file.

    Kalibr: target_type aprilgrid or checkerboard, lengths in metres. Others: type charuco or
    chessboard with OpenCV's names for the parameters; lengths below 1 are in metres, others in mm.
    A file of calib.io's generator describes its board by its name (`calib.io_charuco_420x297_8x11_
    34_25_DICT_5X5.pdf`: 8 rows of 11 squares of 34 mm). Raises TestFieldError naming file and key.
    """
    from thermocald.photogrammetry.targets.boards import Board  # OpenCV is slow to import

    named = _CALIB_IO.fullmatch(path.name)
    # keys are compared in a plain form: `Square_Length_mm` → `squarelength`
    plain = _keys_in_name(path, named) if named else {
        re.sub(r"[^a-z0-9]", "", k.lower().removesuffix("_mm")): v
        for k, v in read_yaml(path, TestFieldError).items()
    }  # fmt: skip
    board = _BoardReader(path, plain)
    kind = str(plain.get("targettype", plain.get("type", ""))).lower()
    if not kind and any(k in plain for k in _SYNONYMS["dictionary"]):
        kind = "charuco"
    if kind not in _KINDS:
        wrong = f"{kind!r} is unknown" if kind else "is missing"
        raise TestFieldError(
            f"{path}, key target_type: {wrong}; give aprilgrid, checkerboard, charuco or chessboard"
        )
    columns, rows = board.count("columns"), board.count("rows")
    if kind.startswith("april"):
        size = 1e3 * board.number("tagsize", "m", above=0.0, high=1e6)
        spacing = board.number("tagspacing", "1", above=0.0, high=1e6)
        start = next((key for key in ("startid", "lowid") if plain.get(key) is not None), None)
        first = 0 if start is None else int(board.number(start, "1", low=0, high=_MOST_ROWS))
        return Board("aprilgrid", columns, rows, marker=size, spacing=spacing, first=first)
    if kind in ("checkerboard", "chessboard") and "rowspacingmeters" in plain:
        wide = 1e3 * board.number("colspacingmeters", "m", above=0.0, high=1e6)
        high = 1e3 * board.number("rowspacingmeters", "m", above=0.0, high=1e6)
        return Board("chessboard", columns, rows, wide, height=high)
    square = board.length("square")
    if "charuco" not in kind:
        if {"squaresx", "numsquaresx"} & set(plain):  # one more than corners
            columns, rows = columns - 1, rows - 1
        return Board("chessboard", columns, rows, square)
    marker = board.length("marker")
    key = board.find_key("dictionary")
    if plain.get(key) is None:
        raise board.fail(key, f"is missing; the file has {', '.join(plain)[:200]}")
    name = _dictionary(path, plain[key])
    legacy = bool(plain.get("legacy", plain.get("legacypattern", False)))
    return Board("charuco", columns, rows, square, marker, dictionary=name, legacy=legacy)


class _BoardReader(QuantityReader):
    """A reader of a board's keys by their meaning in `_SYNONYMS`."""

    error = TestFieldError

    def find_key(self, meaning: str) -> str:
        """Return the synonym for a meaning that the file has; the first if it has none."""
        names = _SYNONYMS[meaning]
        return next((name for name in names if self.mapping.get(name) is not None), names[0])

    def count(self, meaning: str) -> int:
        return self.whole(self.find_key(meaning), "1", high=_MOST_ROWS)

    def length(self, meaning: str) -> float:
        """Read a length in mm; below 1 it is in metres, as in ROS and OpenCV's samples."""
        length = self.number(self.find_key(meaning), "mm", above=0.0, high=1e6)
        return 1e3 * length if length < 1 else length


def _keys_in_name(path: Path, named: re.Match[str]) -> dict[str, Any]:
    """Return the keys of the board that a file's name describes."""
    keys = {"type": named[1].lower(), "squaresx": int(named[3]), "squaresy": int(named[2]),
            "square": float(named[4])}  # fmt: skip
    if keys["type"] == "checker":
        return keys
    if named[5] is None or named[6] is None:
        raise TestFieldError(
            f"{path}: the name does not describe the markers; give --charuco "
            f"{named[3]}x{named[2]} --square {named[4]} with --marker and --dictionary"
        )
    # the smaller dictionaries of a marker size are the first markers of the largest
    name = named[6].upper()
    name = name if name.count("_") > 1 else f"{name}_1000"
    return {**keys, "marker": float(named[5]), "dictionary": name}


def _dictionary(path: Path, value: Any) -> str:
    """Return OpenCV's name of a dictionary, given its name with or without DICT_, or number."""
    import cv2

    if isinstance(value, int):
        names = [n for n in dir(cv2.aruco) if n.startswith("DICT_")]
        known = [n for n in names if getattr(cv2.aruco, n) == value]
        if known:
            return sorted(known)[0]
    name = str(value).strip()
    name = name if name.startswith("DICT_") else f"DICT_{name}"
    if not isinstance(getattr(cv2.aruco, name, None), int):
        raise TestFieldError(f"{path}: {str(value)[:40]!r} is not one of OpenCV's dictionaries")
    return name


def read_rings(path: Path, bits: int, diameter: float, sigma: float | None = None) -> TestField:
    """Read ring-coded targets from a list of Metashape or AICON: label, X, Y, Z in mm.

    A label is the target's number, alone or after a word (`target 12`). Other lines are skipped.
    Raises TestFieldError naming file and line.
    """
    from thermocald.photogrammetry.targets import boards

    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise TestFieldError(f"{path}: is larger than {_LARGEST_BYTES // 1_000_000} MB")
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as cause:
        raise TestFieldError(f"{path}: cannot be read: {cause}") from cause
    numbers: list[int] = []
    points: list[list[float]] = []
    for line, text in enumerate(lines[:_MOST_LINES], 1):
        found = re.match(r"\s*(?:[A-Za-z_]+[\s_]*)?(\d{1,4})[\s,;]+(.*)", text)
        if found is None or text.lstrip().startswith("#"):
            continue
        try:
            point = [float(f) for f in re.split(r"[\s,;]+", found[2].strip(" ,;"))[:3]]
        except ValueError:
            point = []
        if len(point) < 3 or not np.isfinite(point).all():
            raise TestFieldError(
                f"{path}, line {line}: X, Y, Z (mm) are needed after the label, not "
                f"{found[2][:40]!r}"
            )
        numbers.append(int(found[1]))
        points.append(point)
    if not numbers:
        raise TestFieldError(f"{path}: holds no line `label, X, Y, Z`")
    return boards.numbered_rings(numbers, np.array(points), bits, diameter, sigma)


def read_distances(path: Path) -> list[Distance]:
    """Read measured distances from a CSV with a, b, length, sigma mm. Raises UsageError."""
    names = ("a", "b", "length", "sigma")
    found = Table(path, names, UsageError).read(numbers=names[2:], texts=names[:2])
    rows = zip(*(found[name] for name in names), strict=True)
    return [Distance(a.strip(), b.strip(), float(mm), float(sd)) for a, b, mm, sd in rows]
