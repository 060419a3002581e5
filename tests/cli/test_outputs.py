"""A command that cannot write prints one sentence, exits with 2 or 3, leaves no partial file.

Every command with an option that names an output is listed here: a missing one fails the test.
"""

from __future__ import annotations

import ctypes
import errno
import itertools
import os
import shlex
import socket
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, nullcontext, suppress
from pathlib import Path

import pytest

from tests.commands import call, every_command
from tests.marks import mostly_slow
from thermocald.errors import OutputError
from thermocald.files import new_file, write_text

# {to}: the place that cannot be written; {world} and {sheet}: the folders of the fixtures
COMMANDS = {
    "archive": "{world}/thermocald.db --to {to}/archive",
    "backup": "{world}/thermocald.db {to}/b.db",
    "calibrate": "{sheet}/photos --testfield {sheet}/testfield.csv --pixel-pitch 0.00224"
    " --camera-out {to}/c.json",
    "camera at": "{world}/camera.yaml --temperature 30 --to ros --out {to}/x",
    "camera convert": "{world}/cold.json --to ros --out {to}/x",
    "check": "{world}/short --json {to}/x.json",
    "correct": "{world}/points.csv --model {world}/camera.yaml --log {world}/M1 --out {to}/c.csv",
    "demo": "--out {to}/demo --epochs 12",
    "discover": "{world}/short --json {to}/x.json",
    "devices": "--json {to}/x.json",
    "export": "{world}/short --format csv --output {to}/x.csv",
    "export as JSON": "{world}/short --format json --output {to}/x.json",
    "import": "{world}/photos --log {world}/logger.csv --testfield {world}/M1/testfield.csv"
    " --timezone UTC --pixel-pitch 0.00112 --out {to}/M1",
    "reprocess": "{world}/short --out {to}/again",
    "server dashboard": "--output {to}/x.json",
    "session start": "--mock --epochs 2 --no-check --no-report --output {to}/session",
    "simulate": "--preset rpi-v2.1-heating --out {to}/M1",
    "testfield import": "--chessboard 9x6 --square 30 --out {to}/t.csv --force",
    "testfield survey": "{sheet}/photos --field {sheet}/testfield.csv --pixel-pitch 0.00224"
    " --scale {scale} --out {to}/t.csv",
    "fit": "{world}/short --output {to}/m.yaml",
    "predict": "--model {world}/camera.yaml --temperature 30 --json {to}/x.json",
    "replay": "{world}/short --json {to}/x.json",
    "study": "{world}/short --figures {to}/figures",
    "testfield print": "--out {to}/field",
}


def test_every_command_that_writes_is_tried():
    outputs = {"--out", "--output", "--figures"}
    for name, command in every_command():
        assert name in COMMANDS or not outputs & {opt for p in command.params for opt in p.opts}


@pytest.fixture
def words_of(request, world):
    """Map a command's name and the folder of its outputs to its words."""

    def words(name: str, to: Path, inputs: Path = world) -> list[str]:
        line = f"{name.split(' as ')[0]} {COMMANDS[name]}"
        folders = {"to": to, "world": inputs}
        if "{sheet}" in line:
            folders["sheet"], *_, scale = request.getfixturevalue("sheet")
            line = line.replace("{scale}", " ".join(scale))
        return [word.format(**folders) for word in line.split()]

    return words


@contextmanager
def as_other_users():
    """Without the superuser's CAP_DAC_OVERRIDE."""
    libc = ctypes.CDLL(None, use_errno=True)
    header, data = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    libc.capget(header, data)
    before = data[0]
    data[0] &= ~(1 << 1)
    libc.capset(header, data)
    yield
    data[0] = before
    libc.capset(header, data)


QUICK = ["camera convert", "check", "testfield print", "testfield import", "import"]
KINDS = {"full": 3, "denied": 2}


