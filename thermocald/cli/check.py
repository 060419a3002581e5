"""`thermocald check`, `devices`, `doctor`: what is sound, what is attached, what is lacking."""

from __future__ import annotations

from pathlib import Path

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import JsonOption, say, show
from thermocald.errors import DataError, DeviceError


def devices(json: JsonOption = None) -> None:
    """List attached cameras, thermometers and outputs, as they are written in config.yaml.

    What is not certain (what is on a serial port, on an I2C bus) is a comment.

    Example: thermocald devices >> config.yaml
    """
    from thermocald.daemon.soundness import attached, stanzas

    found, notes = attached()
    document = {"format": "thermocald-devices/1", "devices": found, "notes": notes}
    show(document, json, "\n".join(stanzas(found)))
    for note in notes:
        say(note)


def doctor(
    root: Path = expert(Path("/"), help="The machine's root folder, such as a mounted card."),
    json: JsonOption = None,
) -> None:
    """Say what this machine lacks: camera stack, groups, I2C, clock, power, disk.

    Below each thing that is missing is the command that mends it. Nothing is changed. Exit status 1
    where something is missing.

    Example: thermocald doctor
    """
    from thermocald.machine import Machine, finding_lines

    findings = Machine.here(root).findings()
    document = {"format": "thermocald-doctor/1", "findings": findings}
    show(document, json, *finding_lines(findings))
    if any(finding.state == "missing" for finding in findings):
        raise typer.Exit(1)


def check(
    source: Path = typer.Argument(..., help="A recording, a config.yaml, or a store."),
    probe: bool = typer.Option(
        False, "--probe", help="Take one frame and one reading from every device of a config."
    ),
    json: JsonOption = None,
) -> None:
    """Read everything and say what it is; stop at the first thing that is wrong.

    With --probe every device is tried, whatever the others did: exit status 3 where one failed.

    Example: thermocald check config.yaml
    """
    from thermocald.daemon.soundness import examine

    document = examine(source, probe, say)
    show(document, json, *document["lines"])
    if damaged := document.get("damaged"):
        raise DataError(
            f"{source}: {len(damaged)} places are damaged, the first: {damaged[0]}; restore a "
            "backup, or read what is sound"
        )
    probes = document.get("probes", [])
    failed = [probe.name for probe in probes if probe.error]
    if failed:
        raise DeviceError(
            f"{len(failed)} of {len(probes)} devices gave nothing: {', '.join(failed)}; "
            "see their lines"
        )
