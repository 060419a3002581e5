"""`thermocald import`: a recording from photographs and any logger's file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thermocald.cli.common import say, write_result
from thermocald.cli.options import JsonOption, PhotosArgument, PixelPitchOption, TimezoneOption
from thermocald.errors import UsageError

if TYPE_CHECKING:
    from thermocald.store.logger.clock import DeviceClock
    from thermocald.store.logger.photographs import Photograph
    from thermocald.store.recording.head import CameraSpec

__all__ = ["import_"]


def import_(
    photos: PhotosArgument,
    log: Annotated[Path, typer.Option(help="The logger's file, in any dialect of CSV.")],
    testfield: Annotated[
        Path | None, typer.Option(help="The surveyed test field, testfield.csv.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The recording to write (a new folder).")
    ] = None,
    timezone: TimezoneOption = None,
    camera_timezone: Annotated[
        str | None, typer.Option(help="The camera's own, whatever EXIF says of it.")
    ] = None,
    log_timezone: Annotated[str | None, typer.Option(help="The logger's own.")] = None,
    camera_clock: Annotated[
        str, typer.Option(help="How far the camera's clock was ahead: +00:03:12.")
    ] = "0",
    log_clock: Annotated[str, typer.Option(help="How far the logger's clock was ahead.")] = "0",
    ambiguous: Annotated[
        str,
        typer.Option(
            help="The hour that comes twice in autumn: refuse, order (of rows), earlier, later."
        ),
    ] = "refuse",
    times: Annotated[
        str, typer.Option(help="Of photographs: exif, name (of the file), file (date).")
    ] = "exif",
    time_column: Annotated[
        list[str] | None, typer.Option(help="Of the log; twice for a date and a time.")
    ] = None,
    temperature_column: Annotated[
        list[str] | None, typer.Option(help="Of the log; the first is the reference.")
    ] = None,
    separator: Annotated[
        str | None, typer.Option(help="Of the log's columns: ';' ',' tab.")
    ] = None,
    decimal: Annotated[str | None, typer.Option(help="The log's decimal mark: , or .")] = None,
    date_order: Annotated[str | None, typer.Option(help="Of 06/07/2026: dmy or mdy.")] = None,
    unit: Annotated[
        str | None, typer.Option(help="Of the log: degC, K or degF; converted to °C.")
    ] = None,
    pixel_pitch: PixelPitchOption = None,
    principal_distance: Annotated[
        float | None, typer.Option(help="Of the lens, mm; EXIF's by default.", min=0.1)
    ] = None,
    camera: Annotated[Path | None, typer.Option(help="A camera file of any format.")] = None,
    series: Annotated[str, typer.Option(help="Name of this series.")] = "M1",
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show what would be written, and write nothing.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Make a recording of photographs with EXIF times and a logger's file.

    Times without a zone are refused until --timezone says it; columns are guessed and shown, or
    named. --dry-run shows everything that was understood.

    Example: thermocald import photos/ --log logger.csv --timezone Europe/Berlin --testfield
    surveyed.csv --out M1
    """
    from thermocald.store.logger.photographs import SOURCES, find_photographs, read_photograph
    from thermocald.store.logger.series import put_together
    from thermocald.store.logger.temperatures import UNITS, LogOptions, read_log
    from thermocald.store.recording.head import Channel, Head
    from thermocald.store.recording.testfield_file import read_testfield
    from thermocald.store.recording.writer import RecordingWriter

    _one_of("--times", times, SOURCES)
    _one_of("--unit", unit, UNITS)
    _one_of("--date-order", date_order, ("dmy", "mdy"))
    _one_of("--decimal", decimal, (",", "."))
    marks = {"tab": "\t", "\\t": "\t"}
    if not dry_run and (testfield is None or out is None):
        missing = "--testfield" if testfield is None else "--out"
        raise UsageError(f"{missing} is missing (without both, --dry-run shows what is understood)")
    field = None if testfield is None else read_testfield(testfield)
    pictures = [read_photograph(path, times) for path in find_photographs(photos)]
    logged = read_log(
        log,
        LogOptions(
            times=tuple(time_column or ()),
            temperatures=tuple(temperature_column or ()),
            separator=marks.get(separator or "", separator),
            decimal=decimal,
            date_order=date_order,
            unit=unit,
            clock=_clock(timezone, log_timezone, log_clock, ambiguous, "--log-timezone"),
        ),
    )
    clock = _clock(timezone, camera_timezone, camera_clock, ambiguous, "--camera-timezone")
    placed = put_together(pictures, clock, logged)
    spec, notes = _camera(pictures[0], camera, pixel_pitch, principal_distance, dry_run)
    for line in [*placed.preview(), *notes]:
        say(line)
    document = {
        "format": "thermocald-import/1",
        "recording": None if dry_run else out,
        "epochs": len(placed.times),
        "with_temperature": int((placed.at_frame == placed.at_frame).sum()),
        "first": float(placed.times[0]),
        "last": float(placed.times[-1]),
        "channels": list(logged.channels),
        "camera": {
            "width": spec.sensor.width, "height": spec.sensor.height,
            "pixel_pitch": spec.sensor.pixel_pitch, "principal_distance": spec.principal_distance,
        },
        "notes": [*placed.preview(), *notes],
    }  # fmt: skip
    if not dry_run and out is not None and field is not None:
        channels = {name: Channel() for name in logged.channels}
        head = Head(out.name, series, max(placed.interval, 0.001), spec, channels)
        with RecordingWriter(out, head, field) as writer:
            for epoch in placed.epochs():
                writer.append(epoch)
    if write_result(document, json):
        typer.echo(
            "nothing was written (--dry-run)" if dry_run
            else f"{out}: {len(placed.times)} epochs; next: thermocald replay {out}"
        )  # fmt: skip