@pytest.mark.parametrize(
    ("name", "kind"),
    mostly_slow(itertools.product(COMMANDS, KINDS), *itertools.product(QUICK, KINDS)),
)
def test_a_place_that_cannot_be_written_is_one_sentence(
    words_of, world, request, tmp_path, name, kind
):
    if kind == "full":
        folder = request.getfixturevalue("small_disk")(1)
        with suppress(OSError):
            (folder / "filler").write_bytes(bytes(2_000_000))
    else:
        (folder := tmp_path / "denied").mkdir(0o555)
    words, before = words_of(name, folder), sorted(world.glob("*[!lm]"))  # no t.db-wal, t.db-shm
    with as_other_users() if kind == "denied" else nullcontext():
        done = call(*words, folder=tmp_path)
    assert done.returncode == KINDS[kind], done.stderr
    (error,) = (line for line in done.stderr.splitlines() if line.startswith("error:"))
    assert "cannot be written" in error or "the disk is full" in error
    assert not [p for p in folder.rglob("*") if ".part" in p.name]
    assert sorted(world.glob("*[!lm]")) == before


FULL = [OSError(number, os.strerror(number)) for number in (errno.ENOSPC, errno.EDQUOT)]


@pytest.mark.parametrize("ending", [*FULL, KeyboardInterrupt(), SystemExit()])
def test_nothing_half_written_stays_however_it_ends(tmp_path, ending):
    (tmp_path / "x").write_text("before")

    def write():
        with new_file(tmp_path / "x") as partial:
            partial.write_text("half")
            raise ending

    with pytest.raises((OutputError, KeyboardInterrupt, SystemExit)) as ended:
        write()
    assert [p.name for p in tmp_path.iterdir()] == ["x"]
    assert (tmp_path / "x").read_text() == "before"
    assert not isinstance(ended.value, OutputError) or ended.value.exit_status == 3


