"""`thermocald import`, `archive`, `backup`, `convert`: a recording or a store in another form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import (
    JsonOption,
    PhotosArgument,
    PixelPitchOption,
    StoreArgument,
    TimezoneOption,
    progress,
    say,
    show,
    takes_log_options,
    write_json,
)
from thermocald.errors import RecordingError, UsageError


@takes_log_options
def import_(
    photos: PhotosArgument,
    log: Path = typer.Option(..., help="The logger's file, in any dialect of CSV."),
    testfield: Path | None = typer.Option(None, help="The surveyed test field, testfield.csv."),
    out: Path | None = typer.Option(
        None, "--out", "-o", help="The recording to write (a new folder)."
    ),
    pixel_pitch: PixelPitchOption = None,
    camera: Path | None = typer.Option(None, help="A camera file of any format."),
    series: str = typer.Option("M1", help="Name of this series."),
    dry_run: bool = typer.Option(
        False, "--dry-run", help="Show what would be written, and write nothing."
    ),
    camera_timezone: str | None = expert(
        None, help="The camera's time zone, whatever EXIF says of it."
    ),
    camera_clock: str = expert("0", help="How far the camera's clock was ahead: +00:03:12."),
    times: str = expert(
        "exif", help="Where the photographs' times are: exif, name (of the file), file (its date)."
    ),
    principal_distance: float | None = expert(
        None, help="Principal distance, mm; by default EXIF's focal length.", min=0.1
    ),
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
    from thermocald.daemon.soundness import calibration_doubts
    from thermocald.store.logger.clock import device_clock
    from thermocald.store.logger.photographs import read_photographs, read_series, write_photographs
    from thermocald.store.recording.reader import read_recording
    from thermocald.store.recording.sense import doubt_lines
    from thermocald.store.recording.testfield_file import read_testfield

    field = None if testfield is None else read_testfield(testfield)
    if not dry_run and (field is None or out is None):
        missing = "--testfield" if testfield is None else "--out"
        raise UsageError(
            f"{missing} is missing: give it, or --dry-run to see what is understood of the files"
        )
    recording, notes = read_series(
        read_photographs(photos, times),
        device_clock(timezone, camera_timezone, camera_clock, ambiguous, "--camera-timezone"),
        log, log_options, testfield=None if dry_run else field, series=series,
        camera=camera, pitch=pixel_pitch, distance=principal_distance,
    )  # fmt: skip
    for line in notes:
        say(line)
    if not dry_run and out is not None:
        write_photographs(out, recording)
        # what EXIF does not tell of the pixels, the camera that some photographs give does
        doubts = doubt_lines(calibration_doubts(read_recording(out)))
        for line in doubts:
            say(line)
        notes += doubts
    columns, spec = recording.columns, recording.head.camera
    at_frame = columns.at_frame(next(iter(columns.temperatures)))
    document = {
        "format": "thermocald-import/1",
        "recording": None if dry_run else out,
        "epochs": len(columns),
        "with_temperature": int((at_frame == at_frame).sum()),
        "first": float(columns.frame_time[0]),
        "last": float(columns.frame_time[-1]),
        "channels": list(columns.temperatures),
        "camera": {
            "width": spec.sensor.width, "height": spec.sensor.height,
            "pixel_pitch": spec.sensor.pixel_pitch, "principal_distance": spec.principal_distance,
        },
        "notes": notes,
    }  # fmt: skip
    said = f"{out}: {len(columns)} epochs; next: thermocald replay {out}"
    show(document, json, "nothing was written (--dry-run)" if dry_run else said)


def archive(
    store: StoreArgument = None,
    folder: Path = typer.Option(Path(), "--to", help="The folder in which recordings are written."),
    config: Path | None = typer.Option(
        None, "--config", "-c", help="Store and frames of this configuration."
    ),
    frames: Path | None = expert(None, help="The daemon's folder of frames."),
    series: str | None = typer.Option(None, help="CAMERA/SERIES or SERIES; default: all."),
    skip_existing: bool = expert(
        False, "--skip-existing", help="Pass over recordings that are there already."
    ),
    finished: bool = expert(
        False, "--finished", help="Only series that have ended, since the camera began another."
    ),
    retention: bool = expert(
        False, "--retention", help="Then delete frames as the configuration's limits say."
    ),
    json: JsonOption = None,
) -> None:
    """Write every series as a recording `<camera>-<series>`, a folder that replays anywhere.

    Readings that belong to no epoch become `thermometer-<name>.csv`, unless --finished or --series
    is given.

    Example: thermocald archive thermocald.db --to recordings
    """
    from thermocald.config import load_config
    from thermocald.daemon.control import enforce_retention
    from thermocald.store.database.archive import archive_store

    read = None
    if retention and config is None:
        raise UsageError("--retention needs --config FILE: it holds the limits")
    if config is not None:
        read = load_config(config)
        store, frames = store or read.store.path, frames or read.frames.folder
    if store is None:
        raise UsageError("which store? give its file, or --config FILE")
    if finished and not store.exists():
        say(f"{store}: nothing was stored yet")
        return
    document = archive_store(store, folder, frames, series, finished, skip_existing, say)
    deleted = enforce_retention(read) if retention and read is not None else []
    for sentence in deleted:
        say(sentence)
    write_json({"format": "thermocald-archive/1", **document, "deleted": deleted}, json)


def backup(
    store: StoreArgument = None,
    to: Path | None = typer.Argument(None, help="A file that does not exist yet, or a folder."),
    config: Path | None = typer.Option(
        None, "--config", "-c", help="The store of this configuration."
    ),
    keep: int = typer.Option(0, min=0, help="In a folder: delete all but the newest N; 0: none."),
    json: JsonOption = None,
) -> None:
    """Copy a store and read the copy again: every row must be as it was written.

    In a folder the copy is called `<store>-<UTC>.db`. A store that is damaged is not copied: exit
    status 1, and older backups stay.

    Example: thermocald backup thermocald.db backups/
    """
    from thermocald.config import load_config
    from thermocald.store.database.archive import back_up

    if config is not None:
        store, to = load_config(config).store.path, to or store
    if store is None or to is None:
        raise UsageError("give STORE and TO, or --config FILE and TO")
    document = back_up(store, to, keep)
    say(f"{document['backup']}: {document['epochs']} epochs, every row verified")
    for path in document["deleted"]:
        say(f"{path}: deleted, {keep} newer ones are kept")
    write_json(document, json)


_NAMES = {"csv": "observations.csv", "parquet": "observations.parquet"}


def convert(
    recording: Path = typer.Argument(..., help="The recording's folder; changed in place."),
    to: str = typer.Option("parquet", help="csv, or parquet (needs pyarrow)."),
    keep: bool = typer.Option(
        False, "--keep", help="Keep the other file, under its name with `.old`."
    ),
) -> None:
    """Rewrite a recording's observations as Parquet, which reads ten times as fast, or as CSV.

    Every number stays the same to the bit. Other files of the recording are not touched.

    Example: thermocald convert M1 --to parquet
    """
    from thermocald.store.recording.parquet_table import csv_to_parquet, parquet_to_csv
    from thermocald.store.recording.reader import open_recording

    if to not in _NAMES:
        raise UsageError(f"--to {to}: there are {', '.join(_NAMES)}")
    open_recording(recording)  # a folder that is not a recording is left alone
    target = recording / _NAMES[to]
    source = recording / next(name for key, name in _NAMES.items() if key != to)
    if target.exists():
        say(f"{target} is there already")
        return
    if not source.exists():
        raise RecordingError(f"{recording}: has no observations, only frames; nothing to convert")
    before = source.stat().st_size
    with progress(None, "rows") as advance:
        (csv_to_parquet if to == "parquet" else parquet_to_csv)(source, target, advance)
    if keep:
        source.rename(source.with_name(source.name + ".old"))
    else:
        source.unlink()
    say(f"{target}: {target.stat().st_size / 1e6:.1f} MB, {source.name} had {before / 1e6:.1f} MB")
