"""`thermocald testfield print`: the sheets, and the test field that they are."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.cli.testfield_options import Json

if TYPE_CHECKING:
    from thermocald.output.testfield.print import Printed

__all__ = ["print_"]


def print_(
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to write into.")],
    paper: Annotated[
        str, typer.Option("--paper", help="A4, A3, A2, A1, A0, or WIDTHxHEIGHT in mm.")
    ] = "A3",
    landscape: Annotated[bool, typer.Option("--landscape", help="Turn the paper.")] = False,
    corner: Annotated[
        bool, typer.Option("--corner", help="Three sheets for three planes of a corner.")
    ] = False,
    diameter: Annotated[
        float | None, typer.Option("--diameter", help="Of the discs, mm; default by paper size.")
    ] = None,
    bits: Annotated[
        int | None, typer.Option("--bits", help="Of the ring codes: 12, 14, or 0 for none.")
    ] = None,
    plain: Annotated[
        bool, typer.Option("--plain/--no-plain", help="Plain circles between the coded ones.")
    ] = True,
    markers: Annotated[
        str | None,
        typer.Option("--markers", help="Markers too, of a dictionary: DICT_APRILTAG_36h11."),
    ] = None,
    marker_every: Annotated[
        int, typer.Option("--marker-every", help="Every how many-th place is a marker.")
    ] = 5,
    light: Annotated[bool, typer.Option("--light", help="White targets on black.")] = False,
    first_code: Annotated[
        int, typer.Option("--first-code", min=0, help="Skip so many codes: for a second field.")
    ] = 0,
    pitch: Annotated[
        float | None, typer.Option("--pitch", help="Distance of the coded targets, mm.")
    ] = None,
    json: Json = None,
) -> None:
    """Draw a test field: a PDF, an SVG per sheet, and the matching testfield.csv.

    Print without scaling ("actual size"), measure the rulers, then survey what you have built.

    Example: thermocald testfield print --paper A3 --corner --out field
    """
    from thermocald.cli.common import write_json
    from thermocald.output.testfield.layout import Design, paper_size
    from thermocald.output.testfield.print import default_diameter, print_testfield

    page = paper_size(paper, landscape=landscape)
    design = Design(
        page=page,
        diameter=diameter if diameter is not None else default_diameter(page),
        bits=bits,
        plain=plain,
        dictionary=markers,
        marker_every=marker_every,
        light=light,
        sheets=3 if corner else 1,
        first_code=first_code,
        pitch=pitch,
    )
    printed = print_testfield(design, out)
    document = _print_document(printed)
    if json is not None:
        write_json(document, json)
    if json != "-":
        sheet = printed.sheets[0]
        typer.echo(
            f"{out}: {len(printed.sheets)} sheet{'s' if corner else ''} of "
            f"{page[0]:g} × {page[1]:g} mm, {document['coded']} coded and {document['plain']} "
            f"plain circles of {sheet.design.diameter:g} mm, {document['markers']} markers"
        )
        for bar in document["scale_bars"]:
            typer.echo(
                f"  {bar['sheet']}: measure {bar['a']} to {bar['b']} (nominal "
                f"{bar['nominal']:.2f} mm) for --scale {bar['a']} {bar['b']} MM"
            )


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
