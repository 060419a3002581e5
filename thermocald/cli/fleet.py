"""`thermocald fleet`: all cameras of a server, and which of them somebody should look at."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.common import write_result, write_text
from thermocald.cli.options import JsonOption


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
