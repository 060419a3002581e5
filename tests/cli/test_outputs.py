"""A command that cannot write prints one sentence, exits with 2 or 3, leaves no partial file.

Every command with an option that names an output is listed here: a missing one fails the test.
"""

from __future__ import annotations

import ctypes
import errno
import itertools
import os
import shutil
import socket
import stat
import subprocess
import sys
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import cached_property
from pathlib import Path
from string import Formatter
from threading import Thread

import numpy as np
import pytest

import thermocald as tc
from tests.cli.test_testfield import photograph
from tests.commands import call, every_command, finish
from tests.golden.workshop import photographs
from tests.marks import mostly_slow
from thermocald.errors import OutputError
from thermocald.files import new_file, write_text
from thermocald.photogrammetry import camera_files
from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor
from thermocald.store.database.store import Store
from thermocald.store.recording.reader import open_recording
from thermocald.store.recording.testfield_file import read_testfield

_OVERRIDE_PERMISSIONS = 1 << 1  # CAP_DAC_OVERRIDE

# command → its arguments; {to}: the place that cannot be written, the others are made by `World`.
COMMANDS: dict[str, list[str]] = {
    "archive": ["{store}", "--to", "{to}/archive"],
    "backup": ["{store}", "{to}/b.db"],
    "calibrate": [
        "{photos}", "--testfield", "{field}", "--pixel-pitch", "0.00224", "--camera-out",
        "{to}/c.json",
    ],
    "camera at": ["{model}", "--temperature", "30", "--to", "ros", "--out", "{to}/x"],
    "camera convert": ["{camera}", "--to", "ros", "--pixel-pitch", "0.001", "--out", "{to}/x"],
    "check": ["{M1}", "--json", "{to}/x.json"],
    "correct": [
        "{points}", "--model", "{model}", "--log", "{M1}/epochs.csv", "--out", "{to}/c.csv",
    ],
    "demo": ["--out", "{to}/demo", "--epochs", "12"],
    "discover": ["{M1}", "--json", "{to}/x.json"],
    "devices": ["--json", "{to}/x.json"],
    "export": ["{M1}", "--format", "csv", "--output", "{to}/x.csv"],
    "export as JSON": ["{M1}", "--format", "json", "--output", "{to}/x.json"],
    "import": [
        "{snapshots}", "--log", "{log}", "--testfield", "{field}", "--timezone", "UTC",
        "--pixel-pitch", "0.00112", "--out", "{to}/M1",
    ],
    "reprocess": ["{archive}", "--out", "{to}/again"],
    "server dashboard": ["--output", "{to}/x.json"],
    "session start": [
        "--mock", "--epochs", "2", "--no-check", "--no-report", "--output", "{to}/session",
    ],
    "simulate": ["--preset", "rpi-v2.1-heating", "--out", "{to}/M1"],
    "testfield import": [
        "--chessboard", "9x6", "--square", "30", "--out", "{to}/t.csv", "--force",
    ],
    "testfield survey": [
        "{photos}", "--field", "{field}", "--pixel-pitch", "0.00224", "--distances",
        "{distances}", "--out", "{to}/t.csv",
    ],
    "fit": ["{M1}", "--output", "{to}/m.yaml"],
    "predict": ["--model", "{model}", "--temperature", "30", "--json", "{to}/x.json"],
    "replay": ["{M1}", "--json", "{to}/x.json"],
    "study": ["{M1}", "--figures", "{to}/figures"],
    "testfield print": ["--out", "{to}/field"],
}  # fmt: skip


