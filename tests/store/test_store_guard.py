"""The guard of a store whose disk has space for an event but not for a row."""

from __future__ import annotations

import sqlite3
import threading
import time
from dataclasses import replace

import pytest

from thermocald.daemon.store_guard import Row, StoreGuard
from thermocald.errors import StoreBusyError
from thermocald.store.database.store import Store


@pytest.fixture
def guard(tmp_path, head, field):
    guard = StoreGuard(tmp_path / "t.db", durable=False)
    guard.store.create_series(head, field)
    yield guard
    guard.close()


@pytest.fixture
def keep(guard, make_epoch, make_result):
    (series,) = guard.store.all_series()
    return lambda n: guard.append(Row(series, make_epoch(n), make_result(n), {}, True))


def numbers(guard):
    (series,) = guard.store.all_series()
    return [stored.epoch.number for stored in guard.store.epochs(series)]


def test_a_row_that_found_no_room_waits(guard, keep):
    """Regression: an event still fitted into its page, so the row was taken for a bad one."""
    keep(1)
    connection = guard.store._db
    (pages,) = connection.execute("PRAGMA page_count").fetchone()
    connection.execute(f"PRAGMA max_page_count = {pages}")
    number = 1
    while not guard.waiting and number < 1000:  # until the last page is full
        number += 1
        keep(number)
    keep(number + 1)
    assert "disk is full" in guard.away
    assert (guard.lost, guard.waiting) == (0, 2)
    connection.execute("PRAGMA max_page_count = 1000000")
    guard.flush()
    assert (guard.away, guard.lost, guard.waiting) == ("", 0, 0)
    assert numbers(guard) == [*range(1, number + 2)]


def test_a_lock_of_another_program_is_waited_for_and_loses_nothing(guard, keep, monkeypatch):
    """A row was lost if the lock ended at the wrong time, and the watchdog starved for a minute."""
    other = sqlite3.connect(guard.path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    write_event = guard.store.add_event

    def end_lock(event):
        other.close()
        write_event(event)

    monkeypatch.setattr(guard.store, "add_event", end_lock)
    begin = time.monotonic()
    for number in range(1, 11):  # epochs come faster than attempts may be made
        keep(number)
    assert time.monotonic() - begin < 5.0
    assert "another program keeps it locked" in guard.away
    assert (guard.waiting, guard.lost) == (10, 0)
    other.close()
    guard.flush()
    assert (guard.away, guard.lost, guard.waiting) == ("", 0, 0)
    assert numbers(guard) == [*range(1, 11)]


def test_at_the_end_a_lock_is_waited_for(guard, keep):
    other = sqlite3.connect(guard.path, isolation_level=None, check_same_thread=False)
    other.execute("BEGIN IMMEDIATE")
    keep(1)
    threading.Timer(0.6, other.close).start()
    guard.close()
    assert guard.lost == 0
    with Store.open(guard.path) as store:
        assert store.last_epoch(store.find_series()) == 1


def test_numbers_go_on_after_the_rows_that_wait(guard, keep, monkeypatch, head, field):
    """A reload or a session began anew at the last stored number, and lost all that followed."""
    (series,) = guard.store.all_series()
    append = guard.store.append
    keep(1)
    monkeypatch.setattr(guard.store, "append", lambda *_, **__: refuse())
    keep(2)
    keep(3)
    other = replace(series, id=0, head=replace(head, series="new"))
    guard.append(Row(other, guard._waiting[0].epoch, None, {}, True))
    assert (guard.last_epoch(series), guard.last_epoch(series, waiting=False)) == (3, 1)
    assert guard.find(other.camera, "new") == other
    assert guard.find(other.camera, "none") is None
    assert guard.last_epoch(other) == 2
    monkeypatch.setattr(guard.store, "append", append)
    guard.flush()
    assert (guard.lost, guard.waiting) == (0, 0)
    assert [s.name for s in guard.store.all_series()] == [series.name, "new"]


def test_a_long_backlog_is_written_in_parts_so_that_the_watchdog_is_fed(guard, keep, monkeypatch):
    append = guard.store.append
    monkeypatch.setattr(guard.store, "append", lambda *_, **__: refuse())
    for number in range(1, 11):
        keep(number)
    monkeypatch.setattr(guard.store, "append", lambda *a, **k: (time.sleep(0.05), append(*a, **k)))
    guard.flush(0.12)
    assert 5 <= guard.waiting <= 9
    guard.flush()
    assert numbers(guard) == [*range(1, 11)]


def refuse():
    raise StoreBusyError("locked")


def test_losses_are_counted_each_and_reported_once_a_minute(guard, caplog):
    for number in range(200):
        guard.lose(f"epoch {number}: too slow")
    assert guard.lost == 200
    assert caplog.text.count("lost: epoch") == 1
    assert len([e for e in guard.store.events() if e.kind == "epoch_lost"]) <= 1
