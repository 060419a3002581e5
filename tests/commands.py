"""Commands called as `thermocald` is, in the tests' own process: no second is spent on imports."""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import typer
from typer.testing import CliRunner, Result

from thermocald.cli import application, main
from thermocald.cli.commands import COMMANDS
from thermocald.errors import ThermocaldError


def call(*arguments: object, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Exit status, standard output and standard error; folder: where the command is called."""
    command = ["thermocald", *map(str, arguments)]
    out, err = io.StringIO(), io.StringIO()
    before = Path.cwd()
    try:
        os.chdir(folder or before)
        with (
            mock.patch.object(sys, "argv", command),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            main()
        status = 0
    except SystemExit as ended:
        status = int(ended.code or 0)
    finally:
        os.chdir(before)
    assert "Traceback" not in err.getvalue(), err.getvalue()
    return subprocess.CompletedProcess(command, status, out.getvalue(), err.getvalue())


def finish(*arguments: object, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Return what `call` gives of a command that has to end well."""
    done = call(*arguments, folder=folder)
    assert done.returncode == 0, done.stderr
    return done


def refuse(*arguments: object, status: int = 2, folder: Path | None = None) -> str:
    """Return what a command that has to end with this status says, as one line."""
    done = call(*arguments, folder=folder)
    assert done.returncode == status, done.stderr
    return " ".join(done.stderr.split())


def document(*arguments: object, folder: Path | None = None) -> Any:
    """Return the JSON document of a command that has to end well, all of its standard output."""
    return json.loads(finish(*arguments, "--json", "-", folder=folder).stdout)


def answer(*arguments: object, given: str | None = None, **environment: str) -> Result:
    """Return the result of a command; given: its standard input."""
    words = [str(a) for a in arguments]
    # as for users, no other command is set up: 20 ms
    only = application(words[0] if words[0] in COMMANDS else None)
    return CliRunner().invoke(only, words, input=given, env=environment)


def invoke(*arguments: object, **environment: str) -> Result:
    """Return the result of a command; an error of ours is raised as it is."""
    result = answer(*arguments, **environment)
    if isinstance(result.exception, ThermocaldError):
        raise result.exception
    return result


def succeed(*arguments: object, **environment: str) -> Result:
    """Return the result of a command that has to end well."""
    result = invoke(*arguments, **environment)
    assert result.exit_code == 0, (result.output, result.exception)
    return result


def every_command(command: Any = None, name: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Yield the words of each command, and it itself."""
    command = command or typer.main.get_command(application())
    if not hasattr(command, "commands"):
        yield " ".join(name), command
    for key, value in getattr(command, "commands", {}).items():
        yield from every_command(value, (*name, key))
