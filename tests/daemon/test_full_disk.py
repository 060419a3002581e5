"""A full disk under a running daemon: every interface reports it, the daemon waits, and nothing is
lost once there is room again.
"""

from __future__ import annotations

import re
import resource
from pathlib import Path

import pytest

from tests.commands import call
from tests.marks import mostly_slow
from thermocald.daemon.live_state import LiveState
from thermocald.output.dashboard.view import View


def fill(folder: Path) -> None:
    """Fill the disk of a folder to the last byte."""
    with (folder / "filler").open("ab", buffering=0) as file:
        for size in (1 << 20, 1 << 16, 1 << 12, 512, 1):
            try:
                while file.write(b"\0" * size) == size:
                    pass
            except OSError:
                continue


@pytest.fixture
def disk(daemon, measured, small_disk):
    """A small disk with the store of a configured daemon."""
    folder = small_disk(40)
    daemon.store = folder / "thermocald.db"
    daemon.configure(**measured)
    return folder


def said(daemon) -> tuple[int, str, bool, str]:
    """Return exit status and text of `status`, and the page's answer to a health check."""
    done = call("status", "--store", daemon.store)
    well, why = View(daemon.store, LiveState.beside(daemon.store).folder).healthy()
    return done.returncode, done.stdout + done.stderr, well, why


def epochs_wait(daemon) -> bool:
    status, text, well, why = said(daemon)
    return (
        status == 1 and "epochs wait" in text and not well and why == "the store cannot be written"
    )


def test_it_is_said_and_waited_for(daemon, disk):
    daemon.start()
    daemon.more(2)
    daemon.until(lambda: said(daemon)[0] == 0)
    fill(disk)
    daemon.until(lambda: epochs_wait(daemon))
    waiting = daemon.status()["store"]["waiting"]
    # the status is current, not from before the disk was full
    daemon.until(lambda: daemon.status()["store"]["waiting"] > waiting + 2)
    count = len(daemon.results())
    (disk / "filler").unlink()
    daemon.until(lambda: any(r["stored"] for r in daemon.results()[count:]))
    daemon.until(lambda: said(daemon)[::2] == (0, True))
    assert daemon.stop() == 0
    numbers, _ = daemon.stored()
    assert len(numbers) >= len(daemon.results())
    assert any(not r["stored"] for r in daemon.results())
    assert {"store_out", "observations_paused"} <= set(daemon.events())


def test_it_is_said_at_the_start_and_what_waits_at_the_end_is_counted(daemon, disk):
    fill(disk)
    daemon.start()
    assert daemon.wait() in (1, 3)
    assert "error: " in daemon.log()
    (disk / "filler").unlink()
    daemon.start()
    daemon.more(2)
    daemon.until(lambda: said(daemon)[0] == 0)  # its status needs room, the first time
    fill(disk)
    daemon.until(lambda: epochs_wait(daemon))
    assert daemon.stop() == 1
    taken = daemon.results()[-1]["epoch"]
    (disk / "filler").unlink()
    numbers, _ = daemon.stored()
    (lost,) = map(int, re.findall(r"error: (\d+) epochs? lost", daemon.log()))
    assert daemon.log().count(" lost: epoch ") == 2  # in the log, and by the command at its end
    assert lost > 0
    assert len(numbers) + lost >= taken


@pytest.mark.parametrize("room", mostly_slow([1, 4095, 8193, 30_000], 1))
def test_what_was_reported_kept_is_kept_where_a_little_room_is_left(daemon, measured, room):
    """A write fits in part, as at a quota; then the daemon is killed and started again."""
    daemon.run(**measured)
    daemon.more(2)
    resource.prlimit(daemon.process.pid, resource.RLIMIT_FSIZE, (16384 + room, 16384 + room))
    daemon.until(lambda: daemon.status().get("store", {}).get("waiting", 0) > 2)
    daemon.kill()
    kept = {r["epoch"] for r in daemon.results() if r["stored"]}
    assert kept <= set(daemon.stored()[0])
    count = len(daemon.results())
    daemon.start()
    daemon.until(lambda: any(r["stored"] for r in daemon.results()[count:]))
    assert daemon.stop() == 0
    assert kept <= set(daemon.stored()[0])
