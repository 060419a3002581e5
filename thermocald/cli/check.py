"""`thermocald check`: is this recording, configuration or store sound?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.common import say, write_result
from thermocald.cli.options import JsonOption
from thermocald.errors import DataError, DeviceError


def check(
    source: Annotated[Path, typer.Argument(help="A recording, a config.yaml, or a store.")],
    probe: Annotated[
        bool,
        typer.Option(
            "--probe", help="Take one frame and one reading from every device of a config."
        ),
    ] = False,
    json: JsonOption = None,
) -> None:
    """Read everything and say what it is; the first thing that is wrong ends it.

    With --probe every device is tried, whatever the others did: exit status 3 where one failed.

    Example: thermocald check config.yaml
    """
    from thermocald.daemon.soundness import examine

    document = examine(source, probe, say)
    if write_result(document, json):
        typer.echo("\n".join(document["lines"]))
    if damaged := document.get("damaged"):
        raise DataError(
            f"{source}: {len(damaged)} places are damaged, the first: {damaged[0]}; restore a "
            "backup, or read what is sound"
        )
    probes = document.get("probes", [])
    failed = [probe["name"] for probe in probes if probe["error"]]
    if failed:
        raise DeviceError(
            f"{len(failed)} of {len(probes)} devices gave nothing: {', '.join(failed)}; why stands "
            "in their lines"
        )
