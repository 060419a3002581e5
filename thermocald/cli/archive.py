"""`thermocald import`, `archive`, `backup`, `convert`: write recordings and copies of stores."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

import thermocald as tc
from thermocald.cli import options as opt
from thermocald.cli.commands import expert
from thermocald.cli.common import progress, say, show, write_json
from thermocald.errors import RecordingError, UsageError
from thermocald.numbers import counted
from thermocald.result import document_of


@opt.takes_log_options
def import_(
    photos: opt.Photos,
    log: Path = typer.Option(..., help="The logger's file, any dialect of CSV."),
    testfield: Path | None = typer.Option(None, help="The surveyed test field, testfield.csv."),
    out: Path | None = typer.Option(
        None, "--out", "-o", help="The recording to write (a new folder)."
    ),
    pixel_pitch: opt.PixelPitch = None,
    camera: Path | None = typer.Option(None, help="A camera file of any format."),
    series: str = typer.Option("M1", help="Name of this series."),
    dry_run: bool = typer.Option(False, "--dry-run", help="Show only what would be written."),
    camera_timezone: str | None = expert(None, help="Time zone of the camera; overrides EXIF."),
    camera_clock: str = expert("0", help="Advance of the camera's clock, such as +00:03:12."),
    times: str = expert(
        "exif", help="Source of the photographs' times: exif, name (of the file), file (its date)."
    ),
    principal_distance: float | None = expert(
        None, help="Principal distance, mm; default: the focal length in EXIF.", min=0.1
    ),
    timezone: opt.Timezone = None,
    ambiguous: str = "order",
    log_options: Any = None,
    json: opt.Json = None,
) -> None:
    """Make a recording from photographs with EXIF times and a logger's file.

    Times without a zone are refused unless --timezone is given. Columns are guessed, and the guess
    is shown, unless they are named. --dry-run shows how the files were interpreted.

    Example: thermocald import photos/ --log logger.csv --timezone Europe/Berlin --testfield
    surveyed.csv --out M1
    """
    import numpy as np

    if not dry_run and (testfield is None or out is None):
        missing = "--testfield" if testfield is None else "--out"
        raise UsageError(
            f"{missing} is missing: give it, or --dry-run to see how the files are interpreted"
        )
    field = None if testfield is None else tc.read_testfield(testfield)
    notes: list[str] = []

    def note(line: str) -> None:
        notes.append(line)
        say(line)

    found = tc.import_photographs(
        photos, log=log, testfield=None if dry_run else field, timezone=timezone,
        ambiguous=ambiguous, camera_timezone=camera_timezone, camera_clock=camera_clock,
        log_options=log_options, pixel_pitch=pixel_pitch, principal_distance=principal_distance,
        camera=camera, series=series, times=times, out=None if dry_run else out, say=note,
    )  # fmt: skip
    spec = found.head.camera
    document = {
        "format": "thermocald-import/1", "recording": None if dry_run else out,
        "epochs": len(found), "with_temperature": int(np.isfinite(found.temperature).sum()),
        "first": float(found.frame_time[0]), "last": float(found.frame_time[-1]),
        "channels": list(found.temperatures), "notes": notes,
        "camera": {**document_of(spec.sensor), "principal_distance": spec.principal_distance},
    }  # fmt: skip
    summary = f"{out}: {counted(len(found), 'epoch')}; next: thermocald replay {out}"
    show(document, json, "nothing was written (--dry-run)" if dry_run else summary)


def archive(
    store: opt.Store = None,
    folder: Path = typer.Option(Path(), "--to", help="Folder for the recordings."),
    config: opt.StoreConfig = None,
    frames: Path | None = expert(None, help="Folder of the daemon's frames."),
    series: str | None = typer.Option(None, help="CAMERA/SERIES or SERIES; default: all."),
    skip_existing: bool = expert(False, "--skip-existing", help="Skip recordings that exist."),
    finished: bool = expert(
        False, "--finished", help="Only finished series: the camera has begun another one since."
    ),
    retention: bool = expert(
        False, "--retention", help="Then delete frames by the limits of the configuration."
    ),
    json: opt.Json = None,
) -> None:
    """Write every series as a recording `<camera>-<series>`, a folder that `replay` reads.

    Readings that belong to no epoch are written to `thermometer-<name>.csv`, unless --finished or
    --series is given.

    Example: thermocald archive thermocald.db --to recordings
    """
    from thermocald.config import load_config
    from thermocald.daemon.control import enforce_retention
    from thermocald.store.archive import archive_store

    read = None
    if config is not None:
        read = load_config(config)
        store, frames = store or read.store.path, frames or read.frames.folder
    if store is None:
        raise UsageError("STORE is missing: give its file, or --config FILE")
    if finished and not store.exists():
        say(f"{store}: nothing has been stored yet")
        return
    document = archive_store(store, folder, frames, series, finished, skip_existing, say)
    deleted = enforce_retention(read) if retention and read is not None else []
    for sentence in deleted:
        say(sentence)
    write_json({"format": "thermocald-archive/1", **document, "deleted": deleted}, json)


def backup(
    store: str | None = typer.Argument(None, help="The store; a daemon may be using it."),
    to: str | None = typer.Argument(
        None, metavar="TO", help="A file that does not exist yet, or a folder: FOLDER/ is made."
    ),
    config: opt.StoreConfig = None,
    keep: int = typer.Option(0, min=0, help="In a folder, keep only the newest N; 0 keeps all."),
    json: opt.Json = None,
) -> None:
    """Copy a store, then verify every row of the copy.

    In a folder, the copy is named `<store>-<UTC>.db`. A damaged store is not copied: the exit
    status is 1, and older backups are left as they are.

    Example: thermocald backup thermocald.db backups/
    """
    from thermocald.config import load_config
    from thermocald.files import make_folder
    from thermocald.store.archive import back_up

    if config is not None:
        to, store = to or store, str(load_config(config).store.path)
    if store is None or to is None:
        raise UsageError("give STORE and TO, or --config FILE and TO")
    if to.endswith("/") and Path(store).exists():
        make_folder(Path(to))
    document = back_up(Path(store), Path(to), keep)
    copied = f"{document['backup']}: {document['epochs']} epochs, every row verified"
    deleted = [f"{path}: deleted (--keep {keep})" for path in document["deleted"]]
    show(document, json, copied, *deleted)


_NAMES = {"csv": "observations.csv", "parquet": "observations.parquet"}


def convert(
    recording: Path = typer.Argument(..., help="The recording's folder; changed in place."),
    to: str = typer.Option("parquet", help="csv, or parquet (needs pyarrow)."),
    keep: bool = typer.Option(False, "--keep", help="Keep the original file, renamed to `.old`."),
) -> None:
    """Rewrite a recording's observations as Parquet, which is read ten times as fast, or as CSV.

    Every number is preserved bit for bit. The recording's other files are not changed.

    Example: thermocald convert M1 --to parquet
    """
    from thermocald.store.recording.observation_file import csv_to_parquet, parquet_to_csv
    from thermocald.store.recording.reader import open_recording

    if to not in _NAMES:
        raise UsageError(f"--to {to}: must be one of {', '.join(_NAMES)}")
    open_recording(recording)  # raises for a folder that is not a recording
    target = recording / _NAMES[to]
    source = recording / next(name for key, name in _NAMES.items() if key != to)
    if target.exists():
        say(f"{target} exists already")
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
