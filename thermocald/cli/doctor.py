"""`thermocald doctor`: what this machine lacks for cameras and thermometers, and what mends it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import write_result
from thermocald.cli.options import JsonOption


def doctor(
    root: Annotated[Path, expert(help="The machine's root folder, such as a mounted card.")] = Path(
        "/"
    ),
    json: JsonOption = None,
) -> None:
    """Say what this machine lacks: camera stack, groups, I2C, clock, power, disk.

    Below each thing that is missing is the command that mends it. Nothing is changed. Exit status 1
    where something is missing.

    Example: thermocald doctor
    """
    from thermocald.machine import Machine, finding_lines

    findings = Machine.here(root).findings()
    if write_result({"format": "thermocald-doctor/1", "findings": findings}, json):
        typer.echo("\n".join(finding_lines(findings)))
    if any(finding.state == "missing" for finding in findings):
        raise typer.Exit(1)
