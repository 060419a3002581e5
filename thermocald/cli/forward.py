"""`thermocald forward`: send a store's rows to a server, now or for as long as it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.common import log_to_stderr, say, write_json
from thermocald.cli.options import JsonOption

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("forward")(forward)


def forward(
    store: Annotated[Path, typer.Argument(help="The store; may be in use by a daemon.")],
    to: Annotated[
        str, typer.Option("--to", metavar="ADDRESS", help="postgresql://USER@HOST/DATABASE?…")
    ],
    station: Annotated[
        str | None, typer.Option("--station", help="This station's name; default: the host's.")
    ] = None,
    once: Annotated[
        bool, typer.Option("--once", help="Send what waits, then end; else go on for ever.")
    ] = False,
    cursor: Annotated[
        Path | None, typer.Option("--cursor", help="Where it keeps how far it has sent.")
    ] = None,
    json: JsonOption = None,
) -> None:
    """Send epochs, events and readings to a PostgreSQL server, each of them once.

    The store is only read. Without a network rows wait in it, for as long as it takes.

    Example: thermocald forward thermocald.db --to postgresql://pi@db.example/thermocald --once
    """
    import signal
    import socket
    import threading

    from thermocald.fleet.forward import Forwarder, forward_forever
    from thermocald.store.server.address import ServerAddress

    forwarder = Forwarder(store, ServerAddress.parse(to), station or socket.gethostname(), cursor)
    if once:
        done = forwarder.send_waiting()
        if json is not None:
            write_json({"sent": dict(done.sent), "refused": done.refused}, json)
        if json != "-":
            counts = ", ".join(f"{n} {table}s" for table, n in done.sent.items())
            say(f"sent {counts}" + (f"; {done.refused} refused" if done.refused else ""))
        return
    log_to_stderr("INFO")
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    forward_forever(forwarder, ended.wait)