@pytest.mark.parametrize("name", ["camera convert", "server dashboard"])
@pytest.mark.parametrize(
    "kind", ["device", "pipe", "link", "dangling", "link to pipe", "folder", "loop", "socket"]
)
def test_what_is_not_a_file_is_never_replaced(words_of, tmp_path, name, kind):
    words = words_of(name, tmp_path)
    (out,) = (Path(word) for word in words if word.startswith(str(tmp_path)))
    target = tmp_path / "target.yaml" if kind.startswith(("link", "dangling")) else out
    if kind == "device":
        os.mknod(out, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
    elif kind == "folder":
        out.mkdir()
    elif kind == "socket":
        with closing(socket.socket(socket.AF_UNIX)) as server:
            server.bind(str(out))
    elif "pipe" in kind:
        os.mkfifo(target)
    elif kind == "link":
        target.write_text("before")
    if target != out or kind == "loop":
        out.symlink_to(target)
    before = out.lstat().st_ino, stat.S_IFMT(out.lstat().st_mode)
    with ThreadPoolExecutor() as pool:
        read = pool.submit(target.read_bytes) if "pipe" in kind else None
        done = call(*words)
    assert (out.lstat().st_ino, stat.S_IFMT(out.lstat().st_mode)) == before
    assert not list(tmp_path.glob("*.part*"))
    if kind in ("folder", "loop", "socket"):
        assert done.returncode == (3 if kind == "socket" else 2)
        assert "cannot be written" in done.stderr
    else:
        assert done.returncode == 0, done.stderr
        written = read.result() if read else target.read_bytes()
        assert kind == "device" or len(written) > 10
        assert target.is_fifo() or kind == "device" or target.is_file()


def test_the_place_of_an_output_in_further_shapes(tmp_path):
    other = tmp_path / "other"
    other.write_text("other")
    os.link(other, tmp_path / "hard")
    (tmp_path / ".planted.partial").symlink_to(other)  # under the name that we write to first
    (tmp_path / "mode").touch(0o600)
    for name in ("hard", "planted", "mode", "é" * 120):
        out = tmp_path / name
        write_text(out, "new")
        assert (out.read_text(), stat.S_ISREG(out.lstat().st_mode)) == ("new", True)
    assert other.read_text() == "other"
    assert stat.S_IMODE((tmp_path / "mode").stat().st_mode) == 0o600
    reading, writing = os.pipe()  # `>(command)` of a shell
    write_text(Path(f"/proc/self/fd/{writing}"), "new")
    os.close(writing)
    assert os.read(reading, 10) == b"new"
    os.close(reading)


@pytest.mark.parametrize(
    ("output", "status", "said"),
    [(">/dev/full", 3, "No space left"), (">&-", 2, "error: "), ("2>&-", 0, ""),
     ("<&- >&- 2>&-", 0, "")],
)  # fmt: skip
def test_a_full_or_closed_output_is_one_sentence(tmp_path, output, status, said):
    done = subprocess.run(
        ["sh", "-c", f'"$0" -m thermocald --version {output}', sys.executable],
        capture_output=True, text=True, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert (done.returncode, done.stderr.count("\n")) == (status, status > 0)
    assert said in done.stderr


ALL = r"""
import os, shlex, sys, traceback
from thermocald.cli import main
for line in os.fsdecode(sys.stdin.buffer.read()).split("\n"):
    sys.argv = ["thermocald", *shlex.split(line)]
    try:
        main()
        status = 0
    except SystemExit as ended:
        status = ended.code or 0
    except BaseException:
        traceback.print_exc()
        status = 9
    sys.stdout.flush()
    print(f"== {status} {line!a}", file=sys.stderr, flush=True)
"""
NO_UTF8 = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("environment", "name"),
    [
        pytest.param({"PYTHONIOENCODING": "ascii"}, b"M\xe9 ", id="ascii, names in Latin-1"),
        pytest.param({**NO_UTF8, "LANG": "C"}, "Größe·".encode() + b"\xc3", id="C locale"),
        pytest.param({"PYTHONIOENCODING": "utf-16"}, b"\xff\xfe", id="utf-16"),
        pytest.param({"PYTHONIOENCODING": "cp437:strict"}, "a\tb'温".encode(), id="cp437"),
    ],
)
def test_no_command_breaks_on_what_a_terminal_cannot_show(
    words_of, world, tmp_path, environment, name
):
    """Every command that prints, with names that are not text."""
    to, inputs = tmp_path / os.fsdecode(name), tmp_path / os.fsdecode(name + b"in")
    to.mkdir()
    inputs.symlink_to(world)
    lines = [words_of(n, to, inputs) for n in COMMANDS if n not in ("demo", "session start")]
    lines += [["--help"], ["simulate", "--list"], ["doctor"], ["export", inputs / "short"]]
    lines += [["convert", to / "M1", "--keep"], ["status", "--store", inputs / "thermocald.db"]]
    lines += [["study", to / "M1", "--sets", "200", "--report", to / "s.html", "--json", "-"]]
    lines += [["fit", to / "M1", "-o", to / "c.yaml", "--code", to / "c"], ["replay", to / "no"]]
    given = os.fsencode("\n".join(shlex.join(map(str, words)) for words in lines))
    done = subprocess.run(
        [sys.executable, "-c", ALL], input=given, capture_output=True, check=False, cwd=tmp_path,
        env=os.environ | environment, timeout=400,
    )  # fmt: skip
    encoding = environment.get("PYTHONIOENCODING", "utf-8").partition(":")[0]
    said = done.stderr.decode(encoding, errors="replace")
    print(said)
    assert "Traceback" not in said
    assert "Error: " not in said.replace("Error: No such", "").replace("Error: Missing", "")
    statuses = [line.split()[1] for line in said.splitlines() if line.startswith("== ")]
    assert len(statuses) == len(lines)
    assert set(statuses) <= {"0", "1", "2", "3"}
    assert statuses.count("0") >= 20
