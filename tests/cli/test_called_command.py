"""Only the command that is called is imported: it starts sooner, and the daemon is smaller."""

from __future__ import annotations

import subprocess
import sys

import pytest

from thermocald.cli import _called
from thermocald.cli.commands import COMMANDS, GROUPS, command, group

_SAY = """
import sys
sys.argv = ["thermocald", *sys.argv[1:]]
import thermocald.cli
try:
    thermocald.cli.main()
except SystemExit:
    print("|".join(sorted(sys.modules)))
"""


@pytest.mark.parametrize("words", [["run", "--help"], ["-v", "run", "--help"]])
def test_the_others_are_not_imported(words):
    done = subprocess.run(
        [sys.executable, "-c", _SAY, *words], capture_output=True, text=True, check=True
    )
    assert "--hang-after" in done.stdout
    imported = set(done.stdout.splitlines()[-1].split("|"))
    commands = {f"thermocald.cli.{module}" for module in {*COMMANDS.values(), *GROUPS}}
    assert imported & commands == {"thermocald.cli.run"}


@pytest.mark.parametrize(
    ("words", "called"),
    [
        (["study", "x.db"], "study"),
        (["--verbose", "testfield", "print"], "testfield"),
        (["--help", "study"], None),
        (["--version"], None),
        (["stduy"], None),
        ([], None),
    ],
)
def test_the_called_one(words, called):
    assert _called(words) == called


def test_every_word_has_its_function():
    for name in COMMANDS:
        assert (command(name).__doc__ or "").strip(), name
    for name in GROUPS:
        assert group(name).registered_commands, name
