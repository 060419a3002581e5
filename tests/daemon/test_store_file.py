"""The store's file disappears under a running daemon, or is opened again by another name."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.store.small import create_small_series, small_epoch, small_result
from tests.store.small import stored_numbers as numbers
from thermocald.acquisition.frame_folder import FrameFolder
from thermocald.config import FramesConfig
from thermocald.daemon.store_guard import Row, StoreGuard
from thermocald.errors import StoreError
from thermocald.hal import Frame
from thermocald.store.database.store import Store


@pytest.fixture
def path(tmp_path):
    folder = tmp_path / "kept"
    folder.mkdir()
    return folder / "t.db"


def keeping(path, durable=False) -> StoreGuard:
    """Return a guard with epochs 1, 2, 3 and a `keep` that records whether each was stored."""
    guard = StoreGuard(path, durable=durable)
    series = create_small_series(guard.store, start="cold")
    guard.told = {}

    def keep(*many: int) -> None:
        for number in many:
            row = Row(series, small_epoch(number), small_result(number), {}, True)
            guard.told[number] = guard.append(row)

    guard.keep = keep
    keep(1, 2, 3)
    return guard


@pytest.fixture
def guard(path):
    guard = keeping(path)
    yield guard
    guard.close()


def state(guard) -> tuple[str, int, int]:
    """Return the state, and how many epochs wait and are lost."""
    return guard.status()["state"], guard.waiting, guard.lost


def delete(path, what: str) -> None:
    """Delete files by a pattern, or with `.` their folder."""
    if what == ".":
        shutil.rmtree(path.parent)
    else:
        for name in list(path.parent.glob(what)):
            name.unlink()


@pytest.mark.parametrize("beside", ["", "link", "reader"])
@pytest.mark.parametrize("what", ["t.db", "t.db*", ".", "t.db-wal", "t.db-shm"])
def test_a_deleted_store_is_written_again_with_all_that_it_held(path, tmp_path, what, beside):
    """Behind a link, it is written again where the link leads. While another program reads it,
    the -wal file cannot be emptied, so the store is copied.
    """
    name = path
    if beside == "link":
        name = tmp_path / "link.db"
        name.symlink_to(path)
    guard = keeping(name)
    guard.store._db.execute("PRAGMA busy_timeout = 50")  # otherwise the checkpoint waits longer
    reader = sqlite3.connect(path, isolation_level=None)
    if beside == "reader":
        reader.execute("BEGIN")
        assert reader.execute("SELECT count(*) FROM epoch").fetchone() == (3,)
    delete(path, what)
    guard.keep(4, 5)
    assert numbers(path) == [1, 2, 3, 4, 5]
    assert "was deleted" in guard.status()["notice"]
    assert [e.kind for e in guard.store.events()] == ["store_followed"]
    assert list(path.parent.glob("*rescued*")) == []
    reader.close()
    guard.keep(6)
    guard.close()
    assert numbers(path) == [1, 2, 3, 4, 5, 6]
    assert all(guard.told.values())
    assert state(guard) == ("ok", 0, 0)


def test_a_row_that_was_committed_before_its_file_could_be_followed_is_kept_once(
    guard, path, monkeypatch
):
    def full_disk(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(Store, "copy_to", full_disk)
        path.unlink()
        guard.keep(4)
        assert (state(guard), guard.told[4]) == (("out", 1, 0), False)
    guard.flush()
    assert state(guard) == ("ok", 0, 0)
    assert numbers(path) == [1, 2, 3, 4]


def test_the_file_is_followed_while_others_read(guard, path):
    """SQLite's library once crashed the process: a connection was closed under a statement."""
    guard.keep(*range(4, 100))
    series, end = guard.store.all_series()[0], time.monotonic() + 0.8
    wrong: list[str] = []

    def read(place) -> None:
        while time.monotonic() < end:
            try:
                list(place().epochs(series, 1, details=False))
            except StoreError as error:
                wrong.extend([str(error)] * ("closed" not in str(error)))

    places = (lambda: guard, lambda: guard.store)
    readers = [threading.Thread(target=read, args=[place]) for place in places]
    for reader in readers:
        reader.start()
    while time.monotonic() < end:
        time.sleep(0.003)
        path.with_name("t.db-wal").unlink()
        guard.flush()
    for reader in readers:
        reader.join()
    assert "was deleted" in guard.status()["notice"]
    assert wrong == []
    assert numbers(path) == list(range(1, 100))


