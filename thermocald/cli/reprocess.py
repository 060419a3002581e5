"""`thermocald reprocess`: whole archives calibrated again, on many cores or machines.

A task is one series analysed on its own, wherever that is.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import progress, say, write_json, write_result
from thermocald.cli.options import DEFAULT_FREE, FreeOption, JobsOption, JsonOption
from thermocald.errors import DataError, OutputError, ThermocaldError, UsageError
from thermocald.files import make_folder, write_text
from thermocald.result import jsonable
from thermocald.store.server.connection import ServerAddress, is_server
from thermocald.store.sources import source_name

ANALYSES = ("discover", "study")


@dataclass(frozen=True, slots=True)
class SeriesTask:
    """An analysis of one series: a recording's folder or an address that selects it.

    target: the JSON file it writes; sets: of the study's Monte-Carlo simulation.
    """

    analysis: str
    source: Path
    target: Path
    sets: int = 100_000


@dataclass(frozen=True, slots=True)
class SeriesOutcome:
    """What became of a task; `error` is empty where its file is written.

    not_written: the exit status where it is the file that could not be written, else 0.
    """

    task: SeriesTask
    error: str = ""
    not_written: int = 0


def find_series_tasks(sources: list[Path], out: Path, analysis: str, sets: int) -> list[SeriesTask]:
    """A task for every series below some folders, or at some addresses, that is not done yet.

    Raises DataError where there is none, UsageError for an unknown analysis.
    """
    if analysis not in ANALYSES:
        raise UsageError(f"--do {analysis}: there are calibrate, {', '.join(ANALYSES)}")
    found: dict[str, Path] = {}
    for source in sources:
        places = _at_server(source) if is_server(source) else _recordings(source)
        for name, place in places:
            if name in found:
                raise DataError(
                    f"{source_name(place)} and {source_name(found[name])} are the same series "
                    f"{name}; analyse them into folders of their own"
                )
            found[name] = place
    if not found:
        raise DataError(f"{', '.join(map(source_name, sources))}: no series is there")
    tasks = [SeriesTask(analysis, place, out / f"{name}.json", sets)
             for name, place in sorted(found.items())]  # fmt: skip
    return [task for task in tasks if not task.target.exists()]


def analyse(task: SeriesTask) -> SeriesOutcome:
    """Do one task and write its file, whole or not at all; never raises for its data."""
    try:
        document = _discovered(task) if task.analysis == "discover" else _studied(task)
        make_folder(task.target.parent)
        write_text(task.target, json.dumps(jsonable(document), indent=1, allow_nan=False) + "\n")
    except OutputError as error:
        return SeriesOutcome(task, str(error), error.exit_status)
    except (ThermocaldError, OSError) as error:
        return SeriesOutcome(task, str(error))
    return SeriesOutcome(task)


def lost(task: SeriesTask, why: str) -> SeriesOutcome:
    """The outcome of a task whose process died."""
    return SeriesOutcome(task, why)


def _discovered(task: SeriesTask) -> dict[str, Any]:
    import thermocald as tc

    return tc.discover(tc.open(task.source)).as_dict()


def _studied(task: SeriesTask) -> dict[str, Any]:
    import thermocald as tc

    return tc.study(*tc.open_all(task.source), sets=task.sets).as_dict()


def _recordings(folder: Path) -> list[tuple[str, Path]]:
    from thermocald.store.recording.head import read_head

    found = sorted({p.parent for p in folder.rglob("recording.yaml")})
    heads = [(read_head(path), path) for path in found]
    return [(_file_name(head.camera.name, head.series), path) for head, path in heads]


def _at_server(address: Path) -> list[tuple[str, Path]]:
    from thermocald.store.server.reader import ServerStore

    with ServerStore.open(address) as store:
        every = store.all_series()
    found = []
    for series in every:
        chosen = {"station": str(series.identity["station"]), "camera": series.camera,
                  "series": series.name}  # fmt: skip
        found.append((_file_name(*chosen.values()), ServerAddress.narrowed(address, **chosen)))
    return found


def _file_name(*parts: str) -> str:
    return "-".join(parts).replace(os.sep, "_")


def reprocess(
    archives: Annotated[
        list[str],
        typer.Argument(metavar="ARCHIVE…", help="Folders that hold recordings, or postgresql://…"),
    ],
    out: Annotated[Path, typer.Option(help="Where the files are written.")],
    do: Annotated[
        str, typer.Option(help="calibrate every epoch, or discover, study every series.")
    ] = "calibrate",
    engine: Annotated[str, expert(help="local, or a Dask scheduler: tcp://HOST:8786.")] = "local",
    jobs: JobsOption = 1,
    free: FreeOption = DEFAULT_FREE,
    sets: Annotated[
        int, expert(min=100, max=10_000_000, help="Of a study's Monte-Carlo.")
    ] = 100_000,
    json: JsonOption = None,
) -> None:
    """Calibrate every epoch of every recording again, or analyse every series on its own.

    What is done already is not done twice. Calibrations are Parquet files, one a block of epochs,
    which DuckDB, pandas or R read as they stand; discover and study write one JSON file a series.
    Every engine gives the same bits. Exit status 1 where a part failed; the others are there.

    Example: thermocald reprocess archive --out again --jobs 2
    """
    sources = [Path(archive) for archive in archives]
    if do == "calibrate":
        _calibrate(sources, out, free, engine, jobs, json)
    else:
        _analyse(sources, out, do, sets, engine, jobs, json)


def _calibrate(
    archives: list[Path], out: Path, free: str, engine: str, jobs: int, json: str | None
) -> None:
    from thermocald.fleet.reprocess import find_blocks, run_blocks
    from thermocald.series import free_names

    for archive in archives:
        if is_server(archive):
            raise UsageError(
                f"{source_name(archive)}: a server has no recordings to calibrate again; "
                "--do discover and --do study read one"
            )
    blocks = find_blocks(archives, out, free_names(free))
    with progress(len(blocks), "blocks") as advance:
        outcomes = run_blocks(blocks, engine, jobs, lambda _: advance(1))
    failed = [o for o in outcomes if o.error]
    document = {
        "blocks": len(outcomes),
        "epochs": sum(o.epochs for o in outcomes),
        "calibrated": sum(o.calibrated for o in outcomes),
        "failed": [
            {"recording": o.block.recording, "first": o.block.first, "error": o.error}
            for o in failed
        ],
    }
    if write_result(document, json):
        say(
            f"{out}: {document['calibrated']} of {document['epochs']} epochs calibrated in "
            f"{len(outcomes) - len(failed)} blocks"
        )
    if failed:
        first = failed[0]
        if first.not_written:
            raise OutputError(first.error, first.not_written)
        raise DataError(
            f"{len(failed)} of {len(outcomes)} blocks failed; {first.block.recording}, epoch "
            f"{first.block.first + 1} on: {first.error}"
        )


def _analyse(
    sources: list[Path], out: Path, do: str, sets: int, engine: str, jobs: int, json: str | None
) -> None:
    from thermocald.fleet.reprocess import run_tasks

    tasks = find_series_tasks(sources, out, do, sets)
    outcomes = []
    with progress(len(tasks), "series") as advance:
        for outcome in run_tasks(analyse, tasks, lost, engine, jobs):
            outcomes.append(outcome)
            advance(1)
    failed = [o for o in outcomes if o.error]
    if json is not None:
        write_json(
            {
                "series": len(outcomes),
                "failed": [
                    {"source": source_name(o.task.source), "error": o.error} for o in failed
                ],
            },
            json,
        )
    if json != "-":
        say(f"{out}: {len(outcomes) - len(failed)} of {len(outcomes)} series done")
    if failed:
        if failed[0].not_written:
            raise OutputError(failed[0].error, failed[0].not_written)
        raise DataError(
            f"{len(failed)} of {len(outcomes)} series failed; "
            f"{source_name(failed[0].task.source)}: {failed[0].error}"
        )
