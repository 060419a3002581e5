"""Damage on a card is never returned as a right value; what a crash cut off is no damage."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from tests.commands import call
from tests.store.small import change, stored_numbers
from thermocald.daemon.store_guard import StoreGuard
from thermocald.errors import StoreError, ThermocaldError
from thermocald.store.archive import archive_store, back_up
from thermocald.store.database import columns, file
from thermocald.store.database.file import helper, read_wal_tail
from thermocald.store.database.store import Store
from thermocald.store.logger.options import LogOptions
from thermocald.store.logger.photographs import find_photographs
from thermocald.store.logger.temperatures import read_log
from thermocald.store.recording.head import read_head
from thermocald.store.series import Event
from thermocald.store.sources import open_source

NAMES = ["epoch", "frame_time", "c", "sd_x0", "status", "temperature", "blur"]


@pytest.fixture
def whole(store, series, make_epoch, make_result, monkeypatch) -> bytes:
    """A store with chunks, a later calibration and events, as bytes."""
    monkeypatch.setattr(columns, "CHUNK", 16)
    for i in range(1, 37):
        store.append(series, make_epoch(i), make_result(i), extra={"blur": 0.5 * i})
    store.amend(series, 7, make_result(70))
    store.add_event(Event(1.6e9, "knock", "somebody came"))
    store.close()
    return store.path.read_bytes()


def content(path) -> tuple[dict, list, list]:
    """Return all that a reader gets: columns, epochs, events."""
    with Store.open(path) as store:
        (series,) = store.all_series()
        read = store.series_columns(series, NAMES)
        epochs = [
            (s.epoch.number, s.epoch.frame_time, s.result.values.tolist(), s.revision,
             s.result.covariance.tolist(), s.epoch.observations.points.tolist(), s.result.status)
            for s in store.epochs(series)
        ]  # fmt: skip
        events = [e.text for e in store.events()]
        about = (series.head, series.identity, series.testfield.points.tolist())
    return {name: list(map(str, v)) for name, v in read.items()}, epochs, [events, about]


def test_a_flipped_bit_is_never_given_out(whole, store_path, caplog):
    truth = content(store_path)
    rng = np.random.default_rng(17)
    silent, unseen = [], []
    for _ in range(50):
        at, bit = int(rng.integers(len(whole))), int(rng.integers(8))
        data = bytearray(whole)
        data[at] ^= 1 << bit
        store_path.write_bytes(data)
        caplog.clear()
        try:
            found = content(store_path)
        except ThermocaldError:
            found = None
        if found is not None and found != truth and not caplog.messages:
            silent.append(at)
        try:
            with Store.open(store_path) as store:
                examined = store.examine()
        except ThermocaldError:
            continue
        if found != truth and not (examined.damaged or examined.gaps):
            unseen.append((at, bit, found is None))
    assert (silent, unseen) == ([], [])


def test_a_damaged_row_does_not_stop_new_ones(whole, store_path, make_epoch, make_result):
    change(store_path, "UPDATE epoch SET x0 = x0 + 1e-9 WHERE number = 36")
    with Store.open(store_path, "append", durable=False) as store:
        (series,) = store.all_series()
        for i in range(37, 56):
            store.append(series, make_epoch(i), make_result(i))
        assert store.last_epoch(series) == 55
        assert store.examine().damaged == ("rpi/M1, epoch 36",)
        kept = store.epochs(series)
        assert [next(kept).epoch.number for _ in range(35)] == list(range(1, 36))
        with pytest.raises(StoreError, match="epoch 36 is damaged"):
            next(kept)


@pytest.mark.parametrize("statement", [
    "DELETE FROM series", "DELETE FROM testfield", "UPDATE epoch SET number = x'ff' WHERE id = 2",
])  # fmt: skip
def test_a_store_whose_series_are_gone_is_not_empty(whole, store_path, statement):
    change(store_path, statement)
    with Store.open(store_path) as store, pytest.raises(StoreError, match="is damaged"):
        list(map(store.last_epoch, store.all_series()))


def test_missing_epochs_are_named(whole, store_path, caplog):
    change(
        store_path,
        "DELETE FROM epoch WHERE number IN (3, 10, 11, 12)",
        "DELETE FROM detail WHERE id / 1024 NOT IN (SELECT id FROM epoch)",
    )
    with Store.open(store_path) as store:
        found = store.examine()
        assert len(list(store.epochs(store.find_series()))) == 32
    assert "lacks 4 epochs of series M1" in caplog.text
    assert [gap.text for gap in found.gaps] == [
        "rpi/M1: epoch 3 is missing", "rpi/M1: epochs 10 to 12 are missing (3)"
    ]  # fmt: skip
    assert found.damaged == ()


SOUND = (0, False)  # lost transactions, unfinished


@pytest.fixture
def crashed(store, series, make_epoch, make_result, tmp_path):
    """Store and -wal file of a writer that was killed after nine epochs."""
    (tmp_path / "killed").mkdir()
    store.checkpoint()
    for i in range(1, 10):
        store.append(series, make_epoch(i), make_result(i))
    for path in (store.path, helper(store.path, "wal")):
        shutil.copy(path, tmp_path / "killed" / path.name)
    return tmp_path / "killed" / store.path.name


def epochs(path) -> list[int]:
    with Store.open(path) as store:
        return [s.epoch.number for s in store.epochs(store.find_series())]


def frames(wal) -> tuple[bytearray, int]:
    """(the file's bytes, the length of a frame)."""
    data = bytearray(wal.read_bytes())
    return data, 24 + int.from_bytes(data[8:12], "big")


def test_what_a_crash_cut_off_is_no_damage(crashed):
    wal = helper(crashed, "wal")
    whole = wal.read_bytes()
    assert read_wal_tail(wal) == SOUND
    for size in (0, 20, 32, 33, len(whole) // 2, len(whole) - 1):
        wal.write_bytes(whole[:size])
        assert read_wal_tail(wal) == (0, size > 32)
    # in a -wal file that was restarted, the rest of the frame is from before
    wal.write_bytes(whole)
    data, step = frames(wal)
    data[-step // 2 :] = bytes(step // 2)
    wal.write_bytes(data)
    assert read_wal_tail(wal) == (0, True)
    with Store.open(crashed) as store:
        found = store.examine()
    assert (found.damaged, found.unfinished) == ((), True)
    assert "the last write was cut off" in call("check", crashed).stdout
    with closing(StoreGuard(crashed)) as guard:
        guard.flush()
        assert guard.status()["notice"] == ""
        assert [e.kind for e in guard.store.events()] == ["wal_unfinished"]
    assert epochs(crashed) == list(range(1, 9))


def test_every_flip_that_loses_epochs_is_reported(crashed):
    wal = helper(crashed, "wal")
    whole, database = wal.read_bytes(), crashed.read_bytes()
    rng = np.random.default_rng(3)
    for _ in range(15):
        data = bytearray(whole)
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        crashed.write_bytes(database)
        wal.write_bytes(data)
        helper(crashed, "shm").unlink(missing_ok=True)
        lost, unfinished = read_wal_tail(wal)
        kept = epochs(crashed)
        assert (kept == list(range(1, 10))) == ((lost, unfinished) == SOUND)
        assert not unfinished or kept == list(range(1, 9))


def test_what_the_index_counts_was_committed(store, series, store_path, make_epoch):
    """The -shm file of a killed writer shows what is damaged or missing at the end."""
    wal = helper(store_path, "wal")
    for i in range(1, 4):
        store.append(series, make_epoch(i))
    data, step = frames(wal)
    assert read_wal_tail(wal) == SOUND
    wal.write_bytes(data[: 24 + 2 * step])
    assert read_wal_tail(wal)[0] == 1
    data[-5] ^= 1
    wal.write_bytes(data)
    assert read_wal_tail(wal) == (1, False)
    helper(store_path, "shm").unlink()
    assert read_wal_tail(wal) == (0, True)


def test_the_daemon_says_so_and_keeps_a_copy(crashed):
    data, _ = frames(helper(crashed, "wal"))
    data[len(data) // 2] ^= 16
    helper(crashed, "wal").write_bytes(data)
    with Store.open(crashed) as store:
        assert "-wal file" in store.examine().damaged[0]
    with closing(StoreGuard(crashed)) as guard:
        guard.flush()
        assert "its -wal file was damaged" in guard.status()["notice"]
        assert [e.kind for e in guard.store.events()] == ["wal_damaged"]
    (copy,) = crashed.parent.glob("*-wal-damaged-*")
    assert copy.read_bytes() == bytes(data)


@pytest.fixture
def read_only(crashed, request):
    """The same on a medium that is mounted read-only; without root, by mode."""
    folder = crashed.parent
    if os.geteuid() != 0:
        crashed.chmod(0o444)
        folder.chmod(0o555)
        yield crashed
        folder.chmod(0o755)
        return
    mount = request.getfixturevalue("mount")
    mount("--bind", folder, folder)
    mount("-o", "remount,ro,bind", folder)
    yield crashed


def test_what_is_in_the_wal_is_read_where_nothing_can_be_written(read_only, tmp_path):
    """Through a link too; nothing is left behind."""
    before = set(Path(tempfile.gettempdir()).glob("thermocald-*"))
    (tmp_path / "link.db").symlink_to(read_only)
    for path in (read_only, tmp_path / "link.db"):
        assert stored_numbers(path) == list(range(1, 10))
        refused = r"cannot be written: (Read-only file system|Permission denied)"
        with pytest.raises(StoreError, match=refused):
            Store.open(path, "append")
    assert set(Path(tempfile.gettempdir()).glob("thermocald-*")) == before


@pytest.mark.parametrize("use", [
    read_head, Store.open, open_source, lambda path: read_log(path, LogOptions()),
    lambda path: find_photographs([path]), lambda path: back_up(path, path),
    lambda path: back_up(next(path.parents[1].glob("*.db")), path),
    lambda path: archive_store(
        next(path.parents[1].glob("*.db")), path, None, None, False, True, print),
])  # fmt: skip
def test_a_closed_folder_is_said_in_one_line(crashed, monkeypatch, use):
    """It was a PermissionError; root may look into every folder, so the system's answer is made."""
    closed, stat = crashed.parent / "closed" / "file.csv", os.stat

    def refused(path, *arguments, **options):
        if not isinstance(path, int) and closed.parent in Path(path).parents:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return stat(path, *arguments, **options)

    closed.parent.mkdir()
    monkeypatch.setattr(os, "stat", refused)
    with pytest.raises(ThermocaldError, match=r"closed\S*: cannot be (read|written): Permission"):
        use(closed)


def test_a_name_that_lacks_the_wal_is_not_read_as_whole(crashed):
    """After a kill, a hard link shows the store without the -wal of the other name."""
    os.link(crashed, crashed.with_name("other.db"))
    with pytest.raises(StoreError, match="another of its names"):
        Store.open(crashed.with_name("other.db"))


def test_a_copy_is_made_of_what_has_a_wal_and_is_not_torn(crashed, monkeypatch):
    copyfile = shutil.copyfile

    def written_meanwhile(source, target):
        copyfile(source, target)
        with Path(source).open("ab") as file:
            file.write(b"x")

    with monkeypatch.context() as busy:
        busy.setattr(file.shutil, "copyfile", written_meanwhile)
        with pytest.raises(StoreError, match="being written"):
            file.open_copy(crashed)
    with Store.open(crashed, "append"):
        pass  # the -wal file is moved into the store
    monkeypatch.setattr(file.tempfile, "mkdtemp", None)
    file.open_copy(crashed).close()
