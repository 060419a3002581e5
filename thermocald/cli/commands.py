"""Every command, by the name that it is called by, in the order of `thermocald --help`."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import typer

__all__ = ["COMMANDS", "GROUPS", "command", "group"]

# the module of `thermocald.cli` that has the function: only what is called is imported
COMMANDS = {
    "archive": "archive",
    "backup": "backup",
    "calibrate": "calibrate",
    "check": "check",
    "convert": "convert",
    "correct": "correct",
    "demo": "demo",
    "devices": "devices",
    "discover": "discover",
    "doctor": "doctor",
    "fit": "fit",
    "fleet": "fleet",
    "forward": "forward",
    "import": "import_",
    "predict": "predict",
    "replay": "replay",
    "export": "replay",
    "reprocess": "reprocess",
    "run": "run",
    "dashboard": "run",
    "simulate": "simulate",
    "status": "status",
    "top": "status",
    "study": "study",
}
GROUPS = ("camera", "server", "session", "testfield")


def command(name: str) -> Callable[..., Any]:
    """The function of a command of `COMMANDS`, by the command's name."""
    module = importlib.import_module(f"thermocald.cli.{COMMANDS[name]}")
    found: Callable[..., Any] = getattr(module, "import_" if name == "import" else name)
    return found


def group(name: str) -> typer.Typer:
    """The commands below a word of `GROUPS`."""
    found: typer.Typer = importlib.import_module(f"thermocald.cli.{name}").group
    return found
