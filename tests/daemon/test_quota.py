"""A disk without a byte left, or a quota that is used up, under a running daemon: all that is asked
says so, it is waited for, and nothing is lost once there is room again.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.commands import call
from tests.marks import mostly_slow
from thermocald.daemon.live_state import LiveState, read_state
from thermocald.output.dashboard.view import View


def fill(disk: Path) -> None:
    """Leave no byte on a disk."""
    with (disk / "filler").open("ab", buffering=0) as file:
        for size in (1 << 20, 1 << 16, 1 << 12, 512, 1):
            try:
                while file.write(b"\0" * size) == size:
                    pass
            except OSError:
                continue


def empty(disk: Path) -> None:
    (disk / "filler").unlink()


@pytest.fixture
def small_card(tmp_path):
    """The folder of a disk of 40 MB from a file, as a card has it; skips where none is mounted."""
    image, folder = tmp_path / "card.img", tmp_path / "card"
    folder.mkdir()
    image.write_bytes(bytes(40_000_000))
    if os.geteuid() or not all(map(shutil.which, ("mkfs.ext4", "mount"))):
        pytest.skip("needs root, mount and mkfs.ext4")
    made = subprocess.run(["mkfs.ext4", "-q", "-m", "0", image], capture_output=True, check=False)
    mount = ["mount", "-o", "loop", image, folder]
    if made.returncode or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no file system can be mounted from a file here")
    yield folder
    subprocess.run(["umount", "-l", folder], check=False)


def said(daemon) -> tuple[int, str, bool, str]:
    """Exit status and text of `status`, and what the page answers to who asks for its health."""
    done = call("status", "--store", daemon.store)
    well, why = View(daemon.store, LiveState.beside(daemon.store).folder).healthy()
    return done.returncode, done.stdout + done.stderr, well, why


def told_of(daemon, words: str) -> bool:
    status, text, well, why = said(daemon)
    return status == 1 and words in text and not well and why == "the store cannot be written"


def filled_and_emptied(daemon, disk: Path, fill=fill, empty=empty, **environment: str) -> None:
    """The course that all kinds of disks take."""
    daemon.start(**environment)
    daemon.more(4)
    daemon.until(lambda: said(daemon)[0] == 0)
    fill(disk)
    daemon.until(lambda: told_of(daemon, "epochs wait"))
    waiting = read_state(LiveState.beside(daemon.store).folder)["store"]["waiting"]
    # the status goes on: it is not the one from before the disk was full
    daemon.until(
        lambda: read_state(LiveState.beside(daemon.store).folder)["store"]["waiting"] > waiting + 2
    )
    count = len(daemon.results())
    empty(disk)
    daemon.until(lambda: any(r["stored"] for r in daemon.results()[count:]))
    daemon.until(lambda: said(daemon)[::2] == (0, True))
    assert daemon.stop() == 0
    numbers, _ = daemon.stored()
    assert len(numbers) >= len(daemon.results())
    assert any(not r["stored"] for r in daemon.results())
    assert "store_out" in daemon.events()


@pytest.mark.parametrize("kind", mostly_slow(["small_disk", "small_card"], "small_disk"))
def test_a_full_disk_is_said_and_waited_for(daemon, measured, kind, request):
    made = request.getfixturevalue(kind)
    disk = made(40) if kind == "small_disk" else made
    daemon.store = disk / "thermocald.db"
    daemon.configure(**measured)
    filled_and_emptied(daemon, disk)
    assert "observations_paused" in daemon.events()


class Quota:
    """A quota of the daemon's files in a folder, which the kernel here may not know."""

    def __init__(self, folder: Path) -> None:
        self._file = folder.with_name("quota")
        self.environment = {"QUOTA_OF": str(folder), "QUOTA_FILE": str(self._file)}

    def reach(self, folder: Path, room: int = 0) -> None:
        used = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        self._file.with_name("new").write_text(str(used + room))
        self._file.with_name("new").replace(self._file)

    def lift(self, _folder: Path) -> None:
        self._file.unlink()


@pytest.fixture
def quota(daemon, tmp_path, preloaded):
    folder = tmp_path / "home"
    folder.mkdir()
    daemon.forker, daemon.store = preloaded, folder / "thermocald.db"
    return Quota(folder)


@pytest.mark.parametrize("late", mostly_slow([{}, {"QUOTA_LATE": "1"}], {}))
def test_a_quota_is_said_and_waited_for(daemon, measured, quota, late):
    """QUOTA_LATE: the flush fails too, as where blocks are allocated late."""
    daemon.configure(**measured)
    home = daemon.store.parent
    filled_and_emptied(daemon, home, quota.reach, quota.lift, **quota.environment, **late)
    assert "Traceback" not in daemon.log()


