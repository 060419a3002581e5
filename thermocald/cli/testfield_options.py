"""Options that several of the commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["CameraFile", "Json", "PixelPitch"]

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
