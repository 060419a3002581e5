"""Only the command that is run is imported: it starts faster, and the daemon is smaller."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys

import pytest

from tests.commands import call, every_command
from thermocald.cli.commands import COMMANDS, PANELS

_CALL = """
import sys
import thermocald.cli
for words in sys.stdin:
    sys.argv = ["thermocald", *words.split()]
    try:
        thermocald.cli.main()
    except SystemExit:
        print("==", *sys.modules)
"""


def test_only_what_a_command_needs_is_imported_and_the_list_cuts_no_line_off():
    """The panels are in order of use; every line fits into 80 columns. NumPy is for commands that
    calculate.
    """
    words = "--help\n-v run --help\nsession start --help\nstatus --store absent.db\n"
    done = subprocess.run(
        [sys.executable, "-c", _CALL], input=words, capture_output=True, text=True, check=True,
        env={**os.environ, "COLUMNS": "80"},
    )  # fmt: skip
    lines = done.stdout.splitlines()
    imported = [set(line.split()) for line in lines if line.startswith("==")]
    modules = {f"thermocald.cli.{entry.module}" for entry in COMMANDS.values()}
    run, session = "thermocald.cli.run", "thermocald.cli.session"
    assert [i & modules for i in imported] == [set(), {run}, {run, session}, {run, session}]
    assert "numpy" not in imported[-1]
    lines = lines[: next(i for i, line in enumerate(lines) if line.startswith("=="))]
    assert max(map(len, lines)) <= 80
    assert [line[:-1] for line in lines if line.rstrip(":") in PANELS] == list(PANELS)
    for name, entry in COMMANDS.items():
        assert f"  {name:<9}  {entry.line}" in lines, name


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ("thermocald st", ["status", "study"]),
        ("thermocald replay --ex", ["--exterior"]),
        ("thermocald testfield su", ["survey"]),
    ],
)
def test_a_shell_completes_commands_and_options(monkeypatch, typed, expected):
    monkeypatch.setenv("COMP_WORDS", typed)
    monkeypatch.setenv("COMP_CWORD", str(typed.count(" ")))
    monkeypatch.setenv("_THERMOCALD_COMPLETE", "complete_bash")
    done = call()
    assert (done.returncode, done.stdout.split()) == (0, expected)


def test_options_for_experts_stand_apart():
    """They are listed below the usual options, and all of them are listed."""
    text = call("study", "--help").stdout
    usual, advanced = text.split("Advanced:")
    assert "--report" in usual
    assert "--window" in advanced
    assert "--window" not in usual


def test_every_help_has_an_example_and_breaks_no_option_in_two():
    """A wrapped example was `--pixel-` on one line and `pitch` on the next."""
    for name, _ in every_command():
        text = call(*name.split(), "--help").stdout
        assert "Example" in text, name
        assert not re.search(r"--[a-z-]+-$", text, re.MULTILINE)


_INTERRUPTED = """
import os, signal, sys
class Finder:
    def find_spec(self, name, *_):
        if name == "typer":
            os.kill(os.getpid(), signal.SIGINT)
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Finder())
import thermocald.cli
"""
_ENDED = """
import os, signal, sys, time
import thermocald.cli
class Last:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)
def invoke(*_):
    Last()
    time.sleep(60)
thermocald.cli.commands.Command.invoke = invoke
sys.argv = ["thermocald", "devices"]
thermocald.cli.main()
"""


@pytest.mark.parametrize(
    ("script", "status"), [(_INTERRUPTED, -signal.SIGINT), (_ENDED, 128 + signal.SIGTERM)]
)
def test_a_signal_ends_a_command_silently_while_it_is_imported_and_in_a_destructor(script, status):
    """A traceback; and a page that was stopped while pydantic built a model served on."""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=50, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (status, "", "")
