"""A store has one writer, under any of its names, and loses none of its epochs."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import time
from functools import partial

import pytest
import yaml

from tests.commands import call
from tests.daemon.conftest import make_recording
from tests.store.small import create_small_series, small_epoch, small_result, stored_numbers
from thermocald.daemon.store_guard import StoreGuard
from thermocald.errors import StoreError
from thermocald.store import schema
from thermocald.store.database.store import Store


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return make_recording(tmp_path_factory.mktemp("one-writer") / "small", 12)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "kept.db"


@pytest.fixture
def daemon(path):
    """A daemon's store with epochs in its -wal file."""
    guard = StoreGuard(path, durable=False)
    series = create_small_series(guard.store, "M0")
    for number in range(1, 24):
        guard.store.append(series, small_epoch(number))
    yield guard
    guard.close()


def another_name(path, kind):
    """Return another name of the store."""
    if kind == "folder's link":
        (path.parent / "folder").symlink_to(path.parent, target_is_directory=True)
        return path.parent / "folder" / path.name
    other = path.with_name("other.db")
    if kind == "hard link in another folder":
        other = path.parent / "snapshot" / path.name
        other.parent.mkdir()
    (os.link if kind.startswith("hard") else os.symlink)(path, other)
    return other


KINDS = ["link", "hard link", "hard link in another folder", "folder's link"]


@pytest.mark.parametrize("kind", KINDS)
def test_replay_does_not_write_beside_a_daemon(daemon, path, tmp_path, recording, kind, forker):
    other = another_name(path, kind)
    words = ["replay", str(recording), "--store", str(other)]
    if kind == "hard link in another folder":  # in a process of its own, like a second daemon
        status = forker.start(tmp_path, *words).wait()
        said = (tmp_path / "log.txt").read_text()
    else:
        done = call(*words, folder=tmp_path)
        status, said = done.returncode, done.stderr
    assert status == 1
    assert "another thermocald process writes to it" in said
    assert "Traceback" not in said
    daemon.close()
    for name in {path, other} - {tmp_path / "other.db"}:
        assert stored_numbers(name) == list(range(1, 24))


def test_every_command_that_writes_takes_the_lock(daemon, path, tmp_path, recording):
    document = {"store": {"path": str(path)}, "thermometers": [{"name": "t", "driver": "mock"}]}
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(document))
    for words in (
        ["replay", recording, "--store", path],
        ["run", "--recording", recording, "--store", path, "--fast"],
        ["run", "--mock", "--store", path, "--epochs", "2"],
        ["archive", "--config", tmp_path / "c.yaml", "--to", tmp_path / "a", "--retention"],
    ):
        done = call(*words, folder=tmp_path)
        assert done.returncode == 1
        assert "another thermocald process writes to it" in done.stderr
    with Store.open(tmp_path / "t.db", "append"), pytest.raises(StoreError, match="another"):
        StoreGuard(tmp_path / "t.db")


@pytest.mark.parametrize("command", ["check", "archive", "backup"])
def test_what_a_hard_link_lacks_is_not_called_sound(daemon, path, tmp_path, command):
    os.link(path, tmp_path / "other.db")
    more = {"archive": ["--to", tmp_path / "a"], "backup": [tmp_path / "b.db"]}.get(command, [])
    done = call(command, tmp_path / "other.db", *more, folder=tmp_path)
    assert done.returncode == 1
    assert "under another of its names" in done.stderr
    assert call(command, path, *more, folder=tmp_path).returncode == 0


@pytest.mark.slow
def test_a_killed_backup_leaves_no_copy_or_a_whole_one(path, tmp_path, forker):
    numbers = list(range(1, 4001))
    with Store.open(path, "append", durable=False) as store:
        series = create_small_series(store)
        for number in numbers:
            store.append(series, small_epoch(number), small_result(number))
    copies = [tmp_path / f"{k}.db" for k in range(20)]
    for k, copy in enumerate(copies):
        process = forker.start(tmp_path, "backup", str(path), str(copy))
        time.sleep(0.04 * k)
        process.kill()
        process.wait()
    whole = [copy for copy in copies if copy.exists()]
    assert len(whole) < len(copies)
    for copy in (path, *whole):
        assert stored_numbers(copy) == numbers
    assert call("backup", path, copies[0]).returncode == 0


def test_a_store_of_two_names_is_not_written_where_nobody_waits(daemon, path, tmp_path, recording):
    daemon.close()
    os.link(path, tmp_path / "other.db")
    done = call("replay", recording, "--store", tmp_path / "other.db", folder=tmp_path)
    assert done.returncode == 1
    assert "2 names (hard links)" in done.stderr
    # a daemon must not stop because of a user's backup: it reports it and goes on
    with contextlib.closing(StoreGuard(path)) as guard:
        assert "2 names" in guard.status()["notice"]


@pytest.mark.parametrize("kind", ["null", "pipe", "link to null"])
def test_a_device_is_no_store_and_stays(tmp_path, recording, kind):
    """Regression: as root, the node of the null device was removed as an empty file."""
    place = node = tmp_path / "node"
    if kind == "pipe":
        os.mkfifo(node)
    else:
        try:
            os.mknod(node, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
        except PermissionError:
            pytest.skip("no device can be made here")
    if kind.startswith("link"):
        place = tmp_path / "link"
        place.symlink_to(node)
    before = node.lstat().st_ino, node.lstat().st_mode
    for words in (["replay", recording], ["run", "--recording", recording]):
        done = call(*words, "--store", place)
        assert done.returncode in (1, 2)
        assert "is a device or a pipe; a store must be a regular file" in done.stderr
        assert (node.lstat().st_ino, node.lstat().st_mode) == before
    assert {p.name for p in tmp_path.iterdir()} <= {"node", "link", "node.live", "link.live"}


def test_a_place_where_no_store_can_be_made_stays_as_it_was(tmp_path, monkeypatch):
    """The owner and mode of an empty file may have been chosen on purpose."""
    (tmp_path / "t.db").touch()
    (tmp_path / "t.db-wal").mkdir()  # no store can be opened beside it
    with pytest.raises(StoreError):
        StoreGuard(tmp_path / "t.db")

    def flock(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    with monkeypatch.context() as without:
        without.setattr("fcntl.flock", flock)
        with pytest.raises(StoreError, match=r"s\.db: its folder cannot lock files \(No locks"):
            Store.open(tmp_path / "s.db", "append")
    monkeypatch.setattr(schema, "FILE_STEPS", (("CREATE TABLE a (b)", "no SQL"),))  # a full disk
    for open_new in (StoreGuard, partial(Store.open, mode="append")):
        with pytest.raises(StoreError, match="cannot be opened"):
            open_new(tmp_path / "s.db")
    assert {path.name for path in tmp_path.iterdir()} == {"t.db", "t.db-wal"}
