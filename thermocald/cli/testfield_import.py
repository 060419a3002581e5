"""`thermocald testfield import`: the field that somebody owns already."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thermocald.cli.options import JsonOption
from thermocald.cli.testfield_options import (
    AprilGrid,
    Charuco,
    Chessboard,
    Dictionary,
    Legacy,
    MarkerSide,
    Spacing,
    Square,
    board_of,
)
from thermocald.errors import UsageError

if TYPE_CHECKING:
    from thermocald.photogrammetry.field.testfield import TestField

__all__ = ["import_"]


def import_(
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FILE]",
            help="Kalibr's target.yaml, OpenCV's parameters, a file of calib.io's, or a list.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="The testfield.csv to write.")] = Path(
        "testfield.csv"
    ),
    charuco: Charuco = None,
    chessboard: Chessboard = None,
    aprilgrid: AprilGrid = None,
    rings: Annotated[
        int | None, typer.Option(help="FILE lists targets with ring codes of 12 or 14 bits.")
    ] = None,
    square: Square = None,
    marker: MarkerSide = None,
    spacing: Spacing = 0.3,
    dictionary: Dictionary = "DICT_5X5_1000",
    legacy: Legacy = False,
    diameter: Annotated[
        float | None, typer.Option(min=0.1, help="Of ring-coded discs, mm.")
    ] = None,
    sigma: Annotated[
        float | None, typer.Option(min=1e-4, help="Of a coordinate, mm, if measured.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    json: JsonOption = None,
) -> None:
    """Make a testfield.csv of a board that you own: ChArUco, chessboard, AprilGrid, coded rings.

    One flat board calibrates a camera from several poses (`thermocald calibrate`); for a series of
    a camera that stands still put several boards at an angle and survey them together.

    Example: thermocald testfield import april_6x6.yaml --out aprilgrid.csv
    Example: thermocald testfield import --charuco 11x8 --square 30 --marker 22 --dictionary
    DICT_5X5_250 --out charuco.csv
    """
    from thermocald.cli.common import write_json
    from thermocald.store.recording.board_file import read_board, read_rings
    from thermocald.store.recording.testfield_file import write_testfield

    board = board_of(charuco, chessboard, aprilgrid, square, marker, spacing, dictionary, legacy)
    if (source is None) == (board is None):
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
    else:
        assert board is not None
        if board.kind != "aprilgrid":
            _needed(square, "--square")
        if board.kind != "chessboard":
            _needed(marker, "--marker")
        field, said = board.field(sigma), board.name
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


def _needed(value: float | None, option: str) -> None:
    if value is None:
        raise UsageError(f"{option} is missing (mm)")
