"""`thermocald measure`: places in metres from the image points of a calibrated camera."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from thermocald.cli.common import say, warnings_said, write_result
from thermocald.cli.options import (
    ExtrapolateOption,
    JsonOption,
    ModelOption,
    TimezoneOption,
    takes_log_options,
)
from thermocald.errors import UsageError

_USUAL_THERMOMETER_SD = 0.05  # K, where no fit has found it


@takes_log_options
def measure(
    points: Annotated[
        Path,
        typer.Argument(metavar="POINTS.csv", help="Columns time, name, x, y, sx, sy (px)."),
    ],
    model: ModelOption,
    log: Annotated[Path, typer.Option(help="A logger's file, a recording, or a store.")],
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
    from thermocald.analysis.thermal.control_points import UNITS, ControlPoints
    from thermocald.analysis.thermal.model_log import read_model_log
    from thermocald.analysis.thermal.places import measure_places, read_surface
    from thermocald.analysis.thermal.timed_rows import first_times, row_blocks, seconds_of
    from thermocald.store.logger.clock import device_clock

    if length_unit not in UNITS:
        raise UsageError(f"--length-unit {length_unit}: mm or m")
    thermal = tc.load_camera(model)
    if thermal.warning:
        say(f"warning: {thermal.warning}")
    clock = device_clock(timezone, ambiguous=ambiguous)
    given = ControlPoints.read(control, length_unit)
    if given.assumed:
        say(given.assumed)
    surface = read_surface(plane, given)
    table = read_model_log(thermal, log, log_options, first_times(points, clock)[1])
    rows = list(row_blocks(points, ("x", "y", "sx", "sy"), clock))
    for line, why in (r for b in rows for r in b.refused):
        say(f"{points}, line {line}: {why}; left out")
    values = np.concatenate([b.values for b in rows])
    times = np.concatenate([b.times for b in rows])
    names = [r.get("name") or str(n) for b in rows for n, r in zip(b.lines, b.rows, strict=True)]
    when = seconds_of(seen, clock)
    noise = thermal.thermometer_sd or _USUAL_THERMOMETER_SD
    with warnings_said():
        found = measure_places(
            thermal, table, given, when, surface, names, times, values, noise, extrapolate
        )
    if write_result(found.as_dict(), json):
        typer.echo(str(found))
