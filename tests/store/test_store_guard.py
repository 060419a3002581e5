"""The guard of a store whose disk has room for an event but for no row any more, or whose user may
have no more of it.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

from thermocald.daemon.store_guard import Row, StoreGuard
from thermocald.store.database.store import Store
from thermocald.store.series import StoredSeries


def test_a_row_that_found_no_room_waits(tmp_path, head, field, make_epoch, make_result):
    """Found in the laboratory: an event still fitted into its page, so the row counted as bad."""
    guard = StoreGuard(tmp_path / "t.db", durable=False)
    series = guard.store.create_series(head, field)

    def keep(number):
        guard.append(Row(series, make_epoch(number), make_result(number), {}, True))

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
    stored = [epoch.epoch.number for epoch in guard.store.epochs(series)]
    assert stored == list(range(1, number + 2))
    guard.close()


USER = 65534
_Q_SETQUOTA = 0x80000800  # of a user


def run(*command: object) -> subprocess.CompletedProcess[str]:
    words = [str(word) for word in command]
    return subprocess.run(words, capture_output=True, text=True, check=False)


@pytest.fixture
def limited(tmp_path):
    """A folder on a disk where `USER` may have 4 MB; skips where there are no quotas.

    quotactl(2): a struct dqblk is nine numbers, first the limits in kB, last which are given.
    """
    image = tmp_path / "disk.img"
    image.write_bytes(bytes(40_000_000))
    if os.geteuid() or not all(map(shutil.which, ("mkfs.ext4", "mount"))):
        pytest.skip("needs root, mount and mkfs.ext4")
    folder = Path(tempfile.mkdtemp(prefix="thermocald-quota-"))  # into which every user may look
    folder.chmod(0o755)
    made = run("mkfs.ext4", "-qF", "-m", 0, "-O", "quota", image)
    if made.returncode or run("mount", "-o", "loop,usrquota", image, folder).returncode:
        folder.rmdir()
        pytest.skip("this kernel's file systems know no quotas")
    try:
        device = run("findmnt", "-no", "SOURCE", folder).stdout.strip()
        block = (ctypes.c_uint64 * 9)(4096, 4096, 0, 0, 0, 0, 0, 0, 1)
        library = ctypes.CDLL(None, use_errno=True)
        if library.quotactl(_Q_SETQUOTA, device.encode(), USER, ctypes.byref(block)):
            pytest.skip(f"no quota can be set: {os.strerror(ctypes.get_errno())}")
        folder.chmod(0o777)
        yield folder
    finally:
        run("umount", "-l", folder)
        folder.rmdir()


def test_a_quota_is_no_room_and_room_again(limited, head, field, make_epoch, make_result):
    """The disk has room that its user may not have; root has no quota, so another one writes."""
    path = limited / "thermocald.db"
    child = os.fork()
    if child == 0:
        failed = "it broke"
        try:
            os.setgroups([])
            os.setgid(USER)
            os.setuid(USER)
            failed = _keep_as_user(path, head, field, make_epoch, make_result)
        finally:
            with contextlib.suppress(OSError):
                (limited / "failed").write_text(failed)
            os._exit(0)
    os.waitpid(child, 0)
    assert (limited / "failed").read_text() == ""
    with Store.open(path) as store:
        assert [s.epoch.number for s in store.epochs(store.find_series())] == list(range(1, 13))


def _keep_as_user(path, head, field, make_epoch, make_result) -> str:
    """What was not as it must be, empty if all was."""
    guard = StoreGuard(path, durable=False)
    series = StoredSeries(0, head, field, "", {}, {}, 0.0)
    filler = path.with_name("filler")

    def keep(*numbers: int) -> tuple[str, int, int]:
        for number in numbers:
            guard.append(Row(series, make_epoch(number), make_result(number), {}, True))
        return guard.status()["state"], guard.waiting, guard.lost

    if (found := keep(1, 2, 3)) != ("ok", 0, 0):
        return f"with room: {found}"
    with contextlib.suppress(OSError), filler.open("ab", buffering=0) as file:
        while file.write(bytes(512)):
            pass
    if (free := shutil.disk_usage(path.parent).free) < 20_000_000:
        return f"the disk is full, not the quota: {free} bytes"
    found = keep(*range(4, 11))
    if found[0] != "out" or not found[1] or found[2]:
        return f"without: {found}, {guard.away}"
    filler.unlink()
    if (found := keep(11, 12)) != ("ok", 0, 0):
        return f"with room again: {found}"
    guard.close()
    return ""
