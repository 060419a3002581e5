"""`thermocald server`, `forward` and `fleet`: the series of many cameras on a PostgreSQL server.

And `reprocess`: whole archives calibrated again, on many cores or machines. A task is one series
analysed on its own, wherever that is.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thermocald.cli.commands import expert, subcommands
from thermocald.cli.common import log_to_stderr, progress, say, write_json, write_result, write_text
from thermocald.cli.options import DEFAULT_FREE, FreeOption, JobsOption, JsonOption, StoreArgument
from thermocald.config import Config, load_config
from thermocald.errors import DataError, OutputError, UsageError
from thermocald.store.server.connection import ServerAddress, is_server
from thermocald.store.sources import source_name

if TYPE_CHECKING:
    from thermocald.fleet.forward import FrameRule
    from thermocald.fleet.reprocess import Outcome


_Address = Annotated[
    str, typer.Argument(metavar="ADDRESS", help="postgresql://OWNER@HOST/DATABASE, an owner's.")
]


def init(address: _Address) -> None:
    """Make the tables, or bring older ones up to date.

    Example: thermocald server init postgresql://owner@db.example/thermocald
    """
    from thermocald.store.server.connection import create_tables

    parsed = ServerAddress.parse(address)
    create_tables(parsed)
    say(f"{parsed}: the tables are as this program needs them")


def grant(
    address: _Address,
    role: Annotated[str, typer.Argument(help="A role that exists.")],
    forward: Annotated[
        bool, typer.Option("--forward/--read", help="It may only insert; or only read.")
    ] = False,
) -> None:
    """Let a role forward (insert and nothing else) or read.

    Example: thermocald server grant postgresql://owner@db.example/thermocald gauge7 --forward
    """
    from thermocald.store.server.connection import grant as give

    parsed = ServerAddress.parse(address)
    give(parsed, role, writes=forward)
    say(f"{parsed}: {role} may {'insert' if forward else 'read'}")


def dashboard(
    output: Annotated[
        str, typer.Option("-o", "--output", help="The file to write; - for standard output.")
    ] = "-",
) -> None:
    """Write a dashboard for Grafana (import it; its source is the server, PostgreSQL).

    Example: thermocald server dashboard -o fleet.json
    """
    path = Path(output) if output != "-" else output
    text = (files("thermocald.output") / "templates" / "grafana.json").read_text(encoding="utf-8")
    write_text(text, path)


group = subcommands(init=init, grant=grant, dashboard=dashboard)


def forward(
    store: StoreArgument = None,
    to: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="postgresql://USER@HOST/DATABASE?…")
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="Store and `forward:` of this file.")
    ] = None,
    station: Annotated[str | None, expert(help="This station's name; default: the host's.")] = None,
    once: Annotated[
        bool, typer.Option("--once", help="Send what waits, then end; else go on for ever.")
    ] = False,
    cursor: Annotated[Path | None, expert(help="Where it keeps how far it has sent.")] = None,
    json: JsonOption = None,
) -> None:
    """Send epochs, events, readings and chosen frames to a PostgreSQL server, each of them once.

    The store is only read. Without a network rows wait in it, for as long as it takes.

    Example: thermocald forward thermocald.db --to postgresql://pi@db.example/thermocald --once
    """
    import signal
    import socket
    import threading

    from thermocald.fleet.forward import Forwarder, forward_forever

    rule: FrameRule | None = None
    if config is not None:
        read = load_config(config)
        store, to = store or read.store.path, to or read.forward.to
        station = station or read.forward.station
        rule = _configured(read)
        if to is None:
            say(f"{config}: forward.to is null: nothing is sent")
            return
    if store is None or to is None:
        raise UsageError("give STORE and --to ADDRESS, or --config FILE")
    address = ServerAddress.parse(to)
    forwarder = Forwarder(store, address, station or socket.gethostname(), cursor, frames=rule)
    if once:
        done = forwarder.send_waiting()
        if write_result({"sent": dict(done.sent), "refused": done.refused}, json):
            counts = ", ".join(f"{n} {table}s" for table, n in done.sent.items())
            say(f"sent {counts}" + (f"; {done.refused} refused" if done.refused else ""))
        return
    log_to_stderr("INFO")
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    forward_forever(forwarder, ended.wait)


def _configured(config: Config) -> FrameRule | None:
    from thermocald.fleet.forward import FrameRule

    section = config.forward
    if section.frames == "none":
        return None
    most = int(section.frames_mb_per_day * 1e6)
    return FrameRule(config.frames.folder, section.frames, section.every_n, most)


def fleet(
    servers: Annotated[
        list[str],
        typer.Argument(metavar="ADDRESS…", help="postgresql://USER@HOST/DATABASE?station=…"),
    ],
    report: Annotated[Path | None, typer.Option(help="Write a page, one HTML file.")] = None,
    json: JsonOption = None,
) -> None:
    """Show late and dead stations, sensors and clocks, odd cameras, and what needs calibration.

    Example: thermocald fleet postgresql://reader@db.example/thermocald --report fleet.html
    """
    from thermocald.fleet.overview import fleet_document, fleet_lines

    document = fleet_document([Path(server) for server in servers])
    if report is not None:
        from thermocald.output.fleet import render_fleet

        write_text(render_fleet(document), report)
    if write_result(document, json):
        typer.echo("\n".join(fleet_lines(document)))


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


def analyse(task: SeriesTask) -> Outcome:
    """Do one task and write its file, whole or not at all."""
    import thermocald as tc
    from thermocald.fleet.reprocess import Outcome

    if task.analysis == "discover":
        document = tc.discover(tc.open(task.source)).as_dict()
    else:
        document = tc.study(*tc.open_all(task.source), sets=task.sets).as_dict()
    write_json(document, str(task.target))
    return Outcome(task)


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
    from thermocald.fleet.reprocess import find_blocks, run_blocks, run_tasks
    from thermocald.series import free_names

    sources = [Path(archive) for archive in archives]
    if do == "calibrate":
        for source in sources:
            if is_server(source):
                raise UsageError(
                    f"{source_name(source)}: a server has no recordings to calibrate again; "
                    "--do discover and --do study read one"
                )
        blocks = find_blocks(sources, out, free_names(free))
        with progress(len(blocks), "blocks") as advance:
            outcomes = run_blocks(blocks, engine, jobs, lambda _: advance(1))
    else:
        tasks = find_series_tasks(sources, out, do, sets)
        with progress(len(tasks), "series") as advance:
            outcomes = run_tasks(analyse, tasks, engine, jobs, lambda _: advance(1))
    count, failed = len(outcomes), [o for o in outcomes if o.error]
    if do == "calibrate":
        epochs = sum(o.epochs for o in outcomes)
        calibrated = sum(o.calibrated for o in outcomes)
        document = {
            "blocks": count,
            "epochs": epochs,
            "calibrated": calibrated,
            "failed": [
                {"recording": o.task.recording, "first": o.task.first, "error": o.error}
                for o in failed
            ],
        }
        said = f"{calibrated} of {epochs} epochs calibrated in {count - len(failed)} blocks"
    else:
        document = {
            "series": count,
            "failed": [{"source": source_name(o.task.source), "error": o.error} for o in failed],
        }
        said = f"{count - len(failed)} of {count} series done"
    if write_result(document, json):
        say(f"{out}: {said}")
    if not failed:
        return
    first = failed[0]
    if first.not_written:
        raise OutputError(first.error, first.not_written)
    if do == "calibrate":
        what, where = "blocks", f"{first.task.recording}, epoch {first.task.first + 1} on"
    else:
        what, where = "series", source_name(first.task.source)
    raise DataError(f"{len(failed)} of {count} {what} failed; {where}: {first.error}")
