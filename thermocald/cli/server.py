"""`thermocald server`, `forward` and `fleet`: the series of many cameras on a PostgreSQL server."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thermocald.cli.commands import expert, subcommands
from thermocald.cli.common import log_to_stderr, say, write_result, write_text
from thermocald.cli.options import JsonOption, StoreArgument
from thermocald.config import Config, load_config
from thermocald.errors import UsageError

if TYPE_CHECKING:
    from thermocald.fleet.forward import FrameRule


_Address = Annotated[
    str, typer.Argument(metavar="ADDRESS", help="postgresql://OWNER@HOST/DATABASE, an owner's.")
]


def init(address: _Address) -> None:
    """Make the tables, or bring older ones up to date.

    Example: thermocald server init postgresql://owner@db.example/thermocald
    """
    from thermocald.store.server.connection import ServerAddress, create_tables

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
    from thermocald.store.server.connection import ServerAddress
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
    from thermocald.store.server.connection import ServerAddress

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
    from thermocald.fleet.document import fleet_document, fleet_lines

    document = fleet_document([Path(server) for server in servers])
    if report is not None:
        from thermocald.output.fleet import render_fleet

        write_text(render_fleet(document), report)
    if write_result(document, json):
        typer.echo("\n".join(fleet_lines(document)))