class World:
    """The inputs of commands, made when first needed: world["M1"] is a path."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __getitem__(self, name: str) -> Path:
        path: Path = getattr(self, name)
        return path

    @cached_property
    def archive(self) -> Path:
        tc.simulate("rpi-v2.1-heating", seed=1, epochs=24, out=self.folder / "archive/M1")
        return self.folder / "archive"

    @cached_property
    def M1(self) -> Path:
        return self.archive / "M1"

    @cached_property
    def camera(self) -> Path:
        model = CameraModel(Sensor(640, 480, 0.001), InteriorOrientation(c=3.0, x0=0.01))
        camera_files.write(model, self.folder / "camera.yaml", "opencv")
        return self.folder / "camera.yaml"

    @cached_property
    def store(self) -> Path:
        return self._made("replay", str(self.M1), "--store", "{}", name="k.db")

    @cached_property
    def model(self) -> Path:
        return self._made("fit", str(self.M1), "--output", "{}", name="model.yaml")

    @cached_property
    def points(self) -> Path:
        time_s = open_recording(self.M1).columns.frame_time[3]
        (self.folder / "points.csv").write_text(f"time,x,y\n{time_s},100,200\n")
        return self.folder / "points.csv"

    @cached_property
    def field(self) -> Path:
        printed = ["print", "--paper", "A3", "--flat", "--landscape", "--diameter", "12", "--out"]
        return self._made("testfield", *printed, "{}", name="field") / "testfield.csv"

    @cached_property
    def photos(self) -> Path:
        photograph(self.folder / "photos", read_testfield(self.field))
        return self.folder / "photos"

    @cached_property
    def distances(self) -> Path:
        field, path = read_testfield(self.field), self.folder / "distances.csv"
        a, b = 0, len(field) - 1
        length = np.linalg.norm(field.points[a] - field.points[b])
        row = f"{field.names[a]},{field.names[b]},{length},0.1"
        path.write_text(f"a,b,length,sigma\n{row}\n")
        return path

    @cached_property
    def snapshots(self) -> Path:
        (self.folder / "snapshots").mkdir()
        photographs(self.folder / "snapshots")
        return self.folder / "snapshots/photos"

    @cached_property
    def log(self) -> Path:
        return self["snapshots"].parent / "log.csv"

    def words(self, name: str, **places: Path) -> list[str]:
        """Return a command's words, with inputs from this world and outputs in `places`."""
        words = [*name.split(" as ")[0].split(), *COMMANDS[name]]
        fields = {field for word in words for _, field, _, _ in Formatter().parse(word)}
        known = {field: self[field] for field in fields - {None, *places}}
        return [word.format(**known, **places) for word in words]

    def files(self) -> list[Path]:
        """Return all files, except those that SQLite keeps beside a store that was read."""
        return sorted(p for p in self.folder.rglob("*") if not p.match("*.db-*"))

    def _made(self, *arguments: str, name: str) -> Path:
        path = self.folder / name
        finish(*(part.format(path) for part in arguments))
        return path


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return World(tmp_path_factory.mktemp("world"))


@contextmanager
def capabilities(dropped: int):
    """Without some of the superuser's capabilities, as other users are."""
    libc = ctypes.CDLL(None, use_errno=True)
    header, data = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    libc.capget(header, data)
    before = data[0]
    data[0] &= ~dropped
    libc.capset(header, data)
    yield
    data[0] = before
    libc.capset(header, data)


@pytest.fixture
def refusing(tmp_path):
    """Map a kind to a folder that cannot be written: full, or another user's."""
    tool = shutil.which("mount")
    with ExitStack() as undo:

        def make(kind: str) -> Path:
            folder = tmp_path / kind
            folder.mkdir()
            if kind == "denied":
                folder.chmod(0o555)
                undo.enter_context(capabilities(_OVERRIDE_PERMISSIONS))
                return folder
            command = [tool or "mount", "-t", "tmpfs", "-o", "size=4k", "tmpfs", str(folder)]
            done = subprocess.run(command, capture_output=True, check=False) if tool else None
            if done is None or done.returncode:
                pytest.skip("nothing can be mounted here: needs root")
            undo.callback(subprocess.run, ["umount", "-l", str(folder)], check=False)
            with suppress(OSError):
                (folder / "filler").write_bytes(b"x" * 100_000)
            return folder

        yield make


def test_every_command_that_writes_is_tried():
    outputs = {"--out", "--output", "--figures"}
    for name, command in every_command():
        assert name in COMMANDS or not outputs & {opt for p in command.params for opt in p.opts}


QUICK = ["camera convert", "check", "testfield print", "testfield import", "import"]


