"""Commands called as `thermocald` is, in the tests' own process: no second is spent on imports."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

from typer.testing import CliRunner, Result

from thermocald.cli import application, main
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
    return subprocess.CompletedProcess(command, status, out.getvalue(), err.getvalue())


def answer(*arguments: object, given: str | None = None, **environment: str) -> Result:
    """Return the result of a command; given: its standard input."""
    words = [str(a) for a in arguments]
    return CliRunner().invoke(application(), words, input=given, env=environment)


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
