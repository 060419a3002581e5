"""A killed writer, with others beside it, loses at most the current epoch; a full disk nothing.

All processes are forked from one with all imports done: two minutes instead of an hour.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import textwrap
import time
from types import SimpleNamespace

import numpy as np
import pytest

from tests.daemon.conftest import make_recording
from tests.store.small import write_recording
from thermocald.errors import RecordingError, StoreError, StoreFullError
from thermocald.store.database import file
from thermocald.store.database.store import Store

# As a daemon stores epochs: through its guard; prints after each what it reported as stored.
DAEMON = textwrap.dedent(
    """
    import sys
    from pathlib import Path
    import numpy as np
    from thermocald.daemon.store_guard import StoreGuard
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.store.series import EpochResult

    guard = StoreGuard(Path(sys.argv[2]), durable=False)
    (series,) = guard.store.all_series()
    number = (guard.store.last_epoch(series) or 0) + 1
    while True:
        seen = Observations(np.arange(12), np.full((12, 2), float(number)), np.ones((12, 2)))
        result = EpochResult("ok", "", np.full(16, float(number)), np.eye(16))
        guard.store.append(series, Epoch(number, 10.0 * number, np.nan, observations=seen), result)
        print(number, flush=True)
        number += 1
    """
)
_KILLS = 38


@pytest.fixture
def beside(forker, store_path, tmp_path_factory):
    """(kind, number) → processes beside a writer that try to write too, or read."""
    recording = make_recording(tmp_path_factory.mktemp("kills") / "small", 6)

    def start(kind: str, k: int) -> list:
        other = store_path.with_name(f"other-{k}.db")
        if kind == "hard link":
            os.link(store_path, other)
        commands = {
            "alone": [],
            "hard link": [("replay", recording, "--store", other)],
            "second daemon": [("daemon", store_path)],
            "readers": [("check", store_path), ("backup", store_path, other)],
        }[kind]
        folder = store_path.parent / f"beside-{k}"
        folder.mkdir()
        script = DAEMON if kind == "second daemon" else ""
        return [forker.start(folder, *map(str, words), script=script) for words in commands]

    return start


def kill_one(forker, store, start, rng) -> int:
    """Start the writer, then `start`; kill it and return the last epoch that it reported."""
    (store.parent / "log.txt").unlink(missing_ok=True)
    writer = forker.start(store.parent, "daemon", str(store), script=DAEMON)

    def until(count: int) -> list[str]:
        deadline = time.monotonic() + 60.0
        while len(lines := (store.parent / "log.txt").read_text().split("\n")[:-1]) < count:
            assert writer.poll() is None, lines  # the last line may be cut off
            assert time.monotonic() < deadline, lines
            time.sleep(0.001)
        return lines

    until(1)
    others = start()
    until(1 + int(rng.integers(1, 30)))
    time.sleep(float(rng.uniform(0, 0.02)))
    writer.kill()
    writer.wait()
    for other in others:
        if rng.random() < 0.5:
            other.kill()
        try:
            other.wait(0.2)
        except subprocess.TimeoutExpired:  # a second daemon took over, as intended
            other.kill()
            other.wait()
    return int(until(1)[-1])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["alone", "hard link", "second daemon", "readers"])
def test_what_was_reported_is_kept(forker, store_path, head, field, beside, kind):
    """A quick one of the whole daemon is in daemon/test_faults."""
    with Store.open(store_path, "append", durable=False) as store:
        store.create_series(head, field)
    rng = np.random.default_rng(len(kind))
    reported, before = 0, 0
    for k in range(_KILLS):
        said = kill_one(forker, store_path, lambda k=k: beside(kind, k), rng)
        for name in store_path.parent.glob("other-*.db"):
            name.unlink()  # a daemon writes on beside a hard link; nothing else would
        reported += said - before
        with Store.open(store_path) as store:
            assert store.examine().damaged == ()
            series = next(s for s in store.all_series() if s.name == head.series)
            kept = [
                (s.epoch.number, s.epoch.observations.points[0, 0]) for s in store.epochs(series)
            ]
            before = len(kept)
            assert kept == [(i, float(i)) for i in range(1, before + 1)]
            assert before >= said, f"{said - before} reported epochs are missing"
            if kind != "second daemon":
                assert before <= said + 1  # committed, but perhaps not yet reported
            # the others were refused, or wrote after the kill into another series
            assert len(store.all_series()) <= 2
            values = store.series_columns(series, ["c"])["c"].tolist()
            assert values == [float(number) for number in range(1, before + 1)]
    assert reported > _KILLS


@pytest.fixture
def small_disk():
    """Limit files to 400 kB, which acts on one process like a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


def test_a_full_disk(store, series, make_epoch, make_result, small_disk):
    def append(number):
        store.append(series, make_epoch(number), make_result(number))

    with pytest.raises(StoreFullError, match="was not stored: the disk") as caught:
        list(map(append, range(1, 10_000)))
    last = store.last_epoch(series)
    assert last > 10
    assert f"epoch {last + 1} " in str(caught.value)
    with pytest.raises(StoreError, match="disk"):
        append(last + 1)
    assert store.last_epoch(series) == last


def test_the_wal_file_takes_a_quarter_of_a_small_disk(
    store_path, head, field, make_epoch, make_result, monkeypatch
):
    """It filled a disk of 4 MB with 115 epochs, of which 800 find room."""
    monkeypatch.setattr(file.shutil, "disk_usage", lambda _: SimpleNamespace(free=1_000_000))
    with Store.open(store_path, "append", durable=False) as store:
        series = store.create_series(head, field)
        for number in range(1, 50):
            store.append(series, make_epoch(number), make_result(number))
            assert file.helper(store_path, "wal").stat().st_size < 350_000


def test_a_recording_on_a_full_disk_leaves_nothing(tmp_path, head, field, make_epoch, small_disk):
    with pytest.raises(RecordingError, match="cannot be written"):
        write_recording(tmp_path / "r", head, field, map(make_epoch, range(10_000)))
    assert list(tmp_path.iterdir()) == []
