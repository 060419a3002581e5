"""A store in a read-only folder is read with its -wal file, and nothing is left behind."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

from tests.store.small import stored_numbers as numbers
from thermocald.errors import StoreError
from thermocald.store.database import file
from thermocald.store.database.store import Store


@pytest.fixture
def with_wal(killed):
    """A killed daemon's folder: five epochs in the store, nine more in its -wal file."""
    return killed(5, 14)


@pytest.fixture
def read_only(with_wal):
    """The same on a medium that is mounted read-only; without root, by mode."""
    folder = with_wal.parent
    if os.geteuid() != 0:
        with_wal.chmod(0o444)
        folder.chmod(0o555)
        yield with_wal
        folder.chmod(0o755)
        return
    tool = shutil.which("mount")
    command = [tool or "mount", "--bind", folder, folder]
    done = tool and subprocess.run(command, capture_output=True, check=False)
    if not done or done.returncode:
        pytest.skip("root, whom modes do not stop, cannot mount here")
    subprocess.run([tool, "-o", "remount,ro,bind", folder], check=True)
    yield with_wal
    subprocess.run(["umount", "-l", folder], check=False)


def test_what_is_in_the_wal_is_read_where_nothing_can_be_written(read_only, tmp_path):
    """Through a link too."""
    before = set(Path(tempfile.gettempdir()).glob("thermocald-*"))
    (tmp_path / "link.db").symlink_to(read_only)
    for path in (read_only, tmp_path / "link.db"):
        assert numbers(path) == list(range(1, 15))
        with pytest.raises(
            StoreError, match=r"cannot be written: (Read-only file system|Permission denied)"
        ):
            Store.open(path, "append")
    assert set(Path(tempfile.gettempdir()).glob("thermocald-*")) == before


def test_a_name_that_lacks_the_wal_is_not_read_as_whole(with_wal):
    """After a kill, a hard link shows the store without the -wal of the other name."""
    other = with_wal.with_name("other.db")
    os.link(with_wal, other)
    with pytest.raises(StoreError, match="another of its names"):
        Store.open(other)


def test_without_a_wal_it_is_read_in_place(with_wal, monkeypatch):
    with Store.open(with_wal, "append"):
        pass  # the -wal file is moved into the store
    monkeypatch.setattr(file.tempfile, "mkdtemp", None)
    file.open_copy(with_wal).close()


def test_a_file_that_is_being_written_is_not_copied_torn(with_wal, monkeypatch):
    copyfile = shutil.copyfile

    def written_meanwhile(source, target):
        copyfile(source, target)
        with Path(source).open("ab") as file:
            file.write(b"x")

    monkeypatch.setattr(file.shutil, "copyfile", written_meanwhile)
    with pytest.raises(StoreError, match="being written"):
        file.open_copy(with_wal)
