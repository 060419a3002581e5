"""A damaged -wal file is reported as damaged; one cut off by a crash is not."""

from __future__ import annotations

import itertools
import threading

import numpy as np
import pytest

from thermocald.cli import application
from thermocald.daemon.store_guard import StoreGuard
from thermocald.store.database.file import read_wal_tail
from thermocald.store.database.store import Store

SOUND = (0, False)  # lost transactions, unfinished


@pytest.fixture
def crashed(killed):
    """Store and -wal file of a writer that was killed after nine epochs."""
    return killed(0, 9)


def epochs(path) -> list[int]:
    with Store.open(path) as store:
        return [s.epoch.number for s in store.epochs(store.find_series())]


def test_what_a_crash_cut_off_is_no_damage(crashed):
    wal = crashed.with_name(f"{crashed.name}-wal")
    whole = wal.read_bytes()
    assert read_wal_tail(wal) == SOUND
    for size in (0, 20, 32, 33, len(whole) // 2, len(whole) - 1):
        wal.write_bytes(whole[:size])
        assert read_wal_tail(wal) == (0, size > 32)


def test_every_flip_that_loses_epochs_is_reported(crashed):
    wal = crashed.with_name(f"{crashed.name}-wal")
    whole, database = wal.read_bytes(), crashed.read_bytes()
    rng = np.random.default_rng(3)
    for _ in range(15):
        data = bytearray(whole)
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        crashed.write_bytes(database)
        wal.write_bytes(data)
        crashed.with_name(f"{crashed.name}-shm").unlink(missing_ok=True)
        lost, unfinished = read_wal_tail(wal)
        kept = epochs(crashed)
        assert (kept == list(range(1, 10))) == ((lost, unfinished) == SOUND)
        assert not unfinished or kept == list(range(1, 9))


def frames(wal) -> tuple[bytearray, int]:
    """(the file's bytes, the length of a frame)."""
    data = bytearray(wal.read_bytes())
    return data, 24 + int.from_bytes(data[8:12], "big")


def test_a_write_that_a_kill_cut_off_is_no_damage(crashed, capsys):
    """In a -wal file that was restarted, the rest of the frame is from before."""
    wal = crashed.with_name(f"{crashed.name}-wal")
    data, step = frames(wal)
    data[-step // 2 :] = bytes(step // 2)
    wal.write_bytes(data)
    assert read_wal_tail(wal) == (0, True)
    with Store.open(crashed) as store:
        found = store.examine()
        assert store.examine().damaged == ()
    assert (found.damaged, found.unfinished) == ((), True)
    application()(["check", str(crashed)], standalone_mode=False)
    assert "the last write was cut off" in capsys.readouterr().out
    guard = StoreGuard(crashed)
    guard.flush()
    assert guard.status()["notice"] == ""
    assert [e.kind for e in guard.store.events()] == ["wal_unfinished"]
    guard.close()
    assert epochs(crashed) == list(range(1, 9))


def test_what_the_index_counts_was_committed(store, series, store_path, make_epoch):
    """The -shm file of a killed writer shows what is damaged or missing at the end."""
    wal = store_path.with_name(f"{store_path.name}-wal")
    for i in range(1, 4):
        store.append(series, make_epoch(i))
    data, step = frames(wal)
    assert read_wal_tail(wal) == SOUND
    wal.write_bytes(data[: 24 + 2 * step])
    assert read_wal_tail(wal)[0] == 1
    data[-5] ^= 1
    wal.write_bytes(data)
    assert read_wal_tail(wal) == (1, False)
    wal.with_name(f"{store_path.name}-shm").unlink()
    assert read_wal_tail(wal) == (0, True)


@pytest.mark.slow
def test_a_store_that_is_being_written_is_not_damaged(store, series, store_path, make_epoch):
    wal = store_path.with_name(f"{store_path.name}-wal")
    enough = threading.Event()

    def write():
        for i in itertools.takewhile(lambda _: not enough.is_set(), itertools.count(1)):
            store.append(series, make_epoch(i))

    writer = threading.Thread(target=write)
    writer.start()
    try:
        tails = [read_wal_tail(wal) for _ in range(50)]
    finally:
        enough.set()
        writer.join()
    assert store.last_epoch(series) > 2
    assert not any(lost for lost, _ in tails)


def test_the_daemon_says_so_and_keeps_a_copy(crashed):
    wal = crashed.with_name(f"{crashed.name}-wal")
    data = bytearray(wal.read_bytes())
    data[len(data) // 2] ^= 16
    wal.write_bytes(data)
    with Store.open(crashed) as store:
        assert "-wal file" in store.examine().damaged[0]
    guard = StoreGuard(crashed)
    guard.flush()
    assert "its -wal file was damaged" in guard.status()["notice"]
    assert [e.kind for e in guard.store.events()] == ["wal_damaged"]
    (copy,) = crashed.parent.glob("*-wal-damaged-*")
    assert copy.read_bytes() == bytes(data)
    guard.close()
