"""Full disks and locks of other programs lose nothing that was stored, and rows wait for them."""

from __future__ import annotations

import resource
import signal
import sqlite3
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.store.small import stored_numbers, write_recording
from thermocald.daemon.store_guard import Row, StoreGuard
from thermocald.errors import RecordingError, StoreBusyError, StoreError, StoreFullError
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.store.database import file
from thermocald.store.database.store import Store


@pytest.fixture
def guard(tmp_path, head, field, make_epoch, make_result):
    """A guard of a store with one series, with a `keep` of its epochs."""
    guard = StoreGuard(tmp_path / "t.db", durable=False)
    series = guard.store.create_series(head, field)
    guard.keep = lambda n: guard.append(Row(series, make_epoch(n), make_result(n), {}, True))
    yield guard
    guard.close()


def flushed(guard) -> list[int]:
    """Return the numbers of the stored epochs when nothing waits."""
    guard.flush()
    assert (guard.away, guard.lost, guard.waiting) == ("", 0, 0)
    return stored_numbers(guard.path)


@pytest.fixture
def busy(guard, monkeypatch):
    """A store that refuses rows; with `busy(append)` it takes them."""
    append = guard.store.append

    def refuse(*_, **__):
        raise StoreBusyError("locked")

    monkeypatch.setattr(guard.store, "append", refuse)
    return lambda new: monkeypatch.setattr(guard.store, "append", new(append))


def test_a_row_that_found_no_room_waits(guard):
    """Regression: an event still fitted into its page, so the row was taken for a bad one."""
    guard.keep(1)
    connection, number = guard.store._db, 1
    (pages,) = connection.execute("PRAGMA page_count").fetchone()
    connection.execute(f"PRAGMA max_page_count = {pages}")
    while not guard.waiting and number < 1000:  # until the last page is full
        number += 1
        guard.keep(number)
    guard.keep(number + 1)
    assert "disk is full" in guard.away
    assert (guard.lost, guard.waiting) == (0, 2)
    connection.execute("PRAGMA max_page_count = 1000000")
    assert flushed(guard) == [*range(1, number + 2)]


@pytest.fixture
def other(guard):
    """Another program's connection that keeps the store locked."""
    other = sqlite3.connect(guard.path, isolation_level=None, check_same_thread=False)
    other.execute("BEGIN IMMEDIATE")
    yield other
    other.close()


def test_a_lock_of_another_program_is_waited_for_and_loses_nothing(guard, other, monkeypatch):
    """A row was lost if the lock ended at the wrong time, and the watchdog starved for a minute."""
    write_event = guard.store.add_event
    monkeypatch.setattr(guard.store, "add_event", lambda e: (other.close(), write_event(e)))
    attempts, append = [], guard.store.append
    monkeypatch.setattr(
        guard.store, "append", lambda *a, **k: (attempts.append(a), append(*a, **k))
    )
    for number in range(1, 11):  # epochs come faster than attempts may be made
        guard.keep(number)
    assert len(attempts) < 5
    assert "another program keeps it locked" in guard.away
    assert (guard.waiting, guard.lost) == (10, 0)
    other.close()
    assert flushed(guard) == [*range(1, 11)]


def test_at_the_end_a_lock_is_waited_for(guard, other):
    guard.keep(1)
    threading.Timer(0.6, other.close).start()
    guard.close()
    assert guard.lost == 0
    assert stored_numbers(guard.path) == [1]


def test_numbers_go_on_after_the_rows_that_wait(guard, busy, make_epoch, head):
    """A reload or a session began anew at the last stored number, and lost all that followed."""
    (series,) = guard.store.all_series()
    guard.keep(2)
    guard.keep(3)
    other = replace(series, id=0, head=replace(head, series="new"))
    guard.append(Row(other, make_epoch(2), None, {}, True))
    assert (guard.last_epoch(series), guard.last_epoch(series, waiting=False)) == (3, 0)
    assert guard.find(other.camera, "new") == other
    assert guard.find(other.camera, "none") is None
    assert guard.last_epoch(other) == 2
    busy(lambda append: append)
    guard.flush()
    assert (guard.lost, guard.waiting) == (0, 0)
    assert [s.name for s in guard.store.all_series()] == [series.name, "new"]


def test_a_long_backlog_is_written_in_parts_so_that_the_watchdog_is_fed(guard, busy):
    for number in range(1, 11):
        guard.keep(number)
    busy(lambda append: lambda *a, **k: (time.sleep(0.05), append(*a, **k)))
    guard.flush(0.12)
    assert 5 <= guard.waiting <= 9
    assert flushed(guard) == [*range(1, 11)]


def test_losses_are_counted_each_and_reported_once_a_minute(guard, caplog):
    for number in range(200):
        guard.lose(f"epoch {number}: too slow")
    assert guard.lost == 200
    assert caplog.text.count("lost: epoch") == 1
    assert len([e for e in guard.store.events() if e.kind == "epoch_lost"]) <= 1


@pytest.fixture
def small_disk():
    """Limit files to 400 kB, which acts on one process like a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


def test_a_full_disk(store, series, make_epoch, make_result, small_disk):
    def append(number):
        store.append(series, make_epoch(number), make_result(number))

    with pytest.raises(StoreFullError, match="was not stored: the disk") as caught:
        list(map(append, range(1, 10_000)))
    last = store.last_epoch(series)
    assert last > 10
    assert f"epoch {last + 1} " in str(caught.value)
    with pytest.raises(StoreError, match="disk"):
        append(last + 1)
    assert store.last_epoch(series) == last


def test_a_store_without_room_for_its_first_series_is_removed(store, head, field):
    store._db.execute("PRAGMA max_page_count = 1")
    with pytest.raises(StoreFullError, match="series 'M1' was not begun: the disk is full"):
        store.create_series(head, TestField.build([str(i) for i in range(999)], np.ones((999, 3))))
    assert not store.path.exists()


@pytest.mark.parametrize("free", [1_000_000, 4_000])
def test_the_wal_file_takes_a_quarter_of_a_small_disk(
    store_path, head, field, make_epoch, make_result, monkeypatch, free
):
    """It filled a disk of 4 MB with 115 epochs, of which 800 find room."""
    monkeypatch.setattr(file.shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    with Store.open(store_path, "append", durable=False) as store:
        series = store.create_series(head, field)
        for number in range(1, 50):
            store.append(series, make_epoch(number), make_result(number))
            assert file.helper(store_path, "wal").stat().st_size < 350_000


def test_a_recording_on_a_full_disk_leaves_nothing(tmp_path, head, field, make_epoch, small_disk):
    with pytest.raises(RecordingError, match="cannot be written"):
        write_recording(tmp_path / "r", head, field, map(make_epoch, range(10_000)))
    assert list(tmp_path.iterdir()) == []
