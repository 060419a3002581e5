"""`thermocald server`, `forward`, `fleet`: the series of many cameras on a PostgreSQL server.

`reprocess` calibrates or analyses whole archives again, on many cores or machines.
"""

from __future__ import annotations

from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import thermocald as tc
from thermocald.cli import options as opt
from thermocald.cli.commands import expert, subcommands
from thermocald.cli.common import log_to_stderr, progress, say, show, write_json, write_parts
from thermocald.config import load_config
from thermocald.errors import DataError, OutputError, UsageError
from thermocald.numbers import counted
from thermocald.store.server.connection import ServerAddress, is_server
from thermocald.store.sources import source_name

if TYPE_CHECKING:
    from thermocald.fleet.reprocess import Outcome

_Address = Annotated[
    str, typer.Argument(metavar="ADDRESS", help="postgresql://OWNER@HOST/DATABASE, by its owner.")
]


def init(address: _Address) -> None:
    """Create the tables, or bring older ones up to date.

    Example: thermocald server init postgresql://owner@db.example/thermocald
    """
    from thermocald.store.server.connection import create_tables

    parsed = ServerAddress.parse(address)
    create_tables(parsed)
    say(f"{parsed}: the tables are up to date")


def grant(
    address: _Address,
    role: str = typer.Argument(..., help="An existing role."),
    forward: bool = typer.Option(
        False, "--forward/--read", help="Allow the role to insert only, or to read only."
    ),
) -> None:
    """Allow a role to forward (insert only) or to read.

    Example: thermocald server grant postgresql://owner@db.example/thermocald gauge7 --forward
    """
    from thermocald.store.server.connection import grant as give

    parsed = ServerAddress.parse(address)
    give(parsed, role, writes=forward)
    say(f"{parsed}: {role} may {'insert' if forward else 'read'}")


def dashboard(
    output: str = typer.Option("-", "-o", "--output", help="File to write; - is standard output."),
) -> None:
    """Write a dashboard to import into Grafana; its data source is the PostgreSQL server.

    Example: thermocald server dashboard -o fleet.json
    """
    text = (files("thermocald.output") / "templates" / "grafana.json").read_text(encoding="utf-8")
    write_parts((text,), output)


group = subcommands(init=init, grant=grant, dashboard=dashboard)


def forward(
    store: opt.Store = None,
    to: str | None = typer.Option(
        None, metavar="ADDRESS", help="postgresql://USER@HOST/DATABASE?…"
    ),
    config: opt.StoreConfig = None,
    station: str | None = expert(None, help="Name of this station; default: the host's name."),
    once: bool = typer.Option(
        False, "--once", help="Send the waiting rows and exit; default: run until stopped."
    ),
    cursor: Path | None = expert(None, help="File that records which rows have been sent."),
    json: opt.Json = None,
) -> None:
    """Send epochs, events, readings and chosen frames to a PostgreSQL server, each exactly once.

    The store is only read. While there is no network, the rows wait in it.

    Example: thermocald forward thermocald.db --to postgresql://pi@db.example/thermocald --once
    """
    import signal
    import socket
    import threading

    from thermocald.fleet.forward import Forwarder, forward_forever

    frames: dict[str, Any] = {}
    if config is not None:
        read = load_config(config)
        store, to = store or read.store.path, to or read.forward.to
        station = station or read.forward.station
        frames = {"frames": read.frames.folder, "rule": read.forward}
        if to is None:
            say(f"{config}: forward.to is null: nothing is sent")
            return
    if store is None or to is None:
        raise UsageError("give STORE and --to ADDRESS, or --config FILE")
    address = ServerAddress.parse(to)
    forwarder = Forwarder(store, address, station or socket.gethostname(), cursor, **frames)
    if once:
        done = forwarder.send_waiting()
        counts = ", ".join(counted(n, table) for table, n in done.sent.items())
        refused = f"; {done.refused} refused" if done.refused else ""
        document = {"format": "thermocald-forward/1", "sent": done.sent, "refused": done.refused}
        show(document, json, f"sent {counts}{refused}")
        return
    log_to_stderr("INFO")
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    forward_forever(forwarder, ended.wait)


def fleet(
    servers: list[str] = typer.Argument(
        ..., metavar="ADDRESS", help="postgresql://USER@HOST/DATABASE?station=…"
    ),
    report: Path | None = typer.Option(None, help="Write a page to an HTML file."),
    json: opt.Json = None,
) -> None:
    """Show late or dead stations, sensors and clocks, unusual cameras, and calibrations due.

    Example: thermocald fleet postgresql://reader@db.example/thermocald --report fleet.html
    """
    from thermocald.fleet.overview import fleet_document, fleet_lines, render_fleet

    document = fleet_document([Path(server) for server in servers])
    if report is not None:
        write_parts((render_fleet(document),), report)
    show(document, json, *fleet_lines(document))


