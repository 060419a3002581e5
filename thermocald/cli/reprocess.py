"""`thermocald reprocess`: whole archives calibrated again, on many cores or machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import progress, say, write_json, write_result
from thermocald.cli.options import DEFAULT_FREE, FreeOption, JobsOption, JsonOption
from thermocald.errors import DataError, OutputError, UsageError
from thermocald.store.server.connection import is_server
from thermocald.store.sources import source_name


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
    from thermocald.cli.series_task import analyse, find_series_tasks, lost
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