def test_a_store_that_was_moved_away_stays_whole_and_a_new_one_is_begun(guard, path):
    for name in list(path.parent.glob("t.db*")):
        name.rename(name.with_name(name.name.replace("t.db", "old.db")))
    guard.keep(4)
    assert numbers(path) == [4]
    assert numbers(path.with_name("old.db")) == [1, 2, 3]
    assert "moved away" in guard.status()["notice"]


def rescued(guard, path) -> list[int]:
    """Return the epochs of the copy that the notice tells of."""
    (copy,) = path.parent.glob("t-rescued-*.db")
    assert str(copy) in guard.status()["notice"]
    return numbers(copy)


def test_another_file_in_its_place_is_used_and_the_old_one_is_rescued(guard, path, tmp_path):
    guard.store.copy_to(tmp_path / "copy.db")
    guard.keep(4)
    os.replace(tmp_path / "copy.db", path)
    guard.keep(5)
    assert numbers(path) == [1, 2, 3, 5]
    assert rescued(guard, path) == [1, 2, 3, 4]


def test_a_file_that_is_no_store_is_left_alone_and_results_wait(guard, path):
    path.unlink()
    path.write_text("mine, and not a store")
    guard.keep(4, 5)
    guard.event(1.0, "seen", "an event waits, too")
    assert path.read_text() == "mine, and not a store"
    assert (state(guard), guard.told[4]) == (("out", 2, 0), False)
    path.unlink()
    guard.flush()
    assert guard.status()["state"] == "ok"
    assert numbers(path) == [4, 5]
    assert "seen" in [event.kind for event in guard.store.events()]
    (copy,) = path.parent.glob("t-rescued-*.db")
    assert numbers(copy) == [1, 2, 3]


@pytest.mark.parametrize(
    ("name", "why"),
    [("foreign.db", "not a thermocald store"), ("away/t.db", "cannot be written"),
     ("loop.db", "loop"), ("x" * 249 + ".db", "cannot be opened"), ("x" * 300, "too long")],
)  # fmt: skip
def test_what_can_be_no_store_is_refused_in_one_line_and_nothing_is_left(tmp_path, name, why):
    (tmp_path / "loop.db").symlink_to(tmp_path / "loop.db")
    with sqlite3.connect(tmp_path / "foreign.db") as database:
        database.execute("CREATE TABLE x (y)")
    database.close()
    with pytest.raises(StoreError, match=why) as told:
        StoreGuard(tmp_path / name)
    assert len(str(told.value).splitlines()) == 1
    assert {p.name for p in tmp_path.iterdir()} == {"foreign.db", "loop.db"}


@pytest.mark.parametrize(
    "what",
    [{"number": 2**64}, {"frame": Path("a\udcff.png")}, {"frame_time": float("nan")},
     {"number": -5}, {"number": 2, "frame_time": 2e9}, {"temperatures": {"t": object()}}],
    ids=lambda what: next(iter(what)),
)  # fmt: skip
def test_a_row_that_no_store_takes_is_lost_and_holds_up_none(guard, path, what):
    """Of one that the file refuses, see test_lost."""
    epoch = replace(small_epoch(4), **what)
    assert not guard.append(Row(guard.store.all_series()[0], epoch, None, {}, True))
    assert state(guard) == ("ok", 0, 1)
    assert [e.kind for e in guard.store.events()].count("epoch_lost") == 1
    guard.keep(5)
    assert guard.told[5]
    assert numbers(path) == [1, 2, 3, 5]


def test_a_disk_that_is_nearly_full_gets_results_alone(guard, monkeypatch):
    disk, states = SimpleNamespace(free=0), []
    monkeypatch.setattr("thermocald.daemon.store_guard.shutil.disk_usage", lambda _: disk)
    for number, disk.free in enumerate((17e6, 15e6, 17e6, 21e6), 4):
        guard.keep(number)
        states.append(guard.status()["state"])
    assert states == ["ok", "results_only", "results_only", "ok"]


