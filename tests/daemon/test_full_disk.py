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
from thermocald.output.dashboard.view import View


def fill(folder: Path) -> Path:
    """Fill the disk of a folder to the last byte; return the file that does so."""
    with (folder / "filler").open("ab", buffering=0) as file:
        for size in (1 << 20, 1 << 16, 1 << 12, 512, 1):
            try:
                while file.write(b"\0" * size) == size:
                    pass
            except OSError:
                continue
    return folder / "filler"


def told(daemon) -> str:
    """Return what the exit status of `status`, its text and the page agree on."""
    done = call("status", "--store", daemon.store)
    answer = done.returncode, View(daemon.store, daemon.live).healthy()
    waits = "epochs wait" in done.stdout + done.stderr
    words = {(0, (True, "")): "well", (1, (False, "the store cannot be written")): "out"}
    return words.get(answer, "") if waits == (done.returncode == 1) else ""


def test_it_is_said_and_waited_for_and_what_waits_at_the_end_is_counted(
    daemon, measured, small_disk
):
    disk = small_disk(40)
    daemon.store = disk / "thermocald.db"
    daemon.configure(**measured)
    filler = fill(disk)
    daemon.start()
    assert daemon.wait() in (1, 3)
    assert "error: " in daemon.log()
    filler.unlink()
    daemon.start()
    daemon.more(2)
    daemon.until(lambda: told(daemon) == "well")  # its status needs room, the first time
    fill(disk)
    daemon.until(lambda: told(daemon) == "out")
    waiting = daemon.status()["store"]["waiting"]
    # the status is current, not from before the disk was full
    daemon.until(lambda: daemon.status()["store"]["waiting"] > waiting + 2)
    had = len(daemon.results())
    filler.unlink()
    daemon.until(lambda: any(r["stored"] for r in daemon.results()[had:]))
    daemon.until(lambda: told(daemon) == "well")
    had = len(daemon.results())
    assert set(range(1, had + 1)) <= set(daemon.stored()[0])
    assert any(not r["stored"] for r in daemon.results())
    fill(disk)
    daemon.until(lambda: told(daemon) == "out")
    assert daemon.stop() == 1
    filler.unlink()
    (lost,) = map(int, re.findall(r"error: (\d+) epochs? lost", daemon.log()))
    assert daemon.log().count(" lost: epoch ") == 2  # in the log, and by the command at its end
    assert lost > 0
    assert len(daemon.stored()[0]) + lost >= daemon.results()[-1]["epoch"]
    assert {"store_out", "observations_paused"} <= set(daemon.events())


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
    had = len(daemon.results())
    daemon.start()
    daemon.until(lambda: any(r["stored"] for r in daemon.results()[had:]))
    assert daemon.stop() == 0
    assert kept <= set(daemon.stored()[0])
