"""A damaged -wal file is told from one that a crash cut off."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from thermocald.daemon.store_guard import StoreGuard
from thermocald.store.database.store import Store
from thermocald.store.database.wal import lost_commits


@pytest.fixture
def crashed(store_path, field, head, make_epoch, make_result, tmp_path):
    """Store and -wal file of a writer that was killed after nine epochs."""
    (tmp_path / "k").mkdir()
    with Store.open(store_path, "append", durable=False) as store:
        series = store.create_series(head, field)
        store.checkpoint()
        for i in range(1, 10):
            store.append(series, make_epoch(i), make_result(i))
        for name in (store_path.name, f"{store_path.name}-wal"):
            shutil.copy(store_path.with_name(name), tmp_path / "k" / name)
    return tmp_path / "k" / store_path.name


def epochs(path) -> list[int]:
    with Store.open(path) as store:
        return [s.epoch.number for s in store.epochs(store.find_series())]


def test_what_a_crash_cut_off_is_no_damage(crashed):
    wal = crashed.with_name(f"{crashed.name}-wal")
    whole = wal.read_bytes()
    assert lost_commits(wal) == 0
    for size in (0, 20, 32, 33, len(whole) // 2, len(whole) - 1):
        wal.write_bytes(whole[:size])
        assert lost_commits(wal) == 0


def test_every_flip_that_loses_epochs_is_reported(crashed):
    wal = crashed.with_name(f"{crashed.name}-wal")
    whole, database = wal.read_bytes(), crashed.read_bytes()
    rng = np.random.default_rng(3)
    for _ in range(25):
        data = bytearray(whole)
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        crashed.write_bytes(database)
        wal.write_bytes(data)
        crashed.with_name(f"{crashed.name}-shm").unlink(missing_ok=True)
        lost = lost_commits(wal)
        assert (epochs(crashed) == list(range(1, 10))) == (lost == 0)


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