def test_an_event_that_quotes_the_name_of_a_file_holds_up_no_epoch(guard, path):
    guard.event(1.0, "x", "cannot write a\udcff.png")
    guard.keep(4)
    assert numbers(path) == [1, 2, 3, 4]
    assert [event.text for event in guard.store.events()] == ["cannot write a\\udcff.png"]


@pytest.fixture
def card(tmp_path, mount):
    """A folder on which `card("a")` mounts a card and `card(None)` unmounts it."""
    folder = tmp_path / "card"
    folder.mkdir()

    def insert(name: str | None) -> Path:
        if os.path.ismount(folder):
            subprocess.run(["umount", "-l", folder], check=True)
        if name and not (tmp_path / name).exists():
            (tmp_path / name).mkdir()
            mount("-t", "tmpfs", "x", tmp_path / name)
        if name:
            mount("--bind", tmp_path / name, folder)
        return folder

    return insert


@pytest.mark.parametrize("back", [True, False])
def test_an_unmounted_card_is_waited_for_and_nothing_is_begun_in_its_place(card, back):
    """What still waits for it at the end is lost."""
    path = card("a") / "t.db"
    guard = keeping(path)
    card(None)
    for number in (4, 5, 6):
        guard.keep(number)
        assert guard.waiting == number - 3
    assert state(guard) == ("out", 3, 0)
    assert "no longer mounted" in guard.status()["why"]
    assert [guard.told[number] for number in (4, 5, 6)] == [False] * 3
    assert list(path.parent.iterdir()) == []
    if back:
        card("a")
        guard.keep(7)
        assert state(guard) == ("ok", 0, 0)
        assert "store_out" in [event.kind for event in guard.store.events()]
    guard.close()
    assert guard.lost == (0 if back else 3)
    card("a")
    assert numbers(path)[:3] == [1, 2, 3]
    assert not back or numbers(path) == [1, 2, 3, 4, 5, 6, 7]


@pytest.mark.parametrize("folder", ["", "deep/er"])
def test_another_card_gets_what_waited(card, folder):
    place = card("a") / folder
    place.mkdir(parents=True, exist_ok=True)
    path = place / "t.db"
    guard = keeping(path)
    card(None)
    guard.keep(4)
    card("b")
    guard.keep(5)
    assert guard.waiting == guard.lost == 0
    assert "on another disk than is mounted there now; a new store" in guard.status()["notice"]
    guard.close()
    assert numbers(path) == [4, 5]
    card("a")
    assert numbers(path) == [1, 2, 3, 4]  # where 4 was tried, but not reported as stored


def test_a_card_that_was_plugged_in_again_keeps_what_its_wal_file_holds(card, tmp_path):
    """The same files with the same inode numbers, on a disk with another number."""
    path = card("a") / "t.db"
    guard = keeping(path, durable=True)
    card("b")
    for name in ("t.db", "t.db-wal", "t.db-shm"):  # in the order of their creation
        shutil.copy(tmp_path / "a" / name, tmp_path / "b" / name)
    assert (tmp_path / "b/t.db").stat().st_ino == (tmp_path / "a/t.db").stat().st_ino
    guard.keep(4)
    assert "now; the file at its path is used now" in guard.status()["notice"]
    guard.close()
    assert numbers(path) == [1, 2, 3, 4]


def test_a_card_that_is_mounted_over_a_running_store_gets_a_copy_of_what_it_held(card):
    path = card(None) / "t.db"
    guard = keeping(path)
    card("a")
    guard.keep(4)
    assert guard.told[4]
    assert rescued(guard, path) == [1, 2, 3]
    guard.close()
    assert numbers(path) == [4]


def test_frames_are_not_written_where_their_card_was(card):
    frames = FrameFolder(FramesConfig(folder=card("a") / "frames", min_free_gb=0))
    kept = []
    for number, inserted in enumerate(("a", None, "a")):
        card(inserted)
        kept.append(frames.keep("cam", "M1", number, Frame(None, 0.0, 0.0, encoded=b"\xff\xd8")))
        assert ("is not mounted any more" in frames.paused) == (inserted is None)
    assert [one is None for one in kept] == [False, True, False]