def test_an_output_under_a_quota_goes_on_with_whole_lines_and_what_waited(daemon, measured, quota):
    home = daemon.store.parent
    measured["outputs"].append({"name": "two", "driver": "jsonl", "path": str(home / "two.jsonl")})
    daemon.configure(**measured)
    daemon.start(**quota.environment)
    daemon.until(lambda: len(daemon.results("home/two.jsonl")) > 3)
    quota.reach(home, 100)  # less than a line
    daemon.until(lambda: sum(not r["stored"] for r in daemon.results()) > 5)
    quota.lift(home)
    daemon.until(lambda: daemon.results("home/two.jsonl")[-1]["stored"])
    assert daemon.stop() == 0
    told = [r["epoch"] for r in daemon.results("home/two.jsonl")]
    assert told == list(range(1, len(told) + 1))


COMMANDS = {
    "export": ("export", "{recording}", "-o", "{out}"),
    "export json": ("export", "{recording}", "--format", "json", "-o", "{out}"),
    "export parquet": ("export", "{recording}", "--format", "parquet", "-o", "{out}"),
    "replay json": ("replay", "{recording}", "--json", "{out}"),
    "replay store": ("replay", "{recording}", "--store", "{out}.db"),
    "simulate": ("simulate", "--preset", "rpi-v2.1-heating", "--out", "{out}"),
    "testfield": ("testfield", "import", "--chessboard", "9x6", "--square", "30", "--out", "{out}"),
}


@pytest.mark.parametrize("case", COMMANDS)
def test_a_command_under_a_quota_says_so_and_leaves_nothing_half(
    case, quota, recording, tmp_path, preloaded
):
    quota.reach(tmp_path / "home", 200)
    out = tmp_path / "home/out"
    command = [part.format(recording=recording, out=out) for part in COMMANDS[case]]
    done = preloaded.start(tmp_path, *command, **quota.environment)
    said = done.said()
    assert done.returncode == 3
    assert "error: " in said
    assert "Traceback" not in said
    assert not [path for path in out.parent.rglob("*") if path.is_file()]


@pytest.mark.parametrize("room", mostly_slow([1, 4095, 8193, 30_000], 1))
def test_what_was_reported_kept_is_kept_where_a_quota_leaves_a_little(
    daemon, measured, quota, room
):
    """A write that fits in part; then it is killed, and lifted, and goes on."""
    daemon.configure(**measured)
    daemon.start(**quota.environment)
    daemon.more(4)
    quota.reach(daemon.store.parent, room)
    daemon.until(lambda: sum(not r["stored"] for r in daemon.results()) > 2)
    daemon.kill()
    kept = {r["epoch"] for r in daemon.results() if r["stored"]}
    assert kept <= set(daemon.stored()[0])
    quota.lift(daemon.store.parent)
    count = len(daemon.results())
    daemon.start(**quota.environment)
    daemon.until(lambda: any(r["stored"] for r in daemon.results()[count:]))
    assert daemon.stop() == 0
    assert kept <= set(daemon.stored()[0])


def test_where_a_quota_is_reached_before_it_begins_it_says_so(daemon, measured, quota):
    quota.reach(daemon.store.parent)
    daemon.configure(**measured)
    daemon.start(**quota.environment)
    assert daemon.wait() in (1, 3)
    assert "error: " in daemon.log()
    quota.lift(daemon.store.parent)
    daemon.start(**quota.environment)
    daemon.more(3)
    assert daemon.stop() == 0


def test_what_waits_when_it_is_ended_on_a_full_disk_is_counted(daemon, measured, small_disk):
    disk = small_disk(40)
    daemon.store = disk / "thermocald.db"
    ended_when_full(daemon, measured, disk)


@pytest.mark.slow
def test_what_waits_when_it_is_ended_under_a_quota_is_counted(daemon, measured, quota):
    home = daemon.store.parent
    ended_when_full(daemon, measured, home, quota.reach, quota.lift, **quota.environment)


def ended_when_full(daemon, measured, disk, fill=fill, empty=empty, **environment) -> None:
    daemon.configure(**measured)
    daemon.start(**environment)
    daemon.more(4)
    fill(disk)
    daemon.until(lambda: told_of(daemon, "epochs wait"))
    assert daemon.stop() == 1
    taken = daemon.results()[-1]["epoch"]
    empty(disk)
    numbers, _ = daemon.stored()
    lost = daemon.log().count("an epoch is lost: ")
    assert f"error: {lost} epochs were lost" in daemon.log()
    assert lost > 0
    assert len(numbers) + lost >= taken
