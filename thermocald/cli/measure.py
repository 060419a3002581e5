"""`thermocald measure`: places in metres from the image points of a calibrated camera."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from thermocald.cli.common import say, warned, warnings_said, write_result
from thermocald.cli.options import (
    ExtrapolateOption,
    JsonOption,
    LogOption,
    ModelOption,
    TimezoneOption,
    takes_log_options,
)


@takes_log_options
def measure(
    points: Annotated[
        Path,
        typer.Argument(metavar="POINTS.csv", help="Columns time, name, x, y, sx, sy (px)."),
    ],
    model: ModelOption,
    log: LogOption,
    control: Annotated[
        Path, typer.Option(help="Control points: target, X, Y, Z, sX, sY, sZ and x, y, sx, sy.")
    ],
    seen: Annotated[
        str, typer.Option(metavar="TIME", help="When the control points were seen there.")
    ],
    plane: Annotated[Path, typer.Option(help="YAML: level, or plane, or line; and sd.")],
    length_unit: Annotated[str, typer.Option(help="Of control points and plane: mm or m.")] = "mm",
    extrapolate: ExtrapolateOption = False,
    timezone: TimezoneOption = None,
    ambiguous: str = "order",
    log_options: Any = None,
    json: JsonOption = None,
) -> None:
    """Measure where image points lie on a water surface, a plane or a staff.

    Each place has its standard deviation, and stands beside what the camera would have given
    without its thermal model.

    Example: thermocald measure points.csv --model camera.thermal.yaml --log weather.csv
    --control gcp.csv --seen 2026-05-04T09:00:00Z --plane water.yaml --length-unit m
    """
    import thermocald as tc

    thermal = warned(tc.load_camera(model))
    with warnings_said():
        found = tc.measure(
            points, thermal, log=log, control=control, seen=seen, surface=plane, unit=length_unit,
            log_options=log_options, timezone=timezone, ambiguous=ambiguous,
            extrapolate=extrapolate, say=say,
        )  # fmt: skip
    if write_result(found.as_dict(), json):
        typer.echo(str(found))
