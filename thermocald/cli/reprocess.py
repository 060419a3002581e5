"""`thermocald reprocess`: whole archives calibrated again, on many cores or machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.common import progress, say, write_json
from thermocald.cli.options import DEFAULT_FREE_TEXT, FreeOption, JsonOption
from thermocald.errors import DataError, OutputError

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("reprocess")(reprocess)


def reprocess(
    archives: Annotated[
        list[Path], typer.Argument(metavar="ARCHIVE…", help="Folders that hold recordings.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Where the Parquet files are written.")],
    engine: Annotated[
        str, typer.Option("--engine", help="local, or a Dask scheduler: tcp://HOST:8786.")
    ] = "local",
    jobs: Annotated[
        int, typer.Option("--jobs", min=1, max=256, help="Processes of the local engine.")
    ] = 1,
    free: FreeOption = DEFAULT_FREE_TEXT,
    json: JsonOption = None,
) -> None:
    """Calibrate every epoch of every recording again; what is done already is not done twice.

    The files are Parquet, one a block of epochs, which DuckDB, pandas or R read as they stand.
    Every engine gives the same bits. Exit status 1 where a block failed; the others are there.

    Example: thermocald reprocess archive --out again --jobs 2
    """
    from thermocald.cli.options import free_names
    from thermocald.fleet.reprocess import find_blocks, run_blocks

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
    if json is not None:
        write_json(document, json)
    if json != "-":
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