def _one_of(option: str, value: str | None, allowed: tuple[str, ...]) -> None:
    if value is not None and value not in allowed:
        raise UsageError(f"{option} {value}: must be one of {', '.join(allowed)}")


def _clock(
    common: str | None, own: str | None, ahead: str, ambiguous: str, option: str
) -> DeviceClock:
    from thermocald.store.logger.clock import AMBIGUOUS, DeviceClock, clock_error, time_zone

    _one_of("--ambiguous", ambiguous, AMBIGUOUS)
    text = own if own is not None else common
    return DeviceClock(
        zone=None if text is None else time_zone(text),
        ahead=clock_error(ahead),
        ambiguous=ambiguous,
        forced=own is not None,
        option=option if own is not None else "--timezone",
    )


def _camera(
    photograph: Photograph,
    file: Path | None,
    pitch: float | None,
    distance: float | None,
    dry_run: bool,
) -> tuple[CameraSpec, list[str]]:
    """The camera, and what of it was taken from EXIF."""
    from thermocald.cli.camera_file import read_camera
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.store.recording.head import CameraSpec

    notes: list[str] = []
    if file is not None:
        known = read_camera(file, pitch)
        if (known.sensor.width, known.sensor.height) != (photograph.width, photograph.height):
            raise UsageError(
                f"{file}: is of {known.sensor.width} × {known.sensor.height} px, the photographs "
                f"have {photograph.width} × {photograph.height}"
            )
        return CameraSpec(known.name, known.sensor, known.principal_distance, known.interior), notes
    if distance is None and photograph.focal_length is not None:
        distance = photograph.focal_length
        notes.append(f"camera: principal distance {distance:g} mm from EXIF (--principal-distance)")
    if pitch is None:
        pitch = photograph.pixel_pitch
        unknown = (
            "the size of a pixel is not known and EXIF does not say it: --pixel-pitch 0.00112 "
            "(mm), or --camera FILE"
        )
        if pitch is None and not dry_run:
            raise UsageError(unknown)
        said = f"pixel pitch {pitch:.5f} mm from EXIF (--pixel-pitch)" if pitch else unknown
        notes.append(f"camera: {said}")
        pitch = pitch or 0.001
    sensor = Sensor(photograph.width, photograph.height, pitch)
    return CameraSpec(photograph.camera or "camera", sensor, distance), notes
