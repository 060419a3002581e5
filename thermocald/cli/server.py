"""`thermocald server`: the tables of a PostgreSQL server, and who may use them."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.commands import subcommands
from thermocald.cli.common import say, write_text

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
