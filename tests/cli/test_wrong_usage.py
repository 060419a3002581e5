"""What is typed wrongly is answered by one line: what, where, what to do; and before any work."""

from __future__ import annotations

import subprocess
import sys

import pytest

from thermocald.errors import OutputError
from thermocald.files import check_output


def _typed(*words: object, cwd=None) -> tuple[int, list[str]]:
    """Exit status and lines on standard error of the real program."""
    done = subprocess.run(
        [sys.executable, "-m", "thermocald", *map(str, words)],
        cwd=cwd, check=False, capture_output=True, text=True,
    )  # fmt: skip
    return done.returncode, done.stderr.splitlines()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("replya", "M1"), "error: no such command 'replya'"),
        (("replay",), "error: missing argument 'recording'; see 'thermocald replay --help'"),
        (("replay", "M1", "M1"), "see 'thermocald replay --help'"),
        (("study", "M1", "--distance", "-3"), "error: --distance: should be greater than"),
        (("study", "M1", "--seed", "x"), "error: --seed: should be a valid integer"),
        (("predict", "--temperature", "20"), "error: missing option '--model'"),
        (("camera", "foo"), "error: no such command 'foo'; see 'thermocald camera --help'"),
        (("replay", "M1", "--exteriorr", "series"), "no such option: --exteriorr"),
        (("import", "p", "--log", "l"), "error: --testfield is missing: give it, or --dry-run"),
    ],
    ids=lambda words: " ".join(words) if isinstance(words, tuple) else "",
)
def test_it_is_one_line(words, said):
    status, lines = _typed(*words)
    assert status == 2
    assert len(lines) == 1
    assert said in lines[0]


def test_a_switch_is_no_output():
    """`--report / --no-report` of a session shares its name with files of other commands."""
    status, lines = _typed(
        "session", "start", "--camera", "a", "--series", "M1", "--config", "nowhere.yaml"
    )
    assert status == 2
    assert len(lines) == 1
    assert lines[0].startswith("error: nowhere.yaml: ")


def test_nothing_typed_is_answered_by_the_help():
    status, lines = _typed("camera")
    assert status == 2
    assert not [line for line in lines if line.startswith("error")]


@pytest.mark.parametrize("option", ["--report", "--json"])
def test_an_output_that_cannot_be_is_refused_before_the_work(option, tmp_path):
    """The recording does not even exist: it has not been looked at."""
    (tmp_path / "file").touch()
    status, lines = _typed("study", "nowhere", option, "file/page.html", cwd=tmp_path)
    assert status == 2
    assert len(lines) == 1
    assert lines[0].startswith("error: file/page.html: cannot be written: ")
    assert lines[0].endswith("file is a file")


def test_outputs_that_can_be(tmp_path):
    (tmp_path / "there").touch()
    for path in (tmp_path / "there", tmp_path / "new" / "deep" / "a.csv", tmp_path, "/dev/null"):
        check_output(tmp_path / path)
    assert not (tmp_path / "new").exists()
    with pytest.raises(OutputError, match="the kernel keeps this folder; choose another folder"):
        check_output(tmp_path / "/proc/a.csv")
