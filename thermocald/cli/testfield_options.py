"""Options that several of the commands share, and the print that they describe."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thermocald.errors import UsageError

if TYPE_CHECKING:
    from thermocald.output.testfield.board import Board
    from thermocald.output.testfield.layout import Design

__all__ = [
    "AprilGrid",
    "CameraFile",
    "Charuco",
    "Chessboard",
    "Diameter",
    "Dictionary",
    "Flat",
    "Landscape",
    "Legacy",
    "MarkerSide",
    "Paper",
    "Spacing",
    "Square",
    "board_of",
    "design_of",
]

CameraFile = Annotated[
    Path | None,
    typer.Option("--camera", help="A camera file of any format that `camera convert` reads."),
]
Paper = Annotated[str, typer.Option("--paper", help="A4, A3, A2, A1, A0, or WIDTHxHEIGHT in mm.")]
Flat = Annotated[
    bool,
    typer.Option(
        "--flat/--corner",
        help="One flat sheet instead of the three of a corner. A fixed camera cannot be calibrated "
        "from one flat sheet.",
    ),
]
Landscape = Annotated[
    bool | None,
    typer.Option("--landscape/--portrait", help="Default: landscape for a corner, else portrait."),
]
Diameter = Annotated[
    float | None, typer.Option("--diameter", help="Of the discs, mm; default by paper size.")
]

Charuco = Annotated[str | None, typer.Option("--charuco", help="A ChArUco board: 11x8 squares.")]
Chessboard = Annotated[
    str | None, typer.Option("--chessboard", help="A chessboard: 9x6 inner corners.")
]
AprilGrid = Annotated[str | None, typer.Option("--aprilgrid", help="Kalibr's AprilGrid: 6x6 tags.")]
Square = Annotated[
    float | None, typer.Option("--square", min=0.1, help="Of a board: side of a square, mm.")
]
MarkerSide = Annotated[
    float | None, typer.Option("--marker", min=0.1, help="Of a board: side of a marker or tag, mm.")
]
Spacing = Annotated[
    float, typer.Option("--spacing", help="Of an AprilGrid, over the side of a tag.")
]
Dictionary = Annotated[str, typer.Option("--dictionary", help="Of a ChArUco board: OpenCV's name.")]
Legacy = Annotated[bool, typer.Option("--legacy", help="ChArUco as OpenCV drew it before 4.6.")]


def board_of(
    charuco: str | None,
    chessboard: str | None,
    aprilgrid: str | None,
    square: float | None,
    marker: float | None,
    spacing: float,
    dictionary: str,
    legacy: bool,
) -> Board | None:
    """The board that these options describe, None where none does; its sizes are 0 where they are
    not given. UsageError for two boards, or counts that are none.
    """
    from thermocald.output.testfield.board import KINDS, Board

    given = [(k, n) for k, n in zip(KINDS, (charuco, chessboard, aprilgrid), strict=True) if n]
    if len(given) > 1:
        raise UsageError(f"--{given[0][0]} and --{given[1][0]}: one board at a time")
    if not given:
        return None
    kind, counts = given[0]
    columns, rows = _counts(f"--{kind}", counts)
    return Board(kind, columns, rows, square or 0.0, marker or 0.0, spacing, dictionary, legacy)


def _counts(option: str, text: str) -> tuple[int, int]:
    columns, _, rows = text.lower().replace("×", "x").partition("x")
    if not (columns.isascii() and columns.isdigit() and rows.isascii() and rows.isdigit()):
        raise UsageError(f"{option} {text}: write COLUMNSxROWS, such as 9x6")
    if not 0 < int(columns[:6]) <= 1000 or not 0 < int(rows[:6]) <= 1000:
        raise UsageError(f"{option} {text}: counts up to 1000 are possible")
    return int(columns), int(rows)


def design_of(paper: str, flat: bool, landscape: bool | None, diameter: float | None) -> Design:
    """The print that these options describe; UsageError for paper that there is not."""
    from thermocald.output.testfield.layout import Design, paper_size
    from thermocald.output.testfield.print import default_diameter

    page = paper_size(paper, landscape=not flat if landscape is None else landscape)
    if landscape is None and "x" in paper.lower().replace("×", "x"):
        page = paper_size(paper)  # a size in mm says itself how it lies
    return Design(
        page, diameter if diameter is not None else default_diameter(page), sheets=1 if flat else 3
    )
