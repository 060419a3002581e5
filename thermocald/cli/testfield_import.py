"""`thermocald testfield import`: the field that somebody owns already."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thermocald.cli.testfield_options import Json
from thermocald.errors import UsageError

if TYPE_CHECKING:
    from thermocald.photogrammetry.field.testfield import TestField

__all__ = ["import_"]


def import_(
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FILE]", help="Kalibr's target.yaml, OpenCV's board parameters, or a list."
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="The testfield.csv to write.")] = Path(
        "testfield.csv"
    ),
    charuco: Annotated[
        str | None, typer.Option("--charuco", help="A ChArUco board: 11x8 squares.")
    ] = None,
    chessboard: Annotated[
        str | None, typer.Option("--chessboard", help="A chessboard: 9x6 inner corners.")
    ] = None,
    aprilgrid: Annotated[
        str | None, typer.Option("--aprilgrid", help="Kalibr's AprilGrid: 6x6 tags.")
    ] = None,
    rings: Annotated[
        int | None,
        typer.Option("--rings", help="FILE lists targets with ring codes of 12 or 14 bits."),
    ] = None,
    square: Annotated[
        float | None, typer.Option("--square", min=0.1, help="Side of a square, mm.")
    ] = None,
    marker: Annotated[
        float | None, typer.Option("--marker", min=0.1, help="Side of a marker or tag, mm.")
    ] = None,
    spacing: Annotated[
        float, typer.Option("--spacing", help="Of an AprilGrid, over the side of a tag.")
    ] = 0.3,
    dictionary: Annotated[
        str, typer.Option("--dictionary", help="OpenCV's name of the dictionary.")
    ] = "DICT_5X5_1000",
    legacy: Annotated[
        bool, typer.Option("--legacy", help="ChArUco as OpenCV drew it before 4.6.")
    ] = False,
    diameter: Annotated[
        float | None, typer.Option("--diameter", min=0.1, help="Of ring-coded discs, mm.")
    ] = None,
    sigma: Annotated[
        float | None, typer.Option("--sigma", min=1e-4, help="Of a coordinate, mm, if measured.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    json: Json = None,
) -> None:
    """Make a testfield.csv of a board that you own: ChArUco, chessboard, AprilGrid, coded rings.

    One flat board calibrates a camera from several poses (`thermocald calibrate`); for a series of
    a camera that stands still put several boards at an angle and survey them together.

    Example: thermocald testfield import april_6x6.yaml --out aprilgrid.csv
    Example: thermocald testfield import --charuco 11x8 --square 30 --marker 22 --dictionary
    DICT_5X5_250 --out charuco.csv
    """
    from thermocald.cli.common import write_json
    from thermocald.photogrammetry.targets import boards
    from thermocald.store.recording.board_file import read_board, read_rings
    from thermocald.store.recording.testfield_file import write_testfield

    given = [charuco, chessboard, aprilgrid]
    if (source is None) == (sum(g is not None for g in given) == 0) or sum(map(bool, given)) > 1:
        raise UsageError(
            "give a file, or one of --charuco, --chessboard, --aprilgrid with its sizes"
        )
    if out.exists() and not force:
        raise UsageError(f"{out}: exists already: give another name, or --force to replace it")
    field: TestField
    if source is not None and rings is not None:
        if diameter is None:
            raise UsageError("--rings needs the --diameter of the discs, mm")
        if rings not in (12, 14):
            raise UsageError(f"--rings {rings}: there are codes of 12 and of 14 bits")
        field, said = read_rings(source, rings, diameter, sigma), f"rings of {rings} bits"
    elif source is not None:
        field, said = read_board(source, sigma)
    elif charuco is not None:
        columns, rows = _counts("--charuco", charuco)
        sides = _needed(square, "--square"), _needed(marker, "--marker")
        field = boards.charuco(columns, rows, *sides, dictionary, legacy=legacy, sigma=sigma)
        said = f"a ChArUco board of {columns} × {rows} squares"
    elif chessboard is not None:
        columns, rows = _counts("--chessboard", chessboard)
        field = boards.chessboard(columns, rows, _needed(square, "--square"), sigma=sigma)
        said = f"a chessboard of {columns} × {rows} inner corners"
    else:
        columns, rows = _counts("--aprilgrid", aprilgrid or "")
        field = boards.aprilgrid(columns, rows, _needed(marker, "--marker"), spacing, sigma=sigma)
        said = f"an AprilGrid of {columns} × {rows} tags"
    out.absolute().parent.mkdir(parents=True, exist_ok=True)
    write_testfield(out, field)
    extent = [float(v) for v in field.points.max(axis=0) - field.points.min(axis=0)]
    if json is not None:
        write_json(
            {
                "format": "thermocald-testfield-import/1", "testfield": out, "what": said,
                "targets": len(field), "extent": extent,
            },
            json,
        )  # fmt: skip
    if json != "-":
        typer.echo(f"{out}: {said}, {len(field)} targets, {extent[0]:.1f} × {extent[1]:.1f} mm")


def _needed(value: float | None, option: str) -> float:
    if value is None:
        raise UsageError(f"{option} is missing (mm)")
    return value


def _counts(option: str, text: str) -> tuple[int, int]:
    columns, _, rows = text.lower().replace("×", "x").partition("x")
    if not (columns.isascii() and columns.isdigit() and rows.isascii() and rows.isdigit()):
        raise UsageError(f"{option} {text}: write COLUMNSxROWS, such as 9x6")
    if not 0 < int(columns[:6]) <= 1000 or not 0 < int(rows[:6]) <= 1000:
        raise UsageError(f"{option} {text}: counts up to 1000 are possible")
    return int(columns), int(rows)
