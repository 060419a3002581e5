"""The store's file disappears under a running daemon, or is opened again by another name."""

from __future__ import annotations

import os
import shutil
import sqlite3
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from tests.daemon.conftest import tool
from tests.store.small import create_small_series, small_epoch, small_result
from tests.store.small import stored_numbers as numbers
from thermocald.daemon.store_guard import Row, StoreGuard
from thermocald.errors import StoreError
from thermocald.output.dashboard.view import View
from thermocald.store.database.store import Store


@pytest.fixture
def path(tmp_path):
    folder = tmp_path / "kept"
    folder.mkdir()
    return folder / "t.db"


@pytest.fixture
def guard(path):
    guard = keeping(path)
    yield guard
    guard.close()


def keeping(path, durable=False) -> StoreGuard:
    """Return a guard with epochs 1, 2, 3 and a `keep` that records whether each was stored."""
    guard = StoreGuard(path, durable=durable)
    series = create_small_series(guard.store, start="cold")
    guard.told = {}

    def keep(number: int, time_s: float = 1e9) -> None:
        row = Row(series, small_epoch(number, time_s), small_result(number), {}, True)
        guard.told[number] = guard.append(row)

    guard.keep = keep
    for number in (1, 2, 3):
        keep(number)
    return guard


def delete(path, what: str) -> None:
    """Delete files by a pattern, or with `.` their folder."""
    if what == ".":
        shutil.rmtree(path.parent)
    else:
        for name in list(path.parent.glob(what)):
            name.unlink()


@pytest.mark.parametrize("what", ["t.db", "t.db*", ".", "t.db-wal", "t.db-shm"])
def test_a_deleted_store_is_written_again_with_all_that_it_held(guard, path, what):
    delete(path, what)
    for number in (4, 5):
        guard.keep(number)
    assert numbers(path) == [1, 2, 3, 4, 5]
    assert all(guard.told.values())
    assert "was deleted" in guard.status()["notice"]
    assert [e.kind for e in guard.store.events()] == ["store_followed"]
    assert guard.status()["state"] == "ok"
    assert list(path.parent.glob("*rescued*")) == []


@pytest.mark.parametrize("what", ["t.db-wal", "t.db-shm", "t.db*"])
def test_a_reader_in_the_middle_of_it_costs_nothing(guard, path, what):
    """The -wal file cannot be emptied while it reads, so the store is copied."""
    guard.store._db.execute("PRAGMA busy_timeout = 50")  # otherwise the checkpoint waits for it
    reader = sqlite3.connect(path, isolation_level=None)
    reader.execute("BEGIN")
    assert reader.execute("SELECT count(*) FROM epoch").fetchone() == (3,)
    guard.keep(4)
    delete(path, what)
    guard.keep(5)
    assert numbers(path) == [1, 2, 3, 4, 5]
    reader.close()
    guard.keep(6)
    guard.close()
    assert numbers(path) == [1, 2, 3, 4, 5, 6]
    assert all(guard.told.values())


def test_a_row_that_was_committed_before_its_file_could_be_followed_is_kept_once(
    guard, path, monkeypatch
):
    rescue = Store.copy_to

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Store, "copy_to", full_disk)
    path.unlink()
    guard.keep(4)
    assert (guard.status()["state"], guard.told[4], guard.waiting) == ("out", False, 1)
    monkeypatch.setattr(Store, "copy_to", rescue)
    guard.flush()
    assert (guard.status()["state"], guard.waiting, guard.lost) == ("ok", 0, 0)
    assert numbers(path) == [1, 2, 3, 4]


def test_the_file_is_followed_while_others_read(guard, path):
    """SQLite's library once crashed the process: a connection was closed under a statement."""
    for number in range(4, 100):
        guard.keep(number)
    series, end = guard.store.all_series()[0], time.monotonic() + 0.8
    wrong: list[str] = []

    def read(place) -> None:
        while time.monotonic() < end:
            try:
                list(place().epochs(series, 1, details=False))
            except StoreError as error:
                wrong.extend([str(error)] * ("closed" not in str(error)))

    readers = [
        threading.Thread(target=read, args=[place])
        for place in (lambda: guard, lambda: guard.store)
    ]
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


def test_a_deleted_store_behind_a_link_is_written_again_behind_it(tmp_path):
    (tmp_path / "disk").mkdir()
    link = tmp_path / "t.db"
    link.symlink_to(tmp_path / "disk/real.db")
    guard = StoreGuard(link, durable=False)
    series = create_small_series(guard.store)
    for name in (tmp_path / "disk").iterdir():
        name.unlink()
    guard.append(Row(series, small_epoch(1), None, {}, True))
    guard.close()
    assert link.is_symlink()
    assert numbers(tmp_path / "disk/real.db") == [1]


