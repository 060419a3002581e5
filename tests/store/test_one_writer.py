"""A store has one writer, under any of its names, and loses none of its epochs."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import socket
import stat

import pytest
import yaml

from tests.commands import call
from tests.daemon.conftest import make_recording
from tests.store.small import create_small_series, small_epoch, stored_numbers
from thermocald.daemon.store_guard import StoreGuard
from thermocald.errors import StoreError
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


def as_called(path, tmp_path, kind):
    """Return another name of the store."""
    other = tmp_path / "other.db"
    if kind == "same":
        return path
    if kind == "way round":
        return tmp_path / "../" / tmp_path.name / "kept.db"
    if kind == "folder's link":
        (tmp_path / "folder").symlink_to(tmp_path, target_is_directory=True)
        return tmp_path / "folder/kept.db"
    if kind == "link to link":
        other.symlink_to(path)
        path, other = other, tmp_path / "between.db"
    if kind == "hard link in another folder":
        other = tmp_path / "snapshot/kept.db"
        other.parent.mkdir()
    (os.link if kind.startswith("hard") else os.symlink)(path, other)
    return other


KINDS = [
    "same", "link", "link to link", "hard link", "hard link in another folder", "folder's link",
    "way round",
]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_replay_does_not_write_beside_a_daemon(daemon, path, tmp_path, recording, kind, forker):
    other = as_called(path, tmp_path, kind)
    words = ["replay", recording, "--store", other]
    if kind == "hard link in another folder":  # in a process of its own, like a second daemon
        status = forker.start(tmp_path, *map(str, words)).wait()
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


WRITERS = {
    "run": ["run", "--recording", "{recording}", "--store", "{store}", "--fast"],
    "run of devices": ["run", "--mock", "--store", "{store}", "--epochs", "2"],
    "retention": ["archive", "--config", "{config}", "--to", "{folder}/a", "--retention"],
}


@pytest.mark.parametrize("writer", WRITERS)
def test_every_command_that_writes_takes_the_lock(daemon, path, tmp_path, recording, writer):
    places = {
        "recording": recording, "store": path, "folder": tmp_path, "config": tmp_path / "c.yaml",
    }  # fmt: skip
    document = {"store": {"path": str(path)}, "thermometers": [{"name": "t", "driver": "mock"}]}
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(document))
    arguments = [part.format(**places) for part in WRITERS[writer]]
    done = call(*arguments, folder=tmp_path)
    assert done.returncode == 1
    assert "another thermocald process writes to it" in done.stderr


def test_a_command_that_writes_keeps_a_daemon_away(tmp_path):
    with Store.open(tmp_path / "t.db", "append"), pytest.raises(StoreError, match="another"):
        StoreGuard(tmp_path / "t.db")
    StoreGuard(tmp_path / "t.db").close()


@pytest.mark.parametrize("command", ["check", "archive", "backup"])
def test_what_a_hard_link_lacks_is_not_called_sound(daemon, path, tmp_path, command):
    os.link(path, tmp_path / "other.db")
    more = {"archive": ["--to", tmp_path / "a"], "backup": [tmp_path / "b.db"]}.get(command, [])
    done = call(command, tmp_path / "other.db", *more, folder=tmp_path)
    assert done.returncode == 1
    assert "under another of its names" in done.stderr
    assert call(command, path, *more, folder=tmp_path).returncode == 0


def test_a_store_of_two_names_is_not_written_where_nobody_waits(daemon, path, tmp_path, recording):
    daemon.close()
    os.link(path, tmp_path / "other.db")
    done = call("replay", recording, "--store", tmp_path / "other.db", folder=tmp_path)
    assert done.returncode == 1
    assert "2 names (hard links)" in done.stderr
    # a daemon must not stop because of a user's backup: it reports it and goes on
    guard = StoreGuard(path)
    assert "2 names" in guard.status()["notice"]
    guard.close()


def test_a_copy_is_a_store_of_its_own(daemon, path, tmp_path, recording):
    daemon.store.checkpoint()
    shutil.copyfile(path, tmp_path / "copy.db")
    assert call("replay", recording, "--store", tmp_path / "copy.db").returncode == 0
    with Store.open(tmp_path / "copy.db") as store:
        assert len(store.all_series()) == 2


@pytest.mark.parametrize("kind", ["null", "full", "pipe", "socket", "link to null"])
@pytest.mark.parametrize("command", ["replay", "run"])
def test_a_device_is_no_store_and_stays(tmp_path, recording, kind, command):
    """Regression: as root, the node of the null device was removed as an empty file."""
    place = node = tmp_path / "node"
    if kind == "pipe":
        os.mkfifo(node)
    elif kind == "socket":
        with contextlib.closing(socket.socket(socket.AF_UNIX)) as server:
            server.bind(str(node))
    else:
        try:
            os.mknod(node, 0o666 | stat.S_IFCHR, os.makedev(1, 7 if kind == "full" else 3))
        except PermissionError:
            pytest.skip("no device can be made here")
        if kind.startswith("link"):
            place = tmp_path / "link"
            place.symlink_to(node)
    before = node.lstat().st_ino, node.lstat().st_mode
    words = ["replay", recording] if command == "replay" else ["run", "--recording", recording]
    done = call(*words, "--store", place)
    assert done.returncode in (1, 2)
    assert "is a device or a pipe; a store must be a regular file" in done.stderr
    assert (node.lstat().st_ino, node.lstat().st_mode) == before
    assert {p.name for p in tmp_path.iterdir()} <= {"node", "link", "node.live", "link.live"}


def test_an_empty_file_that_was_there_stays_where_no_store_can_be_made(tmp_path):
    """Its owner and mode may have been chosen on purpose."""
    path = tmp_path / "t.db"
    path.touch()
    (tmp_path / "t.db-wal").mkdir()  # no store can be opened beside it
    with pytest.raises(StoreError):
        StoreGuard(path)
    assert path.exists()


def test_a_folder_without_locks_is_named_and_gets_no_file(tmp_path, monkeypatch):
    def flock(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", flock)
    with pytest.raises(StoreError, match=r"t\.db: its folder cannot lock files \(No locks avail"):
        Store.open(tmp_path / "t.db", "append")
    assert list(tmp_path.iterdir()) == []
