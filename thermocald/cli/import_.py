"""`thermocald import`: a recording from photographs and any logger's file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import say, write_result
from thermocald.cli.options import (
    JsonOption,
    PhotosArgument,
    PixelPitchOption,
    TimezoneOption,
    takes_log_options,
)
from thermocald.errors import UsageError

if TYPE_CHECKING:
    pass


@takes_log_options
def import_(
    photos: PhotosArgument,
    log: Annotated[Path, typer.Option(help="The logger's file, in any dialect of CSV.")],
    testfield: Annotated[
        Path | None, typer.Option(help="The surveyed test field, testfield.csv.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The recording to write (a new folder).")
    ] = None,
    pixel_pitch: PixelPitchOption = None,
    camera: Annotated[Path | None, typer.Option(help="A camera file of any format.")] = None,
    series: Annotated[str, typer.Option(help="Name of this series.")] = "M1",
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show what would be written, and write nothing.")
    ] = False,
    camera_timezone: Annotated[
        str | None, expert(help="The camera's own, whatever EXIF says of it.")
    ] = None,
    camera_clock: Annotated[
        str, expert(help="How far the camera's clock was ahead: +00:03:12.")
    ] = "0",
    times: Annotated[
        str, expert(help="Of photographs: exif, name (of the file), file (date).")
    ] = "exif",
    principal_distance: Annotated[
        float | None, expert(help="Of the lens, mm; EXIF's by default.", min=0.1)
    ] = None,
    timezone: TimezoneOption = None,
    ambiguous: str = "order",
    log_options: Any = None,
    json: JsonOption = None,
) -> None:
    """Make a recording of photographs with EXIF times and a logger's file.

    Times without a zone are refused until --timezone says it; columns are guessed and shown, or
    named. --dry-run shows everything that was understood.

    Example: thermocald import photos/ --log logger.csv --timezone Europe/Berlin --testfield
    surveyed.csv --out M1
    """
    from thermocald.store.logger.clock import device_clock
    from thermocald.store.logger.photographs import SOURCES, find_photographs, read_photograph
    from thermocald.store.logger.series import (
        camera_of,
        in_memory,
        put_together,
        write_photographs,
    )
    from thermocald.store.recording.testfield_file import read_testfield

    if times not in SOURCES:
        raise UsageError(f"--times {times}: must be one of {', '.join(SOURCES)}")
    if not dry_run and (testfield is None or out is None):
        missing = "--testfield" if testfield is None else "--out"
        raise UsageError(f"{missing} is missing (without both, --dry-run shows what is understood)")
    field = None if testfield is None else read_testfield(testfield)
    clock = device_clock(timezone, camera_timezone, camera_clock, ambiguous, "--camera-timezone")
    pictures = [read_photograph(path, times) for path in find_photographs(photos)]
    placed = put_together(pictures, clock, log, log_options)
    spec, notes = camera_of(pictures[0], camera, pixel_pitch, principal_distance, dry_run)
    for line in [*placed.preview(), *notes]:
        say(line)
    document = {
        "format": "thermocald-import/1",
        "recording": None if dry_run else out,
        "epochs": len(placed.times),
        "with_temperature": int((placed.at_frame == placed.at_frame).sum()),
        "first": float(placed.times[0]),
        "last": float(placed.times[-1]),
        "channels": list(placed.log.channels),
        "camera": {
            "width": spec.sensor.width, "height": spec.sensor.height,
            "pixel_pitch": spec.sensor.pixel_pitch, "principal_distance": spec.principal_distance,
        },
        "notes": [*placed.preview(), *notes],
    }  # fmt: skip
    if not dry_run and out is not None and field is not None:
        write_photographs(out, in_memory(placed, spec, field, series), placed)
    if write_result(document, json):
        typer.echo(
            "nothing was written (--dry-run)" if dry_run
            else f"{out}: {len(placed.times)} epochs; next: thermocald replay {out}"
        )  # fmt: skip