def test_a_store_that_was_moved_away_stays_whole_and_a_new_one_is_begun(guard, path):
    for name in list(path.parent.glob("t.db*")):
        name.rename(name.with_name(name.name.replace("t.db", "old.db")))
    guard.keep(4)
    assert numbers(path) == [4]
    assert numbers(path.with_name("old.db")) == [1, 2, 3]
    assert "moved away" in guard.status()["notice"]


def test_another_file_in_its_place_is_used_and_the_old_one_is_rescued(guard, path, tmp_path):
    guard.store.copy_to(tmp_path / "copy.db")
    guard.keep(4)
    os.replace(tmp_path / "copy.db", path)
    guard.keep(5)
    assert numbers(path) == [1, 2, 3, 5]
    (rescued,) = path.parent.glob("t-rescued-*.db")
    assert numbers(rescued) == [1, 2, 3, 4]
    assert str(rescued) in guard.status()["notice"]


def test_a_file_that_is_no_store_is_left_alone_and_results_wait(guard, path):
    path.unlink()
    path.write_text("mine, and not a store")
    guard.keep(4)
    guard.keep(5)
    assert path.read_text() == "mine, and not a store"
    assert (guard.status()["state"], guard.waiting, guard.told[4]) == ("out", 2, False)
    path.unlink()
    guard.flush()
    assert guard.status()["state"] == "ok"
    assert numbers(path) == [4, 5]
    (rescued,) = path.parent.glob("t-rescued-*.db")
    assert numbers(rescued) == [1, 2, 3]


def test_a_store_that_cannot_be_made_leaves_nothing_behind(tmp_path):
    database = sqlite3.connect(tmp_path / "foreign.db")
    database.execute("CREATE TABLE x (y)")
    database.close()
    with pytest.raises(StoreError, match="not a thermocald store"):
        StoreGuard(tmp_path / "foreign.db")
    with pytest.raises(StoreError, match="cannot be written"):
        StoreGuard(tmp_path / "away/t.db")
    assert [p.name for p in tmp_path.iterdir()] == ["foreign.db"]


def test_the_running_daemon_says_so_and_loses_nothing(daemon, measured):
    daemon.run(**measured)
    daemon.more(4)
    for name in daemon.folder.glob("thermocald.db*"):
        if name.is_file():
            name.unlink()
    daemon.until(lambda: "was deleted" in daemon.log())
    daemon.more(4)
    daemon.until(lambda: "was deleted" in daemon.status()["store"]["notice"])
    daemon.kill()
    stored = {r["epoch"] for r in daemon.results() if r["stored"]}
    numbers, _ = daemon.stored()
    assert stored <= set(numbers)


@pytest.mark.parametrize(
    "what",
    [{"number": 2**64}, {"frame": Path("a\udcff.png")}, {"frame_time": float("nan")},
     {"number": -5}, {"number": 2, "frame_time": 2e9}, {"temperatures": {"t": object()}}],
    ids=lambda what: next(iter(what)),
)  # fmt: skip
def test_a_row_that_no_store_takes_is_lost_and_holds_up_none(guard, path, what):
    epoch = replace(small_epoch(4), **what)
    assert not guard.append(Row(guard.store.all_series()[0], epoch, None, {}, True))
    assert (guard.waiting, guard.lost) == (0, 1)
    guard.keep(5)
    assert guard.told[5]
    assert numbers(path) == [1, 2, 3, 5]


def test_an_event_that_quotes_the_name_of_a_file_holds_up_no_epoch(guard, path):
    guard.event(1.0, "x", "cannot write a\udcff.png")
    guard.keep(4)
    assert numbers(path) == [1, 2, 3, 4]
    assert [event.text for event in guard.store.events()] == ["cannot write a\\udcff.png"]


@pytest.mark.parametrize("name", ["x" * 249 + ".db", "x" * 300, "loop.db"])
def test_a_name_that_is_none_is_refused_in_one_line(tmp_path, name):
    if name == "loop.db":
        (tmp_path / name).symlink_to(tmp_path / name)
    with pytest.raises(StoreError) as told:
        StoreGuard(tmp_path / name)
    assert len(str(told.value).splitlines()) == 1


