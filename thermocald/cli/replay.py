"""`thermocald replay` and `thermocald export`: a recording calibrated, a series as a table."""

from __future__ import annotations

from pathlib import Path

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import (
    DEFAULT_FREE,
    ExteriorOption,
    FreeOption,
    JobsOption,
    JsonOption,
    TimezoneOption,
    progress,
    say,
    show,
    warnings_said,
    write_parts,
)
from thermocald.errors import DataError, UsageError


def replay(
    recording: Path = typer.Argument(..., help="The recording's folder."),
    store: Path | None = typer.Option(
        None, help="Keep all in this store; an interrupted replay goes on."
    ),
    exterior: ExteriorOption = "auto",
    free: FreeOption = DEFAULT_FREE,
    jobs: JobsOption = 1,
    model: Path | None = typer.Option(
        None, help="Of photographs of a scene: the camera's thermal model."
    ),
    log: Path | None = typer.Option(
        None, help="With --model: a logger's file, a recording, or a store."
    ),
    times: str = expert(
        "exif", "--times", help="With --model, when each was taken: exif, name, or file."
    ),
    recording_out: Path | None = typer.Option(
        None,
        "--recording-out",
        help="With --model: a folder for what does not move, a recording for `discover`.",
    ),
    timezone: TimezoneOption = None,
    json: JsonOption = None,
) -> None:
    """Calibrate every epoch of a recording, and say what the series is worth.

    With --model, RECORDING is a folder of photographs of a scene without a test field: what does
    not move in it is compared with what the thermal model predicts.

    Example: thermocald replay rpi-heating-M1 --store thermocald.db

    Example: thermocald replay photos --model camera.thermal.yaml --log weather.csv --timezone UTC
    """
    import thermocald as tc
    from thermocald.store.recording.sense import doubt_lines

    if (model is None) != (log is None):
        raise UsageError("--model and --log go together")
    if recording_out is not None and model is None:
        raise UsageError(
            "--recording-out goes with --model: it keeps what does not move in a scene"
        )
    if model is not None and log is not None:
        from thermocald.store.logger.photographs import find_photographs

        camera, pictures = tc.load_camera(model), find_photographs([recording])
        with warnings_said(), progress(len(pictures), "following") as advance:
            found = tc.follow_scene(
                recording, camera, log=log, times=times, timezone=timezone, progress=advance,
                recording=recording_out,
            )  # fmt: skip
        show(found, json)
        return
    series = tc.open(recording)
    with progress(len(series), "calibrating") as advance:
        table = series.calibrate(
            exterior=exterior, free=free, store=store, jobs=jobs, progress=advance
        )
    doubts = series.doubts(table)
    document = {**table.as_dict(), "recording": recording, "store": store, "doubts": doubts}
    show(document, json, table)
    for line in doubt_lines(doubts):
        say(line)
    if not table.ok.any():
        why = next(iter(table.without_result), "there is no epoch")
        raise DataError(f"{recording}: no epoch has a result: {why}")


def export(
    source: Path = typer.Argument(..., help="A recording (folder) or a store (file)."),
    format_: str = typer.Option("csv", "--format", help="csv, json, or parquet."),
    output: str = typer.Option("-", "--output", "-o", help="File; - is standard output."),
    exterior: str = typer.Option(
        "",
        help="stored: a store's epochs as they were stored; the others adjust the series "
        "again: auto (of a recording), per_epoch, series, mount.",
    ),
    free: FreeOption = DEFAULT_FREE,
    series: str | None = typer.Option(None, help="Which of a store: CAMERA/SERIES or SERIES."),
    units: str = typer.Option("", help="px, um, deg instead of mm and rad; named in the columns."),
    time_: str = typer.Option("seconds", "--time", help="seconds since 1970 UTC, or iso."),
    separator: str = typer.Option(",", help="Between the columns: , ; | tab"),
    decimal: str = typer.Option(".", help="The decimal mark: . or ,"),
    extra: bool = expert(
        False,
        "--extra",
        help="All thermometers and all else that is stored of an epoch: camera_… settings as "
        "the camera reported them, light, blur, the online filter.",
    ),
    jobs: JobsOption = 1,
) -> None:
    """Write one row per epoch: parameters, standard deviations, sigma0, status.

    With one of --units, --time, --separator, --decimal, --extra, and as Parquet, the temperatures
    of all thermometers follow.

    Example: thermocald export rpi-heating-M1 --format csv > M1.csv

    Example: thermocald export M1 --units px,deg --time iso --separator ';' --decimal ',' -o M1.csv
    """
    import thermocald as tc
    from thermocald.output import series_export
    from thermocald.store.recording.parquet_table import write_parquet

    folder = source.is_dir()
    exterior = exterior or ("auto" if folder else "stored")
    if format_ not in ("csv", "json", "parquet"):
        raise UsageError(f"--format {format_}: csv, json and parquet are written")
    style = series_export.style_of(units, time_, separator, decimal)
    if format_ == "parquet" and output == "-":
        raise UsageError("--format parquet needs a file: -o FILE")
    if format_ == "json" and not style.is_plain:
        raise UsageError("--units, --time, --separator and --decimal are for csv and parquet")
    opened = tc.open(source, series)
    with progress(len(opened) if folder else None, "calibrating") as advance:
        table = opened.calibrate(exterior=exterior, free=free, jobs=jobs, progress=advance)
    known = None
    if extra or format_ == "parquet" or not style.is_plain:
        known = opened.besides(table.number, extra=extra)
    pitch = opened.head.camera.sensor.pixel_pitch
    parts = series_export.column_parts(table, style, pitch, known)
    if format_ == "parquet":
        write_parquet(Path(output), parts)
    elif format_ == "json":
        write_parts(series_export.as_json(parts), output)
    else:
        write_parts(series_export.as_csv(parts, style), output)
    for sentence, count in sorted(table.without_result.items()):
        say(f"{count} epochs without a result: {sentence}")
