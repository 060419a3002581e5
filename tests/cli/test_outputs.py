"""Where a command cannot write: one sentence, exit status 2 or 3, and nothing half-written.

Every registered command with an option that names an output is here: a new one fails the test.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import typer

from thermocald.atomic_file import new_file
from thermocald.cli import application, main
from thermocald.errors import OutputError
from thermocald.output import camera_files
from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor
from thermocald.simulation.presets import preset_simulation

# command → its arguments; {M1}, {M2}: recordings, {camera}: a camera file, {to}: the place that
# cannot be written. None: it needs hardware, a daemon or a server, and its writer is one of these.
COMMANDS: dict[str, list[str] | None] = {
    "archive": None,
    "backup": None,
    "calibrate": None,
    "camera convert": ["{camera}", "--to", "ros", "--pixel-pitch", "0.001", "--out", "{to}/x"],
    "check": ["{M1}", "--json", "{to}/x.json"],
    "correct": None,
    "demo": ["--out", "{to}/demo", "--epochs", "12"],
    "discover": ["{M1}", "--json", "{to}/x.json"],
    "export": ["{M1}", "--format", "csv", "--output", "{to}/x.csv"],
    "import": None,
    "reprocess": None,
    "server dashboard": ["--output", "{to}/x.json"],
    "session start": None,
    "simulate": ["--preset", "rpi-v2.1-heating", "--out", "{to}/M1"],
    "testfield import": None,
    "testfield survey": None,
    "fit": ["{M1}", "--output", "{to}/m.yaml"],
    "predict": None,
    "replay": ["{M1}", "--json", "{to}/x.json"],
    "study": ["{M1}", "--figures", "{to}/figures"],
    "testfield print": ["--out", "{to}/field"],
}


def leaves(command, name=()):
    for key, value in getattr(command, "commands", {}).items():
        yield from leaves(value, (*name, key))
    if not hasattr(command, "commands"):
        yield " ".join(name), {opt for p in command.params for opt in p.opts}


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("world")
    simulation = preset_simulation("rpi-v2.1-heating", 1, "M1", None)
    short = replace(simulation, programme=replace(simulation.programme, epochs=24))
    short.write(folder / "M1")
    interior = InteriorOrientation(c=3.0, x0=0.01)
    model = CameraModel(Sensor(640, 480, 0.001), interior)
    camera_files.write(model, folder / "camera.yaml", "opencv")
    return {"M1": folder / "M1", "camera": folder / "camera.yaml"}


@pytest.fixture
def mounted(tmp_path):
    """(option, …) → a folder that cannot be written: mounted read-only, or full."""
    tool = shutil.which("mount")
    folders = []

    def mount(kind: str) -> Path:
        folder = tmp_path / kind
        folder.mkdir()
        options = ["ro"] if kind == "read-only" else ["size=4k"]
        command = [tool or "mount", "-t", "tmpfs", "-o", *options, "tmpfs", str(folder)]
        done = subprocess.run(command, capture_output=True, check=False) if tool else None
        if done is None or done.returncode:
            pytest.skip("nothing can be mounted here: needs root")
        folders.append(folder)
        return folder

    yield mount
    for folder in folders:
        subprocess.run(["umount", "-l", str(folder)], check=False)


def run(monkeypatch, capsys, *arguments: str) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["thermocald", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code, capsys.readouterr().err


def test_every_command_that_writes_is_tried():
    found = dict(leaves(typer.main.get_command(application())))
    outputs = {"--out", "--output", "--figures"}
    assert {name for name, options in found.items() if options & outputs} <= set(COMMANDS)


QUICK = ["camera convert", "check", "testfield print"]
SLOW = [name for name, given in COMMANDS.items() if given is not None and name not in QUICK]


@pytest.mark.parametrize("kind", ["read-only", "full"])
@pytest.mark.parametrize(
    "name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)]
)
def test_a_place_that_cannot_be_written_is_one_sentence(
    world, mounted, monkeypatch, capsys, name, kind
):
    folder = mounted(kind)
    before = sorted(world["M1"].rglob("*"))
    values = {**{k: str(v) for k, v in world.items()}, "to": str(folder)}
    arguments = [part.format(**values) for part in COMMANDS[name]]
    if kind == "full":
        filler = folder / "filler"
        with contextlib.suppress(OSError):
            filler.write_bytes(b"x" * 100_000)
    code, said = run(monkeypatch, capsys, *name.split(), *arguments)
    assert code == (2 if kind == "read-only" else 3), said
    errors = [line for line in said.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert "cannot be written" in errors[0] or "the disk is full" in errors[0]
    assert "Traceback" not in said
    assert not [p for p in folder.rglob("*") if "partial" in p.name or ".part" in p.name]
    assert sorted(world["M1"].rglob("*")) == before


ENDINGS = [OSError(28, "No space left"), KeyboardInterrupt(), SystemExit()]


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


def test_standard_output_on_a_full_disk_is_one_sentence(world):
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            [sys.executable, "-m", "thermocald", "check", world["M1"], "--json", "-"],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    assert "No space left" in done.stderr
