"""Every command with its line in `thermocald --help`, in the order of the work."""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from thermocald.errors import UsageError
from thermocald.files import Output, check_output

# what the options of all commands write, and where one of a command is no file
_OUTPUTS: dict[str, Output] = {
    **dict.fromkeys(
        ("camera_out", "code", "effect_out", "json", "model_out", "out", "output", "report"), "file"
    ),
    "figures": "folder",
    "recording_out": "recording",
    "archive folder": "folder",
    "correct out": "either",
    "demo out": "folder",
    "import out": "recording",
    "reprocess out": "folder",
    "session start output": "folder",
    "simulate out": "recording",
    "testfield print out": "folder",
}  # fmt: skip
ADVANCED = "Advanced"
"""The section of options that only experts need."""


def expert(default: Any, *names: str, **told: Any) -> Any:
    """Return an option of the advanced ones; arguments as those of `typer.Option`."""
    return typer.Option(default, *names, rich_help_panel=ADVANCED, **told)


class Entry(NamedTuple):
    """A command: the module of `thermocald.cli` that has it, and what it does in one line."""

    module: str
    line: str
    group: bool = False


# only the module of the command that is called is imported
PANELS = {
    "Measure": {
        "demo": Entry("demo", "Try it all on a rendered camera, without hardware"),
        "devices": Entry("run", "List attached cameras, thermometers and outputs"),
        "session": Entry("session", "Take one measurement series, from check to report", True),
        "run": Entry("run", "Acquire, calibrate and keep epochs until told to end"),
        "status": Entry("run", "Say how the daemon is doing"),
        "top": Entry("run", "Show that, always up to date"),
        "dashboard": Entry("run", "Serve the daemon's web page"),
        "import": Entry("archive", "Make a recording from photographs and a logger's file"),
        "simulate": Entry("demo", "Make a recording of a simulated camera that warms up"),
    },
    "Analyse": {
        "replay": Entry("study", "Calibrate every epoch of a recording, and say how it drifts"),
        "export": Entry("study", "Write one row per epoch as CSV, JSON or Parquet"),
        "study": Entry("study", "Test how the camera changes with its temperature; report it"),
        "discover": Entry("study", "Find which effect a model misses, name it, prove it"),
        "fit": Entry("study", "Fit a thermal model to all series of a camera"),
        "calibrate": Entry("camera", "Calibrate a camera from photographs of a test field"),
    },
    "Use": {
        "predict": Entry("camera", "Predict the camera at a temperature, or along a log"),
        "correct": Entry("camera", "Correct image points or images for the temperature"),
        "measure": Entry("camera", "Measure in metres on a water surface, a plane, a staff"),
        "camera": Entry("camera", "Convert and compare cameras; one at a temperature", True),
    },
    "Test field": {
        "testfield": Entry("testfield", "Print, import, survey and check a test field", True)
    },
    "Many cameras": {
        "forward": Entry("server", "Send a store's rows to a server"),
        "fleet": Entry("server", "Show all cameras of a server, and which need a look"),
        "reprocess": Entry("server", "Calibrate or analyse whole archives again"),
        "server": Entry("server", "Make a server's tables, and let stations write to them", True),
    },
    "Look after": {
        "doctor": Entry("run", "Say what this machine lacks, and what mends it"),
        "check": Entry("run", "Say whether a recording, configuration or store is sound"),
        "backup": Entry("archive", "Copy a store that is in use, and verify the copy"),
        "archive": Entry("archive", "Write a store's series as recordings; delete old frames"),
        "convert": Entry("archive", "Rewrite a recording's observations as Parquet or CSV"),
    },
}
COMMANDS = {name: entry for panel in PANELS.values() for name, entry in panel.items()}


_TYPE = re.compile(r"<(?:list\[)?(Path|path|str|int|float)(?: range)?\]?>")
_SAID = {"Path": "path", "path": "path", "str": "text", "int": "number", "float": "number"}