@pytest.mark.parametrize(
    ("name", "kind"),
    mostly_slow(
        itertools.product(COMMANDS, ("full", "denied")),
        *itertools.product(QUICK, ("full", "denied")),
    ),
)
def test_a_place_that_cannot_be_written_is_one_sentence(world, refusing, tmp_path, name, kind):
    words = world.words(name, to=tmp_path / kind)
    folder = refusing(kind)
    before = world.files()
    done = call(*words, folder=tmp_path)
    code, said = done.returncode, done.stderr
    assert code == (3 if kind == "full" else 2), said
    errors = [line for line in said.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert "cannot be written" in errors[0] or "the disk is full" in errors[0]
    assert not [p for p in folder.rglob("*") if "partial" in p.name or ".part" in p.name]
    assert world.files() == before


FULL = [OSError(number, os.strerror(number)) for number in (errno.ENOSPC, errno.EDQUOT)]
ENDINGS = [*FULL, KeyboardInterrupt(), SystemExit()]


@pytest.mark.parametrize("ending", ENDINGS)
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
    if isinstance(ended.value, OutputError):
        assert ended.value.exit_status == 3


QUICK_FILES = ["camera convert", "check", "server dashboard", "testfield import", "devices"]
FILES = [*QUICK_FILES, "export", "export as JSON", "fit", "predict", "replay", "correct"]
"""Commands that write a single file."""


def written_to(world, name: str, out: Path) -> tuple[int, str]:
    to = world.folder / "to"
    (last,) = (word for word in world.words(name, to=to) if word.startswith(str(to)))
    done = call(*(str(out) if word == last else word for word in world.words(name, to=to)))
    return done.returncode, done.stderr


def read_pipe(path: Path) -> tuple[Thread, list[bytes]]:
    found: list[bytes] = []
    thread = Thread(target=lambda: found.append(path.read_bytes()), daemon=True)
    thread.start()
    return thread, found


@pytest.mark.parametrize("kind", ["device", "pipe", "link", "dangling", "link to pipe", "folder"])
@pytest.mark.parametrize("name", mostly_slow(FILES, *QUICK_FILES))
def test_what_is_not_a_file_is_never_replaced(world, tmp_path, name, kind):
    out, target = tmp_path / "out", tmp_path / "folder/target.yaml"
    target.parent.mkdir()
    reader, found = None, [b""]
    if kind == "device":
        try:
            os.mknod(out, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
        except PermissionError:
            pytest.skip("no device can be made here")
    elif kind == "folder":
        out.mkdir()
    elif "pipe" in kind:
        os.mkfifo(target)
        out = out if kind.startswith("link") else target
        reader, found = read_pipe(target)
    if "link" in kind or kind == "dangling":
        if kind == "link":
            target.write_text("before")
        out.symlink_to(target)
    before = out.lstat().st_ino, stat.S_IFMT(out.lstat().st_mode)
    code, said = written_to(world, name, out)
    assert (out.lstat().st_ino, stat.S_IFMT(out.lstat().st_mode)) == before
    if kind == "folder":
        assert code == 2
        assert "cannot be written" in said or "is a folder" in said or "irectory" in said
        assert not list(out.iterdir())
        return
    assert code == 0, said
    if reader is not None:
        reader.join(30.0)
        assert stat.S_ISFIFO(target.lstat().st_mode)
    elif kind != "device":
        found = [target.read_bytes()]
        assert not target.is_symlink()
    assert kind == "device" or len(found[0]) > 10
    assert not [p for p in tmp_path.rglob("*") if "partial" in p.name]


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
    (tmp_path / "loop").symlink_to("loop")
    with closing(socket.socket(socket.AF_UNIX)) as server:
        server.bind(str(tmp_path / "socket"))
    for out in (tmp_path / "loop", tmp_path / "socket"):
        before = out.lstat().st_ino
        with pytest.raises(OutputError, match="cannot be written"):
            write_text(out, "new")
        assert out.lstat().st_ino == before
    reading, writing = os.pipe()  # `>(command)` of a shell
    write_text(Path(f"/proc/self/fd/{writing}"), "new")
    os.close(writing)
    assert os.read(reading, 10) == b"new"
    os.close(reading)


def test_a_backup_does_not_replace_a_device(world, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OutputError, match="not a regular file"), Store.open(world.store) as store:
        store.copy_to(tmp_path / "pipe")
    assert stat.S_ISFIFO((tmp_path / "pipe").lstat().st_mode)


def test_standard_output_on_a_full_disk_is_one_sentence():
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            [sys.executable, "-m", "thermocald", "--version"],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    assert "No space left" in done.stderr


@pytest.mark.parametrize(("closed", "status"), [(">&-", 2), ("2>&-", 0), ("<&- >&- 2>&-", 0)])
def test_a_closed_output_is_no_traceback(tmp_path, closed, status):
    done = subprocess.run(
        ["sh", "-c", f'"$0" -m thermocald --version {closed}', sys.executable],
        capture_output=True, text=True, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == status
    assert done.stderr.count("\n") == (status > 0)
