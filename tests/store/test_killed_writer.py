"""A killed writer loses at most the current epoch; a full disk loses nothing stored before."""

from __future__ import annotations

import os
import resource
import signal

import numpy as np
import pytest

from tests.store.small import write_recording
from tests.store.test_kills import kill_one
from thermocald.errors import RecordingError, StoreError, StoreFullError
from thermocald.store.database.store import Store


def test_a_killed_writer_loses_at_most_the_epoch_in_hand(forker, store_path, head, field):
    with Store.open(store_path, "append", durable=False) as store:
        store.create_series(head, field)
    rng = np.random.default_rng(5)
    for _ in range(3):
        said = kill_one(forker, store_path, list, rng)
        with Store.open(store_path) as store:
            assert store.examine().damaged == ()
            series = store.find_series()
            last = store.last_epoch(series)
            assert last in (said, said + 1)  # committed, but perhaps not yet reported
            kept = [
                (s.epoch.number, s.epoch.observations.points[0, 0]) for s in store.epochs(series)
            ]
            assert kept == [(i, float(i)) for i in range(1, last + 1)]
            assert store.series_columns(series, ["c"])["c"].tolist() == list(range(1, last + 1))


@pytest.fixture
def small_disk():
    """Limit files to 400 kB, which acts on one process like a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


def fill(store, series, make_epoch, make_result) -> int:
    """Append until it fails; return the last epoch stored."""
    number = 0

    def append_for_ever():
        nonlocal number
        while number < 10_000:
            store.append(series, make_epoch(number + 1), make_result(number + 1))
            number += 1

    with pytest.raises(StoreFullError, match="was not stored: the disk") as caught:
        append_for_ever()
    assert f"epoch {number + 1} " in str(caught.value)
    return number


def test_a_full_disk(store_path, head, field, make_epoch, make_result, request):
    with Store.open(store_path, "append", durable=False) as store:
        series = store.create_series(head, field)
    request.getfixturevalue("small_disk")
    with Store.open(store_path, "append", durable=False) as store:
        last = fill(store, series, make_epoch, make_result)
        assert store.last_epoch(series) == last > 10
        with pytest.raises(StoreError, match="disk"):
            store.append(series, make_epoch(last + 1), make_result(last + 1))
        assert store.last_epoch(series) == last


def test_a_recording_on_a_full_disk_leaves_nothing(tmp_path, head, field, make_epoch, small_disk):
    with pytest.raises(RecordingError, match="cannot be written"):
        write_recording(tmp_path / "r", head, field, map(make_epoch, range(10_000)))
    assert list(tmp_path.iterdir()) == []


def test_a_read_only_medium(store_path, head, field, make_epoch, make_result):
    """Without permission for helper files the store can still be read (as root: by mode)."""
    with Store.open(store_path, "append", durable=False) as store:
        series = store.create_series(head, field)
        store.append(series, make_epoch(1), make_result(1))
    store_path.chmod(0o444)
    store_path.parent.chmod(0o555)
    try:
        with Store.open(store_path) as store:
            assert store.last_epoch(series) == 1
        if os.geteuid() != 0:
            with pytest.raises(StoreError, match="read-only"):
                Store.open(store_path, "append")
    finally:
        store_path.parent.chmod(0o755)
