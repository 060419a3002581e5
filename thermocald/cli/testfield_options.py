"""Options that several of the commands share, and the print that they describe."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from thermocald.output.testfield.layout import Design

__all__ = [
    "CameraFile",
    "Diameter",
    "Flat",
    "Json",
    "Landscape",
    "Paper",
    "PixelPitch",
    "design_of",
]

Json = Annotated[
    str | None, typer.Option("--json", help="Write the result as JSON; - for standard output.")
]
CameraFile = Annotated[
    Path | None,
    typer.Option("--camera", help="A camera file of any format that `camera convert` reads."),
]
PixelPitch = Annotated[
    float | None, typer.Option("--pixel-pitch", help="Size of a pixel in mm.", min=1e-5, max=1.0)
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
