"""Every command with its line in `thermocald --help`, in the order of use."""

from __future__ import annotations

import importlib
import math
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from thermocald.errors import UsageError
from thermocald.files import Output, check_output

# what an option writes: in all commands, then in the commands where it differs
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
_READING = (
    "timezone temperature_column name unit date_order time_column log_timezone log_clock ambiguous "
    "encoding separator decimal"
)
_BOARD = {"charuco": "dictionary legacy", "aprilgrid": "spacing"}
# by command and option: the options that do nothing without it
_NEEDED = {
    "archive": {"config": "retention"},
    "camera at": {"out": "to", "renew": "reference frame"},
    "discover": {"plan": "preset testfield programme strength seeds"},
    "fit": {"log": _READING},
    "predict": {"log": _READING, "programme": "camera wanted", "temperature": "channel"},
    "replay": {"model": "log times timezone recording_out"},
    "run": {"recording": "fast"},
    "session start": {"until_separated": "evidence dry_run max_temperature max_rate max_duty"},
    "testfield check": {"camera": "pixel_pitch"},
    "testfield import": {**_BOARD, "rings": "diameter"},
    "testfield print": _BOARD,
}
# … and those that do nothing with it
_IDLE = {
    "discover": {"plan": "verify model_out effect_out report jobs"},
    "fit": {"log": "jobs"},
    "predict": {"log": "distance", "test": "distance"},
    "replay": {"model": "store exterior free jobs"},
    "study": {"reference": "exterior free"},
    "testfield check": {"field": "paper flat landscape diameter"},
    "testfield print": dict.fromkeys(
        ("charuco", "chessboard", "aprilgrid"),
        "flat diameter bits plain markers light first_code pitch",
    ),
}
ADVANCED = "Advanced"
"""The help section of the options that only experts need."""


def expert(default: Any, *names: str, **settings: Any) -> Any:
    """Return an option of the advanced section; the arguments are those of `typer.Option`."""
    return typer.Option(default, *names, rich_help_panel=ADVANCED, **settings)


class Entry(NamedTuple):
    """A command: its module in `thermocald.cli`, and one line that describes it."""

    module: str
    line: str
    group: bool = False


# only the module of the command that is called is imported
PANELS = {
    "Measure": {
        "demo": Entry("demo", "Try the whole program on a rendered camera, without hardware"),
        "devices": Entry("run", "List the attached cameras, thermometers and outputs"),
        "session": Entry("session", "Take one measurement series, from check to report", True),
        "run": Entry("run", "Acquire, calibrate and store epochs until stopped"),
        "status": Entry("run", "Report the state of the daemon"),
        "top": Entry("run", "Show the state of the daemon, continuously updated"),
        "dashboard": Entry("run", "Serve the daemon's web page"),
        "import": Entry("archive", "Make a recording from photographs and a logger's file"),
        "simulate": Entry("demo", "Simulate a camera that warms up, and write a recording"),
    },
    "Analyse": {
        "replay": Entry("study", "Calibrate every epoch of a recording and report the drift"),
        "export": Entry("study", "Write one row per epoch as CSV, JSON or Parquet"),
        "study": Entry("study", "Analyse how a camera changes with its temperature"),
        "discover": Entry("study", "Find, name and verify the effect that a thermal model lacks"),
        "fit": Entry("study", "Fit a thermal model to all series of a camera"),
        "calibrate": Entry("camera", "Calibrate a camera from photographs of a test field"),
    },
    "Use": {
        "predict": Entry("camera", "Predict the camera at a temperature or along a log"),
        "correct": Entry("camera", "Correct image points or images for the temperature"),
        "measure": Entry("camera", "Measure in metres on a water surface, a plane or a staff"),
        "camera": Entry("camera", "Convert and compare camera files; predict a camera", True),
    },
    "Test field": {
        "testfield": Entry("testfield", "Print, import, survey and check a test field", True)
    },
    "Many cameras": {
        "forward": Entry("server", "Send a store's rows to a server"),
        "fleet": Entry("server", "Show all cameras of a server and which need attention"),
        "reprocess": Entry("server", "Calibrate or analyse whole archives again"),
        "server": Entry("server", "Create a server's tables and grant access to them", True),
    },
    "Maintain": {
        "doctor": Entry("run", "Report what this machine lacks and how to fix it"),
        "check": Entry("run", "Check a recording, a configuration or a store for errors"),
        "backup": Entry("archive", "Copy a store that is in use, and verify the copy"),
        "archive": Entry("archive", "Write a store's series as recordings; delete old frames"),
        "convert": Entry("archive", "Rewrite a recording's observations as Parquet or CSV"),
    },
}
COMMANDS = {name: entry for panel in PANELS.values() for name, entry in panel.items()}