ANALYSES = ("discover", "study")
_SETS = 100_000


def find_tasks(sources: list[Path], out: Path, do: str, free: str = "none") -> list[Any]:
    """Return the blocks to calibrate, or each series to analyse as (place, its JSON file).

    Those that are done are left out. Raises DataError if there is no series, UsageError for an
    unknown task, and for a server, which has no recordings to calibrate.
    """
    from thermocald.fleet.reprocess import find_blocks, find_series
    from thermocald.series import free_names

    if do == "calibrate":
        if server := next(filter(is_server, sources), None):
            raise UsageError(
                f"{source_name(server)}: a server has no recordings to calibrate again; "
                "--do discover and --do study read one"
            )
        return find_blocks(sources, out, free_names(free))
    if do not in ANALYSES:
        raise UsageError(f"--do {do}: must be one of calibrate, {', '.join(ANALYSES)}")
    tasks = [(place, out / f"{name}.json") for name, place in sorted(find_series(sources).items())]
    return [task for task in tasks if not task[1].exists()]


def analyse(analysis: str, sets: int, task: tuple[Path, Path]) -> Outcome:
    """Analyse one series and write its JSON file, whole or not at all; sets: draws of a study."""
    from thermocald.fleet.reprocess import Outcome

    source, target = task
    if analysis == "discover":
        document = tc.discover(tc.open(source)).as_dict()
    else:
        document = tc.study(*tc.open_all(source), sets=sets).as_dict()
    write_json(document, str(target))
    return Outcome(task)


def reprocess(
    archives: list[str] = typer.Argument(
        ..., metavar="ARCHIVE", help="Folders that hold recordings, or postgresql://…"
    ),
    out: Path = typer.Option(..., "--out", "-o", help="Folder for the results."),
    do: str = typer.Option("calibrate", help="calibrate epochs, or discover or study series."),
    engine: str = expert("local", help="local, or a Dask scheduler: tcp://HOST:8786."),
    jobs: opt.Jobs = 1,
    free: opt.Free = opt.DEFAULT_FREE,
    sets: int = expert(_SETS, min=100, max=10_000_000, help="Draws of a study's simulation."),
    json: opt.Json = None,
) -> None:
    """Calibrate every epoch of every recording again, or analyse every series separately.

    Existing results are not computed again. Calibrations are Parquet files, one per block of
    epochs, which DuckDB, pandas and R can read; discover and study write one JSON file per series.
    Results do not depend on the engine. The exit status is 1 if a part failed; the others are
    written.

    Example: thermocald reprocess archive --out again --jobs 2
    """
    from thermocald.fleet.reprocess import calibrate_block, run_tasks

    for name, given, usual, of in (
        ("--free", free, opt.DEFAULT_FREE, "calibrate"), ("--sets", sets, _SETS, "study"),
    ):  # fmt: skip
        if given != usual and do != of:
            raise UsageError(f"{name} needs --do {of}")
    blocks, what = do == "calibrate", "blocks" if do == "calibrate" else "series"
    tasks = find_tasks([Path(archive) for archive in archives], out, do, free)
    with progress(len(tasks), what) as advance:
        outcomes = []
        work = calibrate_block if blocks else partial(analyse, do, sets)
        for outcome in run_tasks(work, tasks, engine, jobs):
            outcomes.append(outcome)
            advance(1)
    count, failed = len(outcomes), [o for o in outcomes if o.error]
    if blocks:
        epochs, calibrated = sum(o.epochs for o in outcomes), sum(o.calibrated for o in outcomes)
        document = {"blocks": count, "epochs": epochs, "calibrated": calibrated}
        places = [{"recording": o.task.recording, "first": o.task.first} for o in failed]
        done = counted(count - len(failed), "block")
        summary = f"{calibrated} of {epochs} epochs calibrated in {done}"
    else:
        document = {"series": count}
        places = [{"source": source_name(o.task[0])} for o in failed]
        summary = f"{count - len(failed)} of {count} series analysed"
    errors = [{**place, "error": o.error} for place, o in zip(places, failed, strict=True)]
    found = {"format": "thermocald-reprocess/1", **document, "failed": errors}
    show(found, json, f"{out}: {summary}")
    if not failed:
        return
    first = failed[0]
    if first.not_written:
        raise OutputError(first.error, first.not_written)
    where = places[0].get("source") or f"{first.task.recording}, epoch {first.task.first + 1} on"
    raise DataError(f"{len(failed)} of {count} {what} failed; {where}: {first.error}")
