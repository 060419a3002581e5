"""`thermocald devices`: what is attached, as configuration."""

from __future__ import annotations

import typer

from thermocald.cli.common import say, write_result
from thermocald.cli.options import JsonOption


def devices(json: JsonOption = None) -> None:
    """List attached cameras, thermometers and outputs, as they are written in config.yaml.

    What is not certain (a serial port, an I2C bus: nobody knows what is on it) is a comment.

    Example: thermocald devices >> config.yaml
    """
    from thermocald.daemon.probe import attached, stanzas

    found, notes = attached()
    document = {
        "format": "thermocald-devices/1",
        "devices": [one.as_dict() for one in found],
        "notes": notes,
    }
    if write_result(document, json):
        typer.echo("\n".join(stanzas(found)))
    for note in notes:
        say(note)