@pytest.fixture
def card(tmp_path):
    """A folder on which `card("a")` mounts a card and `card(None)` unmounts it."""
    folder = tmp_path / "card"
    folder.mkdir()

    cards = {}

    def mount(*words: object) -> bool:
        return tool(*words).returncode == 0

    def insert(name: str | None) -> Path:
        if os.path.ismount(folder):
            assert mount("umount", "-l", folder)
        if name and name not in cards:
            cards[name] = tmp_path / name
            cards[name].mkdir()
            if not shutil.which("mount") or not mount("mount", "-t", "tmpfs", "x", cards[name]):
                pytest.skip("nothing can be mounted here: needs root")
        if name:
            assert mount("mount", "--bind", cards[name], folder)
        return folder

    yield insert
    for place in (folder, *cards.values()):
        while os.path.ismount(place) and mount("umount", "-l", place):
            pass


def test_an_unmounted_card_is_waited_for_and_nothing_is_begun_in_its_place(card):
    path = card("a") / "t.db"
    guard = keeping(path)
    card(None)
    for number in (4, 5, 6):
        guard.keep(number)
        assert guard.waiting == number - 3
    status = guard.status()
    assert (status["state"], guard.lost) == ("out", 0)
    assert "no longer mounted" in status["why"]
    assert [guard.told[number] for number in (4, 5, 6)] == [False] * 3
    assert list(path.parent.iterdir()) == []
    card("a")
    guard.keep(7)
    assert (guard.status()["state"], guard.waiting, guard.lost) == ("ok", 0, 0)
    assert "store_out" in [event.kind for event in guard.store.events()]
    guard.close()
    assert numbers(path) == [1, 2, 3, 4, 5, 6, 7]


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
    for name in ("t.db", "t.db-wal", "t.db-shm"):  # in the order of their creation
        assert (path.parent / name).exists()
    card("b")
    for name in ("t.db", "t.db-wal", "t.db-shm"):
        shutil.copy(tmp_path / "a" / name, tmp_path / "b" / name)
    assert (tmp_path / "b/t.db").stat().st_ino == (tmp_path / "a/t.db").stat().st_ino
    guard.keep(4)
    assert (
        "the file at its path" in guard.status()["notice"] or "which is" in guard.status()["notice"]
    )
    guard.close()
    assert numbers(path) == [1, 2, 3, 4]


def test_a_card_that_is_mounted_over_a_running_store_gets_a_copy_of_what_it_held(card):
    path = card(None) / "t.db"
    guard = keeping(path)
    card("a")
    guard.keep(4)
    assert guard.told[4]
    (rescued,) = path.parent.glob("t-rescued-*.db")
    assert numbers(rescued) == [1, 2, 3]
    assert str(rescued) in guard.status()["notice"]
    guard.close()
    assert numbers(path) == [4]


def test_what_waits_for_a_card_that_does_not_come_back_is_reported_as_lost(card):
    path = card("a") / "t.db"
    guard = keeping(path)
    card(None)
    guard.keep(4)
    guard.close()
    assert guard.lost == 1
    assert list(path.parent.iterdir()) == []
    card("a")
    assert set(numbers(path)) >= {1, 2, 3}


@pytest.mark.slow
def test_a_running_daemon_whose_card_is_unmounted_and_mounted_again(card, daemon, devices):
    folder = card("a")
    daemon.store = folder / "thermocald.db"
    frames = {"keep": "all", "folder": str(folder / "frames"), "min_free_gb": 0.0}
    sections = devices()
    shell = ["/bin/sh", "-c", f'echo "$THERMOCALD_STATE" >> {daemon.folder}/told']
    told = {"name": "tell", "driver": "alert_exec", "when": [{"lost": 2}], "command": shell}
    sections["outputs"].append(told)
    daemon.run(**sections, frames=frames)
    daemon.more(4)
    card(None)
    daemon.until(lambda: "no longer mounted" in daemon.log())
    daemon.until(lambda: not daemon.results()[-1]["stored"])
    daemon.until(lambda: daemon.status().get("store", {}).get("state") == "out")
    assert {p.name for p in folder.iterdir()} == {"thermocald.db.live"}
    assert View(daemon.store, folder / "thermocald.db.live").healthy() == (
        False,
        "the store cannot be written",
    )
    daemon.until((daemon.folder / "told").exists)
    card("a")
    daemon.until(lambda: daemon.results()[-1]["stored"])
    daemon.until(lambda: (daemon.folder / "told").read_text() == "out\nin\n")
    assert daemon.stop() == 0
    found, _ = daemon.stored()
    assert found == [r["epoch"] for r in daemon.results()]
    kept = {int(p.stem) for p in (folder / "frames").rglob("*.png")}
    assert kept <= set(found)
