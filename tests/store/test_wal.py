"""A damaged -wal file is reported as damaged; one cut off by a crash, or read-only, is read."""

from __future__ import annotations

import os
import shutil
import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from tests.commands import call
from tests.daemon.conftest import tool
from tests.store.small import stored_numbers
from thermocald.daemon.store_guard import StoreGuard
from thermocald.errors import StoreError
from thermocald.store.database import file
from thermocald.store.database.file import helper, read_wal_tail
from thermocald.store.database.store import Store

SOUND = (0, False)  # lost transactions, unfinished


@pytest.fixture
def crashed(killed):
    """Store and -wal file of a writer that was killed after nine epochs."""
    return killed(0, 9)


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
def read_only(crashed):
    """The same on a medium that is mounted read-only; without root, by mode."""
    folder = crashed.parent
    if os.geteuid() != 0:
        crashed.chmod(0o444)
        folder.chmod(0o555)
        yield crashed
        folder.chmod(0o755)
        return
    if tool("mount", "--bind", folder, folder).returncode:
        pytest.skip("root, whom modes do not stop, cannot mount here")
    assert tool("mount", "-o", "remount,ro,bind", folder).returncode == 0
    yield crashed
    tool("umount", "-l", folder)


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
