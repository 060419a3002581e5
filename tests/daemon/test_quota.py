"""A full disk or an exhausted quota under a running daemon: every interface reports it, the daemon
waits, and nothing is lost once there is room again.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import pytest

from tests.commands import call
from tests.marks import mostly_slow
from thermocald.daemon.live_state import LiveState
from thermocald.output.dashboard.view import View


class Disk:
    """A disk that can be filled to the last byte."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.environment = folder, {}

    def fill(self) -> None:
        with (self.folder / "filler").open("ab", buffering=0) as file:
            for size in (1 << 20, 1 << 16, 1 << 12, 512, 1):
                try:
                    while file.write(b"\0" * size) == size:
                        pass
                except OSError:
                    continue

    def empty(self) -> None:
        (self.folder / "filler").unlink()


class Quota:
    """A quota of the daemon's files in a folder, in place of the kernel's.

    late: the flush fails, too, as with delayed allocation of blocks.
    """

    def __init__(self, folder: Path, late: bool = False) -> None:
        self.folder = folder
        self._file = folder.with_name("quota")
        self.environment = {"QUOTA_OF": str(folder), "QUOTA_FILE": str(self._file)}
        self.environment |= {"QUOTA_LATE": "1"} if late else {}

    def fill(self, room: int = 0) -> None:
        used = sum(path.stat().st_size for path in self.folder.rglob("*") if path.is_file())
        self._file.with_name("new").write_text(str(used + room))
        self._file.with_name("new").replace(self._file)

    def empty(self) -> None:
        self._file.unlink()


@pytest.fixture
def quota(tmp_path):
    (tmp_path / "home").mkdir()
    return Quota(tmp_path / "home")


@pytest.fixture
def place(request, daemon, measured, tmp_path):
    """A place of either kind with the store of a configured daemon."""
    match request.param:
        case "disk":
            place = Disk(request.getfixturevalue("small_disk")(40))
        case "card":
            _, folder = request.getfixturevalue("loop_disk")(40, "-m", "0")
            place = Disk(folder)
        case kind:
            daemon.forker = request.getfixturevalue("preloaded")
            place = request.getfixturevalue("quota")
            if kind == "late quota":
                place = Quota(place.folder, late=True)
    daemon.store = place.folder / "thermocald.db"
    daemon.configure(**measured)
    return place


in_each = partial(pytest.mark.parametrize, "place", indirect=True)


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


@in_each(argvalues=mostly_slow(["disk", "card", "quota", "late quota"], "disk"))
def test_a_full_place_is_said_and_waited_for(daemon, place):
    daemon.start(**place.environment)
    daemon.more(4)
    daemon.until(lambda: said(daemon)[0] == 0)
    place.fill()
    daemon.until(lambda: epochs_wait(daemon))
    waiting = daemon.status()["store"]["waiting"]
    # the status is current, not from before the disk was full
    daemon.until(lambda: daemon.status()["store"]["waiting"] > waiting + 2)
    count = len(daemon.results())
    place.empty()
    daemon.until(lambda: any(r["stored"] for r in daemon.results()[count:]))
    daemon.until(lambda: said(daemon)[::2] == (0, True))
    assert daemon.stop() == 0
    numbers, _ = daemon.stored()
    assert len(numbers) >= len(daemon.results())
    assert any(not r["stored"] for r in daemon.results())
    assert "store_out" in daemon.events()
    assert isinstance(place, Quota) or "observations_paused" in daemon.events()


@in_each(argvalues=mostly_slow(["disk", "quota"], "disk"))
def test_what_waits_when_it_is_ended_there_is_counted(daemon, place):
    daemon.start(**place.environment)
    daemon.more(4)
    place.fill()
    daemon.until(lambda: epochs_wait(daemon))
    assert daemon.stop() == 1
    taken = daemon.results()[-1]["epoch"]
    place.empty()
    numbers, _ = daemon.stored()
    (lost,) = map(int, re.findall(r"error: (\d+) epochs? lost", daemon.log()))
    assert daemon.log().count(" lost: epoch ") == 2  # in the log, and by the command at its end
    assert lost > 0
    assert len(numbers) + lost >= taken


@in_each(argvalues=["quota"])
def test_an_output_under_a_quota_goes_on_with_whole_lines_and_what_waited(daemon, measured, place):
    two = {"name": "two", "driver": "jsonl", "path": str(place.folder / "two.jsonl")}
    measured["outputs"].append(two)
    daemon.configure(**measured)
    daemon.start(**place.environment)
    daemon.until(lambda: len(daemon.results("home/two.jsonl")) > 3)
    place.fill(100)  # less than a line
    daemon.until(lambda: sum(not r["stored"] for r in daemon.results()) > 5)
    place.empty()
    daemon.until(lambda: daemon.results("home/two.jsonl")[-1]["stored"])
    assert daemon.stop() == 0
    told = [r["epoch"] for r in daemon.results("home/two.jsonl")]
    assert told == list(range(1, len(told) + 1))


@in_each(argvalues=["quota"])
@pytest.mark.parametrize("room", mostly_slow([1, 4095, 8193, 30_000], 1))
def test_what_was_reported_kept_is_kept_where_a_quota_leaves_a_little(daemon, place, room):
    """A write fits in part; then the daemon is killed, the quota lifted, the daemon restarted."""
    daemon.start(**place.environment)
    daemon.more(4)
    place.fill(room)
    daemon.until(lambda: sum(not r["stored"] for r in daemon.results()) > 2)
    daemon.kill()
    kept = {r["epoch"] for r in daemon.results() if r["stored"]}
    assert kept <= set(daemon.stored()[0])
    place.empty()
    count = len(daemon.results())
    daemon.start(**place.environment)
    daemon.until(lambda: any(r["stored"] for r in daemon.results()[count:]))
    assert daemon.stop() == 0
    assert kept <= set(daemon.stored()[0])


@in_each(argvalues=["quota"])
def test_where_a_quota_is_reached_before_it_begins_it_says_so(daemon, place):
    place.fill()
    daemon.start(**place.environment)
    assert daemon.wait() in (1, 3)
    assert "error: " in daemon.log()
    place.empty()
    daemon.start(**place.environment)
    daemon.more(3)
    assert daemon.stop() == 0