_TYPE = re.compile(r"<(?:list\[)?(Path|path|str|int|float)(?: range)?\]?>")
_SHOWN = {"Path": "path", "path": "path", "str": "text", "int": "number", "float": "number"}


class Command(TyperCommand):
    """A command whose help lists the advanced options in their own section.

    A number that is not finite, an option that does nothing beside the others, and an output that
    cannot be written are refused before anything is computed.
    """

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        for parameter in self.params:
            if parameter.param_type_name == "argument":  # in capitals, as the texts name it
                parameter.metavar = parameter.metavar or str(parameter.name).upper()

    def invoke(self, ctx: Any) -> Any:
        """Check numbers, options and outputs, then run the command."""
        command = ctx.command_path.partition(" ")[2]
        options = {
            p.name: p.metavar if p.param_type_name == "argument" else max(p.opts, key=len)
            for p in self.params
        }
        # older versions of Typer make them paths later
        types = {p.name: getattr(getattr(p, "type", None), "name", "") for p in self.params}
        values = [
            (name, Path(value) if value and types.get(name) == "path" else value)
            for name, given in ctx.params.items()
            for value in (given if isinstance(given, tuple | list) else (given,))
        ]
        for name, value in values:
            if isinstance(value, float) and not math.isfinite(value):
                raise UsageError(f"{options[name]}: {value} is not a finite number")
        if not ctx.params.get("dry_run"):
            _check_outputs(command, options, values)
        # an option that does nothing without another, or beside it
        given = {n for n in options if ctx.get_parameter_source(n).name == "COMMANDLINE"}
        for table, here in ((_NEEDED, False), (_IDLE, True)):
            for name, others in table.get(command, {}).items():
                for other in given.intersection(others.split()) if (name in given) is here else ():
                    does = "has no effect with" if here else "needs"
                    raise UsageError(f"{options[other]} {does} {options[name]}")
        try:
            return super().invoke(ctx)
        except BrokenPipeError:  # Typer would exit with 1
            raise typer.Exit from None

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, the options, and last the advanced options."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            if (record := parameter.get_help_record(ctx)) is not None:
                usual = "Arguments" if parameter.param_type_name == "argument" else "Options"
                title = getattr(parameter, "rich_help_panel", None) or usual
                name = _TYPE.sub(lambda found: f"<{_SHOWN[found[1]]}>", record[0])
                sections.setdefault(title, []).append((name, record[1]))
        for title in sorted(sections, key=["Arguments", "Options", ADVANCED].index):
            with formatter.section(title):
                formatter.write_dl(sections[title])


def _check_outputs(command: str, options: dict[str, Any], values: list[tuple[str, Any]]) -> None:
    """Raise OutputError for an output that cannot be written.

    Raises UsageError for an output that is another output, or a file that the command reads.
    """
    kinds = {name: _OUTPUTS.get(f"{command} {name}", _OUTPUTS.get(name)) for name in options}
    taken: dict[str, str] = {}
    inputs_first = sorted(values, key=lambda value: kinds[value[0]] is not None)
    for name, given in inputs_first:
        kind, option = kinds[name], options[name]
        if kind is None:
            if isinstance(given, Path):
                read = (given, given / "testfield.csv")  # of a recording
                taken |= {os.path.realpath(file): option for file in read if os.path.isfile(file)}
        # `--report / --no-report` is a switch, not a file
        elif isinstance(given, (str, Path)) and given not in ("", "-"):
            path = Path(given)
            if str(path) == "-":
                raise UsageError(f"{option} -: cannot be standard output; give a file or folder")
            for file in map(path.with_suffix, (".h", ".py")) if name == "code" else (path,):
                check_output(file, kind)
                place = os.path.realpath(file)
                if taken.setdefault(place, option) != option and not place.startswith("/dev/"):
                    raise UsageError(f"{taken[place]} and {option}: both would be {given}")


class Group(TyperGroup):
    """A group whose help lists the commands by panel, each line in full."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one section per panel."""
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
    """Add every command to an application; a command for which `load` is false is only listed."""
    for panel, entries in PANELS.items():
        for name, entry in entries.items():
            shown: dict[str, Any] = {"short_help": entry.line, "rich_help_panel": panel}
            if not load(name):
                app.command(name, cls=Command, **shown)(lambda: None)
                continue
            module = importlib.import_module(f"thermocald.cli.{entry.module}")
            if entry.group:
                app.add_typer(module.group, name=name, cls=Group, help=f"{entry.line}.", **shown)
            else:
                function = getattr(module, "import_" if name == "import" else name)
                app.command(name, cls=Command, **shown)(function)


def subcommands(**functions: Callable[..., Any]) -> typer.Typer:
    """Return a group of commands; a trailing `_`, as in `import_`, is not part of the name."""
    app = typer.Typer(no_args_is_help=True)
    for name, function in functions.items():
        app.command(name.rstrip("_"), cls=Command)(function)
    return app
