"""`thermocald doctor`: what this machine lacks for cameras and thermometers, and what mends it."""

from __future__ import annotations

import grp
import os
import pwd
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thermocald.cli.common import write_json
from thermocald.cli.options import JsonOption

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.machine import Finding

__all__ = ["doctor", "report"]

_MARKS = {"ok": "ok", "missing": "MISSING", "warning": "warning", "not needed": "-"}


def doctor(
    root: Annotated[
        Path, typer.Option(help="The machine's root folder, such as a mounted card.")
    ] = Path("/"),
    json: JsonOption = None,
) -> None:
    """Say what this machine lacks: camera stack, groups, I2C, clock, power, disk.

    Below each thing that is missing is the command that mends it. Nothing is changed.

    Example: thermocald doctor
    """
    from thermocald.acquisition.steady_clock import machine_clock_trusted
    from thermocald.machine import Machine

    here = root == Path("/")
    machine = Machine(
        root,
        _user_name(),
        os.getuid(),
        frozenset(_group_names()),
        machine_clock_trusted() if here else None,
    )
    findings = machine.findings()
    if json is not None:
        document = {
            "format": "thermocald-doctor/1",
            "findings": [asdict(finding) for finding in findings],
        }
        write_json(document, json)
    if json != "-":
        for line in report(findings):
            typer.echo(line)


def report(findings: Sequence[Finding]) -> list[str]:
    """One line for each finding, its remedy below, and a sentence at the end."""
    width = max(len(finding.name) for finding in findings)
    lines = []
    for finding in findings:
        lines.append(f"{_MARKS[finding.state]:>7}  {finding.name:<{width}}  {finding.text}")
        if finding.remedy:
            lines.append(f"{'':>9}{'':<{width}}  → {finding.remedy}")
    missing = [finding.name for finding in findings if finding.state == "missing"]
    lines.append("")
    lines.append(f"to mend: {', '.join(missing)}" if missing else "nothing is missing")
    return lines


def _user_name() -> str:
    """The user's name, or number where it has none (a container)."""
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return str(os.getuid())


def _group_names() -> list[str]:
    names = []
    for number in {os.getgid(), *os.getgroups()}:
        try:
            names.append(grp.getgrgid(number).gr_name)
        except KeyError:
            continue
    return names