class Command(TyperCommand):
    """A command whose help has its expert's options in a section of their own.

    An output that cannot be written is refused before anything is computed.
    """

    def invoke(self, ctx: Any) -> Any:
        """Look where the outputs go, and run the command."""
        if not ctx.params.get("dry_run"):
            _check_outputs(ctx)
        return super().invoke(ctx)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments, options, and last the advanced ones."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            if (record := parameter.get_help_record(ctx)) is not None:
                usual = "Arguments" if parameter.param_type_name == "argument" else "Options"
                title = getattr(parameter, "rich_help_panel", None) or usual
                name = _TYPE.sub(lambda found: f"<{_SAID[found[1]]}>", record[0])
                sections.setdefault(title, []).append((name, record[1]))
        for title in sorted(sections, key=["Arguments", "Options", ADVANCED].index):
            with formatter.section(title):
                formatter.write_dl(sections[title])


def _check_outputs(ctx: Any) -> None:
    """Refuse outputs that could not be written: OutputError; one for two results: UsageError."""
    command, above = ctx.info_name, ctx.parent
    while above is not None and above.parent is not None:
        command, above = f"{above.info_name} {command}", above.parent
    written: dict[str, str] = {}
    for name, given in ctx.params.items():
        kind = _OUTPUTS.get(f"{command} {name}", _OUTPUTS.get(name))
        # `--report / --no-report` is no file
        if kind is None or not isinstance(given, (str, Path)) or str(given) in ("", "-"):
            continue
        path, option = Path(given), f"--{name.replace('_', '-')}"
        for file in map(path.with_suffix, (".h", ".py")) if name == "code" else (path,):
            check_output(file, kind)
            place = os.path.realpath(file)
            if written.setdefault(place, option) != option and not place.startswith("/dev/"):
                raise UsageError(f"{written[place]} and {option}: both would be {given}")


class Group(TyperGroup):
    """Commands listed by panels, each with its whole line."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one section for each panel."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            assert command is not None
            panel = getattr(command, "rich_help_panel", None)
            title = panel if isinstance(panel, str) else "Commands"
            line = command.short_help or (command.help or "").split("\n\n")[0]
            sections.setdefault(title, []).append((name, " ".join(line.split())))
        widest = max(len(name) for rows in sections.values() for name, _ in rows)
        for title, rows in sections.items():
            with formatter.section(title):
                formatter.write_dl([(f"{name:<{widest}}", line) for name, line in rows])


def add_commands(app: typer.Typer, load: Callable[[str], bool]) -> None:
    """Add every command to an application; those that `load` does not want, by their line only."""
    for panel, entries in PANELS.items():
        for name, entry in entries.items():
            told: dict[str, Any] = {"short_help": entry.line, "rich_help_panel": panel}
            if not entry.group:
                function = command(name) if load(name) else _not_loaded
                app.command(name, cls=Command, **told)(function)
            elif load(name):
                app.add_typer(group(name), name=name, cls=Group, help=f"{entry.line}.", **told)
            else:
                app.command(name, cls=Command, **told)(_not_loaded)


def command(name: str) -> Callable[..., Any]:
    """Return the function of a command, by the command's name."""
    module = importlib.import_module(f"thermocald.cli.{COMMANDS[name].module}")
    found: Callable[..., Any] = getattr(module, "import_" if name == "import" else name)
    return found


def group(name: str) -> typer.Typer:
    """Return the commands below a word."""
    found: typer.Typer = importlib.import_module(f"thermocald.cli.{name}").group
    return found


def subcommands(**functions: Callable[..., Any]) -> typer.Typer:
    """Return the commands below a word; a name that Python keeps for itself ends in `_`."""
    app = typer.Typer(no_args_is_help=True)
    for name, function in functions.items():
        app.command(name.rstrip("_"), cls=Command)(function)
    return app


def _not_loaded() -> None:
    raise AssertionError("a command that is only listed was called")
