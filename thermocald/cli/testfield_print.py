"""`thermocald testfield print`: the sheets, and the test field that they are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.cli.common import say
from thermocald.cli.options import JsonOption
from thermocald.cli.testfield_options import (
    AprilGrid,
    Charuco,
    Chessboard,
    Diameter,
    Dictionary,
    Flat,
    Landscape,
    Legacy,
    MarkerSide,
    Paper,
    Spacing,
    Square,
    board_of,
    design_of,
)

if TYPE_CHECKING:
    from thermocald.output.testfield.board import Board
    from thermocald.output.testfield.print import Printed

__all__ = ["ONE_PLANE", "print_"]

ONE_PLANE = (
    "one flat sheet calibrates a camera from photographs in several poses (thermocald calibrate); "
    "a camera that stands still before it gets no result: for series print the corner, or put up "
    "two or three sheets at an angle and survey them"
)


def print_(
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to write into.")],
    paper: Paper = "A3",
    flat: Flat = False,
    landscape: Landscape = None,
    diameter: Diameter = None,
    bits: Annotated[
        int | None, typer.Option(help="Of the ring codes: 12, 14, or 0 for none.")
    ] = None,
    plain: Annotated[
        bool, typer.Option("--plain/--no-plain", help="Plain circles between the coded ones.")
    ] = True,
    markers: Annotated[
        str | None, typer.Option(help="Markers too, of a dictionary: DICT_APRILTAG_36h11.")
    ] = None,
    marker_every: Annotated[int, typer.Option(help="Every N-th place is a marker.")] = 5,
    light: Annotated[bool, typer.Option("--light", help="White targets on black.")] = False,
    first_code: Annotated[
        int, typer.Option(min=0, help="Skip so many codes: for a second field.")
    ] = 0,
    pitch: Annotated[float | None, typer.Option(help="Distance of the coded targets, mm.")] = None,
    charuco: Charuco = None,
    chessboard: Chessboard = None,
    aprilgrid: AprilGrid = None,
    square: Square = None,
    marker: MarkerSide = None,
    spacing: Spacing = 0.3,
    dictionary: Dictionary = "DICT_5X5_1000",
    legacy: Legacy = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace a test field that was printed before.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Draw a test field: a PDF, an SVG per sheet, and the testfield.csv that belongs to it.

    By default it is a corner of three sheets; the last page of the PDF shows how to put it up.
    Print without scaling ("actual size"), measure the rulers, then survey what you have built.

    With --charuco, --chessboard or --aprilgrid it is one board of that kind, as large as the paper
    allows unless sizes are given.

    Example: thermocald testfield print --paper A3 --out field
    Example: thermocald testfield print --aprilgrid 6x6 --paper A2 --out board
    """
    from thermocald.cli.common import write_json
    from thermocald.output.testfield.print import print_testfield

    board = board_of(charuco, chessboard, aprilgrid, square, marker, spacing, dictionary, legacy)
    if board is not None:
        _print_board(board, paper, landscape, out, force, json)
        return

    design = replace(
        design_of(paper, flat, landscape, diameter),
        bits=bits, plain=plain, dictionary=markers, marker_every=marker_every, light=light,
        first_code=first_code, pitch=pitch,
    )  # fmt: skip
    printed = print_testfield(design, out, replace_printed=force)
    document = _print_document(printed)
    if json is not None:
        write_json(document, json)
    if json == "-":
        return
    sheets = "1 sheet" if flat else "3 sheets of a corner (and how to put it up)"
    typer.echo(
        f"{out}: {sheets} of {design.page[0]:g} × {design.page[1]:g} mm, {document['coded']} coded "
        f"and {document['plain']} plain circles of {design.diameter:g} mm, {document['markers']} "
        "markers"
    )
    for bar in document["scale_bars"]:
        typer.echo(
            f"  {bar['sheet']}: measure {bar['a']} to {bar['b']} (nominal "
            f"{bar['nominal']:.2f} mm) for --scale {bar['a']} {bar['b']} MM"
        )
    if flat:
        say(ONE_PLANE)


def _print_board(
    board: Board, paper: str, landscape: bool | None, out: Path, force: bool, json: str | None
) -> None:
    """The board on one page, which lies as the board does unless it is said how."""
    from thermocald.cli.common import write_json
    from thermocald.output.testfield.layout import PAPERS, paper_size
    from thermocald.output.testfield.print import print_board

    wide = board.columns > board.rows and paper.strip().upper() in PAPERS
    page = paper_size(paper, landscape=wide if landscape is None else landscape)
    board = board.filled(page)
    printed = print_board(board, page, out, replace_printed=force)
    document = {
        "format": "thermocald-testfield-print/1",
        "files": [str(path) for path in printed.files],
        "sheets": 1,
        "board": board.kind,
        "square": board.square,
        "marker": board.marker,
        "targets": len(printed.field),
    }
    if json is not None:
        write_json(document, json)
    if json == "-":
        return
    typer.echo(
        f"{out}: {board.name} ({board.measures}) on {page[0]:g} × {page[1]:g} mm, "
        f"{len(printed.field)} targets"
    )
    say(ONE_PLANE)


def _print_document(printed: Printed) -> dict[str, Any]:
    circles = [t for sheet in printed.sheets for t in sheet.targets]
    bars = []
    for sheet in printed.sheets:
        if sheet.scale_bar is not None:
            a, b = sheet.scale_bar
            length = ((b.x - a.x) ** 2 + (b.y - a.y) ** 2) ** 0.5
            bars.append({"sheet": sheet.title, "a": a.name, "b": b.name, "nominal": length})
    return {
        "format": "thermocald-testfield-print/1",
        "files": [str(path) for path in printed.files],
        "sheets": len(printed.sheets),
        "diameter": printed.sheets[0].design.diameter,
        "targets": len(printed.field),
        "coded": sum(bool(t.code) for t in circles),
        "plain": sum(not t.code for t in circles),
        "markers": sum(len(sheet.markers) for sheet in printed.sheets),
        "scale_bars": bars,
    }
