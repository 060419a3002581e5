"""Only the command that is run is imported: it starts faster, and the daemon is smaller."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

from tests.commands import call, every_command
from thermocald.cli.commands import COMMANDS, PANELS

_SAY = """
import sys
sys.argv = ["thermocald", *sys.argv[1:]]
import thermocald.cli
try:
    thermocald.cli.main()
except SystemExit:
    print("|".join(sorted(sys.modules)))
"""


_MODULES = {f"thermocald.cli.{entry.module}" for entry in COMMANDS.values()}


def test_the_others_are_not_imported():
    words = ["-v", "run", "--help"]
    done = subprocess.run(
        [sys.executable, "-c", _SAY, *words], capture_output=True, text=True, check=True
    )
    assert "--hang-after" in done.stdout
    imported = set(done.stdout.splitlines()[-1].split("|"))
    assert imported & {*_MODULES, "numpy"} == {"thermocald.cli.run"}


def test_the_list_imports_none_and_cuts_no_line_off():
    """The panels are in order of use; every line fits into 80 columns."""
    done = subprocess.run(
        [sys.executable, "-c", _SAY, "--help"], capture_output=True, text=True, check=True,
        env={**os.environ, "COLUMNS": "80"},
    )  # fmt: skip
    *lines, modules = done.stdout.splitlines()
    assert not set(modules.split("|")) & {*_MODULES, "numpy"}
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
