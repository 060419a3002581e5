"""Only the command that is run is imported: it starts faster, and the daemon is smaller."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys

import pytest

from tests.commands import call, every_command, finish
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
thermocald.cli.application()
import thermocald.output.dashboard.application
print("==", *sys.modules)
import thermocald as tc, thermocald.daemon.plan
import thermocald.analysis.thermal.gauge, thermocald.analysis.thermal.correction
import thermocald.analysis.online.running_series, thermocald.analysis.series.adjusted
tc.load_camera
from tests.analysis.test_gauge import TAU, thermal_camera
from thermocald.analysis.thermal.predictor import Predictor
predictor = Predictor(thermal_camera(TAU))
predictor.take(0.0, {"temperature": 20.0})
predictor.at(1.0)
print("==", *sys.modules)
"""


def test_only_what_a_command_needs_is_imported_and_the_list_cuts_no_line_off():
    """The panels are in order of use; every line fits into 80 columns. NumPy is for commands that
    calculate. OpenCV, SciPy and Matplotlib are half of the page's memory and of a command's start;
    SciPy's optimiser is 20 MB, its sparse matrices are 12, and a camera as it is predicted, at a
    gauge, and in its series is without.
    """
    words = "--help\n-v run --help\nsession start --help\nstatus --store absent.db\n"
    done = subprocess.run(
        [sys.executable, "-c", _CALL], input=words, capture_output=True, text=True, check=True,
        env={**os.environ, "COLUMNS": "80"},
    )  # fmt: skip
    lines = done.stdout.splitlines()
    *imported, page, camera = (set(line.split()) for line in lines if line.startswith("=="))
    modules = {f"thermocald.cli.{entry.module}" for entry in COMMANDS.values()}
    run, session = "thermocald.cli.run", "thermocald.cli.session"
    assert [i & modules for i in imported] == [set(), {run}, {run, session}, {run, session}]
    assert "numpy" not in imported[-1]
    assert not page & {"cv2", "matplotlib", "plotly", "scipy"}
    heavy = ("optimize", "stats", "spatial", "integrate", "sparse")
    assert not camera & {f"scipy.{n}" for n in heavy}
    lines = lines[: next(i for i, line in enumerate(lines) if line.startswith("=="))]
    assert max(map(len, lines)) <= 80
    assert [line[:-1] for line in lines if line.rstrip(":") in PANELS] == list(PANELS)
    for name, entry in COMMANDS.items():
        assert f"  {name:<9}  {entry.line}" in lines, name


def test_a_shell_completes_commands_and_options(monkeypatch):
    monkeypatch.setenv("_THERMOCALD_COMPLETE", "complete_bash")
    for typed, expected in (("st", ["status", "study"]), ("replay --ex", ["--exterior"])):
        monkeypatch.setenv("COMP_WORDS", f"thermocald {typed}")
        monkeypatch.setenv("COMP_CWORD", str(1 + typed.count(" ")))
        assert finish().stdout.split() == expected


def test_every_help_has_an_example_and_breaks_no_option_in_two():
    """A wrapped example was `--pixel-` on one line and `pitch` on the next.

    Options for experts are listed below the usual ones.
    """
    texts = {name: call(*name.split(), "--help").stdout for name, _ in every_command()}
    for name, text in texts.items():
        assert "Example" in text, name
        assert not re.search(r"--[a-z-]+-$", text, re.MULTILINE)
    usual, advanced = texts["study"].split("Advanced:")
    assert "--report" in usual
    assert "--window" in advanced


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


@pytest.mark.parametrize(
    ("words", "closed", "status"), [("simulate --list", 1, 0), ("stduy", 2, 2)]
)
def test_a_reader_that_has_gone_changes_no_status(words, closed, status):
    """The status was 1, and of a progress that nobody read no result was written."""
    reader, pipe = os.pipe()
    os.close(reader)
    streams = {["stdin", "stdout", "stderr"][closed]: pipe}
    command = [sys.executable, "-m", "thermocald", *words.split()]
    assert subprocess.run(command, timeout=60, check=False, **streams).returncode == status
    os.close(pipe)
