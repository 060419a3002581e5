"""A disk without a byte left under a running daemon: said by everything that is asked, waited for,
and nothing is lost once there is room again.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.commands import call
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


def filled_and_emptied(daemon, disk: Path) -> None:
    """The course that both kinds of disks take."""
    daemon.start()
    daemon.until(lambda: len(daemon.results()) > 3)
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
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) >= len(daemon.results())
    assert any(not r["stored"] for r in daemon.results())
    assert {"store_out", "observations_paused"} <= set(daemon.events())


def test_a_full_disk_is_said_and_waited_for(daemon, devices, small_disk, tmp_path):
    disk = small_disk(40)
    daemon.store = disk / "thermocald.db"
    daemon.configure(**devices(period_s=0.5))
    filled_and_emptied(daemon, disk)


def test_a_full_card_is_said_and_waited_for(daemon, devices, small_card):
    daemon.store = small_card / "thermocald.db"
    daemon.configure(**devices(period_s=0.5))
    filled_and_emptied(daemon, small_card)


def test_what_waits_when_it_is_ended_on_a_full_disk_is_counted(daemon, devices, small_disk):
    disk = small_disk(40)
    daemon.store = disk / "thermocald.db"
    daemon.configure(**devices(period_s=0.5))
    daemon.start()
    daemon.until(lambda: len(daemon.results()) > 3)
    fill(disk)
    daemon.until(lambda: told_of(daemon, "epochs wait"))
    assert daemon.stop() == 1
    taken = daemon.results()[-1]["epoch"]
    empty(disk)
    numbers, _ = daemon.stored()
    assert numbers == list(range(1, len(numbers) + 1))
    lost = daemon.log().count("an epoch is lost: ")
    assert f"error: {lost} epochs were lost" in daemon.log()
    assert lost > 0
    assert len(numbers) + lost >= taken
