"""A killed writer loses at most the current epoch; a full disk loses nothing kept before."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest

from thermocald.errors import StoreError, StoreFullError
from thermocald.store.database.store import Store

# Appends for ever, and says after each commit what it has committed.
WRITER = textwrap.dedent(
    """
    import sys
    from pathlib import Path
    import numpy as np
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.store.database.store import Store
    from thermocald.store.series import EpochResult

    with Store.open(Path(sys.argv[1]), "append", durable=False) as store:
        series = store.find_series()
        number = (store.last_epoch(series) or 0) + 1
        while True:
            seen = Observations(np.arange(12), np.full((12, 2), float(number)), np.ones((12, 2)))
            result = EpochResult("ok", "", np.full(16, float(number)), np.eye(16))
            store.append(series, Epoch(number, 10.0 * number, np.nan, observations=seen), result)
            print(number, flush=True)
            number += 1
    """
)


def kill_after(forker, path, epochs: int, delay_s: float) -> int:
    """Run a writer, kill -9 it a little after some epochs; what it said it had committed."""
    log = path.parent / "said.txt"
    log.unlink(missing_ok=True)
    process = forker.start(path.parent, str(path), script=WRITER, log=log.name)
    deadline = time.monotonic() + 60
    while log.read_text().count("\n") < epochs:
        assert process.poll() is None, log.read_text()
        assert time.monotonic() < deadline
        time.sleep(0.001)
    time.sleep(delay_s)
    process.kill()
    process.wait()
    return int(log.read_text().split("\n")[-2])  # what follows the last line end is half a line


def test_a_killed_writer_loses_at_most_the_epoch_in_hand(forker, store_path, head, field):
    with Store.open(store_path, "append", durable=False) as store:
        store.create_series(head, field)
    rng = np.random.default_rng(5)
    for _ in range(6):
        said = kill_after(forker, store_path, int(rng.integers(1, 30)), float(rng.uniform(0, 0.02)))
        with Store.open(store_path) as store:
            assert store.examine().damaged == ()
            series = store.find_series()
            last = store.last_epoch(series)
            assert last in (said, said + 1)  # committed, and perhaps not yet said
            kept = [
                (s.epoch.number, s.epoch.observations.points[0, 0]) for s in store.epochs(series)
            ]
            assert kept == [(i, float(i)) for i in range(1, last + 1)]
            assert store.series_columns(series, ["c"])["c"].tolist() == list(range(1, last + 1))


@pytest.fixture
def small_disk():
    """Files may not grow beyond 400 kB: what a full disk looks like to one process."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


def fill(store, series, make_epoch, make_result) -> int:
    """Append until it fails; the last epoch that was kept."""
    number = 0

    def append_for_ever():
        nonlocal number
        while number < 10_000:
            store.append(series, make_epoch(number + 1), make_result(number + 1))
            number += 1

    with pytest.raises(StoreFullError, match="was not kept: the disk") as caught:
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


def test_space_again_after_a_full_disk(store_path, head, field, make_epoch, make_result):
    """By SQLite's own bound, which gives the error of a full disk."""
    with Store.open(store_path, "append", durable=False) as store:
        series = store.create_series(head, field)
        store._db.execute("PRAGMA max_page_count = 60")
        last = fill(store, series, make_epoch, make_result)
        store._db.execute("PRAGMA max_page_count = 100000")
        for number in range(last + 1, last + 30):
            store.append(series, make_epoch(number), make_result(number))
        assert store.examine().damaged == ()
        found = store.series_columns(series, ["c"])["c"]
        assert found.tolist() == [make_result(i).values[0] for i in range(1, last + 30)]


def test_a_recording_on_a_full_disk_leaves_nothing(tmp_path, head, field, make_epoch, small_disk):
    from thermocald.errors import RecordingError
    from thermocald.store.recording.reader import write_recording

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


# On a file system of 2 MB with a filler of 0.6 MB: fill the store, remove the filler, go on.
FULL = textwrap.dedent(
    """
    import sys
    from pathlib import Path
    import numpy as np
    from thermocald.epoch import Epoch
    from thermocald.errors import StoreFullError
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.store.database.store import Store
    from thermocald.store.recording.head import CameraSpec, Head
    from thermocald.store.series import EpochResult

    disk = Path(sys.argv[1])
    (disk / "filler").write_bytes(bytes(600_000))
    points = np.random.default_rng(1).uniform(size=(50, 3))
    field = TestField.build([str(i) for i in range(50)], points)
    head = Head("a", "M1", 1.0, CameraSpec("c", Sensor(99, 99, 0.001)))
    number = 0

    def append():
        global number
        seen = Observations(np.arange(50), np.full((50, 2), 1.0 + number), np.ones((50, 2)))
        result = EpochResult("ok", "", np.full(16, 1.0 + number), np.eye(16))
        store.append(series, Epoch(number + 1, 10.0 * number, np.nan, observations=seen), result)
        number += 1

    with Store.open(disk / "store.db", "append") as store:
        series = store.create_series(head, field)
        try:
            while True:
                append()
        except StoreFullError as error:
            print(error)
        full = number
        (disk / "filler").unlink()
        for _ in range(20):
            append()
    with Store.open(disk / "store.db") as store:
        assert store.examine().damaged == ()
        kept = store.series_columns(store.find_series(), ["c"])["c"].tolist()
    print(full, kept == [float(i) for i in range(1, full + 21)])
    """
)


def test_a_file_system_without_room(tmp_path):
    """A real ENOSPC, on a tmpfs in a mount namespace of its own."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = f'mount -t tmpfs -o size=2m tmpfs \'{disk}\' && exec "$0" "$@"'
    namespace = ["unshare", "-rm", "sh", "-c", mount]
    if not shutil.which("unshare") or subprocess.run([*namespace, "true"], check=False).returncode:
        pytest.skip("no file system can be mounted here: unshare -rm is not permitted")
    command = [*namespace, sys.executable, "-c", FULL, str(disk)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    message, verdict = done.stdout.splitlines()
    full, sound = verdict.split()
    assert f"epoch {int(full) + 1} of series 'M1' was not kept: the disk is full" in message
    assert int(full) > 20
    assert sound == "True"
